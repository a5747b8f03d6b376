import itertools
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.record.loggers import CSVLogger

from cnfp_torchrl.training.constraint_counts import ConstraintTally
from cnfp_torchrl.training.metrics import Metrics


def make_metrics(path: Path, *, interval: int = 100) -> Metrics:
    logger = CSVLogger("metrics", log_dir=str(path))
    return Metrics([logger], ConstraintTally(["wall"]), total_frames=1000, interval=interval)


def rows(path: Path, name: str) -> list[list[float]]:
    lines = (path / "metrics" / "scalars" / f"{name}.csv").read_text().splitlines()
    return [[float(number) for number in line.split(",")] for line in lines]


def steps(count: int, *, cost: float = 0.0, episode_return: float | None = None) -> TensorDict:
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[-1] = episode_return is not None
    total = torch.full((count, 1), episode_return or 0.0)
    costs = torch.full((count, 1), cost)
    return TensorDict(
        {"next": {"cost": costs, "done": done, "episode_reward": total}}, batch_size=[count]
    )


def test_what_is_left_at_the_end_is_a_last_entry(tmp_path: Path) -> None:
    metrics = make_metrics(tmp_path)
    for count in (60, 60, 30):
        metrics.add_steps(steps(count, cost=1.0))
        metrics.log_if_due()
    metrics.add_steps(steps(10, episode_return=-3.0))
    metrics.finish()
    assert rows(tmp_path, "violations/wall") == [[120, 120], [160, 150]]
    assert rows(tmp_path, "train/return") == [[160, -3]]


def test_an_entry_is_not_written_twice(tmp_path: Path) -> None:
    metrics = make_metrics(tmp_path)
    metrics.add_steps(steps(100))
    metrics.log_if_due()
    metrics.finish()
    assert rows(tmp_path, "violations/wall") == [[100, 0]]


def test_times_are_logged_at_each_entry_and_rise(tmp_path: Path) -> None:
    metrics = make_metrics(tmp_path)
    for _ in range(3):
        metrics.add_steps(steps(100))
        metrics.log_if_due()
    metrics.finish()
    for name in ("train/seconds", "train/processor_seconds"):
        at, seconds = zip(*rows(tmp_path, name), strict=True)
        assert at == (100, 200, 300)
        assert all(later > earlier for earlier, later in itertools.pairwise(seconds))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_is_told_also_after_the_last_interval(
    value: float, tmp_path: Path
) -> None:
    metrics = make_metrics(tmp_path)
    metrics.add_steps(steps(10))
    metrics.add_losses(TensorDict({"loss_actor": torch.tensor(1.0)}))
    metrics.add_losses(TensorDict({"loss_actor": torch.tensor(value)}))
    metrics.log_if_due()
    with pytest.raises(FloatingPointError, match=f"loss_actor became {value} by step 10"):
        metrics.finish()


def test_a_return_that_is_not_finite_is_told(tmp_path: Path) -> None:
    metrics = make_metrics(tmp_path)
    metrics.add_steps(steps(100, episode_return=float("nan")))
    with pytest.raises(FloatingPointError, match="return became nan by step 100"):
        metrics.log_if_due()
