"""Streams of other pipelines: through a collector, and through an environment."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import CatTensors, TransformedEnv
from torchrl.modules import SafeProbabilisticTensorDictSequential

from cnfp_torchrl import constrain_env
from cnfp_torchrl.envs import Map, ShowTask, TaskView
from cnfp_torchrl.modules import make_constrained_actor
from cnfp_torchrl.tasks.point_nav import BatteryGeometry, ObstacleGeometry, PointNavEnv
from cnfp_torchrl.visual.rerun import FlowStream, StreamHook, StreamTransform
from tests.visual.cases import Gaussian, make_actor
from tests.visual.rerun.recorded import compare, read, recorded


def pipeline(batch: list[int]) -> tuple[TransformedEnv, SafeProbabilisticTensorDictSequential]:
    env = constrain_env(
        PointNavEnv(batch, seed=0, max_steps=4), BatteryGeometry(), ObstacleGeometry()
    )
    actor = make_constrained_actor(Gaussian(torch.zeros(2), torch.ones(2)), env)
    return env, actor


EXECUTED = "/stages/3\\ obstacle/executed"


@pytest.mark.parametrize(("batch", "agent"), [([3], 1), ([], 0)])
def test_collector_with_a_hook(batch: list[int], agent: int, tmp_path: Path) -> None:
    env, actor = pipeline(batch)
    collected = []
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        collector = Collector(
            env,
            actor,
            frames_per_batch=6 * max(env.batch_size.numel(), 1),
            total_frames=12 * max(env.batch_size.numel(), 1),
            auto_register_policy_transforms=False,
            post_collect_hook=StreamHook(FlowStream(stream, actor, env), agent),
        )
        collected.extend(data.clone() for data in collector)
        collector.shutdown()
    agents = max(env.batch_size.numel(), 1)
    steps = torch.cat([data.reshape(agents, -1)[agent] for data in collected])
    executed = read(path, EXECUTED, "Points2D:positions")
    assert list(executed) == [agents * step for step in range(12)]
    for step, action in zip(executed, steps["action"], strict=True):
        np.testing.assert_array_equal(executed[step][-1], action.numpy())
    returns = read(path, "/series/return", "Scalars:scalars")
    reward = steps["next", "reward"].reshape(3, 4).double()
    expected = reward.cumsum(1).reshape(-1).numpy()
    np.testing.assert_allclose([value.item() for value in returns.values()], expected)


@pytest.mark.parametrize("frames", [1, 6])
@pytest.mark.parametrize(("batch", "agent"), [([2, 2], 2), ([], 0)])
def test_a_hook_that_leaves_out_steps_records_what_the_stream_does(
    batch: list[int], agent: int, frames: int, tmp_path: Path
) -> None:
    env, actor = pipeline(batch)
    agents = max(env.batch_size.numel(), 1)
    rollout = env.rollout(12, actor, break_when_any_done=False)
    one, other = tmp_path / "hook.rrd", tmp_path / "stream.rrd"
    with recorded(one) as stream:
        hook = StreamHook(FlowStream(stream, actor, env, every=5), agent)
        for part in rollout.split(frames, -1):
            hook(part)
        assert hook.frames == 12 * agents
    with recorded(other) as stream:
        flow_stream = FlowStream(stream, actor, env, every=5)
        for step, transition in enumerate(rollout.reshape(agents, 12)[agent]):
            flow_stream.log_step(agents * step, transition)
    assert list(read(one, EXECUTED, "Points2D:positions")) == [0, 5 * agents, 10 * agents]
    same = compare(one, other)
    assert same.returncode == 0, same.stderr


class OnAMap(TaskView):
    """A view that does not say which entries its position is read from."""

    map = Map((0.0, 4.0), (0.0, 4.0))

    def position(self, states: TensorDictBase) -> Tensor:
        return states["nested", "place"]


def test_steps_that_are_left_out_have_what_a_view_may_read(tmp_path: Path) -> None:
    env, actor = pipeline([])
    place = CatTensors(["observation"], ("nested", "place"), del_keys=False)
    env = env.append_transform(place).append_transform(ShowTask(OnAMap()))
    # The first two numbers are the place; what is observed stays as it was.
    rollout = env.rollout(6, actor, break_when_any_done=False)
    rollout["nested", "place"] = rollout["nested", "place"][..., :2]
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        StreamHook(FlowStream(stream, actor, env, every=3))(rollout)
    assert list(read(path, EXECUTED, "Points2D:positions")) == [0, 3]


@pytest.mark.parametrize(("batch", "agent"), [([3], 2), ([], 0)])
def test_environment_with_a_transform(batch: list[int], agent: int, tmp_path: Path) -> None:
    env, actor = pipeline(batch)
    taken = []
    path = tmp_path / "recording.rrd"
    with recorded(path) as stream:
        env.append_transform(StreamTransform(FlowStream(stream, actor, env), agent))
        taken.append(env.rollout(6, actor, break_when_any_done=False))
    steps = taken[0].reshape(-1, 6)[agent]
    executed = read(path, EXECUTED, "Points2D:positions")
    assert list(executed) == list(range(6))
    for step, action in enumerate(steps["action"]):
        np.testing.assert_array_equal(executed[step][-1], action.numpy())
    reward = read(path, "/series/reward", "Scalars:scalars")
    np.testing.assert_allclose(
        [value.item() for value in reward.values()], steps["next", "reward"].squeeze(-1).numpy()
    )


@pytest.mark.parametrize("way", [StreamHook, StreamTransform])
def test_worker_processes_are_refused(way: type) -> None:
    stream = FlowStream(rr.RecordingStream("tests"), make_actor({}))
    with pytest.raises(TypeError, match="stay in the process that opened the recording"):
        pickle.dumps(way(stream))
    with pytest.raises(ValueError, match="agent: expected an index >= 0, given -1"):
        way(stream, agent=-1)


def test_batches_without_the_agent_are_refused() -> None:
    hook = StreamHook(FlowStream(rr.RecordingStream("tests"), make_actor({})), agent=4)
    with pytest.raises(ValueError, match=r"an index below 3.*shape \(3, 5\), given 4"):
        hook(TensorDict({}, [3, 5]))
    with pytest.raises(ValueError, match="given no time dimension"):
        hook(TensorDict({}, []))
