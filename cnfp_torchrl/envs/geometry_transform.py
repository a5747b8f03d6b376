"""The base of all transforms that publish a constraint's allowed actions into the tensordict."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, EnvBase, Transform

from cnfp_torchrl.geometry import ConstraintSet, GeometryError

CONSTRAINTS_KEY = "constraints"
"""Where geometry stands in the tensordict: ``("constraints", NAME, FIELD)``."""

SAFE_ACTION_KEY = (CONSTRAINTS_KEY, "safe_action")
"""A candidate for the centre: an action that a geometry believes to be safe, ``(*batch, d)``."""

_RESERVED_NAMES = ("centre", "safe_action")


class GeometryTransform(Transform, ABC):
    """Publishes one constraint's set of allowed actions, as a function of the state.

    A new constraint is one method::

        class SpeedLimit(GeometryTransform):
            def constraint_set(self, tensordict):
                speed = tensordict["observation"][..., 3:]
                return Ball(-speed, torch.ones_like(speed[..., 0]), validate_args=False)

        env.append_transform(SpeedLimit("speed_limit"))

    The set's fields then stand at ``("constraints", "speed_limit", FIELD)`` after every reset and
    step, and in the specs. In a replay buffer (``buffer.append_transform``) they are computed at
    sampling, at the root and under ``next``, instead of being stored.

    Everything is checked here, eagerly, once a step, so that nothing has to be checked later in
    compiled code. A set must be valid in every state, also where no action keeps the constraint:
    publish one that misses the action bounds there; the flow drops it in that state and says so.

    Args:
        name: the constraint's name, by which flow and order refer to it.
        in_keys: what `constraint_set` reads; refused when not finite.

    Raises:
        ValueError: for a bad or reserved name.
        GeometryError: for input that is not finite, and for a set that is not one, naming key or
            constraint and field, and the batch index.
    """

    def __init__(self, name: str, in_keys: Sequence[NestedKey] = ("observation",)) -> None:
        if not isinstance(name, str) or not name or name in _RESERVED_NAMES:
            raise ValueError(
                f"name: expected a constraint's name other than {list(_RESERVED_NAMES)}, "
                f"given {name!r}"
            )
        super().__init__(in_keys=list(in_keys), out_keys=[(CONSTRAINTS_KEY, name)])
        self.name = name

    @abstractmethod
    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the allowed actions of each state.

        The specs are derived from what this returns for the zero of the observation spec. Construct
        the set with ``validate_args=False``: this class validates it, and names the constraint.

        Args:
            tensordict: a state of any batch size; not to be changed.

        Returns:
            a set whose fields have, or broadcast to, the tensordict's batch size.
        """

    def safe_action(self, tensordict: TensorDictBase, allowed: ConstraintSet) -> Tensor | None:
        """Return an action believed to keep all constraints, ``(*batch, d)``, or None.

        It is a candidate for the centre of the allowed actions and will be checked.

        Args:
            tensordict: a state of any batch size; not to be changed.
            allowed: what `constraint_set` returned for it.
        """
        return None

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        published = set(observation_spec.keys(include_nested=True, leaves_only=True))
        if missing := [key for key in self.in_keys if key not in published]:
            raise KeyError(
                f"constraint '{self.name}': expected to read {missing}, "
                f"given an environment with {sorted(map(str, published))}"
            )
        entries = self._entries(observation_spec.zero())
        for key, value in entries.items():
            if key in published:
                raise ValueError(
                    f"constraint '{self.name}': expected to be the only one to publish {key}, "
                    "given another transform that does; rename one, or drop one's safe action"
                )
            observation_spec[key] = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Publish at the root and, if there is one, under ``next``: for use in a replay buffer."""
        self._call(tensordict)
        if "next" in tensordict.keys():  # noqa: SIM118 - a tensordict iterates over its batch
            self._call(tensordict.get("next"))
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.in_keys:
            self._refuse_what_is_not_finite(key, next_tensordict.get(key))
        for key, value in self._entries(next_tensordict, validate=True).items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _entries(
        self, tensordict: TensorDictBase, *, validate: bool = False
    ) -> dict[tuple[str, ...], Tensor]:
        allowed = self.constraint_set(tensordict)
        if validate:
            allowed.validate(self.name)
        batch = tensordict.batch_size
        entries: dict[tuple[str, ...], Tensor] = {}
        for field, value in allowed.fields().items():
            event = value.shape[value.ndim - allowed.event_dims[field] :]
            try:
                expanded = value.expand((*batch, *event)).contiguous()
            except RuntimeError:
                raise GeometryError(
                    f"constraint '{self.name}', field '{field}': expected a batch shape that "
                    f"broadcasts to {tuple(batch)}, given shape {tuple(value.shape)}"
                ) from None
            entries[CONSTRAINTS_KEY, self.name, field] = expanded
        action = self.safe_action(tensordict, allowed)
        if action is not None:
            entries[SAFE_ACTION_KEY] = action
        return entries

    def _refuse_what_is_not_finite(self, key: NestedKey, value: Tensor) -> None:
        finite = value.isfinite()
        if not bool(finite.all()):
            index = (~finite).nonzero()[0].tolist()
            raise GeometryError(
                f"constraint '{self.name}', key {key!r} at index {index}: expected a finite "
                f"number, given {value[tuple(index)].item()}"
            )


def appended_transforms(env: EnvBase) -> list[Transform]:
    """Return the transforms of an environment in order, none if it has none."""
    transform = getattr(env, "transform", None)
    if transform is None:
        return []
    return list(transform) if isinstance(transform, Compose) else [transform]
