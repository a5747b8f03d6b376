"""What is drawn of a flow policy, as arrays: painters for matplotlib and Rerun only paint it.

A `Scene` is one step, in any dimension; `Setting` is what all steps have in common.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cnfp_torchrl.envs import Map
from cnfp_torchrl.visual.explanation import Explanation, explain
from cnfp_torchrl.visual.outlines import Line, Outlines, View, set_outline, within
from cnfp_torchrl.visual.setting import Setting
from cnfp_torchrl.visual.snapshot import FlowSnapshot

Floats = NDArray[np.float32]

_DEPTH = 7.0
"""Densities of this many nats below the highest are drawn as nothing."""
_SPIKES = 0.995
"""A saturated flow crowds at boundaries without limit; this share of the cells sets the scale."""


@dataclass(frozen=True)
class Detail:
    """How fine a scene is computed.

    Args:
        cells: The number of cells of the density's grid along each of two axes; four times as many
            in one dimension.
        rays: The number of rays of outlines.
        nodes: The number of nodes along each axis of the grid that dropped sets are traced on.
        shadows: Whether the shadows of sets are drawn in more than two dimensions, and not
            sections; slow.
    """

    cells: int = 40
    rays: int = 360
    nodes: int = 96
    shadows: bool = False


PRINTED = Detail(cells=240, rays=1440, nodes=400, shadows=True)


class SetsOnMap(NamedTuple):
    """Where the agent stands and where the allowed actions would lead it.

    Args:
        position: The position of the agent, ``(2,)``.
        goal: The goal, where it has to go, ``(2,)``, or None.
        sets: The boundary of each constraint's set, none of dropped ones.
        dropped: The boundary of each dropped constraint's set, none of the others.
        allowed: The boundary of the allowed moves.
        targets: The points that the samples lead to, ``(n, 2)``.
        move: The move of the followed action, ``(2,)``.
    """

    position: NDArray[np.float64]
    goal: list[float] | None
    sets: list[list[Line]]
    dropped: list[list[Line]]
    allowed: list[Line]
    targets: NDArray[np.float64]
    move: Floats


class Scene:
    """One step of a flow policy, as arrays, each computed when it is first asked for.

    Args:
        setting: The setting of all steps.
        snapshot: The snapshot, of which the followed sample is the executed action.
        detail: The fineness of what is drawn.
        actions: The grid of `Setting.grid`; None makes it anew.
    """

    def __init__(
        self,
        setting: Setting,
        snapshot: FlowSnapshot,
        detail: Detail | None = None,
        actions: Tensor | None = None,
    ) -> None:
        self.setting, self.snapshot = setting, snapshot
        self.detail = Detail() if detail is None else detail
        self._actions = actions
        self._region = snapshot.region.to(torch.float64)
        self._outlines: dict[tuple[int, ...], Outlines] = {}
        self._samples: dict[tuple[int, tuple[int, ...]], Floats] = {}

    @cached_property
    def explanation(self) -> Explanation:
        """What happened, with the shares that are allowed and how far constraints moved things."""
        return explain(self.snapshot, self.setting.view, self.setting.components)

    @cached_property
    def entropy(self) -> float:
        """An estimate of the policy's entropy in nats; the executed action is no draw for it."""
        return -float(self.snapshot.stages[-1].log_density[1:].mean())

    @property
    def moved(self) -> Mapping[str, float | None]:
        """By how much each constraint moved the executed action, None where that is unknown."""
        return {effect.name: effect.moved for effect in self.explanation.constraints}

    def samples(self, stage: int, components: Sequence[int]) -> Floats:
        """Return components of all samples after a stage, ``(n, m)``."""
        key = stage, tuple(components)
        if key not in self._samples:
            samples = self.snapshot.stages[stage].samples.numpy()
            everything = key[1] == tuple(range(samples.shape[-1]))
            self._samples[key] = samples if everything else samples[:, list(components)]
        return self._samples[key]

    def path(self, stage: int, components: Sequence[int]) -> Floats:
        """Return where the executed action was after each stage so far, ``(stage + 1, m)``."""
        followed = self.snapshot.followed
        return np.stack([self.samples(i, components)[followed] for i in range(stage + 1)])

    def tracks(self, stage: int, components: Sequence[int], count: int) -> Floats:
        """Return the ways of some samples from the stage before, ``(count, 2, m)``."""
        if stage == 0:
            return np.zeros((0, 2, len(components)), dtype=np.float32)
        # Not the first, which is the executed action.
        ends = [self.samples(i, components)[1 : 1 + count] for i in (stage - 1, stage)]
        return np.stack(ends, axis=1)

    def set_lines(self, index: int, components: Sequence[int]) -> list[Line]:
        """Return the boundary of one of the region's sets within the view; none of dropped ones."""
        boundary = self._seen(components).of_set(index)
        return [] if boundary is None else within(boundary, self._view(components))

    def dropped_lines(self, index: int, components: Sequence[int]) -> list[Line]:
        """Return the boundary of a dropped set in the plane; none of sets that hold.

        In more dimensions it has none: it has no point in common with the region, and no section
        to be seen from it.
        """
        if self._seen(components).holds(index) or self.setting.dim != 2:
            return []
        allowed = self.snapshot.region.sets[index]
        return set_outline(allowed, self._view(components), self.detail.nodes)

    def allowed_lines(self, stage: int, components: Sequence[int]) -> list[Line]:
        """Return the boundary of what is allowed after a stage, within the view."""
        applied = self.snapshot.stages[stage].applied
        boundary = self._seen(components).of_intersection(applied)
        return within(boundary, self._view(components))

    def interval(self, applied: Sequence[int]) -> tuple[float, float] | None:
        """Return the ends of some sets' intersection in one dimension; None where none holds."""
        seen = self._seen((0,))
        if not any(seen.holds(k) for k in applied):
            return None
        low, high = seen.of_intersection(applied)[:, 0].tolist()
        return low, high

    @cached_property
    def actions(self) -> Tensor:
        """The cells of the density's grid, see `Setting.grid`."""
        return self.setting.grid(self.detail.cells) if self._actions is None else self._actions

    @cached_property
    def log_density(self) -> Tensor | None:
        """The log-density at the cells after each stage, ``(stages, *cells)``; -inf outside.

        In the precision of the snapshot, which is much finer than colors are; None in more than two
        dimensions.
        """
        if self.setting.dim > 2:
            return None
        given = self.actions.reshape(-1, self.setting.dim)
        return self.snapshot.log_densities(given).unflatten(1, self.actions.shape[:-1])

    @cached_property
    def heat(self) -> NDArray[np.uint8] | None:
        """Densities as brightness, 0 where there is next to none, ``(stages, *cells)``."""
        if self.log_density is None:
            return None
        values = self.log_density.numpy()
        share = np.clip((values - (_top(values) - _DEPTH)) / _DEPTH, 0.0, 1.0)
        return np.round(255 * share).astype(np.uint8)

    @cached_property
    def curves(self) -> list[Line]:
        """Actions and densities in one dimension, the highest as 1, of each stage."""
        assert self.log_density is not None
        values = self.log_density.numpy()
        heights = np.exp(np.minimum(values - _top(values), 0.0))
        return [np.stack([self.actions[:, 0].numpy(), curve], axis=-1) for curve in heights]

    def on_map(self, targets: int) -> SetsOnMap | None:
        """Return the sets and some samples at the agent's position; None for a task without a map.

        Args:
            targets: The number of samples.
        """
        view, samples = self.setting.view, self.snapshot.stages[-1].samples
        plane = view.map
        if plane is None:
            return None
        state = self.snapshot.state
        position = view.position(state).tolist()
        origin, goal = np.array(position), view.goal(state)
        sets: list[list[Line]] = []
        dropped: list[list[Line]] = []
        allowed: list[Line] = []
        moves = samples[:0, :2].numpy()
        if plane.step_length is not None and self.setting.dim == 2:
            step, limits = plane.step_length, _reachable(plane, position, plane.step_length)
            seen = self._seen((0, 1))
            for k, constraint in enumerate(self.snapshot.region.sets[1:], start=1):
                boundary = seen.of_set(k)
                inside = [] if boundary is None else within(boundary, limits)
                traced = []
                if boundary is None:
                    traced = set_outline(constraint, limits, self.detail.nodes)
                sets.append([origin + step * line for line in inside])
                dropped.append([origin + step * line for line in traced])
            whole = seen.of_intersection(range(len(self.snapshot.region.sets)))
            allowed = [origin + step * line for line in within(whole, limits)]
            moves = step * samples.numpy()
        executed = moves[self.snapshot.followed] if len(moves) else np.zeros(2, dtype=np.float32)
        return SetsOnMap(
            origin,
            None if goal is None else goal.tolist(),
            sets,
            dropped,
            allowed,
            origin + moves[1 : 1 + targets],
            executed,
        )

    def _seen(self, components: Sequence[int]) -> Outlines:
        key = tuple(components)
        if key not in self._outlines:
            self._outlines[key] = Outlines(
                self._region, key, rays=self.detail.rays, shadows=self.detail.shadows
            )
        return self._outlines[key]

    def _view(self, components: Sequence[int]) -> View:
        first, second = (self.setting.limits[component] for component in components)
        return (*first, *second)


def density_limits(snapshot: FlowSnapshot) -> tuple[float, float]:
    """Return the ends of one color scale for base and stages, in nats, from the samples' bulk."""
    drawn = [snapshot.latent_log_density, *(stage.log_density for stage in snapshot.stages)]
    values = torch.cat(drawn).double()
    values = values[values.isfinite()]
    if len(values) == 0:
        return -1.0, 0.0
    high = float(values.quantile(0.95))
    low = min(float(values.quantile(0.01)), high - 3)
    return max(low, high - _DEPTH), high


def base_density(snapshot: FlowSnapshot, spread: float, cells: int) -> tuple[Tensor, Tensor]:
    """Return a grid of latents around the Gaussian's mean, and its log-density there.

    Args:
        snapshot: A snapshot of one or two dimensions.
        spread: The reach of the grid, in standard deviations.
        cells: The number of cells along each axis.

    Returns:
        Latents ``(cells, 1)`` or ``(cells, cells, 2)``, and log-densities without the last axis.
    """
    along = torch.linspace(-spread, spread, cells)
    standard = torch.stack(torch.meshgrid([along] * snapshot.dim, indexing="xy"), dim=-1)
    normalizer = (snapshot.scale.log() + 0.5 * math.log(2 * math.pi)).sum()
    return snapshot.loc + snapshot.scale * standard, -standard.square().sum(-1) / 2 - normalizer


def _reachable(plane: Map, position: Sequence[float], step: float) -> View:
    """Return the limits of the map in action units, seen from a position."""
    (x_low, x_high), (y_low, y_high) = plane.x, plane.y
    x, y = position
    return ((x_low - x) / step, (x_high - x) / step, (y_low - y) / step, (y_high - y) / step)


def _top(values: NDArray[np.float64]) -> float:
    """Return the log-density that the scale ends at, 0 where there is none at all."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0
    rank = int(_SPIKES * (len(finite) - 1))
    return float(np.partition(finite, rank)[rank])
