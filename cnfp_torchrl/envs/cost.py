"""The cost transform: indicators of constraint violations as one tensor, and their sum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.batched_envs import BatchedEnvBase

from cnfp_torchrl.keys import COST_KEY, EPISODE_COST_KEY
from cnfp_torchrl.modules import appended_transforms

Indicator = Callable[[TensorDictBase, TensorDictBase], Tensor]
"""``(state and action, what the step led to) -> violated?``, bool ``(*batch,)``."""


class ConstraintCost(Transform):
    """Write indicators of violations at ``cost``, and their sum so far at ``episode_cost``.

    Both are float32 ``(*batch, K)``, one column for each name of `constraint_names`, and zero after
    a reset. ``cost`` under ``next`` is the cost of the action beside it.

    Args:
        indicators: Functions of the tensordicts before and after a step, by the constraint's name,
            for environments without costs. None takes the ``cost`` that the environment publishes.

    Raises:
        TypeError: for indicators that are no mapping of names to functions.
        ValueError: for an indicator of the wrong shape or dtype, and where the environment's cost
            is missing or not float32 ``(*batch, K)``.
    """

    def __init__(self, indicators: Mapping[str, Indicator] | None = None) -> None:
        if indicators is not None:
            _refuse_what_is_no_indicator(indicators)
        super().__init__(in_keys=[COST_KEY], out_keys=[COST_KEY, EPISODE_COST_KEY])
        self.indicators = None if indicators is None else dict(indicators)

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """The columns' names, of the indicators, or of the environment that publishes costs."""
        if self.indicators is not None:
            return tuple(self.indicators)
        if self.parent is None:
            raise RuntimeError(
                "constraint_names: expected indicators or an environment, given neither; append "
                "the transform to an environment first"
            )
        return constraint_names(self.parent)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        if self.indicators is not None:
            shape = (*observation_spec.shape, len(self.indicators))
            observation_spec[COST_KEY] = Bounded(
                0.0, 1.0, shape, device=observation_spec.device, dtype=torch.float32
            )
        else:
            self._require_cost(observation_spec)
        observation_spec[EPISODE_COST_KEY] = self._sum_spec(observation_spec[COST_KEY])
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        # The sum so far is read at the root, so that batched environments pass it to their workers.
        state_spec = input_spec["full_state_spec"]
        if state_spec is None:
            state_spec = Composite(shape=input_spec.shape, device=input_spec.device)
        if self.indicators is not None:
            shape = torch.Size((*input_spec.shape, len(self.indicators)))
        else:
            shape = self.parent.observation_spec[COST_KEY].shape
        state_spec[EPISODE_COST_KEY] = Unbounded(
            shape, device=input_spec.device, dtype=torch.float32
        )
        input_spec["full_state_spec"] = state_spec
        return input_spec

    def _sum_spec(self, cost: Any) -> Unbounded:
        return Unbounded(cost.shape, device=cost.device, dtype=torch.float32)

    def _require_cost(self, observation_spec: Composite) -> None:
        spec = observation_spec.get(COST_KEY, None)
        batch = observation_spec.shape
        if spec is None:
            raise ValueError(
                f"ConstraintCost(indicators=None): expected an environment that publishes "
                f"{COST_KEY!r}, given one with {sorted(map(str, observation_spec.keys()))}; "
                "pass indicators, or for a GymEnv call auto_register_info_dict()"
            )
        if spec.dtype != torch.float32 or spec.shape[:-1] != batch:
            raise ValueError(
                f"ConstraintCost(indicators=None), key {COST_KEY!r}: expected float32 of shape "
                f"({tuple(batch)}, K), given {spec.dtype} of shape {tuple(spec.shape)}; pass "
                "indicators that convert it"
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.indicators is not None:
            next_tensordict.set(COST_KEY, self.evaluate(tensordict, next_tensordict))
        total = tensordict.get(EPISODE_COST_KEY) + next_tensordict.get(COST_KEY)
        return next_tensordict.set(EPISODE_COST_KEY, total)

    def evaluate(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        """Return the costs of a step by the indicators, float32 ``(*batch, K)``.

        Args:
            tensordict: States and the actions that were executed in them.
            next_tensordict: What the actions led to.

        Raises:
            TypeError: for an indicator that returns no tensor.
            ValueError: for an indicator of the wrong shape or dtype.
        """
        assert self.indicators is not None
        columns = []
        for name, indicator in self.indicators.items():
            column = indicator(tensordict, next_tensordict)
            batch = next_tensordict.batch_size
            if not isinstance(column, Tensor):
                raise TypeError(
                    f"indicator '{name}': expected it to return a bool tensor of shape "
                    f"{tuple(batch)}, given {type(column).__name__}"
                )
            if column.dtype != torch.bool or column.shape != batch:
                raise ValueError(
                    f"indicator '{name}': expected bool of shape {tuple(batch)}, "
                    f"given {column.dtype} of shape {tuple(column.shape)}"
                )
            columns.append(column)
        return torch.stack(columns, dim=-1).float()

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # Where only some agents are reset, the caller merges: the others keep their sums.
        zero = self.container.observation_spec[EPISODE_COST_KEY].zero()
        if self.indicators is not None:
            tensordict_reset.set(COST_KEY, zero.clone())
        return tensordict_reset.set(EPISODE_COST_KEY, zero)


def _refuse_what_is_no_indicator(indicators: Mapping[str, Indicator]) -> None:
    if not isinstance(indicators, Mapping):
        raise TypeError(
            "indicators: expected a mapping of constraint names to functions, given "
            f"{type(indicators).__name__}; write ConstraintCost({{NAME: indicator}})"
        )
    if not indicators:
        raise ValueError("indicators: expected at least one, or None, given an empty mapping")
    for name, indicator in indicators.items():
        if not callable(indicator):
            raise TypeError(
                f"indicator '{name}': expected a function of the tensordicts before and after the "
                f"step, given {indicator!r}"
            )


def constraint_names(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the columns of an environment's ``cost``.

    They are, in this order of preference: those of the last `ConstraintCost` with indicators, the
    environment's ``constraint_names``, and those in the metadata of a wrapped Gymnasium env. Of
    environments in a row, those of others made like them.

    Raises:
        ValueError: when the environment names none, or environments in a row do not agree.
    """
    for transform in reversed(appended_transforms(env)):
        if isinstance(transform, ConstraintCost) and transform.indicators is not None:
            return transform.constraint_names
    bare = env
    while isinstance(bare, TransformedEnv):
        bare = bare.base_env
    if isinstance(bare, BatchedEnvBase):
        return _names_in_a_row(bare)
    names = getattr(env, "constraint_names", None) or (getattr(env, "metadata", None) or {}).get(
        "constraint_names"
    )
    if not names:
        raise ValueError(
            f"env: expected one that names its constraints (constraint_names, or a ConstraintCost "
            f"with indicators), given {type(env).__name__}"
        )
    return tuple(names)


def _names_in_a_row(env: BatchedEnvBase) -> tuple[str, ...]:
    """Return the names of other environments, made like those of a batched one.

    Not of its workers: they end when they are asked for what they have not, and one that is not
    started asks itself without end.
    """
    makers = list(zip(env.create_env_fn, env.create_env_kwargs, strict=True))
    found: list[tuple[str, ...]] = []
    for i, (make, options) in enumerate(makers):
        if any(make is other and _are_equal(options, others) for other, others in makers[:i]):
            continue
        one = make(**options)
        try:
            found.append(constraint_names(one))
        finally:
            if not one.is_closed:
                one.close()
    if len(set(found)) > 1:
        raise ValueError(
            f"env: expected environments with the same constraint_names, given {found}"
        )
    return found[0]


def _are_equal(options: Mapping[str, Any], others: Mapping[str, Any]) -> bool:
    """Tell whether options are known to be equal: those that hold tensors or arrays are not."""
    try:
        return bool(options == others)
    except (RuntimeError, ValueError):
        return False


def refuse_misnamed_judges(constraints: Sequence[str], judged: Sequence[str]) -> None:
    """Refuse a constraint without a judge of its name where there is one of nearly its name.

    Args:
        constraints: The names of the constraints that have geometry.
        judged: The names of the judges.

    Raises:
        ValueError: naming both.
    """
    others = [name for name in judged if name not in constraints]
    for name in constraints:
        if name not in judged and (alike := get_close_matches(name, others, n=1)):
            raise ValueError(
                f"constraint {name!r}: expected a judge of the same name in the environment, "
                f"given one named {alike[0]!r}; give geometry and judge one name"
            )


def counted_constraints(env: EnvBase) -> tuple[str, ...]:
    """Return the names of the columns of ``cost``; none if the environment counts nothing."""
    return constraint_names(env) if COST_KEY in env.observation_spec.keys() else ()  # noqa: SIM118
