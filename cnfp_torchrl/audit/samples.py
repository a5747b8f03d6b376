"""Samples of actions in the states of an audit, and what each of them leads to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from cnfp_torchrl.audit.lookahead import Lookahead
from cnfp_torchrl.audit.statistics import plain
from cnfp_torchrl.geometry import ConstraintSet, Region
from cnfp_torchrl.modules import ConstrainedFlowModule

HUGE = 1e6
"""Latents of this scale saturate every squash."""

LATENTS = ("latents N(0, 1)", "latents N(0, 10²)", "one latent huge", "all latents huge")
"""One huge latent among moderate ones reaches every point of the boundary, all of them corners."""

UNIFORM = "uniform in the action bounds"


@dataclass(frozen=True)
class Samples:
    """Actions in n states, m from the flow and then m uniform ones, with what they lead to.

    Args:
        head: The flow module.
        states: The states, ``(n,)``.
        keys: The entries of a state that identify it.
        region: The sets, anchors and flags of the states.
        actions: The actions, ``(2 m, n, d)``.
        reachable: The mask of the actions that the flow can reach, ``(2 m, n)``.
        violated: The mask of violations by constraint, False without an indicator, ``(2 m, n, K)``.
        kept: The mask of the constraints that are active in the next state, ``(2 m, n, K)``.
        judged: Flags of the constraints that have an indicator, K of them.
    """

    head: ConstrainedFlowModule
    states: TensorDictBase
    keys: Sequence[NestedKey]
    region: Region
    actions: Tensor
    reachable: Tensor
    violated: Tensor
    kept: Tensor
    judged: tuple[bool, ...]

    @property
    def half(self) -> int:
        """The number m of actions of each kind."""
        return len(self.actions) // 2

    @property
    def active(self) -> Tensor:
        """Which constraints are active in which state, ``(n, K)``."""
        return self.region.is_active[..., 1:]

    @property
    def amounts(self) -> Tensor:
        """By how much each constraint is relaxed in which state, ``(n, K)``, dropped ones inf."""
        return self.region.amounts()[..., 1:].expand(len(self.states), -1)

    def describe(self, row: int, state: int) -> dict[str, Any]:
        """Return one action in its state as plain values."""
        latents = LATENTS[row % len(LATENTS)]
        flags = self.violated[row, state].tolist()
        return {
            **self.describe_state(state),
            "action": plain(self.actions[row, state]),
            "drawn": latents if row < self.half else UNIFORM,
            "violates": [name for name, bad in zip(self.head.order, flags, strict=True) if bad],
        }

    def describe_state(self, state: int) -> dict[str, Any]:
        """Return a state as plain values: its entries, and each constraint's set."""
        return describe_state(self.head, self.states[state], self.keys)


def draw_samples(
    lookahead: Lookahead,
    head: ConstrainedFlowModule,
    keys: Sequence[NestedKey],
    indicators: Sequence[str],
    actions: int,
) -> Samples:
    """Draw actions in every state, through the flow and uniformly, and look one step ahead.

    Args:
        lookahead: The states, with a model of one step.
        head: The flow module.
        keys: The entries of a state that identify it.
        indicators: The names of the indicators that judge steps.
        actions: The number of each kind in each state.
    """
    states, bounds = lookahead.states, head.bounds
    bijector = head.get_bijector(states)
    latents = draw_latents(actions, len(states), bounds.dim).to(bounds.low)
    sampled = bijector(latents)  # not with its log-determinant, which projections have none of
    uniform = bounds.low + (bounds.high - bounds.low) * torch.rand_like(latents)
    drawn = torch.cat([sampled, uniform])
    outcome = lookahead.outcome(drawn)
    unjudged = torch.zeros_like(outcome.violated[..., 0])
    columns = dict(zip(indicators, outcome.violated.unbind(-1), strict=True))
    return Samples(
        head,
        states,
        keys,
        head.get_region(states),
        drawn,
        bijector.contains(drawn),
        torch.stack([columns.get(name, unjudged) for name in head.order], dim=-1),
        outcome.kept,
        tuple(name in indicators for name in head.order),
    )


def draw_latents(rows: int, states: int, dim: int) -> Tensor:
    """Return latents ``(rows, states, dim)``, row i of the kind ``LATENTS[i % 4]``."""
    kind = (torch.arange(rows) % len(LATENTS))[:, None, None]
    one = torch.nn.functional.one_hot(torch.randint(dim, (rows, states)), dim) > 0
    scale = torch.ones(rows, states, dim)
    scale[(kind == 1).expand_as(scale)] = 10.0
    scale[((kind == 2) & one) | (kind == 3)] = HUGE
    return scale * torch.randn(rows, states, dim)


def describe_state(
    head: ConstrainedFlowModule, state: TensorDictBase, keys: Sequence[NestedKey]
) -> dict[str, Any]:
    """Return a state ``()`` as plain values: its entries, and each constraint's set."""
    region = head.get_region(state)
    flags, amounts = region.is_active[1:].tolist(), region.amounts()[1:]
    given = zip(head.order, region.sets[1:], flags, amounts, strict=True)
    return {
        "state": {_name(key): plain(state.get(key)) for key in keys},
        "sets": {
            name: {
                "family": type(allowed).__name__,
                "active": active,
                "relaxation": plain(amount),
                **_plain_fields(allowed),
            }
            for name, allowed, active, amount in given
        },
    }


def _plain_fields(allowed: ConstraintSet) -> dict[str, Any]:
    return {name: plain(value) for name, value in allowed.fields().items()}


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))
