"""Time what safe acting and training cost beside unsafe ones, line by line.

`python experiments/benchmarks/lines.py [--line NAME ...] [--quick] [--out FOLDER]` measures on one
thread, and each line anew in a minute or so:

- point-nav-step: point navigation's step, constrained beside plain, at several batch sizes;
- own-step: the same of a particle with a user's own ball and two half-spaces, and no safe action;
- tight-step: the same with a ball and a slanted half-space, of which one in 16 states is so tight
  that its anchor takes steps inwards;
- whole-path: network, distribution, environment, geometry and anchor, beside an unconstrained
  `TanhNormal` in the plain environment, of both;
- flow: constructing the exact flow, drawing and scoring, beside a `TanhNormal` that is constructed
  alike, with growth in batch, d and K;
- anchors, update, training: see `anchor_times.py` and `updates.py`.

Random problems come from one generator with a fixed seed (`problem`).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from interleaved import (
    ROUNDS,
    Call,
    Replay,
    Rows,
    compared,
    point_nav_start,
    processor,
    rounds,
    versions,
    write,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from cnfp_torchrl import (
    Ball,
    Box,
    ConstrainedFlow,
    ConstraintSet,
    GeometryTransform,
    HalfSpaces,
    Region,
    constrain_env,
    make_constrained_actor,
)
from cnfp_torchrl.bijectors import ExactSquash
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv

RESULTS = Path(__file__).resolve().parents[1] / "results"
STEPS = 30
"""The steps of a replayed rollout; point navigation's episodes are of 100."""


@dataclass(frozen=True)
class Settings:
    """How much is measured.

    Args:
        quick: Whether to measure little, for a test.
        count: The number of rounds.
        seconds: The time of a call of each kind in a round.
    """

    quick: bool = False
    count: int = ROUNDS
    seconds: float = 0.1

    def timed(self, calls: dict[str, Call]) -> dict[str, list[float]]:
        """Return the seconds of each call in each round."""
        return rounds(calls, self.count, self.seconds)

    def of(self, values: list[int]) -> list[int]:
        """Return all values, or for a test the first one."""
        return values[:1] if self.quick else values


class Particle(EnvBase):
    """A particle that is pushed about on a plane, always from the same random starts."""

    def __init__(self, agents: int) -> None:
        super().__init__(batch_size=[agents])
        self.observation_spec = Composite(observation=Unbounded([agents, 4]), shape=[agents])
        self.action_spec = Bounded(-1.0, 1.0, [agents, 2])
        self.reward_spec = Unbounded([agents, 1])
        self.done_spec = Binary(1, [agents, 1], dtype=torch.bool)
        generator = torch.Generator().manual_seed(0)
        position = 2 * torch.rand(agents, 2, generator=generator) - 1
        speed = 0.2 * torch.randn(agents, 2, generator=generator)
        self.start = self.now = torch.cat([position, speed], -1)

    def _shown(self, **more: Tensor) -> TensorDict:
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict({"observation": self.now, "done": done, **more}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        self.now = self.start
        return self._shown()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        position, speed = self.now.split(2, -1)
        speed = 0.9 * speed + 0.1 * tensordict["action"]
        position = (position + 0.1 * speed).clamp(-1, 1)
        self.now = torch.cat([position, speed], -1)
        return self._shown(reward=-position.norm(dim=-1, keepdim=True))

    def _set_seed(self, seed: int | None) -> None:
        return


class SpeedLimit(GeometryTransform):
    """A ball: the next speed is at most one half."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        speed = tensordict["observation"][..., 2:]
        return Ball(-9 * speed, torch.full_like(speed[..., 0], 5.0), validate_args=False)


class BrakeAtWalls(GeometryTransform):
    """Two half-spaces: barriers at the upper walls."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        position, speed = tensordict["observation"].split(2, -1)
        normals = torch.eye(2).expand(*position.shape[:-1], 2, 2)
        return HalfSpaces(normals, 4 * (1 - position) - 6 * speed, validate_args=False)


class SlowTurns(GeometryTransform):
    """A ball: the next speed is small beside what the actions may add."""

    def constraint_set(self, tensordict: TensorDictBase) -> Ball:
        speed = tensordict["observation"][..., 2:]
        return Ball(-3 * speed, torch.full_like(speed[..., 0], 1.2), validate_args=False)


class BrakeOutwards(GeometryTransform):
    """A half-space: a barrier at a circle."""

    def constraint_set(self, tensordict: TensorDictBase) -> HalfSpaces:
        position = tensordict["observation"][..., :2]
        room = 1 - position.norm(dim=-1, keepdim=True)
        return HalfSpaces(position.unsqueeze(-2), room, validate_args=False)


OWN: dict[str, tuple[type[GeometryTransform], ...]] = {
    "own": (SpeedLimit, BrakeAtWalls),
    "tight": (SlowTurns, BrakeOutwards),
}
"""The constraints of a particle, by the task's name."""


def environments(
    task: str, agents: int, *, compile: bool = False
) -> tuple[EnvBase, TransformedEnv]:
    """Return the plain and the constrained environment of a task."""
    if task in OWN:
        limits = [kind(kind.__name__) for kind in OWN[task]]
        return Particle(agents), constrain_env(Particle(agents), *limits, compile=compile)
    plain, base = (PointNavEnv([agents], seed=0) for _ in range(2))
    return plain, constrain_env(base, BatteryGeometry(), ObstacleGeometry(), compile=compile)


def network(env: EnvBase) -> nn.Module:
    """Return a small Gaussian network."""
    inputs = env.observation_spec["observation"].shape[-1]
    return nn.Sequential(MLP(inputs, 4, num_cells=[64, 64]), NormalParamExtractor())


@torch.no_grad()
def time_steps(task: str, batches: list[int], settings: Settings) -> dict[str, Rows]:
    """Return the times of a step, constrained and plain."""
    results = {}
    for agents in settings.of(batches):
        plain, env = environments(task, agents)
        actor = make_constrained_actor(network(env), env)
        recorded = env.rollout(STEPS, actor, break_when_any_done=False)
        start = {} if task in OWN else point_nav_start(recorded)
        calls: dict[str, Call] = {
            "plain": Replay(plain, recorded, start),
            "constrained": Replay(env, recorded, start),
        }
        if not settings.quick:
            _, compiled = environments(task, agents, compile=True)
            calls["constrained, compiled"] = Replay(compiled, recorded, start)
        times = settings.timed(calls)
        results[f"{task}, step, batch {agents}"] = compared(times, "plain", agents)
    return results


@torch.no_grad()
def time_whole_path(settings: Settings) -> dict[str, Rows]:
    """Return the times of acting and stepping, constrained and not."""
    results = {}
    for task in ("point navigation", "own"):
        for agents in settings.of([16, 4096]):
            plain, env = environments(task, agents)
            spec = env.action_spec_unbatched
            body = TensorDictModule(network(env), ["observation"], ["loc", "scale"])
            free = ProbabilisticActor(
                body,
                spec=spec,
                in_keys=["loc", "scale"],
                distribution_class=TanhNormal,
                distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
                default_interaction_type=InteractionType.RANDOM,
            )
            actor = make_constrained_actor(network(env), env)
            calls: dict[str, Call] = {
                "TanhNormal, plain": partial(plain.rollout, STEPS, free, break_when_any_done=False),
                "exact flow, constrained": partial(
                    env.rollout, STEPS, actor, break_when_any_done=False
                ),
            }
            times = settings.timed(calls)
            title = f"{task}, rollout of {STEPS} steps, batch {agents}"
            results[title] = compared(times, "TanhNormal, plain", agents * STEPS)
    return results


def problem(
    batch: int, dim: int, constraints: int, *, tight: float = 0.3, relaxed: float = 0.0
) -> list[ConstraintSet]:
    """Return action bounds and sets: balls, boxes and half-spaces in turn.

    Easy ones share a point with room around it, tight ones a point with a thousandth of that; of
    relaxed ones the first set misses the action bounds.

    Args:
        batch: The number of states.
        dim: The number d of action components.
        constraints: The number K of sets.
        tight: The share of states that are tight.
        relaxed: The share of states in which a set gives way.
    """
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    middle = 0.6 * uniform(batch, dim) - 0.3
    room = torch.where(uniform(batch) < tight, 1e-3, 1.0) * (0.2 + 0.3 * uniform(batch))
    gone = (uniform(batch, 1) < relaxed) & (torch.arange(constraints) == 0).any()
    sets: list[ConstraintSet] = [Box(-torch.ones(dim), torch.ones(dim))]
    for k in range(constraints):
        at = torch.where(gone, 3 * middle.sign(), middle) if k == 0 else middle
        away = torch.randn(batch, dim, generator=generator)
        away = away / away.norm(dim=-1, keepdim=True)
        if k % 3 == 0:
            radius = room + 0.3 * uniform(batch)
            sets.append(Ball(at + (radius - room).unsqueeze(-1) * away, radius))
        elif k % 3 == 1:
            low = at - room.unsqueeze(-1) * (1 + uniform(batch, dim))
            sets.append(Box(low, at + room.unsqueeze(-1) * (1 + uniform(batch, dim))))
        else:
            offsets = (away * at).sum(-1, keepdim=True) + room.unsqueeze(-1)
            sets.append(HalfSpaces(away.unsqueeze(-2), offsets))
    return sets


def drawn(region: Region, loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions of the exact flow, constructed anew, and their log-densities."""
    base = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
    squash = ExactSquash(region, validate_args=False)
    return ConstrainedFlow(base, squash).rsample_and_log_prob()


def drawn_freely(bounds: Box, loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Return actions of a TanhNormal, constructed anew, and their log-densities."""
    return TanhNormal(loc, scale, low=bounds.low, high=bounds.high).rsample_and_log_prob()


def with_backward(call: Callable[[], tuple[Tensor, Tensor]]) -> None:
    """Call, and differentiate the sum of what is returned."""
    torch.stack([part.sum() for part in call()]).sum().backward()


def time_flow(settings: Settings) -> dict[str, Rows]:
    """Return the times of flows beside TanhNormal, for growing batches, dimensions, constraints."""
    results = {}
    sizes = [(256, 2, 2), (16, 2, 2), (4096, 2, 2), (65536, 2, 2)]
    sizes += [(256, 6, 2), (256, 32, 2), (256, 2, 1), (256, 2, 4), (256, 2, 8)]
    for batch, dim, count in sizes[:1] if settings.quick else sizes:
        sets = problem(batch, dim, count)
        bounds = sets[0]
        assert isinstance(bounds, Box)
        prepared = bounds.prepared()  # as an actor has them
        found = Region.build(sets)
        region = Region((prepared, *sets[1:]), found.anchor, found.active, found.relaxation)
        loc = torch.zeros(batch, dim, requires_grad=True)
        scale = torch.ones(batch, dim, requires_grad=True)
        free, flow = partial(drawn_freely, bounds, loc, scale), partial(drawn, region, loc, scale)
        title = f"flow, batch {batch}, d = {dim}, K = {count}"
        times = settings.timed({"TanhNormal": free, "exact flow": flow})
        results[title] = compared(times, "TanhNormal")
        both: dict[str, Call] = {
            "TanhNormal": partial(with_backward, free),
            "exact flow": partial(with_backward, flow),
        }
        times = settings.timed(both)
        results[f"{title}, with the backward pass"] = compared(times, "TanhNormal")
    return results


LINES: dict[str, Callable[[Settings], dict[str, Rows]]] = {
    "point-nav-step": partial(time_steps, "point navigation", [1, 16, 256, 4096]),
    "own-step": partial(time_steps, "own", [1, 16, 256, 4096, 65536]),
    "tight-step": partial(time_steps, "tight", [1, 16, 256, 4096]),
    "whole-path": time_whole_path,
    "flow": time_flow,
}


def main() -> None:
    """Measure the lines that were asked for, and keep those that were measured before."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--line", nargs="+", choices=list(LINES), default=list(LINES))
    parser.add_argument("--quick", action="store_true", help="little of everything, for a test")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    settings = Settings(count=arguments.rounds)
    if arguments.quick:
        settings = Settings(quick=True, count=2, seconds=0.001)
    for name in arguments.line:
        load: dict[str, Any] = {"load before, over 1, 5 and 15 minutes": _load()}
        results = LINES[name](settings)
        about = {
            "command": f"python experiments/benchmarks/lines.py --line {name}",
            "processor": f"{processor()}; the process's own time on it",
            "rounds": settings.count,
            **versions(),
            **load,
            "load after": _load(),
        }
        path = arguments.out / f"lines_{name.replace('-', '_')}.json"
        write(path, f"Measured: {name}", about, results)
        sys.stdout.write(path.with_suffix(".md").read_text())
        sys.stdout.flush()


def _load() -> str:
    return ", ".join(f"{load:.1f}" for load in os.getloadavg())


if __name__ == "__main__":
    main()
