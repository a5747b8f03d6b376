"""A constraint that appears after training: trained policies in a changed task, without retraining.

The networks stay as they are. The map of the environment, of its indicators and of the constraints'
geometry is another one, and the flow is built for it; a method without a flow, or with a part of
one, meets the new constraint unprepared. Starts and goals avoid the new rectangle.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.modules import guarded
from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.evaluation import evaluate_seeded
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings
from experiments.paper.records import Evaluation, Outcome

SECOND_RECTANGLE = (0.43, 0.43, 0.67, 0.67)
"""Away from the stations, across many of the ways between starts and goals."""

STRICTER_RESERVE = 30
"""In percent, for 20: of "a lower battery reserve" the reading that asks for more. The agent has
ten percent less to spend, and must not fall below what was harmless before. From the lowest start,
40 %, the farthest station, 0.95 away, is just within the cautious reach of 0.99."""


def with_second_rectangle(layout: Layout) -> Layout:
    """Return the map with one more obstacle."""
    return dataclasses.replace(layout, rectangles=(*layout.rectangles, SECOND_RECTANGLE))


def with_stricter_reserve(layout: Layout) -> Layout:
    """Return the map whose battery constraint is violated below `STRICTER_RESERVE` percent."""
    return dataclasses.replace(layout, battery_threshold=STRICTER_RESERVE)


CHANGES: dict[str, Callable[[Layout], Layout]] = {
    "second rectangle": with_second_rectangle,
    "stricter battery reserve": with_stricter_reserve,
}
"""By name, as in `Record.afterwards`."""


def changed(config: DictConfig, change: Callable[[Layout], Layout]) -> DictConfig:
    """Return a run's configuration with every map in it changed.

    Args:
        config: The resolved configuration; each part of it names its own map.
        change: The change of the map.

    Raises:
        ValueError: when there is no map in it.
    """
    content = OmegaConf.to_container(config, resolve=True)
    assert isinstance(content, dict)
    nodes = list(_layouts(content))
    if not nodes:
        raise ValueError(
            "config: expected an environment with a cnfp_torchrl.tasks.point_nav.Layout, given "
            "one without; only point navigation can be changed afterwards"
        )
    for node in nodes:
        layout = change(instantiate(OmegaConf.create(node), _convert_="all"))
        node.update(dataclasses.asdict(layout))
    return DictConfig(content)


def evaluate_afterwards(folder: RunFolder) -> dict[str, Evaluation]:
    """Return what a run's policy does in each changed task, by change.

    Args:
        folder: A finished run; its configuration says how many episodes, from which seed.
    """
    config = folder.load_config()
    return {name: evaluation(folder, changed(config, change)) for name, change in CHANGES.items()}


def evaluation(folder: RunFolder, config: DictConfig) -> Evaluation:
    """Return what a run's policy does in the task of a configuration."""
    settings: EvaluationSettings = instantiate(config.evaluation)
    env = build_environment(config, batch_size=[settings.episodes])
    actor = guarded(load_actor(folder, config, env))
    score = instantiate(config.env.score)

    def outcome(deterministic: bool) -> Outcome:
        result = evaluate_seeded(env, actor, settings, deterministic=deterministic)
        return Outcome.of(result.report(score))

    return Evaluation(stochastic=outcome(False), deterministic=outcome(True))


def _layouts(content: Any) -> Iterator[dict[str, Any]]:
    if isinstance(content, dict):
        if content.get("_target_") == "cnfp_torchrl.tasks.point_nav.Layout":
            yield content
        for value in content.values():
            yield from _layouts(value)
    elif isinstance(content, list):
        for value in content:
            yield from _layouts(value)
