"""The action bounds of a spec, as a set and as a module that holds them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec

from cnfp_torchrl.geometry import Box, require_action_bounds
from cnfp_torchrl.keys import ACTION_KEY


class ActionBounds(nn.Module):
    """The box of action bounds, in the dtype of the action spec, on any device.

    Its tensors follow the device alone. They are no buffers: ``.half()`` would round those beyond
    the spec, and loading the ``state_dict`` of a TorchRL loss, which has even buffers that are not
    persistent, would replace them by another actor's.

    Args:
        box: The bounds, ``(d,)``.
    """

    def __init__(self, box: Box) -> None:
        super().__init__()
        self._box = box.prepared()
        self._elsewhere: dict[torch.device, Box] = {}

    @property
    def dim(self) -> int:
        """The number of components of an action."""
        return self._box.dim

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the action spec."""
        return self._box.dtype

    def on(self, device: torch.device | None) -> Box:
        """Return the bounds on a device; None takes the module's."""
        if device is None or device == self._box.low.device:
            return self._box
        # A loss that is moved takes along parameters and buffers, not their modules. Copied once a
        # device: each copy to a GPU waits for it.
        if device not in self._elsewhere:
            self._elsewhere[device] = self._box.to(device=device).prepared()
        return self._elsewhere[device]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        device = fn(self._box.low.new_empty(0)).device
        if device.type != "meta":
            self._box, self._elsewhere = self._box.to(device=device).prepared(), {}
        return self

    def __getstate__(self) -> dict[str, Any]:
        # Another process need not have the devices.
        return {**self.__dict__, "_elsewhere": {}}

    def extra_repr(self) -> str:
        return f"low={self._box.low.tolist()}, high={self._box.high.tolist()}"


def action_bounds(spec: TensorSpec, action_key: NestedKey = ACTION_KEY) -> Box:
    """Return the bounds of the action spec of one state as a box, ``(d,)``.

    Args:
        spec: A bounded spec ``(d,)`` such as ``env.action_spec_unbatched``, or a composite with one
            at `action_key`, whose shape may begin with the composite's.
        action_key: The action's key in a composite spec.

    Raises:
        ValueError: when the spec has no finite bounds, is not of vectors, or is of a batch.
        GeometryError: when its bounds are closer than rounding error, or out of the dtype's range.
    """
    leaf = spec[action_key] if isinstance(spec, Composite) else spec
    batch = tuple(spec.shape) if isinstance(spec, Composite) else ()
    shape = tuple(getattr(leaf, "shape", ()))
    given = f"given {type(leaf).__name__} of shape {shape}"
    bounds = _finite_bounds(leaf)
    if bounds is None:
        raise ValueError(
            f"spec of '{action_key}': expected a continuous spec of vectors with bounds on both "
            f"sides, the first stage of every flow, {given}; give the environment an action spec "
            "such as torchrl.data.Bounded(low, high, (d,)), and discrete choices another actor"
        )
    if shape[:-1] != batch:
        raise ValueError(
            f"spec of '{action_key}': expected that of one state's action, a vector of shape "
            f"({', '.join(map(str, [*batch, 'd']))}), {given}; pass env.action_spec_unbatched, and "
            "for several agents put their dimension into the environment's batch size"
        )
    low, high = (bound.reshape(-1, bound.shape[-1]) for bound in bounds)
    if bool((low != low[:1]).any() | (high != high[:1]).any()):
        raise ValueError(
            f"spec of '{action_key}': expected the same bounds for all batch elements, {given}"
        )
    return require_action_bounds(Box(low[0].clone(), high[0].clone()), f"spec of '{action_key}'")


def refuse_other_bounds(what: str, bounds: Box, expected: Box) -> None:
    """Refuse bounds other than those of the environment.

    Args:
        what: The owner of the bounds, for the message.
        bounds: The owner's bounds, ``(d,)``.
        expected: The environment's bounds, ``(d,)``.

    Raises:
        ValueError: naming both.
    """
    given = bounds.to(expected.dtype) if bounds.dtype != expected.dtype else bounds
    if given.low.shape == expected.low.shape and all(
        torch.equal(a.to(b.device), b)
        for a, b in ((given.low, expected.low), (given.high, expected.high))
    ):
        return
    raise ValueError(
        f"{what}: expected the environment's action bounds, low {expected.low.tolist()} and high "
        f"{expected.high.tolist()}, given low {bounds.low.tolist()} and high "
        f"{bounds.high.tolist()}; build the actor with the environment's action_spec_unbatched"
    )


def _finite_bounds(leaf: Any) -> tuple[Tensor, Tensor] | None:
    space = getattr(leaf, "space", None)
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if not isinstance(low, Tensor) or not isinstance(high, Tensor):
        return None
    if low.ndim == 0 or not low.is_floating_point():
        return None
    # TorchRL gives unbounded specs the largest numbers of their dtype for bounds.
    limits = torch.finfo(low.dtype)
    return (low, high) if bool(((low > limits.min) & (high < limits.max)).all()) else None
