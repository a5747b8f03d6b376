"""Adam without the bookkeeping that takes longer than its arithmetic where networks are small."""

from __future__ import annotations

from collections.abc import Callable
from operator import is_, itemgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.optim import Adam, optimizer
from torch.optim.optimizer import Optimizer

_FLAGS = itemgetter("fused", "amsgrad", "maximize", "decoupled_weight_decay")
_PLAIN = (True, False, False, False)
"""The flags of a group under which a step is the fused operation alone."""


class _Group(NamedTuple):
    """A group's settings and tensors, each list in the order of the parameters."""

    settings: dict[str, Any]
    parameters: list[Tensor]
    states: list[dict[str, Tensor]]
    means: list[Tensor]
    squares: list[Tensor]
    steps: list[Tensor]
    counts: Tensor
    """The tensor that all of `steps` are elements of."""


class FusedAdam(Adam):
    """A `torch.optim.Adam` with ``fused=True`` that looks up its tensors once, not at each step.

    Steps, states and their names are Adam's; so are steps with hooks, with settings beyond
    ``weight_decay``, and those in which a parameter has no gradient, or which a gradient scaler or
    a closure belongs to. What is left out otherwise takes twice the time of the update itself for
    networks of 64 units.

    Args:
        args: The arguments of `torch.optim.Adam`.
        kwargs: The options of `torch.optim.Adam`; ``fused`` is true by default.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._groups: list[_Group] | None = None
        super().__init__(*args, **{"fused": True, **kwargs})

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Make a step, and return what the closure returned, if there is one."""
        if self._groups is None or closure is not None or not self._is_plain(self._groups):
            returned = self._adam_step(closure)
            self._groups = self._looked_up()
            return returned
        gradients = [
            [p.grad for p in group.parameters if p.grad is not None] for group in self._groups
        ]
        if any(len(a) < len(b.parameters) for a, b in zip(gradients, self._groups, strict=True)):
            return self._adam_step(closure)
        for (settings, parameters, _, means, squares, steps, counts), of_group in zip(
            self._groups, gradients, strict=True
        ):
            counts.add_(1)
            beta1, beta2 = settings["betas"]
            torch._fused_adam_(
                parameters,
                of_group,
                means,
                squares,
                [],
                steps,
                lr=settings["lr"],
                beta1=beta1,
                beta2=beta2,
                weight_decay=settings["weight_decay"],
                eps=settings["eps"],
                amsgrad=False,
                maximize=False,
                grad_scale=None,
                found_inf=None,
            )
        return None

    # PyTorch would wrap it in what `_adam_step` calls.
    step.hooked = True  # type: ignore[attr-defined]

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget all gradients, or set them to zero."""
        if not set_to_none:
            super().zero_grad(set_to_none)
            return
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group of parameters."""
        super().add_param_group(param_group)
        self._groups = None

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Called when a copy is made and when a state is loaded, too.
        super().__setstate__(state)
        self._groups = None

    def _adam_step(self, closure: Callable[[], Any] | None) -> Any:
        """Make a step of Adam's own, with its hooks, in which PyTorch wraps it at its first use."""
        is_wrapped = getattr(Adam.step, "hooked", False)
        step = Adam.step if is_wrapped else Optimizer.profile_hook_step(Adam.step)
        return step(self, closure)

    def _is_plain(self, groups: list[_Group]) -> bool:
        """Tell whether groups are as they were looked up, without hooks or a gradient scaler."""
        hooks = (
            self._optimizer_step_pre_hooks,
            self._optimizer_step_post_hooks,
            optimizer._global_optimizer_pre_hooks,
            optimizer._global_optimizer_post_hooks,
        )
        if any(hooks) or hasattr(self, "grad_scale") or hasattr(self, "found_inf"):
            return False
        return len(self.param_groups) == len(groups) and all(
            settings is group.settings
            and _has_plain_settings(settings)
            and len(settings["params"]) == len(group.parameters)
            and all(map(is_, settings["params"], group.parameters))
            and all(map(is_, map(self.state.get, group.parameters), group.states))
            for settings, group in zip(self.param_groups, groups, strict=True)
        )

    def _looked_up(self) -> list[_Group] | None:
        """Return all groups, or None if a step of one of them is more than the fused operation."""
        groups = []
        for settings in self.param_groups:
            parameters = list(settings["params"])
            states = [self.state.get(parameter, {}) for parameter in parameters]
            alike = {(parameter.device, parameter.dtype) for parameter in parameters}
            if (
                len(alike) != 1
                or not all(states)
                or not _has_plain_settings(settings)
                or any(parameter.is_complex() for parameter in parameters)
            ):
                return None
            means = [state["exp_avg"] for state in states]
            squares = [state["exp_avg_sq"] for state in states]
            counts = torch.stack([state["step"] for state in states])
            steps = list(counts)
            for state, step in zip(states, steps, strict=True):
                state["step"] = step
            groups.append(_Group(settings, parameters, states, means, squares, steps, counts))
        return groups


def _has_plain_settings(settings: dict[str, Any]) -> bool:
    """Tell whether a step of a group of these settings is the fused operation alone."""
    return _FLAGS(settings) == _PLAIN and not isinstance(settings["lr"], Tensor)
