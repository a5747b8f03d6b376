"""The figures of a finished run, without a viewer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import constraint_names
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual.arena import layout_of
from cnfp_torchrl.visual.canvas import save_png
from cnfp_torchrl.visual.colors import constraint_colors
from cnfp_torchrl.visual.flow_stages import flow_stages
from cnfp_torchrl.visual.learning_curves import learning_curves, read_scalars
from cnfp_torchrl.visual.snapshot import FlowSnapshot, take_snapshot
from cnfp_torchrl.visual.states import telling_states
from cnfp_torchrl.visual.trajectories import record_episodes, trajectories

METRICS, FIGURES = "metrics", "figures"

_EPISODES = 6
_STATES = 256
_MOST_DIMENSIONS_TO_MEASURE = 3


def draw_run_figures(folder: RunFolder, *, trusted: Sequence[str] = ()) -> list[Path]:
    """Draw a finished run's figures into its folder ``figures/``, and return the files.

    ``learning_curves.png``; ``trajectories.png`` where the environment has a map; and, where the
    actor is a constrained one, ``flow_permissive.png`` and ``flow_restrictive.png``.

    Args:
        folder: with configuration and checkpoint.
        trusted: see `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    # A run that goes on after its figures draws the same random numbers as without them.
    with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(config.seed)
        figures = _figures(folder, config)
    place = folder.path / FIGURES
    return [save_png(figure, place / f"{name}.png") for name, figure in figures.items()]


def _figures(folder: RunFolder, config: DictConfig) -> dict[str, Figure]:
    env = _environment(config, _STATES)
    actor = load_actor(folder, config, env)
    head = flow_head(actor)
    names = list(dict.fromkeys([*head.order, *_counted(env)]))
    colors = constraint_colors(names)
    run = f"{type(head.flow).__name__}, seed {config.seed}"
    curves = learning_curves(
        read_scalars(folder.path / METRICS), colors=colors, title=f"Learning curves · {run}"
    )
    figures = {"learning_curves": curves}
    layout = layout_of(env)
    if layout is not None:
        figures["trajectories"] = _trajectories(config, actor, colors)
    if not head.flow.has_density:
        return figures  # the stages of a flow are drawn with their densities
    for kind, state in zip(("permissive", "restrictive"), telling_states(env, head), strict=True):
        snapshot = take_snapshot(actor, state, seed=config.seed)
        if kind == "restrictive":
            snapshot = snapshot.following_the_longest_path()
        title = f"{kind.capitalize()} state{_openness(snapshot)} · {run}"
        figures[f"flow_{kind}"] = flow_stages(snapshot, layout=layout, colors=colors, title=title)
    return figures


def _trajectories(
    config: DictConfig, actor: SafeProbabilisticTensorDictSequential, colors: dict[str, str]
) -> Figure:
    env = _environment(config, _EPISODES)
    layout = layout_of(env)
    assert layout is not None
    title = "Evaluation episodes of the stochastic policy"
    return trajectories(
        layout, record_episodes(env, actor), _counted(env), colors=colors, title=title
    )


def _environment(config: DictConfig, batch: int) -> TransformedEnv:
    env = build_environment(config, batch_size=[batch], with_anchor=True)
    env.set_seed(config.evaluation.seed)
    return env


def _counted(env: TransformedEnv) -> list[str]:
    """Return the names of the violations that an environment counts, none if it counts nothing."""
    try:
        return list(constraint_names(env))
    except ValueError:
        return []


def _openness(snapshot: FlowSnapshot) -> str:
    said = ""
    # In many dimensions the share is as good as zero everywhere and tells nothing.
    if snapshot.dim <= _MOST_DIMENSIONS_TO_MEASURE:
        share = snapshot.allowed_share()
        said = f": {'all' if share == 1 else f'{100 * share:.0f} % of'} actions allowed"
    dropped = " and ".join(snapshot.dropped)
    return f"{said}, {dropped} cannot hold" if dropped else said
