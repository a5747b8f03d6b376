"""Episodes of a policy, their returns and their violations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cnfp_torchrl.training.environment import counted_constraints
from cnfp_torchrl.training.settings import NUMBER, EvaluationSettings

Policy = Callable[[TensorDictBase], TensorDictBase]
"""Writes the action into a tensordict of states: any TorchRL policy."""


@dataclass(frozen=True)
class LinearScore:
    """A return placed on a line through two references, so that results compare.

    Args:
        zero: the return that scores 0.
        one: the return that scores 1.

    Raises:
        ValueError: for a reference that is no number, and for two equal ones.
    """

    zero: float
    one: float

    def __post_init__(self) -> None:
        NUMBER.require("env.score.zero", self.zero)
        NUMBER.require("env.score.one", self.one)
        if self.zero == self.one:
            raise ValueError(
                f"env.score.one: expected another return than env.score.zero, given {self.one} for "
                "both"
            )

    def __call__(self, return_mean: float) -> float:
        """Return the score of a mean return."""
        return (return_mean - self.zero) / (self.one - self.zero)


@dataclass(frozen=True)
class Evaluation:
    """What happened in a number of whole episodes.

    Args:
        returns: undiscounted return of each episode, ``(episodes,)``.
        costs: violations of each episode by constraint, ``(episodes, K)``.
        names: the constraints' names.
        steps: steps taken in all.
    """

    returns: Tensor
    costs: Tensor
    names: tuple[str, ...]
    steps: int

    @property
    def violations(self) -> dict[str, int]:
        """Violating steps by constraint."""
        totals = self.costs.sum(0).round().long().tolist()
        return dict(zip(self.names, totals, strict=True))

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
            "episodes": episodes,
            "steps": self.steps,
        }


def evaluate_seeded(
    env: EnvBase,
    policy: Policy,
    settings: EvaluationSettings,
    *,
    deterministic: bool = False,
    see: Callable[[TensorDictBase], None] | None = None,
) -> Evaluation:
    """Run the episodes that a seed determines: starts, goals and what the policy draws.

    Args:
        env: see `evaluate`.
        policy: see `evaluate`.
        settings: number of episodes and the seed.
        deterministic: see `evaluate`.
        see: see `evaluate`.
    """
    env.set_seed(settings.seed)
    torch.manual_seed(settings.seed)
    return evaluate(env, policy, episodes=settings.episodes, deterministic=deterministic, see=see)


@torch.no_grad()
def evaluate(
    env: EnvBase,
    policy: Policy,
    *,
    episodes: int,
    deterministic: bool = False,
    max_steps: int = 10_000,
    see: Callable[[TensorDictBase], None] | None = None,
) -> Evaluation:
    """Run a policy for whole episodes and count.

    Args:
        env: any batch size; as many batches are run as the episodes need, the first ones count.
        policy: writes ``action``.
        episodes: how many.
        deterministic: take `deterministic_sample` of a probabilistic policy instead of drawing.
        max_steps: a longer episode is an error: the environment never ends.
        see: is shown every transition of every batch, of the environment's batch size.

    Raises:
        ValueError: when `episodes` is not positive.
        RuntimeError: when an episode outlasts `max_steps`.
        FloatingPointError: when a return is not finite.
    """
    if episodes < 1:
        raise ValueError(f"episodes: expected a number >= 1, given {episodes}")
    names = counted_constraints(env)
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    returns: list[Tensor] = []
    costs: list[Tensor] = []
    steps = 0
    with set_exploration_type(mode):
        while sum(len(each) for each in returns) < episodes:
            shown = _shown(transitions(env, policy), see)
            batch_return, batch_cost, batch_steps = _run_batch(env, shown, len(names), max_steps)
            returns.append(batch_return)
            costs.append(batch_cost)
            steps += batch_steps
    kept = torch.cat(returns)[:episodes]
    if not bool(kept.isfinite().all()):
        broken = int((~kept.isfinite()).sum())
        raise FloatingPointError(
            f"return: expected finite numbers, but those of {broken} of {episodes} episodes are "
            "not; look at the environment's reward and at the policy's parameters"
        )
    return Evaluation(kept, torch.cat(costs)[:episodes], names, steps)


def transitions(env: EnvBase, policy: Policy) -> Iterator[TensorDictBase]:
    """Reset an environment and yield its transitions under a policy, without end."""
    state: TensorDictBase = env.reset()
    while True:
        transition, state = env.step_and_maybe_reset(policy(state))
        yield transition


def _shown(
    steps: Iterator[TensorDictBase], see: Callable[[TensorDictBase], None] | None
) -> Iterator[TensorDictBase]:
    for transition in steps:
        if see is not None:
            see(transition)
        yield transition


def _run_batch(
    env: EnvBase, stream: Iterator[TensorDictBase], constraints: int, max_steps: int
) -> tuple[Tensor, Tensor, int]:
    size = env.batch_size.numel()
    running = torch.ones(size, dtype=torch.bool, device=env.device)
    returns = torch.zeros(size, device=env.device)
    costs = torch.zeros(size, constraints, device=env.device)
    steps = 0
    for transition in islice(stream, max_steps):
        outcome = transition.get("next")
        returns += running * outcome.get("reward").reshape(size)
        if constraints:
            costs += running.unsqueeze(-1) * outcome.get("cost").reshape(size, constraints)
        steps += int(running.sum())
        running = running & ~outcome.get("done").reshape(size)
        if not bool(running.any()):
            return returns.cpu(), costs.cpu(), steps
    raise RuntimeError(
        f"max_steps: expected every episode to end within {max_steps} steps, but "
        f"{int(running.sum())} of {size} go on; truncate the environment"
    )
