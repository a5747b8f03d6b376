"""What an environment may show of its task: sentences, a map, time series and telling states.

Explanations, figures, the stream and the audit work for any environment. One that knows more than
its observation gives it to them through a `TaskView`, which its class returns by a method::

    class MyEnv(EnvBase):
        def task_view(self, env: EnvBase) -> TaskView:
            return MyView(self)

``env`` is the environment as it is used, with all its transforms. A Gymnasium environment may have
such a method, too. Every part of a `TaskView` has a default that shows nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

Point = tuple[float, float]

StateSetter = Callable[[EnvBase, TensorDictBase], TensorDictBase]
"""``(env, states) -> shown``: put an environment into states, and return what it then shows.

It is given the environment without its transforms, and states of its batch size with the entries
of its observation spec: such as it showed before, and drawn ones. What it returns needs no more
than these entries, read from the environment anew: whoever calls it checks that they are those of
the states.
"""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Something on a map that stands still.

    Args:
        name: path of the shape; slashes separate groups, as in ``walls/inner``.
        color: on a light background, as ``#RRGGBB``.
        color_on_dark: on a dark background; None takes the same.
        label: for legends; None leaves it out of them.
    """

    name: str
    color: str = "#5A5A5A"
    color_on_dark: str | None = None
    label: str | None = None


@dataclass(frozen=True, kw_only=True)
class Boxes(Shape):
    """Filled rectangles ``(x_low, y_low, x_high, y_high)``."""

    boxes: tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True, kw_only=True)
class Discs(Shape):
    """Filled discs of one radius, cut off at the map's edge."""

    centers: tuple[Point, ...]
    radius: float


@dataclass(frozen=True, kw_only=True)
class Marks(Shape):
    """Places, drawn in one size whatever the map's."""

    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True)
class Polyline(Shape):
    """A line through points."""

    points: tuple[Point, ...]


@dataclass(frozen=True)
class Map:
    """A plane in which an agent moves, and what stands in it.

    Args:
        x: lowest and highest first coordinate.
        y: lowest and highest second coordinate.
        unit: of both, for the axes.
        shapes: from bottom to top.
        step_length: an action a moves the agent by ``step_length * a``; None where actions are no
            moves, and sets of actions cannot be drawn in place.
        goal_radius: of the disc in which a goal counts as reached; None draws none.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    unit: str = ""
    shapes: tuple[Shape, ...] = ()
    step_length: float | None = None
    goal_radius: float | None = None

    @property
    def center(self) -> Point:
        """The middle of the map."""
        return sum(self.x) / 2, sum(self.y) / 2

    @property
    def half_width(self) -> float:
        """Half of the longer side."""
        return max(self.x[1] - self.x[0], self.y[1] - self.y[0]) / 2


@dataclass(frozen=True)
class Series:
    """A number of each state, to be drawn over time.

    Args:
        name: also that of the constraint whose color it has, if there is one.
        unit: such as ``%``.
        threshold: drawn as a line of its own.
        limits: lowest and highest value that there can be.
    """

    name: str
    unit: str = ""
    threshold: float | None = None
    limits: tuple[float, float] | None = None

    @property
    def title(self) -> str:
        """Name and unit."""
        name = self.name[:1].upper() + self.name[1:]
        return f"{name} ({self.unit})" if self.unit else name


class TaskView:
    """What a task shows of its states; nothing, unless a subclass says otherwise."""

    map: Map | None = None
    """The map, for tasks in a plane; then `position` is needed."""

    series: Sequence[Series] = ()
    """Numbers to draw over time; then `series_values` is needed."""

    position_keys: Sequence[NestedKey] = ()
    """The entries of a state that `position` reads."""

    state_setter: StateSetter | None = None
    """Puts the environment into chosen states, for audits; None where that cannot be done."""

    def position(self, states: TensorDictBase) -> Tensor:
        """Return where the agent is on the map, ``(*batch, 2)``."""
        raise NotImplementedError(f"{type(self).__name__} has a map and needs `position`")

    def goal(self, states: TensorDictBase) -> Tensor | None:
        """Return where the agent has to go, ``(*batch, 2)``; None for tasks without a goal."""
        return None

    def series_values(self, states: TensorDictBase) -> Mapping[str, Tensor]:
        """Return the values of all series by their names, each ``(*batch,)``."""
        return {}

    def situation(self, state: TensorDictBase) -> str | None:
        """Return a sentence on a state of batch size ``()``, such as where the agent is."""
        return None

    def constraint_sentences(self, state: TensorDictBase) -> Mapping[str, str]:
        """Return sentences on a state of batch size ``()``, by the constraints' names."""
        return {}

    def candidate_states(self, env: EnvBase) -> tuple[TensorDictBase, TensorDictBase] | None:
        """Return states ``(n,)`` among which to look for a permissive and for a restrictive one.

        Args:
            env: with all transforms; may be reset.

        Returns:
            Both sets of states, as the environment shows them; None looks along a random walk.
        """
        return None


NOTHING: TaskView = TaskView()
"""The view of a task that shows nothing."""


def find_task_view(env: EnvBase | None) -> TaskView:
    """Return what an environment shows of its task, below any transforms.

    Environments that run in workers are not asked.
    """
    layer: object = env
    while layer is not None:
        # Of the class: a batched environment that was never reset forwards a look at the instance
        # to workers that there are not yet.
        if hasattr(type(layer), "task_view"):
            return layer.task_view(env)  # type: ignore[attr-defined]
        layer = layer.base_env if isinstance(layer, TransformedEnv) else _wrapped(layer)
    return NOTHING


def _wrapped(layer: object) -> object | None:
    """Return the environment of another library that one of TorchRL's wraps."""
    inner = getattr(layer, "__dict__", {}).get("_env")
    return getattr(inner, "unwrapped", None)
