r"""The judge of the barriers: derivatives in time by automatic differentiation along the motion.

It shares no formula with the geometry, which differentiates by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from cnfp_torchrl.tasks.safe_control.unicycle import Problem, motion


def ellipse_values(problem: Problem, state: Tensor) -> Tensor:
    """Return the value h of each ellipse at the point ahead, 0 on its edge, ``(n, K)``."""
    x, y, theta = state[..., 0], state[..., 1], state[..., 2]
    px, py = x + problem.ahead * theta.cos(), y + problem.ahead * theta.sin()
    return torch.stack(
        [((px - a) / rx) ** 2 + ((py - b) / ry) ** 2 - 1 for a, b, rx, ry in problem.ellipses], -1
    )


def barrier_values(problem: Problem, state: Tensor) -> Tensor:
    r"""Return :math:`\psi = \dot h + \kappa h` of each ellipse, ``(n, K)``."""
    still = torch.zeros_like(state[..., :2])
    values = partial(ellipse_values, problem)
    return _rate(values, state, motion(state, still)) + problem.kappa * values(state)


def barrier_excess(problem: Problem, state: Tensor, control: Tensor) -> Tensor:
    r"""Return :math:`-\dot\psi - \alpha\psi` of each ellipse, ``(n, K)``: above 0 it is broken.

    Args:
        problem: The sizes.
        state: States ``(n, 5)``.
        control: Accelerations ``(n, 2)``.
    """
    values = partial(barrier_values, problem)
    rate = _rate(values, state, motion(state, control))
    return (-rate - problem.alpha * values(state)).detach()


def _rate(values: Callable[[Tensor], Tensor], state: Tensor, velocity: Tensor) -> Tensor:
    """Return the derivative of values ``(n, K)`` along a velocity of the state."""
    with torch.enable_grad():
        at = state if state.requires_grad else state.detach().requires_grad_()
        columns = [
            torch.autograd.grad(column.sum(), at, create_graph=True)[0]
            for column in values(at).unbind(-1)
        ]
        return torch.stack([(column * velocity).sum(-1) for column in columns], -1)
