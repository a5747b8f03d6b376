r"""The unicycle: its motion, a nominal controller, costs, and the published starts.

A state is :math:`(x, y, \theta, v, \omega)`, a control the accelerations
:math:`(\dot v, \dot\omega)`. Sizes are those of HardNet (Min and Azizan 2024, arXiv 2410.10807) and
of its published code, re-implemented.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Problem:
    """The sizes of the task.

    Args:
        ellipses: Obstacles, each as center and half-axes ``(x, y, r_x, r_y)``.
        ahead: The distance of the point that must stay outside ahead of the axle.
        kappa: The rate of the barrier's first order.
        alpha: The rate of its second order.
        duration: The length of an episode.
        dt: The length of a step, shorter where a control exceeds `largest`.
        largest: The control from which steps are shortened.
        state_weights: Weights of the squared states in the cost.
        control_weights: Weights of the squared controls in the cost.
    """

    ellipses: tuple[tuple[float, float, float, float], ...] = (
        (-2.25, 0.5, 0.5, 0.75),
        (-0.8, 0.0, 0.5, 0.5),
    )
    ahead: float = 0.1
    kappa: float = 10.0
    alpha: float = 20.0
    duration: float = 1.0
    dt: float = 0.02
    largest: float = 100.0
    state_weights: tuple[float, ...] = (100.0, 100.0, 0.0, 0.1, 0.1)
    control_weights: tuple[float, ...] = (0.1, 0.1)


class Costs(NamedTuple):
    """What an episode cost, ``(n,)``, and how often controls broke a barrier.

    Args:
        cost: The integral of the weighted squares of states and controls.
        violations: The number of controls that broke a barrier, over all states.
        largest: The largest excess over a barrier.
        excess: The integral of the excess over each barrier, ``(n, K)``: HardNet's own measure.
            None without a judge.
    """

    cost: Tensor
    violations: int
    largest: float
    excess: Tensor | None


def starts(barrier: Callable[[Tensor], Tensor], count: int = 1000, seed: int = 17) -> Tensor:
    """Return the published starts in float64, ``(count, 5)``.

    Args:
        barrier: The value of each barrier, ``(n, K)``; starts below 0 are drawn again.
        count: The number of starts.
        seed: The seed of NumPy's old generator.
    """
    generator = np.random.RandomState(seed)
    one = np.array([-4.0, 0.0, -np.pi / 4, 0.0, 0.0])
    other = np.array([-3.5, 0.5, -np.pi / 8, 0.0, 0.0])

    def drawn(size: int) -> np.ndarray:
        share = generator.rand(size, 5)
        return share * one + (1 - share) * other

    states = drawn(count)
    bad = np.arange(count)
    while len(bad):
        bad = bad[(barrier(torch.from_numpy(states[bad])).detach() < 0).any(-1).numpy()]
        states[bad] = drawn(len(bad))
    return torch.from_numpy(states)


def nominal_control(state: Tensor) -> Tensor:
    """Return the accelerations that steer to the origin as if nothing stood in the way."""
    x, y, theta, speed, turn = state.unbind(-1)
    distance = (x.square() + y.square()).sqrt()
    wanted_turn = 10 * (x * theta.sin() - y * theta.cos()) / (distance + 1e-5)
    ahead = -x * theta.cos() - y * theta.sin()
    wanted_speed = (10 * distance * ahead).clamp(-5, 5)
    return torch.stack([5 * (wanted_speed - speed), 5 * (wanted_turn - turn)], -1)


def motion(state: Tensor, control: Tensor) -> Tensor:
    """Return the derivative of the state in time."""
    _, _, theta, speed, turn = state.unbind(-1)
    return torch.stack([speed * theta.cos(), speed * theta.sin(), turn, *control.unbind(-1)], -1)


def encoded(state: Tensor) -> Tensor:
    """Return what a network sees of a state: the heading as cosine and sine, ``(*batch, 6)``."""
    theta = state[..., 2:3]
    return torch.cat([state[..., :2], theta.cos(), theta.sin(), state[..., 3:]], -1)


def step_cost(problem: Problem, state: Tensor, control: Tensor) -> Tensor:
    """Return the cost of a unit of time, the weighted squares of state and control."""
    q, r = (state.new_tensor(w) for w in (problem.state_weights, problem.control_weights))
    return (q * state.square()).sum(-1) + (r * control.square()).sum(-1)


def episode(
    problem: Problem,
    state: Tensor,
    controller: Callable[[Tensor], Tensor],
    *,
    most: float = torch.inf,
    judge: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Costs:
    """Run an episode and integrate its cost by Euler's method.

    Args:
        problem: The sizes.
        state: Starts ``(n, 5)``.
        controller: The control of each state, ``(n, 2)``.
        most: The cost from which an episode costs no more.
        judge: The excess over each barrier of controls in their states, ``(n, K)``.
    """
    cost, violations, largest = state.new_zeros(len(state)), 0, 0.0
    integral: Tensor | None = None
    for _ in range(round(problem.duration / problem.dt)):
        # Above `most` the step's costs do not count, all of them or none.
        counts = (cost.detach() < most).to(state.dtype)
        if not bool(counts.any()):
            break
        left = torch.full_like(cost, problem.dt)
        spent = torch.zeros_like(cost)
        while bool((left > 0).any()):
            control = controller(state)
            with torch.no_grad():
                fastest = control.abs().amax(-1)
                step = torch.minimum(problem.dt * problem.largest / fastest, left)
                runs = left > 0
                if judge is not None:
                    excess = judge(state, control)
                    violations += int((excess[runs] > 0).any(-1).sum())
                    largest = max(largest, float(excess[runs].max()))
                    broken = step.unsqueeze(-1) * excess.relu()
                    integral = broken if integral is None else integral + broken
                left = left - step
            spent = spent + step * step_cost(problem, state, control)
            state = state + step.unsqueeze(-1) * motion(state, control)
        cost = cost + counts * spent
    return Costs(cost, violations, largest, integral)
