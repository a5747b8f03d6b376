"""Constrained actors in TorchRL's collectors, whose weights are updated on the way."""

import pickle
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv
from torchrl.modules import AdditiveGaussianModule

from cnfp_torchrl import constrain_env
from cnfp_torchrl.envs import constraint_bijectors
from cnfp_torchrl.modules import WarmUpPolicy, guarded, make_constrained_actor, split_at_latent
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.networks import gaussian_network
from tests.point_nav import make_actor, make_network

AGENTS, STEPS = 8, 5


def shift(actor: Any) -> None:
    """Change the weights so much that all locations show it."""
    with torch.no_grad():
        *_, bias = actor.parameters()
        bias += 0.5


def assert_acted_by(actor: Any, batch: TensorDictBase) -> None:
    expected = actor.module[0](batch.select("observation").clone())
    torch.testing.assert_close(batch["loc"], expected["loc"])
    assert batch["next", "cost"].sum() == 0
    density = actor.module[-1].get_dist(batch)
    # `log_prob` inverts, in float32: only actions that are not saturated tell anything.
    clear = (density.bijector.inv(batch["action"]).abs() < 3).all(-1)
    assert clear.float().mean() > 0.5
    scored = density.log_prob(batch["action"])
    torch.testing.assert_close(batch["action_log_prob"][clear], scored[clear], rtol=0.02, atol=0.02)


def test_collector(env: TransformedEnv) -> None:
    actor = make_actor(return_log_prob=True)
    collector = Collector(
        env,
        actor,
        frames_per_batch=AGENTS * STEPS,
        total_frames=3 * AGENTS * STEPS,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        assert batch.shape == (AGENTS, STEPS)
        assert_acted_by(actor, batch)
        shift(actor)
        collector.update_policy_weights_(TensorDict.from_module(actor).data)


def _make_env(seed: int) -> TransformedEnv:
    return constrain_env(PointNavEnv((AGENTS,), seed=seed), BatteryGeometry(), ObstacleGeometry())


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_multi_sync_collector(workers: int) -> None:
    env = _make_env(0)
    network = gaussian_network(5, 2, hidden=[8])
    actor = make_constrained_actor(network, env, return_log_prob=True)
    collector = MultiSyncCollector(
        [partial(_make_env, seed) for seed in range(workers)],
        actor,
        frames_per_batch=workers * AGENTS * STEPS,
        total_frames=3 * workers * AGENTS * STEPS,
        cat_results="stack",
        auto_register_policy_transforms=False,
    )
    try:
        batches = 0
        for batch in collector:
            batches += 1
            assert batch.shape == (workers, AGENTS, STEPS)
            assert_acted_by(actor, batch)
            shift(actor)
            collector.update_policy_weights_()
        assert batches == 3
    finally:
        collector.shutdown()


def _collect(env: TransformedEnv, policy: Any, cls: type = Collector) -> Any:
    return cls(
        env,
        policy,
        frames_per_batch=AGENTS,
        total_frames=2 * AGENTS,
        auto_register_policy_transforms=False,
    )


OTHER_BOUNDS = Bounded(-1.0, 1.5, (2,))
WRAPPED = {
    "actor": lambda actor: actor,
    "warm-up": lambda actor: WarmUpPolicy(actor, 10),
    "guarded": guarded,
    "latent": lambda actor: split_at_latent(actor).policy,
    "compiled": lambda actor: torch.compile(actor, backend="eager"),
}


@pytest.mark.parametrize("wrapped", WRAPPED.values(), ids=WRAPPED)
def test_actor_of_other_bounds_is_refused(env: TransformedEnv, wrapped: Any) -> None:
    actor = make_constrained_actor(
        make_network(), bijectors=constraint_bijectors(env), spec=OTHER_BOUNDS, flow="gauge"
    )
    with pytest.raises(ValueError, match=r"actor: expected the environment's action bounds"):
        _collect(env, wrapped(actor))


def test_actor_of_other_bounds_follows_one_that_fits(env: TransformedEnv) -> None:
    next(iter(_collect(env, make_actor())))
    pickle.loads(pickle.dumps(env.transform[-1].clone()))
    actor = make_constrained_actor(
        make_network(), bijectors=constraint_bijectors(env), spec=OTHER_BOUNDS
    )
    with pytest.raises(ValueError, match=r"actor: expected the environment's action bounds"):
        _collect(env, actor)


def test_exploration_behind_the_flow_is_refused(env: TransformedEnv) -> None:
    policy = TensorDictSequential(make_actor(), AdditiveGaussianModule(Bounded(-1.0, 1.0, (2,))))
    with pytest.raises(TypeError, match="no AdditiveGaussianModule on constrained actions"):
        _collect(env, policy)


def test_policies_of_others_are_not_judged(env: TransformedEnv) -> None:
    for policy in (None, TensorDictModule(lambda o: o[..., :2], ["observation"], ["action"])):
        next(iter(_collect(env, policy)))
