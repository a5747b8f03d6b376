"""SAC, TD3 and PPO by configuration: one folder, evaluation and resume for all."""

from pathlib import Path

import pytest
import torch

from cnfp_torchrl.configuration import compose_config
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.train import train
from experiments.resume import differences

from .conftest import TINY, TinyRun
from .test_resume import go_on, run_until

ALGORITHMS = {
    "sac": ["algorithm=sac"],
    "td3": ["algorithm=td3"],
    # Latents have no warm-up to come after.
    "ppo": ["algorithm=ppo", "training.warmup_frames=0", "collector.frames_per_batch=96"],
}
LEARNED = {
    "sac": ["loss/actor", "loss/qvalue", "loss/alpha"],
    "td3": ["loss/actor", "loss/qvalue"],
    "ppo": ["loss/objective", "loss/critic", "loss/entropy", "train/clip_fraction"],
}


@pytest.mark.parametrize("flow", ["exact", "projection", "unconstrained"])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_trains_all_that_it_has(name: str, flow: str, tiny_run: TinyRun) -> None:
    folder, summary = tiny_run(*ALGORITHMS[name], f"flow={flow}", "training.update_ratio=0.1")
    _, reference = tiny_run(f"flow={flow}")
    assert set(summary) == set(reference)
    assert summary["steps"] == 192
    if flow != "unconstrained":
        assert summary["violations"] == {"obstacle": 0, "battery": 0}
    for logged in ["train/return", *LEARNED[name]]:
        assert (folder.path / "metrics" / "scalars" / f"{logged}.csv").is_file(), logged
    start, _ = tiny_run(
        *ALGORITHMS[name], f"flow={flow}", "training.update_ratio=0", "optim.lr=1e-30"
    )
    before, after = (run.load_checkpoint()["loss"] for run in (start, folder))
    parts = {key.split(".")[0] for key in after if key.split(".")[0].endswith("_params")}
    assert len(parts) >= 2
    for part in parts:
        keys = [key for key in after if key.startswith(part) and after[key].is_floating_point()]
        assert any(not torch.equal(before[key], after[key]) for key in keys), part


@pytest.mark.parametrize("name", ["td3", "ppo"])
def test_every_algorithm_goes_on_bit_by_bit(name: str, tmp_path: Path) -> None:
    overrides = [*TINY, *ALGORITHMS[name], "checkpoint.interval=64", "training.update_ratio=0.1"]
    config = compose_config(*overrides)
    train(config, RunFolder.create(tmp_path / "whole"))
    run_until(config, tmp_path / "stopped", 150)
    go_on(tmp_path / "stopped")
    assert not differences(tmp_path / "whole", tmp_path / "stopped")


def test_the_actor_of_td3_follows_every_second_update(tiny_run: TinyRun) -> None:
    one = tiny_run("algorithm=td3", "training.update_ratio=0.0105")[0].load_checkpoint()["loss"]
    none = tiny_run("algorithm=td3", "training.update_ratio=0")[0].load_checkpoint()["loss"]
    changed = {key.split(".")[0] for key in one if not torch.equal(one[key], none[key])}
    assert changed == {"qvalue_network_params"}


MIXED = {
    "a loss of PPO": (["loss=ppo"], "network.critic: expected .*state_value.*algorithm=sac"),
    "with its network": (["loss=ppo", "network=state_value"], "take algorithm=ppo"),
    "a loss of SAC": (["algorithm=ppo", "loss=sac", "network=mlp"], "given ConstrainedSACLoss"),
    "delayed updates of SAC": (["+algorithm.actor_every=2"], "2 and ConstrainedSACLoss"),
    "a critic of actions": (["algorithm=ppo", "network=mlp"], "expected .*'state_value'"),
}


@pytest.mark.parametrize(("overrides", "message"), MIXED.values(), ids=MIXED)
def test_what_does_not_belong_together_is_refused(
    overrides: list[str], message: str, tmp_path: Path
) -> None:
    folder = RunFolder.create(tmp_path / "run")
    with pytest.raises(ValueError, match=message):
        train(compose_config(*overrides), folder)
    assert not list(folder.path.iterdir())
