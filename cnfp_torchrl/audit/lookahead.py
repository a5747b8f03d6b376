"""One-step lookahead: what actions would lead to, without a step of the environment itself."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from tqdm import tqdm

from cnfp_torchrl.audit.states import bare, before_concatenation, difference
from cnfp_torchrl.envs import Indicator, StateSetter, constraint_names
from cnfp_torchrl.keys import COST_KEY
from cnfp_torchrl.modules import ConstrainedFlowModule


class Outcome(NamedTuple):
    """What actions led to, ``(m, n, ...)`` for m actions in each of n states."""

    violated: Tensor
    """By indicator, bool ``(m, n, I)``."""
    kept: Tensor
    """Whether each constraint is active in the next state, bool ``(m, n, K)``."""


class StepReader:
    """Read indicators and active flags off a step.

    Args:
        env: The environment.
        head: The flow module, which knows the constraints.
        indicators: Named indicators; None takes the environment's ``cost``.

    Raises:
        ValueError: when the environment publishes no cost, or of another shape than its names.
    """

    def __init__(
        self,
        env: EnvBase,
        head: ConstrainedFlowModule,
        indicators: Mapping[str, Indicator] | None = None,
    ) -> None:
        self.head = head
        self._indicators = indicators
        self.names = tuple(constraint_names(env) if indicators is None else indicators)
        if indicators is not None:
            return
        spec = env.observation_spec.get(COST_KEY, None)
        expected = (*env.batch_size, len(self.names))
        if spec is None or tuple(spec.shape) != expected:
            given = "none" if spec is None else f"shape {tuple(spec.shape)}"
            raise ValueError(
                f"env, key {COST_KEY!r}: expected {expected}, one column for each of "
                f"{list(self.names)}, given {given}; append ConstraintCost or pass indicators"
            )

    def violated(self, states: TensorDictBase, outcome: TensorDictBase) -> Tensor:
        """Return which indicators call a step a violation, bool ``(*batch, I)``."""
        if self._indicators is None:
            return outcome.get(COST_KEY) > 0
        columns = [indicator(states, outcome) for indicator in self._indicators.values()]
        return torch.stack(columns, dim=-1)

    def active(self, states: TensorDictBase) -> Tensor:
        """Return which constraints are active, bool ``(*batch, K)``."""
        return self.head.get_region(states).is_active[..., 1:]

    def amounts(self, states: TensorDictBase) -> Tensor:
        """Return by how much the constraints are relaxed, ``(*batch, K)``, dropped ones inf."""
        return self.head.get_region(states).amounts()[..., 1:]

    def step(self, env: EnvBase, states: TensorDictBase, action: Tensor) -> Outcome:
        """Step an environment that is in the given states."""
        before = states.clone().set(self.head.action_key, action)
        outcome = env.step(before).get("next")
        # After the end of an episode nothing has to hold any more.
        ended = outcome.get("terminated", torch.tensor(False)).reshape(*states.batch_size, -1)
        return Outcome(self.violated(before, outcome), self.active(outcome) | ended.any(-1, True))


class Lookahead(ABC):
    """States ``(n,)`` with a model of one step from each of them."""

    states: TensorDictBase

    @abstractmethod
    def outcome(self, actions: Tensor) -> Outcome:
        """Return what actions ``(m, n, d)`` lead to, each one in its own state."""


class StateSetterLookahead(Lookahead):
    """Put the environment into each state again, as many at once as its batch holds.

    Args:
        env: The environment.
        state_setter: The function that puts the environment into states.
        states: The states ``(n,)``, as the environment returned them.
        reader: What reads indicators and flags.

    Raises:
        ValueError: by `outcome`, when the environment then shows another state.
    """

    def __init__(
        self, env: EnvBase, state_setter: StateSetter, states: TensorDictBase, reader: StepReader
    ) -> None:
        self.env, self.state_setter = env, state_setter
        self.states, self.reader = states, reader
        self._shown = before_concatenation(env, states)

    def outcome(self, actions: Tensor) -> Outcome:
        flat = actions.flatten(0, 1)
        size, shape = self.env.batch_size.numel(), self.env.batch_size
        found = []
        for first in range(0, len(flat), size):
            # The last batch is filled up with a pair of state and action that is repeated.
            pair = torch.arange(first, first + size).clamp(max=len(flat) - 1)
            index = pair % len(self.states)
            states, expected = (x[index].reshape(shape) for x in (self.states, self._shown))
            shown = self.state_setter(bare(self.env), expected)
            if (key := difference(bare(self.env), expected, shown)) is not None:
                name = type(bare(self.env)).__name__
                raise ValueError(
                    f"state_setter: expected a function that puts {name} into given states, but "
                    f"then it shows another {key!r}"
                )
            action = flat[pair].reshape(*shape, -1)
            found.append([x.reshape(size, -1) for x in self.reader.step(self.env, states, action)])
        violated, kept = (torch.cat(parts)[: len(flat)] for parts in zip(*found, strict=True))
        return Outcome(*(x.unflatten(0, actions.shape[:2]) for x in (violated, kept)))


class CopyLookahead(Lookahead):
    """Step copies of the environment that were made while it stood in the states.

    Args:
        copies: Environments with their current states, of the environment's batch size.
        reader: What reads indicators and flags.
    """

    def __init__(self, copies: list[tuple[EnvBase, TensorDictBase]], reader: StepReader) -> None:
        self.copies, self.reader = copies, reader
        self.states: TensorDictBase = torch.cat([states.reshape(-1) for _, states in copies])

    def outcome(self, actions: Tensor) -> Outcome:
        size = len(self.states) // len(self.copies)
        bar = tqdm(total=len(actions) * len(self.copies), unit="step", disable=None, leave=False)
        columns = []
        with bar:
            for (env, states), block in zip(self.copies, actions.split(size, dim=1), strict=True):
                rows = []
                for row in block:
                    action = row.reshape(*states.batch_size, -1)
                    outcome = self.reader.step(copy.deepcopy(env), states, action)
                    rows.append([x.reshape(size, -1) for x in outcome])
                    bar.update()
                columns.append([torch.stack(x) for x in zip(*rows, strict=True)])
        return Outcome(*(torch.cat(x, dim=1) for x in zip(*columns, strict=True)))
