"""What the stream and its blueprint share: names, entity paths, limits and colors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import rerun as rr
from torchrl.envs import EnvBase
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl.envs import constraint_names
from cnfp_torchrl.modules import flow_head
from cnfp_torchrl.tasks.point_nav import Layout
from cnfp_torchrl.visual.arena import layout_of
from cnfp_torchrl.visual.colors import constraint_colors

TIMELINE = "env_step"
MAP = "map"
LEGEND = "legend"
EXPLANATION = "explanation"
SERIES = "series"
METRICS = "metrics"

Projection = tuple[int, int]
"""Two components of the action, counted from 0, that span a view."""

REACH_IN_ONE = (-0.45, 1.1)
"""Heights of a view of one component: the highest density is at 1, the sets stand below 0."""

_MARGIN = 1.1
_MARGIN_OF_CHAINS = 1.6


class StageView(NamedTuple):
    """One view of one stage.

    Args:
        stage: index of the stage.
        components: of the action that the view shows, one or two.
        path: under which the view's entities lie.
        title: of the view.
    """

    stage: int
    components: tuple[int, ...]
    path: str
    title: str


@dataclass(frozen=True)
class FlowScene:
    """The views of a flow policy.

    Args:
        stages: names of the flow's stages in order of application.
        constraints: names of the constraints in order of application.
        low: lower action bounds.
        high: upper action bounds.
        projections: pairs of components, one row of views for each; none in one dimension.
        layout: of point navigation's map; None for environments without one.
        costs: names of the columns of ``cost``; none where the environment counts nothing.
        reach: how far views extend, in half widths of the action bounds.
    """

    stages: tuple[str, ...]
    constraints: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    projections: tuple[Projection, ...]
    layout: Layout | None
    costs: tuple[str, ...]
    reach: float

    @classmethod
    def of(
        cls,
        actor: SafeProbabilisticTensorDictSequential,
        env: EnvBase | None = None,
        projections: Sequence[Sequence[int]] | None = None,
    ) -> FlowScene:
        """Return the scene of an actor.

        Args:
            actor: from `make_constrained_actor` or `constrain`.
            env: says whether there is a map and what the costs are called; None: neither.
            projections: pairs of action components, each a row of views; None shows the first two.

        Raises:
            ValueError: when a projection does not name two different components of the action, or
                when the flow has no density.
        """
        head = flow_head(actor)
        if not head.flow.has_density:
            raise ValueError(
                "actor: expected a flow with a density, such as flow=exact, given "
                f"{type(head.flow).__name__}, whose stages have none to draw"
            )
        dim = head.action_dim
        moves = head.flow.reads_constraints and not head.flow.is_safe
        return cls(
            stages=tuple(head.stage_names),
            constraints=tuple(head.order),
            low=tuple(head.bounds.low.tolist()),
            high=tuple(head.bounds.high.tolist()),
            projections=_projections(dim, projections),
            layout=None if env is None else layout_of(env),
            costs=_cost_names(env),
            # A chain of squashes leaves the action bounds before its last stage.
            reach=_MARGIN_OF_CHAINS if moves else _MARGIN,
        )

    @property
    def dim(self) -> int:
        """The dimension d of the action space."""
        return len(self.low)

    @property
    def colors(self) -> dict[str, str]:
        """The constraints' colors, those of all figures."""
        return constraint_colors(self.constraints)

    @property
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
        return ends if self.reach == _MARGIN else self.limits

    def rows(self) -> list[list[StageView]]:
        """Return the views, a row for each projection, stages from left to right."""
        rows = []
        for components in self.projections or ((0,),):
            row = []
            for index, name in enumerate(self.stages):
                said = "action bounds" if name == "bounds" else name
                title, parts = f"{index + 1} · {said}", ["stages", f"{index + 1} {name}"]
                if index > 0 and index + 1 == len(self.stages):
                    title = f"{title}, highest priority"
                if self.dim > 2:
                    pair = "a{}, a{}".format(*(c + 1 for c in components))
                    title, parts = f"{title} ({pair})", [*parts, pair]
                path = rr.new_entity_path(parts).strip("/")
                row.append(StageView(index, tuple(components), path, title))
            rows.append(row)
        return rows


def _cost_names(env: EnvBase | None) -> tuple[str, ...]:
    if env is None or "cost" not in env.observation_spec.keys():  # noqa: SIM118
        return ()
    return constraint_names(env)


def _projections(dim: int, projections: Sequence[Sequence[int]] | None) -> tuple[Projection, ...]:
    if dim == 1:
        if projections:
            raise ValueError(
                f"projections: expected none for an action of one component, given {projections}"
            )
        return ()
    chosen = [(0, 1)] if projections is None else [tuple(each) for each in projections]
    for pair in chosen:
        if len(pair) != 2 or len(set(pair)) != 2 or not all(0 <= c < dim for c in pair):
            raise ValueError(
                f"projections: expected pairs of two different components in 0..{dim - 1}, "
                f"given {pair}"
            )
    if not chosen or len(set(chosen)) != len(chosen):
        raise ValueError(f"projections: expected at least one pair, each once, given {chosen}")
    return tuple((int(first), int(second)) for first, second in chosen)
