"""The view of a task that an environment may offer: names, sentences, a map, series, states.

Explanations, figures, the stream and the audit work for any environment. One that can show more
than its observation does so through a `TaskView`, which a method of its class returns::

    class MyEnv(EnvBase):
        def task_view(self, env: EnvBase) -> TaskView:
            return MyView(self)

``env`` is the environment as it is used, with all its transforms. A Gymnasium environment may have
such a method, too, and `ShowTask` gives a view to an environment whose class has none. Every part
of a `TaskView` has a default that shows nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv, Transform, TransformedEnv

from cnfp_torchrl.modules import appended_transforms

Point = tuple[float, float]

StateSetter = Callable[[EnvBase, TensorDictBase], TensorDictBase]
"""``(env, states) -> observed``: put an environment into states, and return what it then observes.

The environment comes without its transforms. The states are of its batch size and have the entries
of its observation spec; some were observed before, others are drawn. The result needs these entries
alone, read anew from the environment: the caller checks that they equal those of the states.
"""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A part of a map that does not move.

    Args:
        name: The shape's path; slashes separate groups, as in ``walls/inner``.
        color: The color on a light background, as ``#RRGGBB``.
        color_on_dark: The color on a dark background; None takes the same.
        label: The entry in legends; None makes none.
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
    """Points, drawn in one size whatever the map's."""

    points: tuple[Point, ...]


@dataclass(frozen=True, kw_only=True)
class Polyline(Shape):
    """A line through points."""

    points: tuple[Point, ...]


@dataclass(frozen=True)
class Map:
    """A plane in which an agent moves, and the shapes in it.

    Args:
        x: The lowest and highest first coordinate.
        y: The lowest and highest second coordinate.
        unit: The unit of both, for the axes.
        shapes: The shapes from bottom to top.
        step_length: The length by which an action a moves the agent, ``step_length * a``; None
            where actions are no moves, so that sets of actions cannot be drawn on the map.
        goal_radius: The radius of the disc in which a goal counts as reached; None draws none.
        names: The names of both coordinates, for the axes.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    unit: str = ""
    shapes: tuple[Shape, ...] = ()
    step_length: float | None = None
    goal_radius: float | None = None
    names: tuple[str, str] = ("x", "y")

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
        name: The series' name; with that of a constraint it has the constraint's color.
        unit: The unit, such as ``%``.
        threshold: The value at which a line is drawn.
        limits: The lowest and highest possible value.
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


@dataclass(frozen=True)
class Component:
    """A component of an action or of an observation.

    Args:
        name: The component's name, such as ``hip torque``.
        unit: The unit, such as ``N m``.
    """

    name: str
    unit: str = ""

    @property
    def title(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


class TaskView:
    """The view of a task on its states, empty until a subclass overrides parts of it."""

    action_components: Sequence[Component] = ()
    """The names and units of the action's components, all of them or none."""

    observation_components: Sequence[Component] = ()
    """The names and units of the components of ``observation``, all of them or none."""

    map: Map | None = None
    """The map, for tasks in a plane; then `position` is needed."""

    series: Sequence[Series] = ()
    """Numbers to draw over time; then `series_values` is needed."""

    position_keys: Sequence[NestedKey] = ()
    """The entries of a state that `position` reads; with them, unlogged steps take less time."""

    state_setter: StateSetter | None = None
    """The function that puts the environment into chosen states; None where none can."""

    def position(self, states: TensorDictBase) -> Tensor:
        """Return the agent's positions on the map, ``(*batch, 2)``."""
        raise NotImplementedError(f"{type(self).__name__} has a map and needs `position`")

    def goal(self, states: TensorDictBase) -> Tensor | None:
        """Return the goals' positions, ``(*batch, 2)``; None for tasks without a goal."""
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
        """Return states ``(n,)`` to choose a permissive one from, and others for a restrictive one.

        Args:
            env: The environment with all transforms; may be reset.

        Returns:
            Both batches of states, as the environment publishes them; None takes a random walk's.
        """
        return None


NOTHING: TaskView = TaskView()
"""The view of a task that shows nothing."""


class ShowTask(Transform):
    """Give a view to an environment whose class has none; change nothing else.

    Args:
        view: The view.

    Raises:
        TypeError: for anything that is no `TaskView`.
    """

    def __init__(self, view: TaskView) -> None:
        super().__init__()
        if not isinstance(view, TaskView):
            raise TypeError(
                "env.view: expected an instance of a class derived from "
                f"cnfp_torchrl.envs.TaskView, given {view!r}"
            )
        self.view = view

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset


def find_task_view(env: EnvBase | None) -> TaskView:
    """Return the view of an environment, which may be below transforms; else an empty one.

    Environments that run in workers are not asked.
    """
    for layer in environment_layers(env):
        if isinstance(layer, TransformedEnv):
            views = [t.view for t in appended_transforms(layer) if isinstance(t, ShowTask)]
            if views:
                return views[-1]
        # Not hasattr(layer, ...): a batched environment that was never reset would forward that to
        # its workers, which do not exist yet.
        elif hasattr(type(layer), "task_view"):
            return layer.task_view(env)  # type: ignore[attr-defined]
    return NOTHING


def action_components(env: EnvBase | None, dim: int) -> tuple[Component, ...]:
    """Return what the components of an environment's action are called, with their units.

    The task's names come first, then those of MuJoCo's actuators, then numbers: ``a1``, ``a2``, ...

    Args:
        env: The environment; None numbers the components.
        dim: The dimension of the action space.

    Raises:
        ValueError: when the task names another number of components, or two of them alike.
    """
    view = find_task_view(env)
    named = tuple(view.action_components)
    if not named:
        return _actuators(env, dim) or numbered_components("a", dim)
    require_names("action_components", "action", named, dim, view)
    return named


def numbered_components(letter: str, count: int) -> tuple[Component, ...]:
    """Return components without names of their own, counted from 1."""
    return tuple(Component(f"{letter}{i + 1}") for i in range(count))


def require_names(
    field: str, whose: str, named: Sequence[Component], count: int, view: TaskView
) -> None:
    """Refuse names of a task's view that do not fit.

    Args:
        field: The field of the view.
        whose: The vector that is named.
        named: The names and units.
        count: The vector's number of components.
        view: The view.

    Raises:
        ValueError: when there are more or fewer names than components, or two that are alike.
    """
    given = [component.name for component in named]
    if len(given) != count:
        raise ValueError(
            f"{field}: expected {count} names, one for each component of the {whose}, "
            f"given {len(given)} by {type(view).__name__}"
        )
    if len(set(given)) != count:
        raise ValueError(
            f"{field}: expected a different name for each component of the {whose}, given {given} "
            f"by {type(view).__name__}"
        )


def _actuators(env: EnvBase | None, dim: int) -> tuple[Component, ...]:
    """Return the names of MuJoCo's actuators, where an environment has them."""
    for layer in environment_layers(env):
        model: Any = getattr(layer, "__dict__", {}).get("model")
        if getattr(model, "nu", None) == dim:
            names = [model.actuator(i).name or f"a{i + 1}" for i in range(dim)]
            return tuple(Component(name) for name in names)
    return ()


def environment_layers(env: EnvBase | None) -> Iterator[object]:
    """Yield an environment and what it wraps, to the innermost one.

    Of environments in a row, `torchrl.envs.SerialEnv`, the first one is taken, once they are made,
    which is at the first reset; what runs in workers is out of reach.
    """
    layer: object = env
    while layer is not None:
        yield layer
        fields = getattr(layer, "__dict__", {})
        if isinstance(layer, TransformedEnv):
            layer = layer.base_env
        elif isinstance(layer, SerialEnv):
            layer = None if layer.is_closed else next(iter(fields.get("_envs", [])), None)
        else:
            layer = getattr(fields.get("_env"), "unwrapped", None)
