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

from cnfp_torchrl.envs import action_components, counted_constraints, find_task_view
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual.colors import constraint_colors
from cnfp_torchrl.visual.explanation import explain, unit_of
from cnfp_torchrl.visual.figures.canvas import save_png
from cnfp_torchrl.visual.figures.learning_curves import learning_curves, read_scalars
from cnfp_torchrl.visual.figures.stages import flow_stages
from cnfp_torchrl.visual.figures.trajectories import record_episodes, trajectories
from cnfp_torchrl.visual.snapshot import FlowSnapshot, take_snapshot
from cnfp_torchrl.visual.states import telling_states

METRICS, FIGURES = "metrics", "figures"
_TITLES = {
    "permissive": "Most permissive state that was seen",
    "restrictive": "State in which constraints bind",
}


def draw_run_figures(
    folder: RunFolder,
    *,
    trusted: Sequence[str] = (),
    episodes: int = 6,
    dpi: int = 130,
) -> list[Path]:
    """Draw a finished run's figures into its folder ``figures/``, and return the files.

    ``learning_curves.png``; ``trajectories.png`` where the environment has a map; and, where the
    actor is a constrained one, ``flow_permissive.png`` and ``flow_restrictive.png``.

    Args:
        folder: The folder of a run, with configuration and checkpoint.
        trusted: The packages that it may name, see `RunFolder.load_config`.
        episodes: The number of episodes drawn.
        dpi: Dots per inch.
    """
    config = folder.load_config(trusted)
    # A run that goes on after its figures draws the same random numbers as without them.
    with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(config.seed)
        figures = _figures(folder, config, episodes)
    target = folder.path / FIGURES
    return [save_png(figure, target / f"{name}.png", dpi=dpi) for name, figure in figures.items()]


def _figures(folder: RunFolder, config: DictConfig, episodes: int) -> dict[str, Figure]:
    env = _environment(config)
    actor = load_actor(folder, config, env)
    head = flow_head(actor)
    names = list(dict.fromkeys([*head.order, *counted_constraints(env)]))
    colors = constraint_colors(names)
    run = f"{type(head.flow).__name__}, seed {config.seed}"
    curves = learning_curves(
        read_scalars(folder.path / METRICS),
        colors=colors,
        title=f"Learning curves · {run}",
        unit=unit_of(action_components(env, head.action_dim)),
    )
    figures = {"learning_curves": curves}
    if find_task_view(env).map is not None:
        figures["trajectories"] = _trajectories(_environment(config, episodes), actor, colors)
    if not head.flow.has_density:
        return figures  # the stages of a flow are drawn with their densities
    for kind, state in zip(("permissive", "restrictive"), telling_states(env, head), strict=True):
        snapshot = take_snapshot(actor, state, seed=config.seed)
        title = f"{_TITLES[kind]}{_openness(snapshot)} · {run}"
        if snapshot.is_saturated:
            snapshot = snapshot.with_standard_base(config.seed)
            title += "\nthe policy is saturated: samples of N(0, 1) in its place"
        if kind == "restrictive":
            snapshot = snapshot.following_the_longest_path()
        figures[f"flow_{kind}"] = flow_stages(snapshot, env=env, colors=colors, title=title)
    return figures


def _trajectories(
    env: TransformedEnv, actor: SafeProbabilisticTensorDictSequential, colors: dict[str, str]
) -> Figure:
    episodes = record_episodes(env, actor)
    title = "Evaluation episodes of the stochastic policy"
    return trajectories(
        find_task_view(env), episodes, counted_constraints(env), colors=colors, title=title
    )


def _environment(config: DictConfig, batch: int | None = None) -> TransformedEnv:
    size = None if batch is None else [batch]
    env = build_environment(config, batch_size=size, with_anchor=True)
    env.set_seed(config.evaluation.seed)
    return env


def _openness(snapshot: FlowSnapshot) -> str:
    share, title = explain(snapshot).share_allowed, ""
    if share is not None:
        title = f": {'all' if share == 1 else f'{100 * share:.0f} % of'} actions allowed"
    dropped = " and ".join(snapshot.dropped)
    return f"{title}, {dropped} cannot hold" if dropped else title
