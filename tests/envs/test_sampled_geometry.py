"""Sets that a replay buffer computes at sampling: those of the environment, in few bytes."""

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv

from cnfp_torchrl.envs import (
    GeometryTransform,
    PackedStates,
    SampledGeometry,
    constrain_env,
    constraint_bijectors,
    constraints_to_sample,
)
from cnfp_torchrl.geometry import Ball, ConstraintSet, HalfSpaces
from cnfp_torchrl.modules import ConstrainedFlowModule
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.training.storage import prepare_buffer


class SpeedLimit(GeometryTransform):
    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        speed = tensordict["observation"][..., 2:]
        return Ball(-speed, 1.5 + speed[..., 0].abs(), validate_args=False)


class ManyRows(GeometryTransform):
    """Eight half-spaces whose normals are the same everywhere."""

    def constraint_set(self, tensordict: TensorDictBase) -> ConstraintSet:
        observation = tensordict["observation"]
        generator = torch.Generator().manual_seed(0)
        normals = torch.randn(8, 1, generator=generator)
        offsets = 1 + observation[..., :1].square().expand(*observation.shape[:-1], 8)
        return HalfSpaces(normals, offsets, validate_args=False)


def point_nav() -> TransformedEnv:
    return constrain_env(PointNavEnv((16,), seed=0), BatteryGeometry(), ObstacleGeometry())


def pendulum() -> TransformedEnv:
    return constrain_env(GymEnv("Pendulum-v1"), SpeedLimit("speed"), ManyRows("rows"))


ENVS = {"point navigation": point_nav, "pendulum": pendulum}
ALL_ENVS = pytest.mark.parametrize("make_env", ENVS.values(), ids=ENVS)
LIMITS = [0, 44, 64, 10**6]


def read_of(env: TransformedEnv) -> list[NestedKey]:
    """What an actor with the exact flow reads of a state."""
    head = ConstrainedFlowModule(env.action_spec_unbatched, constraint_bijectors(env))
    return ["observation", *head.geometry_keys()]


@ALL_ENVS
@pytest.mark.parametrize("limit", LIMITS)
def test_samples_are_what_was_published(make_env: type[TransformedEnv], limit: int) -> None:
    env = make_env()
    keys = read_of(env)
    published = env.rollout(20, break_when_any_done=False).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), batch_size=64)
    kept = prepare_buffer(buffer, env, keys, constraint_bytes=limit)
    buffer.extend(published.select(*kept))
    sample = buffer.sample()
    expected = published[sample["index"]]
    assert expected["observation"].std() > 0
    for key in [*keys, *[("next", key) for key in keys]]:
        torch.testing.assert_close(sample[key], expected[key], rtol=1e-6, atol=1e-6)
        assert sample[key].shape == expected[key].shape


def bytes_of_a_transition(
    env: TransformedEnv, steps: TensorDictBase, keys: list[NestedKey], limit: int
) -> float:
    """Bytes in storage and in the ring of states, for steps as a collector yields them."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=4)
    kept = prepare_buffer(buffer, env, keys, constraint_bytes=limit)
    for time in range(steps.shape[-1]):
        buffer.extend(steps[..., time].reshape(-1).select(*kept))
    stored = buffer.storage.get(range(len(buffer)))
    total = sum(value.nbytes for value in stored.values(True, True))
    packed = [
        transform for transform in buffer._transform or [] if isinstance(transform, PackedStates)
    ]
    return (total + sum(transform.nbytes for transform in packed)) / len(buffer)


@ALL_ENVS
def test_stored_sets_keep_the_limit(make_env: type[TransformedEnv]) -> None:
    env = make_env()
    keys, steps = read_of(env), env.rollout(60, break_when_any_done=False)
    without = bytes_of_a_transition(env, steps, ["observation"], 0)
    for limit in (48, 80, 10**6):
        more = bytes_of_a_transition(env, steps, keys, limit) - without
        # Each episode has a state more than transitions; they are of 60 steps here.
        assert more <= 1.05 * limit
        sampled = constraints_to_sample(env, keys, limit)
        assert bool(sampled) == (limit < 10**6 and not (limit == 80 and make_env is point_nav))
    if make_env is point_nav:
        assert bytes_of_a_transition(env, steps, keys, 64) - without <= 64


def test_nothing_is_computed_without_constraints() -> None:
    assert constraints_to_sample(PointNavEnv((4,)), ["observation"], 0) == []
    assert SampledGeometry(PointNavEnv((4,)), []).field_keys == []


def test_unknown_constraints_are_refused() -> None:
    with pytest.raises(KeyError, match="wall"):
        SampledGeometry(point_nav(), ["wall"])
