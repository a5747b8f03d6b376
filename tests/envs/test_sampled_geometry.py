"""Sets that a replay buffer computes at sampling: those of the environment, in few bytes."""

from collections.abc import Sequence

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv

from cnfp_torchrl.envs import (
    BatteryGeometry,
    GeometryTransform,
    ObstacleGeometry,
    PointNavEnv,
    SampledGeometry,
    constrain_env,
    constraint_bijectors,
    constraints_to_sample,
)
from cnfp_torchrl.geometry import Ball, ConstraintSet, HalfSpaces
from cnfp_torchrl.modules import ConstrainedFlowModule
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


def size(stored: TensorDictBase, keys: Sequence[NestedKey]) -> int:
    return sum(stored[key][0].nbytes for key in keys)


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


@ALL_ENVS
@pytest.mark.parametrize("limit", LIMITS)
def test_stored_sets_keep_the_limit(make_env: type[TransformedEnv], limit: int) -> None:
    env = make_env()
    keys = read_of(env)
    published = env.rollout(2).reshape(-1)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
    kept = prepare_buffer(buffer, env, keys, constraint_bytes=limit)
    buffer.extend(published.select(*kept))
    stored = buffer.storage.get(range(len(buffer)))
    constraints = [key for key in stored.keys(True, True) if "constraints" in key]
    fields = {key for each in constraint_bijectors(env) for key in each.geometry_keys}
    always = [key for key in keys if "constraints" in key and key not in fields]
    if limit >= 2 * size(published, always):
        assert size(stored, constraints) <= limit
    assert all(key in constraints for key in always)
    assert all(("next", *key) in constraints for key in always)
    sampled = constraints_to_sample(env, keys, limit)
    if limit == 10**6:
        assert not sampled
    if limit == 0:
        assert set(sampled) == {each.name for each in constraint_bijectors(env)}


def test_the_reference_task_stores_at_most_64_bytes_more_than_without_constraints() -> None:
    env = point_nav()
    published = env.rollout(2).reshape(-1)
    sizes = []
    for keys in (read_of(env), ["observation"]):
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
        kept = prepare_buffer(buffer, env, keys, constraint_bytes=64)
        buffer.extend(published.select(*kept))
        stored = buffer.storage.get(range(len(buffer)))
        sizes.append(size(stored, list(stored.keys(True, True))))
    assert 0 < sizes[0] - sizes[1] <= 64


def test_nothing_is_computed_without_constraints() -> None:
    assert constraints_to_sample(PointNavEnv((4,)), ["observation"], 0) == []
    assert SampledGeometry(PointNavEnv((4,)), []).field_keys == []


def test_unknown_constraints_are_refused() -> None:
    with pytest.raises(KeyError, match="wall"):
        SampledGeometry(point_nav(), ["wall"])
