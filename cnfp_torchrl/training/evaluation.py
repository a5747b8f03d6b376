"""Episodes of a policy, their returns and their violations."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import torch
from hydra.utils import instantiate
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cnfp_torchrl.configuration import require_fields
from cnfp_torchrl.keys import COST_KEY, REWARD_KEY
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    SafeRandomPolicy,
    constrain,
    flow_head,
    guarded,
)
from cnfp_torchrl.training.agent import build_environment, load_actor
from cnfp_torchrl.training.constraint_counts import (
    ConstraintCounts,
    ConstraintTally,
    constraint_reports,
    violations_of,
)
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Writes the action into a tensordict of states: any TorchRL policy."""


@dataclass(frozen=True)
class LinearScore:
    """A return placed on a line through two references, so that results compare.

    Args:
        zero: The return that scores 0.
        one: The return that scores 1.

    Raises:
        ValueError: for a reference that is no number, and for two equal ones.
    """

    zero: float
    one: float

    def __post_init__(self) -> None:
        require_fields("env.score", self)
        if self.zero == self.one:
            raise ValueError(
                f"env.score.one: expected another return than env.score.zero, given {self.one} for "
                "both"
            )

    def __call__(self, return_mean: float) -> float:
        """Return the score of a mean return."""
        return (return_mean - self.zero) / (self.one - self.zero)


class StandStill(TensorDictModuleBase):
    """Always the zero action.

    Args:
        head: The flow module of an actor, which knows the action's key and size.
    """

    def __init__(self, head: ConstrainedFlowModule) -> None:
        super().__init__()
        self.head = head
        self.in_keys: list[NestedKey] = []
        self.out_keys = [head.action_key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write zeros."""
        bounds = self.head.bounds
        zeros = bounds.low.new_zeros(*tensordict.shape, bounds.dim)
        return tensordict.set(self.head.action_key, zeros)


@dataclass(frozen=True)
class Evaluation:
    """What happened in a number of whole episodes.

    Args:
        returns: The undiscounted return of each episode, ``(episodes,)``.
        costs: Violations of each episode by judge, ``(episodes, J)``.
        constraints: Counts of each constraint: those that are judged first, in the order of the
            costs.
        steps: The number of steps of these episodes in all.
        cut_off: The number of episodes that would have gone on and were cut off.
    """

    returns: Tensor
    costs: Tensor
    constraints: Mapping[str, ConstraintCounts]
    steps: int
    cut_off: int = 0

    @property
    def violations(self) -> dict[str, int | None]:
        """Violating steps by constraint, None for those that nothing judges."""
        return violations_of(self.constraints)

    def report(self, score: LinearScore | None) -> dict[str, Any]:
        """Return the numbers as plain values."""
        mean = float(self.returns.mean())
        episodes = len(self.returns)
        spread = float(self.returns.std()) / episodes**0.5 if episodes > 1 else None
        return {
            "return_mean": mean,
            "return_standard_error": spread,
            "score": None if score is None else score(mean),
            "violations": self.violations,
            "constraints": constraint_reports(self.constraints),
            "episodes": episodes,
            "steps": self.steps,
            "cut_off": self.cut_off,
        }


def evaluate_seeded(
    env: EnvBase,
    policy: Policy,
    settings: EvaluationSettings,
    *,
    deterministic: bool = False,
) -> Evaluation:
    """Run the episodes that a seed determines: starts, goals and what the policy draws.

    Args:
        env: See `evaluate`.
        policy: See `evaluate`.
        settings: The number of episodes, the seed, and the length at which episodes are cut off.
        deterministic: See `evaluate`.
    """
    env.set_seed(settings.seed)
    torch.manual_seed(settings.seed)
    return evaluate(
        env,
        policy,
        episodes=settings.episodes,
        deterministic=deterministic,
        max_steps=settings.max_steps,
    )


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Policy,
    *,
    episodes: int,
    deterministic: bool = False,
    max_steps: int = 10_000,
) -> Evaluation:
    """Run a policy for whole episodes and count.

    Args:
        env: The environment of any batch size; as many batches are run as the episodes need, of
            which the first episodes count.
        policy: Any TorchRL policy.
        episodes: The number of episodes.
        deterministic: Whether to take `deterministic_sample` of a probabilistic policy instead of
            drawing.
        max_steps: The length at which an episode that goes on is cut off, which a warning tells.

    Raises:
        ValueError: when `episodes` is not positive.
        FloatingPointError: when a return is not finite.
    """
    if episodes < 1:
        raise ValueError(f"episodes: expected a number >= 1, given {episodes}")
    tally = ConstraintTally.of(env)
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    returns = torch.zeros(0)
    costs, steps, cut_off = torch.zeros(0, len(tally.judged)), 0, 0
    with set_exploration_type(mode):
        while (missing := episodes - len(returns)) > 0:
            batch = _run_batch(env, policy, tally, missing, max_steps)
            returns = torch.cat([returns, batch.returns])
            costs = torch.cat([costs, batch.costs])
            steps, cut_off = steps + batch.steps, cut_off + batch.cut_off
    if cut_off:
        warnings.warn(
            f"{cut_off} of {episodes} episodes went on after {max_steps} steps and were cut off "
            "there (evaluation.max_steps)",
            stacklevel=2,
        )
    if not bool(returns.isfinite().all()):
        broken = int((~returns.isfinite()).sum())
        raise FloatingPointError(
            f"return: expected finite numbers, but those of {broken} of {episodes} episodes are "
            "not; look at the environment's reward and at the policy's parameters"
        )
    return Evaluation(returns, costs, tally.counts(), steps, cut_off)


class _Batch(NamedTuple):
    """Returns ``(n,)``, costs ``(n, J)`` and numbers of some episodes, as in `Evaluation`."""

    returns: Tensor
    costs: Tensor
    steps: int
    cut_off: int


def transitions(env: EnvBase, policy: Policy) -> Iterator[TensorDictBase]:
    """Reset an environment and yield its transitions under a policy, without end."""
    state: TensorDictBase = env.reset()
    while True:
        transition, state = env.step_and_maybe_reset(policy(state))
        yield transition


def _run_batch(
    env: EnvBase,
    policy: Policy,
    tally: ConstraintTally,
    most: int,
    max_steps: int,
) -> _Batch:
    """Run one episode of every agent, and return those of the first ones."""
    size = env.batch_size.numel()
    running = torch.ones(size, dtype=torch.bool, device=env.device)
    wanted = torch.arange(size, device=env.device) < most
    returns = torch.zeros(size, device=env.device)
    costs = torch.zeros(size, len(tally.judged), device=env.device)
    steps = 0
    for transition in islice(transitions(env, policy), max_steps):
        outcome = transition.get("next")
        tally.add(transition, running & wanted)
        returns += running * outcome.get(REWARD_KEY).reshape(size)
        if tally.judged:
            costs += running.unsqueeze(-1) * outcome.get(COST_KEY).reshape(costs.shape)
        steps += int((running & wanted).sum())
        running = running & ~outcome.get("done").reshape(size)
        if not bool((running & wanted).any()):
            break
    return _Batch(returns[:most].cpu(), costs[:most].cpu(), steps, int((running & wanted).sum()))


def evaluate_run(
    folder: RunFolder, settings: EvaluationSettings, *, trusted: tuple[str, ...] = ()
) -> dict[str, dict[str, Any]]:
    """Return the report of the trained policy and of each baseline.

    Args:
        folder: A finished run.
        settings: The number of episodes and the seed, the same for all.
        trusted: See `RunFolder.load_config`.
    """
    config = folder.load_config(trusted)
    env = build_environment(config, batch_size=[settings.episodes], with_anchor=True)
    actor = load_actor(folder, config, env)
    safe = constrain(actor, flow="exact")
    exact = flow_head(safe)
    score = instantiate(config.env.get("score"))
    policies: dict[str, tuple[Policy, bool]] = {
        "trained, stochastic": (guarded(actor, env), False),
        "trained, deterministic": (guarded(actor, env), True),
        "safe random": (SafeRandomPolicy(safe), False),
        "standing still": (StandStill(exact), False),
    }
    for name, make in instantiate(config.env.get("baselines") or {}).items():
        policies[name] = (make(exact), False)
    reports = {}
    for name, (policy, deterministic) in policies.items():
        result = evaluate_seeded(env, policy, settings, deterministic=deterministic)
        reports[name] = result.report(score)
    return reports
