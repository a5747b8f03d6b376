"""The flow in three states: on the map, permissive and restrictive, from kept Gaussians.

A network enters a picture of one state by nothing but the Gaussian that it puts there, so the few
numbers of these are kept, and no checkpoint is needed to draw.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, NamedTuple, Self

import torch
from matplotlib.figure import Figure
from pydantic import Field, model_validator
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl import constrain_env
from cnfp_torchrl.modules import ExactFlow, flow_head, make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import SUMMARY, RunFolder
from cnfp_torchrl.visual import FlowSnapshot, explain, take_snapshot
from cnfp_torchrl.visual.figures import flow_stages
from experiments.figures.banner import flow_banner
from experiments.paper.records import Kept, Text

ORDER = ["battery", "obstacle"]


class Place(NamedTuple):
    """A state of point navigation.

    Args:
        position: The position of the agent, in arena units.
        battery: The battery in percent.
        goal: The goal in arena units.
    """

    position: tuple[float, float]
    battery: int
    goal: tuple[float, float]


PLACES = {
    "flow": Place((0.34, -0.33), 28, (-0.55, 0.3)),
    "permissive": Place((0.62, 0.62), 100, (0.5, 0.5)),
    "restrictive": Place((-0.93, 0.19), 22, (0.5, 0.3)),
}
"""Chosen by hand: at a corner of the rectangle, far from everything, and between wall and station.

In the first and the last the battery reaches a station and no farther, and the goal is elsewhere.
"""


class Gaussian(Kept):
    """What a network puts into one state: location and scale, of two components each."""

    loc: tuple[float, float]
    scale: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]


class KeptPolicy(Kept):
    """The Gaussians that a network puts into `PLACES`.

    Args:
        source: Where they come from, in words.
        gaussians: One for each place, by its name.
    """

    source: Text
    gaussians: dict[str, Gaussian]

    @model_validator(mode="after")
    def _fit(self) -> Self:
        if sorted(self.gaussians) != sorted(PLACES):
            given = sorted(self.gaussians)
            raise ValueError(f"gaussians: expected {sorted(PLACES)}, given {given}")
        return self


UNTRAINED = KeptPolicy(
    source="a standard normal, in place of a network: no trained policy is kept",
    gaussians=dict.fromkeys(PLACES, Gaussian(loc=(0.0, 0.0), scale=(1.0, 1.0))),
)


class FixedGaussian(nn.Module):
    """The same location and scale in every state.

    Args:
        loc: The location, ``(d,)``.
        scale: The scale, ``(d,)``.
    """

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.loc, self.scale = loc, scale

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return location and scale for observations ``(*batch, n)``."""
        batch = observation.shape[:-1]
        return self.loc.expand(*batch, -1), self.scale.expand(*batch, -1)


def find_policy(path: Path, runs: Path) -> KeptPolicy:
    """Return the kept policy; else keep that of a finished run; else `UNTRAINED`.

    Args:
        path: The path of the kept policy.
        runs: The folder of runs; those of ``experiment=exact`` are in its folder ``exact``.

    Raises:
        ValueError: when what is there cannot be used, naming it.
        OSError: when it cannot be read.
    """
    if path.is_file():
        return KeptPolicy.read(path)
    for summary in sorted((runs / "exact").rglob(SUMMARY)):
        policy = policy_of(RunFolder.open(summary.parent))
        path.write_text(policy.model_dump_json(indent=1) + "\n", encoding="utf-8")
        return policy
    return UNTRAINED


@torch.no_grad()
def policy_of(folder: RunFolder) -> KeptPolicy:
    """Return what a finished run's network puts into `PLACES`.

    Raises:
        ValueError: when the run is not one of an exact flow, for which the pictures are drawn.
    """
    config = folder.load_config()
    env = build_environment(config, batch_size=[])
    actor = load_actor(folder, config, env)
    flow = flow_head(actor).flow
    if not isinstance(flow, ExactFlow):
        raise ValueError(
            f"run: expected one of the exact flow, given {type(flow).__name__} in "
            f"{folder.path}; train it with experiment=exact"
        )
    gaussians = {}
    for name, place in PLACES.items():
        state = actor(_reset(env, place))
        loc, scale = (tuple(state.get(key).tolist()) for key in ("loc", "scale"))
        gaussians[name] = Gaussian(loc=loc, scale=scale)
    source = (
        f"the network of the exact flow, seed {config.seed}, after "
        f"{folder.load_settings()['collector']['total_frames']:,} training steps"
    )
    return KeptPolicy(source=source, gaussians=gaussians)


def flow_figures(policy: KeptPolicy) -> dict[str, Figure]:
    """Return the flow on the map, and the permissive and the restrictive state."""
    flow, permissive, restrictive = (snapshot(policy, name) for name in PLACES)
    env = PointNavEnv()
    restrictive = restrictive.following_the_longest_path()
    return {
        "flow": flow_banner(flow, env),
        "permissive": flow_stages(permissive, env=env, title=_title("Permissive", permissive)),
        "restrictive": flow_stages(restrictive, env=env, title=_title("Restrictive", restrictive)),
    }


def snapshot(policy: KeptPolicy, name: str) -> FlowSnapshot:
    """Return the exact flow with the kept Gaussian of one of `PLACES`."""
    env = constrain_env(PointNavEnv(seed=0), BatteryGeometry(), ObstacleGeometry())
    kept = policy.gaussians[name]
    actor: SafeProbabilisticTensorDictSequential = make_constrained_actor(
        FixedGaussian(torch.tensor(kept.loc), torch.tensor(kept.scale)), env
    )
    return take_snapshot(actor, _reset(env, PLACES[name]))


def _reset(env: TransformedEnv, place: Place) -> TensorDictBase:
    return env.reset(position=place.position, battery=place.battery, goal=place.goal)


def _title(kind: str, drawn: FlowSnapshot) -> str:
    share = explain(drawn).share_allowed
    assert share is not None
    return f"{kind} state: {100 * share:.0f} % of the actions are allowed"
