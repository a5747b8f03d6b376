"""One step of learning: what it changes, that nothing waits for a GPU, and that it compiles."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra.utils import instantiate
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.agent import build_actor, build_environment, build_loss
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.storage import prepare_buffer
from cnfp_torchrl.training.train import train
from cnfp_torchrl.training.update import Update
from tests.host_reads import HostReads, no_synchronization

from .conftest import TINY

EXPERIMENTS = ["exact", "exact_action_entropy", "unconstrained", "lagrangian"]


def prepared(
    experiment: str, device: str = "cpu", **options: Any
) -> tuple[Update, TensorDictReplayBuffer]:
    """Return the update of an experiment, and a buffer of transitions."""
    overrides = [f"experiment={experiment}", "network.hidden=[8]", "replay_buffer.batch_size=32"]
    config = compose_config(*overrides)
    torch.manual_seed(0)
    env = build_environment(config)
    actor = build_actor(config, env)
    buffer = instantiate(config.replay_buffer)
    cost = [("next", "cost")] if experiment == "lagrangian" else []
    kept = prepare_buffer(buffer, env, actor.in_keys, other_keys=cost, constraint_bytes=64)
    steps = env.rollout(10, actor, break_when_any_done=False).detach().reshape(-1)
    buffer.extend(steps.select(*kept).to(device))
    loss = build_loss(config, env, actor.to(device)).to(device)
    target = instantiate(config.target, _partial_=True)(loss)
    optimizer = instantiate(config.optim, _partial_=True)(loss.parameters())
    return Update(loss, optimizer, target, **options), buffer


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_a_step_changes_all_that_learns(experiment: str) -> None:
    update, buffer = prepared(experiment)
    before = {key: value.clone() for key, value in update.loss.state_dict().items()}
    losses = update(buffer.sample())
    assert all(value.isfinite() for value in losses.values())
    after = update.loss.state_dict()
    for key, _ in update.loss.named_parameters():
        assert not torch.equal(after[key], before[key]), key
    for key in (key for key in after if key.startswith("target_")):
        assert not torch.equal(after[key], before[key]), key


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_a_step_reads_nothing_on_the_host(experiment: str) -> None:
    update, buffer = prepared(experiment)
    update(buffer.sample())  # the first one sets the optimizer up
    batch = buffer.sample()
    with HostReads() as reads:
        losses = update.loss(batch)
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        update.target.step()
    assert not reads.lines


def test_reading_on_the_host_would_be_seen() -> None:
    ones = torch.ones(2)
    with HostReads() as reads:
        float(ones[0])
        _ = ones[ones > 0]
        torch.tensor([1.0])
    assert reads.count == 3


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_a_step_on_a_gpu_does_not_synchronize(experiment: str) -> None:
    update, buffer = prepared(experiment, device="cuda")
    update(buffer.sample())
    batch = buffer.sample()
    with no_synchronization():
        losses = update(batch)
    assert all(value.isfinite() for value in losses.values())


# Compiled -----------------------------------------------------------------------------------------


def stepped(make: Callable[[], tuple[Update, TensorDictReplayBuffer]]) -> dict[str, Tensor]:
    """Return the loss's state after three steps on given batches and noise."""
    update, buffer = make()
    torch.manual_seed(1)
    batches = [buffer.sample() for _ in range(3)]
    for seed, batch in enumerate(batches):
        torch.manual_seed(seed)
        update(batch)
    return update.loss.state_dict()


@pytest.mark.slow
@pytest.mark.parametrize("experiment", ["exact", "unconstrained"])
@pytest.mark.filterwarnings("ignore")
def test_compiled_steps_are_the_eager_ones(experiment: str, fresh_compiler: None) -> None:
    # Compiled noise is drawn by another generator unless it falls back to torch's own.
    with torch._inductor.config.patch(fallback_random=True):
        states = [
            stepped(lambda compiled=compiled: prepared(experiment, compiled=compiled))
            for compiled in (False, True)
        ]
    for key, expected in states[0].items():
        torch.testing.assert_close(states[1][key], expected, rtol=1e-2, atol=1e-3, msg=key)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_run_trains_compiled(tmp_path: Path, fresh_compiler: None) -> None:
    config = compose_config(*TINY, "compile=true")
    summary = train(config, RunFolder.create(tmp_path / "run"))
    assert sum(summary["violations"].values()) == 0
