"""A warning, once, where a constraint gave way in every state that was seen."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from cnfp_torchrl.geometry import ConstraintSet, relaxation_floor

STATES = 256
"""States that a look takes in: of one large batch, or of as many small ones as it needs."""

LOOKS = 64
"""Looks after which nobody watches any more; each costs one synchronization with the host."""


class RelaxedEverywhereWarning(UserWarning):
    """A constraint could not be had in any state of a larger batch."""


class RelaxationWatch:
    """Warn, once, of constraints that gave way in each state of a larger batch.

    Giving way counts beyond what a set without interior needs
    (`cnfp_torchrl.geometry.relaxation_floor`): an equality always does that much.

    Args:
        names: Names of the constraints, in order of application.
        leeway: The leeway of their anchor.
    """

    def __init__(self, names: Sequence[str], leeway: float) -> None:
        self._names, self._leeway = tuple(names), leeway
        self._looks_left = LOOKS if names else 0
        self._begin_look()

    @property
    def looks(self) -> bool:
        """Whether anybody watches still."""
        return self._looks_left > 0

    def _begin_look(self) -> None:
        self._seen, self._have_all_held = 0, False
        self._had: Tensor | None = None
        self._least: Tensor | None = None

    def __call__(self, sets: Sequence[ConstraintSet], relaxation: Tensor, states: int) -> None:
        """Look at a batch of states.

        Args:
            sets: The action bounds and the constraints' sets.
            relaxation: The amounts, ``(*batch, K + 1)``, the bounds' first.
            states: The number of states in the batch.
        """
        if not self._looks_left:
            return
        if not self._have_all_held:
            self._take_in(sets, relaxation)
        self._count(states)

    def all_held(self, states: int) -> None:
        """Take in a batch of states in which no constraint gave way; reads nothing."""
        if self._looks_left:
            self._have_all_held = True
            self._count(states)

    def _count(self, states: int) -> None:
        self._seen += states
        if self._seen >= STATES:
            if not self._have_all_held:
                self._look()
            self._looks_left = max(self._looks_left - 1, 0)
            self._begin_look()

    def _take_in(self, sets: Sequence[ConstraintSet], relaxation: Tensor) -> None:
        amounts = relaxation[..., 1:].reshape(-1, len(self._names))
        floor = relaxation_floor(sets, self._leeway)[..., 1:]
        # Where a set is empty, its rounding, and with it the floor, may be anything.
        gave_way = (relaxation[..., 1:] > floor) | relaxation[..., 1:].isinf()
        had, least = ~gave_way.reshape(-1, len(self._names)).all(0), amounts.amin(0)
        if self._had is not None and self._least is not None and self._had.device == had.device:
            had, least = had | self._had, torch.minimum(least, self._least)
        self._had, self._least = had, least

    def _look(self) -> None:
        assert self._had is not None
        assert self._least is not None
        missed = [
            f"'{name}' (by {amount:.3g} or more)"
            if amount < float("inf")
            else f"'{name}' (dropped)"
            for name, held, amount in zip(
                self._names, self._had.tolist(), self._least.tolist(), strict=True
            )
            if not held
        ]
        if missed:
            warnings.warn(
                f"constraint {' and '.join(missed)}: gave way in each of {self._seen} states, "
                "because no action within the bounds keeps it there, together with the constraints "
                "of higher priority; look at the units of its set and of the action spec, and at "
                "its order. What happens then: docs/relaxation.md",
                RelaxedEverywhereWarning,
                stacklevel=2,
            )
            self._looks_left = 0
