"""A constraint that cannot be had anywhere is told once; one that gives way at times is not."""

import warnings
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

from cnfp_torchrl.envs import GeometryTransform, RelaxedEverywhereWarning
from cnfp_torchrl.envs.relaxation_watch import LOOKS, STATES
from cnfp_torchrl.geometry import Ball, ConstraintSet
from tests.copies import EVERY_COPY
from tests.walls import HOLDS, MISSED, Wall, Walls, Window, walls


def drive(env: EnvBase, steps: int) -> list[str]:
    """Act at random; returns the warnings of constraints that hold nowhere."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env.rollout(steps, break_when_any_done=False)
    kind = RelaxedEverywhereWarning
    return [str(warning.message) for warning in caught if issubclass(warning.category, kind)]


@pytest.mark.parametrize("agents", [STATES, 64])
def test_what_holds_nowhere_is_told_once(agents: int) -> None:
    env = walls(Walls([MISSED], agents))
    (message,) = drive(env, 2 * STATES // agents + 2)
    assert "'wall' (by 2 or more)" in message
    assert f"each of {STATES} states" in message
    assert drive(env, STATES // agents + 1) == []


@pytest.mark.parametrize("agents", [STATES, 16])
def test_what_holds_somewhere_is_not_told(agents: int) -> None:
    env = walls(Walls([MISSED] * 15 + [HOLDS], agents))
    assert drive(env, 3 * STATES // agents) == []


def test_a_few_states_say_nothing() -> None:
    assert drive(walls(Walls([MISSED], 16)), 4) == []


def test_what_is_dropped_everywhere_is_told_too() -> None:
    (message,) = drive(walls(Walls([MISSED], STATES), Wall(), Window("window")), 2)
    assert "'wall' (by" in message
    assert "'window' (dropped)" in message


class Point(GeometryTransform):
    """A single action, an equality: without interior, and always relaxed by a little."""

    def constraint_set(self, tensordict: object) -> ConstraintSet:
        return Ball(torch.zeros(STATES, 2), torch.zeros(STATES))


def test_a_set_without_interior_is_no_sign_of_trouble() -> None:
    env = walls(Walls([HOLDS], STATES), Wall(), Point("point"))
    assert not env.reset()["constraints", "point", "active"].any()
    assert drive(env, 3) == []


class Alike(Walls):
    """All agents see the same limit."""

    def _shown(self, cost: Tensor) -> TensorDict:
        limit = self.limits[self.time % len(self.limits)].expand(*self.batch_size, 1)
        return super()._shown(cost).set("observation", limit.clone())


def test_later_batches_are_watched_too_but_not_for_ever() -> None:
    env = walls(Alike([HOLDS] * 3 + [MISSED] * 4, STATES, length=100))
    assert len(drive(env, 6)) == 1
    env = walls(Alike([HOLDS] * (LOOKS + 1) + [MISSED] * 3, STATES, length=100))
    assert drive(env, LOOKS + 3) == []


@EVERY_COPY
def test_copies_watch_on(copied: Callable[[TransformedEnv], TransformedEnv]) -> None:
    env = walls(Walls([MISSED], 16))
    assert drive(env, 3) == []
    assert len(drive(copied(env), STATES // 16)) == 1


def test_a_worker_tells_it() -> None:
    env = SerialEnv(2, [lambda: walls(Walls([MISSED], STATES))] * 2)
    assert len(drive(env, 2)) == 2
    env.close()
