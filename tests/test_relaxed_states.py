"""States in which a constraint cannot hold, from the environment to the actor and its training."""

import math
from collections.abc import Callable, Sequence

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from cnfp_torchrl.envs import ActionGuard, GeometryTransform, constraint_bijectors
from cnfp_torchrl.geometry import ConstraintSet, HalfSpaces
from cnfp_torchrl.modules import (
    ConstrainedFlowModule,
    SafeRandomPolicy,
    make_constrained_actor,
)
from cnfp_torchrl.objectives import ConstrainedSACLoss
from cnfp_torchrl.training.networks import action_value_network, gaussian_network
from cnfp_torchrl.training.update import Update
from tests.walls import HOLDS, MISSED, Wall, Walls, walls

# The environment warns of what holds nowhere, which is what these tests are about.
pytestmark = pytest.mark.filterwarnings("ignore::cnfp_torchrl.envs.RelaxedEverywhereWarning")

MORE = 1e-3 * 2
"""What relaxed rows of actions in [-1, 1] give way beyond the least amount."""

Publish = Callable[[Tensor], ConstraintSet]


class Told(GeometryTransform):
    """Sets that are the same in all states."""

    def __init__(self, publish: Publish, name: str = "told") -> None:
        super().__init__(name)
        self.answer = publish

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        return self.answer(torch.zeros(*tensordict.shape, 2))


def acted(*geometries: GeometryTransform, agents: int = 64, steps: int = 8) -> TensorDictBase:
    """Drive at random, hardly and absurdly hard, under a guard."""
    env = walls(Walls([HOLDS], agents, judged=()), *geometries).append_transform(ActionGuard())
    scale = torch.logspace(-2, 6, agents).unsqueeze(-1).expand(-1, 2)
    actor = TensorDictSequential(
        TensorDictModule(
            lambda seen: (torch.randn(len(seen), 2) * scale, scale),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        ConstrainedFlowModule(env.action_spec_unbatched, constraint_bijectors(env)),
    )
    with torch.no_grad():
        return env.rollout(steps, actor, break_when_any_done=False)


def test_one_impossible_row_leaves_the_other_rows_alone() -> None:
    normals = torch.tensor([[-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    offsets = torch.tensor([-5.0, -0.3, 0.9])
    steps = acted(
        Told(lambda z: HalfSpaces(normals.expand(*z.shape[:-1], 3, 2), offsets.expand(len(z), 3)))
    )
    rows = steps["constraints", "told", "row_relaxation"]
    assert (rows[..., 1:] == 0).all()
    assert (rows[..., 0] > 4).all()
    action = steps["action"].double()
    assert action[..., 0].min() > 1 - 1.2 * MORE
    assert action[..., 1].max() <= -0.3
    assert action[..., 1].min() >= -0.9
    # Of the room that the possible rows leave, all is used.
    assert action[..., 1].max() - action[..., 1].min() > 0.55


def test_a_lower_constraint_binds_in_what_a_relaxed_one_leaves() -> None:
    low = Told(
        lambda z: HalfSpaces(torch.eye(2)[1:].expand(*z.shape[:-1], 1, 2), z[..., :1]), "low"
    )
    steps = acted(
        low,
        Told(lambda z: HalfSpaces(-torch.eye(2)[:1].expand(*z.shape[:-1], 1, 2), z[..., :1] - 5)),
    )
    assert steps["constraints", "low", "active"].all()
    assert steps["action"][..., 1].max() <= 0
    assert steps["action"][..., 0].min() > 1 - 1.2 * MORE


UNITS = (1e-6, 1e-4, 1.0, 1e3, 1e6)


def test_actions_of_any_unit_behave_alike() -> None:
    def drive(unit: float) -> TensorDictBase:
        env = walls(Walls([HOLDS, MISSED, -0.2, 0.0], 16, unit=unit), Wall(unit=unit))
        env.append_transform(ActionGuard())
        torch.manual_seed(0)
        policy = SafeRandomPolicy(make_constrained_actor(gaussian_network(1, 2, hidden=[8]), env))
        with torch.no_grad():
            return env.rollout(6, policy, break_when_any_done=False)

    expected = drive(1.0)
    assert 0 < expected["constraints", "wall", "active"].double().mean() < 1
    for unit in UNITS:
        given = drive(unit)
        for key in (("constraints", "wall", "active"), ("next", "cost")):
            assert torch.equal(given[key], expected[key]), unit
        for key in ("action", ("constraints", "wall", "relaxation"), ("constraints", "anchor")):
            torch.testing.assert_close(given[key] / unit, expected[key], rtol=1e-3, atol=1e-5)


def learn(limits: Sequence[float], entropy: str, updates: int) -> tuple[list[float], list[float]]:
    """Return the entropy weight and the largest gradient of each update of a SAC agent."""
    torch.manual_seed(0)
    env = walls(Walls(limits, 16))
    actor = make_constrained_actor(gaussian_network(1, 2, hidden=[16]), env)
    critic = action_value_network(1, 2, hidden=[16])
    loss = ConstrainedSACLoss(actor, critic, action_spec=env.action_spec_unbatched, entropy=entropy)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    update = Update(loss, optimizer, SoftUpdate(loss, tau=0.01))
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(2000), batch_size=128)
    with torch.no_grad():
        steps = env.rollout(60, SafeRandomPolicy(actor), break_when_any_done=False)
    assert (~steps["constraints", "wall", "active"]).double().mean() >= 0.5
    buffer.extend(steps.reshape(-1).exclude("loc", "scale"))
    alphas, gradients = [], []
    for _ in range(updates):
        losses = update(buffer.sample())
        assert all(bool(value.isfinite().all()) for value in losses.values())
        norms = [p.grad.norm() for p in loss.parameters() if p.grad is not None]
        gradients.append(float(torch.stack(norms).max()))
        alphas.append(float(losses["alpha"]))
    return alphas, gradients


@pytest.mark.parametrize("limits", [[MISSED], [HOLDS, MISSED]], ids=["all states", "half"])
def test_learning_in_relaxed_states_stays_bounded(limits: Sequence[float]) -> None:
    """The entropy weight does not chase what a thin region cannot give, nor do gradients grow."""
    alphas, gradients = learn(limits, "reference", 400)
    assert 0 < min(alphas) <= max(alphas) < 1.1
    assert all(map(math.isfinite, gradients))
    assert max(gradients) < 30


def test_the_weight_of_the_entropy_of_actions_stays_bounded_too() -> None:
    """A thin region has less entropy than any usual target: the weight rises to its bound."""
    alphas, gradients = learn([MISSED], "action", 400)
    assert alphas[-1] == pytest.approx(10.0)
    assert max(alphas) < 10.01
    assert max(gradients) < 5000
