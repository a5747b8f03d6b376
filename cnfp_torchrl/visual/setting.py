"""What the pictures of all steps of a policy have in common: stages, limits, colors, titles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torchrl.envs import EnvBase

from cnfp_torchrl.envs import (
    Component,
    TaskView,
    action_components,
    counted_constraints,
    find_task_view,
    numbered_components,
    require_names,
)
from cnfp_torchrl.keys import OBSERVATION_KEY
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.visual.colors import constraint_colors
from cnfp_torchrl.visual.explanation import unit_of
from cnfp_torchrl.visual.snapshot import FlowSnapshot

_MOST_OBSERVED = 64
"""Observations of more components, such as pictures, have no names and no curves."""

_MARGIN = 1.1
_MARGIN_OF_CHAINS = 1.6
"""A chain of squashes leaves the action bounds before its last stage."""


class StageView(NamedTuple):
    """One view of one stage.

    Args:
        stage: The index of the stage.
        components: The components of the action that the view shows, one or two, counted from 0.
        title: The title of the view.
    """

    stage: int
    components: tuple[int, ...]
    title: str


@dataclass(frozen=True)
class Setting:
    """What the scenes of a flow policy have in common.

    Args:
        stages: The names of the flow's stages in order of application.
        constraints: The names of the constraints in order of application.
        low: The lower action bounds.
        high: The upper action bounds.
        projections: Pairs of components, one row of views for each; none in one dimension.
        view: The view: what the task shows of itself.
        components: The names and units of the action's components.
        observation: The names and units of the components of ``observation``; none where there are
            too many to show.
        costs: The names of the columns of ``cost``; none where the environment counts nothing.
        moves: Whether it is known how far each constraint moves an action.
        reach: The reach of views, in half widths of the action bounds.
        leaves_bounds: Whether there can be actions outside the bounds before the last stage.
    """

    stages: tuple[str, ...]
    constraints: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    projections: tuple[tuple[int, int], ...]
    view: TaskView
    components: tuple[Component, ...]
    observation: tuple[Component, ...]
    costs: tuple[str, ...]
    moves: bool
    reach: float
    leaves_bounds: bool

    @classmethod
    def of(
        cls,
        head: ConstrainedFlowModule,
        env: EnvBase | None = None,
        projections: Sequence[Sequence[int]] | None = None,
    ) -> Setting:
        """Return the setting of a policy.

        Args:
            head: The policy's flow module.
            env: The environment, which shows its task and says what the costs are called; None:
                neither.
            projections: Pairs of action components, each a row of views; None shows each component
                once.

        Raises:
            ValueError: when a projection does not name two different components of the action, when
                the flow has no density, or when the task's names of components do not fit.
        """
        if not head.flow.has_density:
            raise ValueError(
                "actor: expected a flow with a density, such as flow=exact, given "
                f"{type(head.flow).__name__}, whose stages have none to draw"
            )
        view, dim = find_task_view(env), head.action_dim
        leaves_bounds = head.flow.reads_constraints and not head.flow.is_safe
        return cls(
            stages=tuple(head.stage_names),
            constraints=tuple(head.order),
            low=tuple(head.bounds.low.tolist()),
            high=tuple(head.bounds.high.tolist()),
            projections=_projections(dim, projections),
            view=view,
            components=action_components(env, dim),
            observation=_observation(env, view),
            costs=() if env is None else counted_constraints(env),
            moves=head.flow.is_safe,
            reach=_MARGIN_OF_CHAINS if leaves_bounds else _MARGIN,
            leaves_bounds=leaves_bounds,
        )

    def holding(self, snapshot: FlowSnapshot) -> Setting:
        """Return this setting, reaching to all samples of a step."""
        bounds = snapshot.region.bounds
        samples = torch.stack([stage.samples for stage in snapshot.stages]).flatten(0, 1)
        middle, half = (bounds.low + bounds.high) / 2, (bounds.high - bounds.low) / 2
        farthest = 1.05 * float(((samples - middle) / half).abs().max())
        return replace(self, reach=max(self.reach, farthest))

    @property
    def unit(self) -> str:
        """The unit of distances between actions."""
        return unit_of(self.components)

    @property
    def dim(self) -> int:
        """The dimension d of the action space."""
        return len(self.low)

    @cached_property
    def colors(self) -> dict[str, str]:
        """The constraints' colors, those of all figures."""
        return constraint_colors(self.constraints)

    @cached_property
    def limits(self) -> tuple[tuple[float, float], ...]:
        """The part of the action space that the views show, for each component."""
        ends = []
        for low, high in zip(self.low, self.high, strict=True):
            middle, half = (low + high) / 2, (high - low) / 2
            ends.append((middle - self.reach * half, middle + self.reach * half))
        return tuple(ends)

    @property
    def support(self) -> tuple[tuple[float, float], ...]:
        """The part of the views in which there can be a density, for each component."""
        ends = tuple(zip(self.low, self.high, strict=True))
        return self.limits if self.leaves_bounds else ends

    def axis_title(self, component: int) -> str:
        """Return a component's name, unit and bounds."""
        return axis_title(self.components[component], (self.low[component], self.high[component]))

    def names(self, components: Sequence[int]) -> str:
        """Return the names of some components of the action."""
        return ", ".join(self.components[component].name for component in components)

    def rows(self) -> list[list[StageView]]:
        """Return the views, a row for each projection, stages from left to right."""
        rows = []
        for components in self.projections or ((0,),):
            row = []
            for index, name in enumerate(self.stages):
                title = f"{index + 1} · {'action bounds' if name == 'bounds' else name}"
                if index > 0 and index + 1 == len(self.stages):
                    title = f"{title}, highest priority"
                row.append(StageView(index, tuple(components), title))
            rows.append(row)
        return rows

    def grid(self, cells: int) -> Tensor:
        """Return the middles of equal cells over the support.

        ``(4 * cells, 1)`` in one dimension and, the second component first, ``(cells, cells, 2)``
        in two.
        """
        count = cells if self.dim == 2 else 4 * cells
        share = (torch.arange(count) + 0.5) / count
        axes = [low + (high - low) * share for low, high in self.support]
        # One component after the other in memory: to add up two neighbors takes thrice as long.
        return torch.stack(torch.meshgrid(*axes, indexing="xy")).movedim(0, -1)


def axis_title(component: Component, limits: tuple[float, float]) -> str:
    """Return what stands at an axis: a name, its unit, and the ends of the axis."""
    low, high = limits
    return f"{component.title}, {low:.3g} to {high:.3g}"


def _observation(env: EnvBase | None, view: TaskView) -> tuple[Component, ...]:
    spec = None if env is None else env.observation_spec.get(OBSERVATION_KEY, None)
    if env is None or spec is None or len(spec.shape) != len(env.batch_size) + 1:
        return ()
    size, named = spec.shape[-1], tuple(view.observation_components)
    if named:
        require_names("observation_components", "observation", named, size, view)
    if size > _MOST_OBSERVED:
        return ()
    return named or numbered_components("o", size)


def _projections(
    dim: int, projections: Sequence[Sequence[int]] | None
) -> tuple[tuple[int, int], ...]:
    if dim == 1:
        if projections:
            raise ValueError(
                f"projections: expected none for an action of one component, given {projections}"
            )
        return ()
    if projections is None:
        # Of an odd number of components the last one is shown beside the one before.
        projections = [(min(i, dim - 2), min(i, dim - 2) + 1) for i in range(0, dim, 2)]
    chosen = [tuple(pair) for pair in projections]
    for pair in chosen:
        if len(pair) != 2 or len(set(pair)) != 2 or not all(0 <= c < dim for c in pair):
            raise ValueError(
                f"projections: expected pairs of two different components in 0..{dim - 1}, "
                f"given {pair}"
            )
    if not chosen or len(set(chosen)) != len(chosen):
        raise ValueError(f"projections: expected at least one pair, each once, given {chosen}")
    return tuple((int(first), int(second)) for first, second in chosen)
