"""Checks of what a family's methods take and return: fields, shapes, dtypes, batches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from cnfp_torchrl.geometry import ConstraintSet, GeometryError
from cnfp_torchrl.testing.family_error import FamilyError, called, shown


def check_event_dims(sets: ConstraintSet, anchor: Tensor) -> None:
    """`event_dims` maps each field to its number of event dimensions, and fits the example."""
    family = type(sets)
    fields = [field.name for field in dataclasses.fields(sets)]
    dims = getattr(sets, "event_dims", None)
    if not isinstance(dims, Mapping) or not all(
        isinstance(name, str) and isinstance(number, int) and number >= 0
        for name, number in dims.items()
    ):
        raise FamilyError(
            family,
            "event_dims",
            "expected a mapping from each field's name to its number of event dimensions, such as "
            f'{{"center": 1, "radius": 0}} for {fields}, given {dims!r}',
        )
    try:
        sets.validate_shapes(family.__name__)
    except GeometryError as error:
        raise FamilyError(
            family, "event_dims", f"expected to fit the fields, given {dict(dims)}: {error}"
        ) from error
    if sets.dtype != anchor.dtype:
        raise ValueError(
            f"anchor: expected the dtype of the sets, {sets.dtype}, given {anchor.dtype}"
        )
    if sets.dim != anchor.shape[-1]:
        raise FamilyError(
            family,
            "event_dims",
            f"expected the anchor's action dimension, {anchor.shape[-1]}, given {sets.dim}, the "
            "last size of the first field with event dimensions",
        )
    try:
        torch.broadcast_shapes(sets.batch_shape, anchor.shape[:-1])
    except RuntimeError:
        shapes = {name: tuple(field.shape) for name, field in sets.fields().items()}
        raise FamilyError(
            family,
            "event_dims",
            f"expected a batch shape that broadcasts with the anchor's, {tuple(anchor.shape[:-1])},"
            f" given {tuple(sets.batch_shape)}, from fields {shapes} and {dict(dims)}",
        ) from None


def check_invalid_fields(sets: ConstraintSet, anchor: Tensor) -> None:
    """`invalid_fields` yields (field, boolean mask, expected), and accepts the example."""
    family = type(sets)
    for rule in called(family, "invalid_fields", lambda: list(sets.invalid_fields())):
        if not (isinstance(rule, tuple) and len(rule) == 3 and rule[0] in sets.event_dims):
            raise FamilyError(
                family,
                "invalid_fields",
                f"expected (field, mask of bad elements, what was expected), given {rule!r}",
            )
        field, bad, _ = rule
        if not isinstance(bad, Tensor) or bad.dtype != torch.bool:
            given = getattr(bad, "dtype", type(bad).__name__)
            raise FamilyError(
                family, "invalid_fields", f"expected a boolean mask for '{field}', given {given}"
            )
    try:
        sets.validate()
    except GeometryError as error:
        raise FamilyError(
            family, "invalid_fields", f"expected to accept the example: {error}"
        ) from error


def check_output_shapes(sets: ConstraintSet, anchor: Tensor) -> None:
    """Results have the shape (*sample, *batch), sets the fields' event shapes, all one dtype."""
    batch = torch.broadcast_shapes(sets.batch_shape, anchor.shape[:-1])
    whole = anchor.expand(*batch, -1)
    ones = torch.ones_like(whole)
    for sample in ((), (3,), (5, 4)):
        action, direction = (x.expand(*sample, *whole.shape) for x in (whole, ones))
        for method, call in _calls(sets, action, direction, whole).items():
            dtype = torch.bool if method == "contains" else sets.dtype
            value = called(type(sets), method, call)
            _check_tensor(sets, method, value, (*sample, *batch), dtype)
    reach = whole.detach().abs().amax(-1) + 1
    _check_fields(sets, "eroded", sets.eroded, batch)
    _check_fields(sets, "eroded", partial(sets.eroded, reach), batch)
    _check_fields(sets, "around", partial(sets.around, whole, reach), batch)
    box = called(type(sets), "bounding_box", sets.bounding_box)
    for bound in (box.low, box.high):
        wide = called(type(sets), "bounding_box", partial(bound.expand, whole.shape))
        _check_tensor(sets, "bounding_box", wide, whole.shape, sets.dtype)


def check_batches(sets: ConstraintSet, anchor: Tensor) -> None:
    """Batch elements do not mix, and fields of different batch shapes broadcast."""
    batch = torch.broadcast_shapes(sets.batch_shape, anchor.shape[:-1])
    index = torch.arange(batch.numel(), device=anchor.device)
    flat, at = sets.select(batch, index), anchor.expand(*batch, -1).reshape(-1, anchor.shape[-1])
    direction = at + torch.linspace(-1, 2, at.shape[-1], dtype=at.dtype, device=at.device)
    action = at + 0.1 * direction
    calls = _calls(flat, action, direction, at)
    whole = {method: called(type(sets), method, call) for method, call in calls.items()}
    for i in index[:4]:
        one = flat.select(at.shape[:1], i)
        for method, call in _calls(one, action[i], direction[i], at[i]).items():
            value, case = called(type(sets), method, call), f"element {int(i)} of a batch alone"
            _check_same(one, method, value, whole[method][i], case)
    one = flat.select(at.shape[:1], index[0])
    for name in one.fields():
        # One field gets a batch shape of its own.
        fields = {
            field: value.expand(*((2, 1) if field == name else (3,)), *value.shape)
            for field, value in one.fields().items()
        }
        mixed = type(one)(**fields, validate_args=False)
        case = f"batch shapes (2, 1) of '{name}' and (3,) of the other fields"
        wide = [x[0].expand(*mixed.batch_shape, -1) for x in (action, direction, at)]
        for method, call in _calls(mixed, *wide).items():
            _check_same(one, method, called(type(sets), method, call), whole[method][0], case)


def _calls(
    sets: ConstraintSet, action: Tensor, direction: Tensor, anchor: Tensor
) -> dict[str, Callable[[], Tensor]]:
    return {
        "slack": partial(sets.slack, action),
        "contains": partial(sets.contains, action),
        "gauge": partial(sets.gauge, direction, anchor),
        "gauge_about": lambda: sets.gauge_about(anchor)(direction),
    }


def _check_tensor(
    sets: ConstraintSet, method: str, value: object, shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    if isinstance(value, Tensor) and value.shape == shape and value.dtype == dtype:
        return
    given = type(value).__name__
    if isinstance(value, Tensor):
        given = f"{tuple(value.shape)} and {value.dtype}"
    raise FamilyError(
        type(sets), method, f"expected shape {tuple(shape)} and {dtype}, given {given}"
    )


def _check_fields(
    sets: ConstraintSet, method: str, call: Callable[[], ConstraintSet], batch: torch.Size
) -> None:
    result = called(type(sets), method, call)
    # One that knows more about the part that is left has more fields, see `VisibleRegion.eroded`.
    fields = getattr(result, "event_dims", {}).items()
    if not (isinstance(result, ConstraintSet) and sets.event_dims.items() <= fields):
        raise FamilyError(
            type(sets), method, f"expected a set of the same family, given {type(result).__name__}"
        )
    for name, dims in sets.event_dims.items():
        mine, value = getattr(sets, name), result.fields()[name]
        event = mine.shape[mine.ndim - dims :]
        shape = called(
            type(sets), method, partial(torch.broadcast_shapes, value.shape, (*batch, *event))
        )
        if value.dtype != mine.dtype or shape != (*batch, *event):
            raise FamilyError(
                type(sets),
                method,
                f"expected a field '{name}' that broadcasts to {(*batch, *event)} and "
                f"{mine.dtype}, given {tuple(value.shape)} and {value.dtype}",
            )


def _check_same(
    sets: ConstraintSet, method: str, value: Tensor, expected: Tensor, case: str
) -> None:
    if torch.allclose(value.double(), expected.double(), rtol=1e-3, equal_nan=True):
        return
    raise FamilyError(
        type(sets),
        method,
        f"expected the same as in one batch, {shown(expected)}, given {shown(value)} for {case}: "
        f"fields {[f'{name} = {shown(field)}' for name, field in sets.fields().items()]}",
    )
