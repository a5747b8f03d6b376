"""The base of all transforms that publish a constraint's allowed actions into the tensordict."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, NoReturn, Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from cnfp_torchrl.geometry import (
    ConstraintSet,
    Evidence,
    GeometryError,
    are_within,
    extremes,
)
from cnfp_torchrl.keys import (
    CONSTRAINTS_KEY,
    RESERVED_NAMES,
    SAFE_ACTION_KEY,
    field_key,
    refuse_non_finite,
    refuse_string,
)
from cnfp_torchrl.modules import (
    ConstraintBijector,
    ConstraintPublisher,
    action_bounds,
    appended_transforms,
)


class GeometryTransform(Transform, ConstraintPublisher):
    """Publish one constraint's set of allowed actions, as a function of the state.

    A new constraint is one method::

        class SpeedLimit(GeometryTransform):
            def constraint_set(self, tensordict):
                speed = tensordict["observation"][..., 3:]
                return Ball(-speed, torch.ones_like(speed[..., 0]), validate_args=False)

        env.append_transform(SpeedLimit("speed_limit"))

    The set's fields then stand at ``("constraints", "speed_limit", FIELD)`` after every reset and
    step, and in the specs. In a replay buffer (``buffer.append_transform``) they are computed at
    sampling, at the root and under ``next``, instead of being stored.

    Everything is checked once a step, so that nothing has to be checked later in compiled code. In
    an environment of `constrain_env` all checks of a step are read on the host together with
    whether the anchors need a search: on a GPU it is waited for once.

    A set must be valid in every state, even where no action keeps the constraint: publish one that
    misses the action bounds there. It is relaxed in that state, and the relaxation is published.
    The sets of all states are of one family.

    Args:
        name: The constraint's name, by which flow and order refer to it.
        in_keys: The keys of all entries that `constraint_set` and `safe_action` read, nested ones
            as tuples or lists; values that are not finite are refused.
        margin: The distance in action units by which every action is to stay inside, such as an
            actuator's error. The published set is moved inwards by it.
        resolution: The grid to which actions are rounded, to the nearest point, before they are
            executed: a step in action units, or the actuator's dtype. A floating one, such as
            ``torch.float16``, has steps relative to the largest action; an integer one, such as
            ``torch.int8``, divides the action bounds. The set is moved inwards by half of the
            grid's diagonal, so that the rounded action lies in the set that was stated. Action
            bounds are not moved: they are to be points of the grid.
        validate: Whether the values that `constraint_set` reads and returns are checked at each
            step. Without it NaN or a set that is none leads to actions that guarantee nothing.

    Raises:
        ValueError: for a bad or reserved name, a margin below 0 or a resolution that is no step.
        TypeError: for `in_keys` that are a string, and where `constraint_set` returns no set.
        GeometryError: for reading other entries than `in_keys`, for input that is not finite, for a
            set that is not one, for a second family, for a family that breaks the contract of
            `ConstraintSet` and, at the first batch, for sets that depend on other states than their
            own, naming key or constraint and field, and the batch index.
    """

    _family: type[ConstraintSet] | None = None
    _is_compared = False
    is_published_by_another = False
    """Whether a transform behind this one publishes the set, in the environment's steps."""
    _valid_shapes: list[tuple[torch.Size, torch.dtype]] | None = None

    def __init__(
        self,
        name: str,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        margin: float = 0.0,
        resolution: float | torch.dtype | None = None,
        validate: bool = True,
    ) -> None:
        if not isinstance(name, str) or not name or name in RESERVED_NAMES:
            raise ValueError(
                f"name: expected a constraint's name other than {list(RESERVED_NAMES)}, "
                f"given {name!r}"
            )
        refuse_string("in_keys", in_keys)
        # A configuration has lists where nested keys are tuples.
        keys = [tuple(key) if isinstance(key, list) else key for key in in_keys]
        super().__init__(in_keys=keys, out_keys=[(CONSTRAINTS_KEY, name)])
        if not 0 <= margin < math.inf:
            raise ValueError(f"margin: expected a distance >= 0 in action units, given {margin}")
        if isinstance(resolution, int | float) and not 0 < resolution < math.inf:
            raise ValueError(f"resolution: expected a step > 0 or a dtype, given {resolution}")
        self.name = name
        self.margin, self.resolution, self.validate = margin, resolution, validate
        self._inwards: float | None = None

    @abstractmethod
    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the allowed actions of each state.

        The specs are derived from what this returns for the zero of the observation spec. Construct
        the set with ``validate_args=False``: this class validates it, and names the constraint.

        Args:
            tensordict: States of any batch size; not to be changed.

        Returns:
            A set whose fields have, or broadcast to, the tensordict's batch size.
        """

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor | None:
        """Return an action believed to keep all constraints, ``(*batch, d)``, or None.

        It is a candidate for the anchor of the allowed actions and will be checked.

        Args:
            tensordict: States of any batch size; not to be changed.
            allowed: The set that is published for them.
        """
        return None

    @property
    def bijectors(self) -> list[ConstraintBijector]:
        """The module of this constraint, in a list of one."""
        if self._family is None:
            raise RuntimeError(
                f"constraint '{self.name}': expected to be part of an environment whose specs were "
                "read, which tells the family of its sets; use constraint_bijectors(env)"
            )
        return [ConstraintBijector(self.name, self._family)]

    def checked_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the set to publish in some states, if it is of the same family as before.

        It is moved inwards by margin and resolution. Its values are not checked.

        Raises:
            TypeError: when it is no `ConstraintSet`.
            GeometryError: for another family than before, and one that breaks the contract.
        """
        allowed = self._own("constraint_set", self.constraint_set, tensordict)
        if type(allowed) is not self._family:
            self._refuse_what_is_no_set(allowed)
            self._family = type(allowed)
        return self._moved_inwards(allowed)

    def entries(self, tensordict: TensorDictBase) -> dict[tuple[str, ...], Tensor]:
        """Return what is published in some states, without a check, as exported programs need it.

        Args:
            tensordict: States of any batch size; not changed.
        """
        return self.published(tensordict, self.checked_set(tensordict))

    def _validated(self, allowed: ConstraintSet) -> ConstraintSet:
        try:
            return allowed.validate(self.name)
        except GeometryError as error:
            if self._inwards:
                error.add_note(
                    f"after the set was moved inwards by {self._inwards:.3g} for margin and "
                    "resolution, which leaves nothing of it in this state: take less, or state the "
                    "constraint as HalfSpaces, which give way by the least amount and say so"
                )
            raise

    def _moved_inwards(self, allowed: ConstraintSet) -> ConstraintSet:
        """Return the set less all that is closer to its boundary than margin and rounding."""
        if self._inwards is None:
            self._inwards = self.margin + self._largest_rounding(allowed.dim)
        if self._inwards == 0:
            return allowed
        if not allowed.can_be_inflated():
            raise TypeError(
                f"constraint '{self.name}': expected a family of sets that can be moved inwards by "
                f"margin and resolution, one that states `inflated`, given {type(allowed).__name__}"
            )
        first = next(iter(allowed.fields().values()))
        return allowed.inflated(first.new_full((1,), -self._inwards))

    def _largest_rounding(self, dim: int) -> float:
        """Return the largest distance by which rounding to the actuator's grid moves an action."""
        if self.resolution is None:
            return 0.0
        if not isinstance(self.resolution, torch.dtype):
            return self.resolution / 2 * math.sqrt(dim)
        if self.parent is None:
            raise RuntimeError(
                f"constraint '{self.name}': expected to be part of an environment, which knows the "
                "action bounds that a dtype's resolution depends on; append it first"
            )
        bounds = action_bounds(self.parent.full_action_spec, self.parent.action_key).to(
            torch.float64
        )
        if self.resolution.is_floating_point:
            largest = torch.maximum(bounds.low.abs(), bounds.high.abs())
            steps = torch.finfo(self.resolution).eps * largest
        else:
            limits = torch.iinfo(self.resolution)
            steps = (bounds.high - bounds.low) / (limits.max - limits.min)
        return float(steps.norm()) / 2

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        published = set(observation_spec.keys(include_nested=True, leaves_only=True))
        if missing := [key for key in self.in_keys if key not in published]:
            raise KeyError(
                f"constraint '{self.name}': expected to read {missing}, "
                f"given an environment with {sorted(map(str, published))}; {self._remedy()}"
            )
        # Nothing else, as policies without an environment and replay buffers have nothing else.
        state = observation_spec.zero().select(*self.in_keys)
        try:
            allowed = self.checked_set(state)
            entries = self.published(state, allowed)
            if state.numel():
                self._refuse_what_follows_the_batch(state, allowed)
        except Exception as error:
            if _is_missing_entry(error):
                raise GeometryError(
                    f"constraint '{self.name}': expected {type(self).__name__} to read no entries "
                    f"of a state but its in_keys, {self.in_keys}, given one that needs others "
                    f"({error.args[0]}); {self._remedy()}, of {sorted(map(str, published))}"
                ) from error
            error.add_note(
                "called for the zero of the observation spec, which need not be a state of the "
                "environment, because the shapes and dtypes of the specs are those of the set "
                "returned for it; its values are not used, so that any will do"
            )
            raise
        self._refuse_slack_of_wrong_shape(allowed, state.batch_size)
        for key, value in entries.items():
            if key in published:
                raise ValueError(
                    f"constraint '{self.name}': expected to be the only one to publish {key}, "
                    "given another transform that does; rename one, or drop one's safe action"
                )
            observation_spec[key] = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Publish at the root and, where it exists, under ``next``: for use in a replay buffer."""
        # An environment may be in the middle of an episode, and goes on as before.
        before, self.is_published_by_another = self.is_published_by_another, False
        try:
            self._call(tensordict)
            if "next" in tensordict.keys():  # noqa: SIM118 - a tensordict iterates over its batch
                self._call(tensordict.get("next"))
        finally:
            self.is_published_by_another = before
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.is_published_by_another:
            return next_tensordict
        allowed, _ = self.write_set(next_tensordict)
        if self.validate:
            check = self.check(next_tensordict, allowed)
            found = evidence([check])
            values = torch.stack([evidence.value for evidence in found]).tolist() if found else []
            if not are_within(values, (evidence.limit for evidence in found)):
                refuse_values([check])
        if not self._is_compared and next_tensordict.numel() > 1:
            self._refuse_what_follows_the_batch(next_tensordict, allowed)
            self._is_compared = True
        return next_tensordict

    def write_set(
        self, states: TensorDictBase
    ) -> tuple[ConstraintSet, dict[tuple[str, ...], Tensor]]:
        """Write the set of some states, and a safe action if there is one, into them.

        Values are left for the caller to check (`check`).

        Args:
            states: States of any batch size.

        Returns:
            The set with its fields as they are published, and all that was written.
        """
        try:
            allowed = self.checked_set(states)
        except Exception:
            self._refuse_what_is_not_finite(states)  # the likely cause
            raise
        if self.validate and not torch.compiler.is_compiling():
            self._check_shapes(allowed)
        entries = self.published(states, allowed)
        write_entries(states, entries)
        fields = allowed.fields()
        as_published = {field: entries[field_key(self.name, field)] for field in fields}
        if any(as_published[field] is not value for field, value in fields.items()):
            # Not strided ones, over which all that follows takes longer.
            allowed = type(allowed)(**as_published, validate_args=False)
        return allowed, entries

    def _check_shapes(self, allowed: ConstraintSet) -> None:
        shapes = [(value.shape, value.dtype) for value in allowed.fields().values()]
        if shapes != self._valid_shapes:
            allowed.validate_shapes(self._where(allowed))
            self._valid_shapes = shapes

    def check(self, states: TensorDictBase, allowed: ConstraintSet) -> Check:
        """Return what is to be checked of some states and their `checked_set`."""
        inputs = {key: states.get(key) for key in self.in_keys}
        return Check(self.name, inputs, allowed, partial(self._refuse_values, states, allowed))

    def _refuse_values(self, states: TensorDictBase, allowed: ConstraintSet) -> None:
        self._refuse_what_is_not_finite(states)
        self._validated(allowed)

    def __getstate__(self) -> dict[str, Any]:
        # Whoever publishes it between resets stays behind.
        return {**super().__getstate__(), "is_published_by_another": False}

    def clone(self) -> Self:
        """Return a copy without environment, which publishes its set itself."""
        copy = super().clone()
        copy.is_published_by_another = False
        return copy

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.is_published_by_another:
            # Unless that transform was taken away since, or no longer follows.
            others = (t for t in appended_transforms(self.container) if t is not self)
            publishers = (t for t in others if isinstance(t, ConstraintPublisher))
            self.is_published_by_another = any(t.publishes_for(self) for t in publishers)
        return self._call(tensordict_reset)

    def published(
        self, tensordict: TensorDictBase, allowed: ConstraintSet
    ) -> dict[tuple[str, ...], Tensor]:
        """Return what is published in some states of their `checked_set`.

        Args:
            tensordict: States of any batch size; not changed.
            allowed: The states' set.
        """
        batch = tensordict.batch_size
        entries: dict[tuple[str, ...], Tensor] = {}
        for field, value in allowed.fields().items():
            event = value.shape[value.ndim - allowed.event_dims[field] :]
            shape = (*batch, *event)
            if value.shape != shape:
                try:
                    value = value.expand(shape)
                except RuntimeError:
                    raise GeometryError(
                        f"constraint '{self.name}', field '{field}': expected a batch shape that "
                        f"broadcasts to {tuple(batch)}, given shape {tuple(value.shape)}"
                    ) from None
            entries[field_key(self.name, field)] = value.contiguous()
        action = self._own("safe_action", self.safe_action, tensordict, allowed)
        if action is not None:
            expected = (*batch, allowed.dim)
            _refuse_other_shape(f"{self._at('safe_action')}: expected None or", action, expected)
            entries[SAFE_ACTION_KEY] = action
        return entries

    def _at(self, method: str) -> str:
        return f"constraint '{self.name}', {type(self).__name__}.{method}"

    def _remedy(self) -> str:
        return (
            f"name all that it reads, as in {type(self).__name__}('{self.name}', "
            "in_keys=['observation', ('nested', 'key')]), or in a configuration by in_keys: "
            "[observation, [nested, key]]"
        )

    def _own(self, method: str, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call a constraint's own code; its errors get the names of constraint and method."""
        try:
            return call(*arguments)
        except AttributeError as error:
            # An environment would report the AttributeError itself as a missing spec.
            raise GeometryError(f"{self._at(method)}: AttributeError: {error}") from error
        except Exception as error:
            error.add_note(f"raised by {self._at(method)}")
            raise

    def _where(self, allowed: ConstraintSet) -> str:
        return f"constraint '{self.name}' ({type(allowed).__name__})"

    def _refuse_what_is_no_set(self, allowed: ConstraintSet) -> None:
        family = type(allowed)
        if not isinstance(allowed, ConstraintSet):
            raise TypeError(
                f"{self._at('constraint_set')}: expected it to return a ConstraintSet such as "
                f"cnfp_torchrl.geometry.Ball, given {family.__name__}"
            )
        if self._family is not None:
            raise GeometryError(
                f"{self._where(allowed)}: expected a {self._family.__name__}, as in the states "
                f"before, given a {family.__name__}; return sets of one family in all states"
            )
        allowed.validate_shapes(self._where(allowed))

    def _refuse_what_follows_the_batch(
        self, states: TensorDictBase, allowed: ConstraintSet
    ) -> None:
        """Refuse sets of states that are not those of the same states in another batch.

        One half-space for each state, given as normals ``(*batch, d)``, has the shape of a single
        set of as many half-spaces as there are states. ``observation[0, 3:]`` in place of
        ``observation[..., 3:]`` has the shape of a set that all states share, and is the first
        state's. Compared for the last state, alone or twice, up to the rounding of other batch
        sizes.
        """
        last = states.reshape(-1)[-1:]
        other = self.checked_set(last if states.numel() > 1 else last.expand(2).clone())
        # Not with limits of its own for each environment of this batch, which no state tells.
        compares = other.batch_shape.numel() == 1 or states.numel() == 1
        for field, value in allowed.fields().items():
            event, batch = allowed.event_dims[field], states.batch_size
            given, alone = value, other.fields()[field]
            shapes = [tuple(values.shape[values.ndim - event :]) for values in (given, alone)]
            where = f"constraint '{self.name}', field '{field}'"
            if shapes[0] != shapes[1]:
                raise GeometryError(
                    f"{where}: expected one shape of a state's set whatever the batch, given "
                    f"{shapes[0]} for {states.numel()} states and {shapes[1]} for "
                    f"{2 if states.numel() == 1 else 1}; put the batch first, and then what "
                    "belongs to one set: a single half-space for each state has normals "
                    "(*batch, 1, d) and offsets (*batch, 1)"
                )
            if not compares:
                continue
            given = given.expand((*batch, *shapes[0])).reshape(-1, *shapes[0])[-1]
            alone = alone.reshape(-1, *shapes[0])[-1]
            atol = 1e-5 * float(given.masked_fill(~given.isfinite(), 0).abs().amax())
            if not torch.allclose(alone, given, rtol=1e-3, atol=atol, equal_nan=True):
                raise GeometryError(
                    f"{where}: expected that of a state whatever other states are beside it, given "
                    f"{given.tolist()} for the last of {states.numel()} states and "
                    f"{alone.tolist()} for the same state alone; compute it from each state's own "
                    "entries, such as observation[..., 3:]"
                )

    def _refuse_slack_of_wrong_shape(self, allowed: ConstraintSet, batch: torch.Size) -> None:
        zeros = next(iter(allowed.fields().values())).new_zeros(*batch, allowed.dim)
        method = f"constraint_set, {type(allowed).__name__}.slack"
        slack = self._own(method, allowed.slack, zeros)
        given = f"for actions {tuple(zeros.shape)} expected"
        _refuse_other_shape(f"{self._at(method)}: {given}", slack, batch)

    def _refuse_what_is_not_finite(self, states: TensorDictBase) -> None:
        for key in self.in_keys:
            name = f"constraint '{self.name}', key {key!r}"
            refuse_non_finite(name, states.get(key), error=GeometryError)


def _is_missing_entry(error: BaseException) -> bool:
    """Tell a tensordict's error of a missing entry from that of a constraint's own dictionary."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    return isinstance(error, KeyError) and module.partition(".")[0] == "tensordict"


def write_entries(states: TensorDictBase, entries: Mapping[Any, Tensor]) -> None:
    """Write entries into states, by their keys."""
    for key, value in entries.items():
        states.set(key, value)


class Check(NamedTuple):
    """What is to be checked of some states: the values that were read and the set they led to."""

    name: str
    inputs: dict[NestedKey, Tensor]
    allowed: ConstraintSet
    refuse: Callable[[], None]
    """Raise if a value is not as it must be."""


def evidence(checks: Sequence[Check]) -> list[Evidence]:
    """Return numbers that are all within their limits if all values are as they must be.

    Args:
        checks: Checks of the same states.
    """
    # What several constraints read is looked at once.
    inputs = {key: value for check in checks for key, value in check.inputs.items()}
    found = [
        evidence
        for value in inputs.values()
        if value.is_floating_point()
        for evidence in extremes(value, torch.finfo(value.dtype).max)
    ]
    return found + [evidence for check in checks for evidence in check.allowed.evidence()]


def refuse_values(checks: Sequence[Check]) -> NoReturn:
    """Refuse values whose `evidence` is beyond its limits.

    Raises:
        GeometryError: naming constraint, field and batch index; the constraints alone, where
            looking at the values one by one finds nothing wrong with them.
    """
    for check in checks:
        check.refuse()
    raise GeometryError(
        f"constraints {[check.name for check in checks]}: expected values within the limits of "
        "their families' `evidence`, given some beyond that their `invalid_fields` accept; let the "
        "two agree, and where steps are compiled, let `constraint_set` compute the same compiled "
        "and not"
    )


def _refuse_other_shape(expected: str, given: Tensor, shape: Sequence[int]) -> None:
    if not isinstance(given, Tensor) or given.shape != torch.Size(shape):
        what = tuple(given.shape) if isinstance(given, Tensor) else type(given).__name__
        raise GeometryError(f"{expected} a tensor of shape {tuple(shape)}, given {what}")
