from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from cnfp_torchrl.commands.evaluate import evaluation_table
from cnfp_torchrl.tasks.point_nav import PointNavEnv
from cnfp_torchrl.training.evaluation import LinearScore, evaluate, evaluate_run
from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.training.settings import EvaluationSettings


def still(observation: torch.Tensor) -> torch.Tensor:
    return torch.zeros(*observation.shape[:-1], 2)


STILL = TensorDictModule(still, in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_standing_still_has_the_return_and_violations_of_the_table(batch: tuple[int, ...]) -> None:
    env = PointNavEnv(batch, seed=0)
    env.set_seed(7)
    start = env.reset()["observation"].reshape(-1, 5)
    env.set_seed(7)
    result = evaluate(env, STILL, episodes=len(start))
    distance = (start[:, :2] - start[:, 3:]).norm(dim=-1)
    stations = torch.tensor(env.layout.stations)
    away = (torch.cdist(start[:, :2], stations) > 0.1).all(-1) & (distance > 0.1)
    charge = (start[:, 2] * 100).round()
    # Step t leaves charge - t percent, which violates below 20.
    expected = (100 - (charge - 20)).clamp(0, 100)
    assert away.any()
    torch.testing.assert_close(result.returns[away], -100 * distance[away], rtol=1e-4, atol=0.01)
    torch.testing.assert_close(result.costs[away, 1], expected[away])
    assert result.costs[:, 0].sum() == 0
    assert result.steps == 100 * len(start)


def test_more_episodes_than_the_batch_holds() -> None:
    result = evaluate(PointNavEnv((3,), seed=0, max_steps=5), STILL, episodes=7)
    assert len(result.returns) == 7
    assert len(result.returns.unique()) == 7


def test_a_gymnasium_environment_is_evaluated_too() -> None:
    env = GymEnv("cnfp_torchrl/PointNav-v0").auto_register_info_dict()
    result = evaluate(env, STILL, episodes=2)
    assert result.returns.shape == (2,)
    assert (result.returns < 0).all()


def test_returns_that_are_not_finite_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    step = PointNavEnv._step

    def broken_step(self: PointNavEnv, tensordict: Any) -> Any:
        result = step(self, tensordict)
        result["reward"][1] = torch.nan
        return result

    monkeypatch.setattr(PointNavEnv, "_step", broken_step)
    with pytest.raises(FloatingPointError, match="those of 1 of 3 episodes are not"):
        evaluate(PointNavEnv((3,), seed=0, max_steps=5), STILL, episodes=3)


def test_endless_episodes_are_cut_off_and_told() -> None:
    with pytest.warns(UserWarning, match="3 of 3 episodes went on after 10 steps"):
        result = evaluate(PointNavEnv((2,), seed=0), STILL, episodes=3, max_steps=10)
    assert (result.cut_off, result.steps) == (3, 30)
    assert result.report(None)["cut_off"] == 3


def test_score_is_the_line_of_the_method() -> None:
    score = LinearScore(-104.0, 14.0)
    for value in (-104.0, 0.0, 2.0, 14.0, 54.0):
        assert score(value) == pytest.approx((value + 104) / 118)


def test_report_of_a_run(tiny_run: Callable[..., tuple[RunFolder, Any]]) -> None:
    folder, summary = tiny_run("flow=squash")
    # The saved configuration truncates after 12 steps.
    reports = evaluate_run(folder, EvaluationSettings(episodes=4))
    assert list(reports) == [
        "trained, stochastic",
        "trained, deterministic",
        "safe random",
        "standing still",
        "shortest path",
    ]
    for policy, result in summary["evaluation"].items():
        trained = reports[f"trained, {policy}"]
        assert trained["return_mean"] == pytest.approx(result["return_mean"])
    for name in ("safe random", "shortest path"):
        assert reports[name]["violations"] == {"obstacle": 0, "battery": 0}
    assert reports["safe random"]["constraints"]["battery"]["violations_while"]["active"] == 0
    lines = evaluation_table(reports).splitlines()
    assert len(lines) >= 6
    assert f"{trained['score']:.3f}" in lines[2]


def test_missing_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=str(tmp_path / "absent")):
        RunFolder.open(tmp_path / "absent")
