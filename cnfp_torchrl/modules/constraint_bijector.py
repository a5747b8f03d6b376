"""The bijector of one constraint as a TensorDictModule."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from cnfp_torchrl.bijectors import Bijector, paper_squash
from cnfp_torchrl.geometry import ConstraintSet
from cnfp_torchrl.keys import (
    ACTION_KEY,
    LOG_DET_KEY,
    active_key,
    field_key,
    refuse_string,
    relaxation_key,
    require,
    row_relaxation_key,
)


class ConstraintBijector(TensorDictModuleBase):
    """Turn the geometry of one constraint in a tensordict into a bijector.

    An actor takes such modules and combines their sets (`ConstrainedFlowModule`). Called alone, the
    module pushes the sample through the constraint's own squash and adds the log-determinant.

    Args:
        name: The constraint's name; its geometry lies at ``("constraints", name, FIELD)``.
        set_type: The family of its sets, such as `cnfp_torchrl.geometry.Ball`.
        sample_key: The key of the sample ``(*batch, d)`` that `forward` replaces.
        log_det_key: The key of the log-determinant ``(*batch,)`` that `forward` adds to, from 0 if
            absent.

    Raises:
        TypeError: when `set_type` is no subclass of `ConstraintSet`.
    """

    def __init__(
        self,
        name: str,
        set_type: type[ConstraintSet],
        *,
        sample_key: NestedKey = ACTION_KEY,
        log_det_key: NestedKey = LOG_DET_KEY,
    ) -> None:
        super().__init__()
        if not (isinstance(set_type, type) and issubclass(set_type, ConstraintSet)):
            raise TypeError(
                f"set_type of constraint '{name}': expected a subclass of ConstraintSet such as "
                f"cnfp_torchrl.geometry.Ball, given {set_type!r}"
            )
        self.name = name
        self.set_type = set_type
        self.sample_key = sample_key
        self.log_det_key = log_det_key
        self.geometry_keys: list[NestedKey] = [field_key(name, f) for f in set_type.event_dims]
        self.in_keys = [*self.geometry_keys, sample_key]
        self.out_keys = [sample_key, log_det_key]

    @property
    def active_key(self) -> NestedKey:
        """The key of whether the constraint holds in a state, which `ConstraintAnchor` writes."""
        return active_key(self.name)

    @property
    def relaxation_key(self) -> NestedKey:
        """The key of the amount by which the constraint was widened, by `ConstraintAnchor`."""
        return relaxation_key(self.name)

    @property
    def row_relaxation_key(self) -> NestedKey | None:
        """The key of the same amounts row by row, None if the family has no rows."""
        return row_relaxation_key(self.name) if self.set_type.has_rows() else None

    @property
    def amounts_key(self) -> NestedKey:
        """The key of the amounts by which a flow widens the set, row by row if there are rows."""
        return self.row_relaxation_key or self.relaxation_key

    def get_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        """Return the sets of allowed actions; their values were checked when published.

        Raises:
            MissingGeometryError: when the geometry is missing, naming the key.
        """
        remedy = f"append the environment transform that publishes constraint '{self.name}'"
        values = {
            field: require(tensordict, key, remedy)
            for key, field in zip(self.geometry_keys, self.set_type.event_dims, strict=True)
        }
        return self.set_type(**values, validate_args=False)

    def get_transform(self, tensordict: TensorDictBase) -> Bijector:
        """Return the constraint's own squash, onto its set alone (the paper's squash)."""
        return paper_squash(self.get_set(tensordict))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Push the sample through `get_transform` and add its log-determinant."""
        sample, log_det = self.get_transform(tensordict).forward_and_log_det(
            tensordict.get(self.sample_key)
        )
        before = tensordict.get(self.log_det_key, None)
        tensordict.set(self.sample_key, sample)
        tensordict.set(self.log_det_key, log_det if before is None else before + log_det)
        return tensordict

    def __repr__(self) -> str:
        return f"ConstraintBijector({self.name!r}, {self.set_type.__name__})"


def in_order(
    bijectors: Sequence[ConstraintBijector], order: Sequence[str] | None
) -> list[ConstraintBijector]:
    """Return the bijectors in order of application: lowest priority first, highest last.

    Args:
        bijectors: One for each constraint.
        order: The constraints' names in order of application; None takes the bijectors' own.

    Raises:
        TypeError: when a bijector is no `ConstraintBijector`, or the order is a string.
        ValueError: when a name is unknown, missing or repeated.
    """
    for bijector in bijectors:
        if not isinstance(bijector, ConstraintBijector):
            raise TypeError(
                "bijectors: expected a sequence of ConstraintBijector, given one with a "
                f"{type(bijector).__name__} in it; write bijectors=constraint_bijectors(env)"
            )
    refuse_string("order", order)
    names = [bijector.name for bijector in bijectors]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            "names: expected a name of its own for each constraint, given "
            f"{repeated} more than once"
        )
    wanted = list(names if order is None else order)
    if sorted(wanted) != sorted(names):
        raise ValueError(
            f"order: expected each of the constraints {names} exactly once, given {wanted}"
        )
    by_name = dict(zip(names, bijectors, strict=True))
    return [by_name[name] for name in wanted]
