"""How an environment is asked what actions would lead to, without a step of its own."""

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

from cnfp_torchrl.audit.states import Place, bare, difference
from cnfp_torchrl.envs import Indicator, constraint_names
from cnfp_torchrl.keys import COST_KEY
from cnfp_torchrl.modules import ConstrainedFlowModule


class Outcome(NamedTuple):
    """What actions led to, ``(m, n, ...)`` for m actions in each of n states."""

    violated: Tensor
    """By indicator, bool ``(m, n, I)``."""
    kept: Tensor
    """Whether each constraint is active in the next state, bool ``(m, n, K)``."""


class Reader:
    """Read indicators and active flags off a step.

    Args:
        env: the environment.
        head: the flow module, which knows the constraints.
        indicators: named indicators; None takes the environment's ``cost``.

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
        region = self.head.get_region(states)
        assert region.active is not None
        return region.active[..., 1:]

    def step(self, env: EnvBase, states: TensorDictBase, action: Tensor) -> Outcome:
        """Step an environment that is in the given states."""
        before = states.clone().set(self.head.action_key, action)
        outcome = env.step(before).get("next")
        # After the end of an episode nothing has to hold any more.
        ended = outcome.get("terminated", torch.tensor(False)).reshape(*states.batch_size, -1)
        return Outcome(self.violated(before, outcome), self.active(outcome) | ended.any(-1, True))


class Probe(ABC):
    """States ``(n,)`` in which an environment can be asked what any action would lead to."""

    states: TensorDictBase

    @abstractmethod
    def outcome(self, actions: Tensor) -> Outcome:
        """Return what actions ``(m, n, d)`` lead to, each one tried in its own state."""


class PlacedProbe(Probe):
    """Asks by putting the environment into each state again, as many at once as its batch holds.

    Args:
        env: the environment.
        place: how to put it into a state.
        states: ``(n,)``, as the environment returned them.
        reader: of steps.

    Raises:
        ValueError: by `outcome`, when the environment then shows another state.
    """

    def __init__(self, env: EnvBase, place: Place, states: TensorDictBase, reader: Reader) -> None:
        self.env, self.place, self.states, self.reader = env, place, states, reader

    def outcome(self, actions: Tensor) -> Outcome:
        flat = actions.flatten(0, 1)
        size, shape = self.env.batch_size.numel(), self.env.batch_size
        found = []
        for first in range(0, len(flat), size):
            # The last batch is filled up with pairs that are asked twice.
            pair = torch.arange(first, first + size).clamp(max=len(flat) - 1)
            states = self.states[pair % len(self.states)].reshape(shape)
            shown = self.place(bare(self.env), states)
            if (key := difference(self.env, states, shown)) is not None:
                raise ValueError(
                    f"place: expected a function that puts {type(bare(self.env)).__name__} into "
                    f"given states, but then it shows another {key!r}"
                )
            action = flat[pair].reshape(*shape, -1)
            found.append([x.reshape(size, -1) for x in self.reader.step(self.env, states, action)])
        violated, kept = (torch.cat(parts)[: len(flat)] for parts in zip(*found, strict=True))
        return Outcome(*(x.unflatten(0, actions.shape[:2]) for x in (violated, kept)))


class CopiedProbe(Probe):
    """Asks copies of the environment, one for each action, made while it stood in the states.

    Args:
        copies: environments with their current states, of the environment's batch size.
        reader: of steps.
    """

    def __init__(self, copies: list[tuple[EnvBase, TensorDictBase]], reader: Reader) -> None:
        self.copies, self.reader = copies, reader
        self.states: TensorDictBase = torch.cat([states.reshape(-1) for _, states in copies])

    def outcome(self, actions: Tensor) -> Outcome:
        size = len(self.states) // len(self.copies)
        bar = tqdm(total=len(actions) * len(self.copies), unit="step", disable=None, leave=False)
        columns = []
        with bar:
            for (env, states), block in zip(self.copies, actions.split(size, dim=1), strict=True):
                rows = []
                for each in block:
                    action = each.reshape(*states.batch_size, -1)
                    outcome = self.reader.step(copy.deepcopy(env), states, action)
                    rows.append([x.reshape(size, -1) for x in outcome])
                    bar.update()
                columns.append([torch.stack(x) for x in zip(*rows, strict=True)])
        return Outcome(*(torch.cat(x, dim=1) for x in zip(*columns, strict=True)))
