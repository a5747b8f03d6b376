"""Steps and violations by what a constraint was: active, relaxed or dropped."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import RewardSum
from torchrl.record.loggers import CSVLogger

from cnfp_torchrl.commands.evaluate import evaluation_table
from cnfp_torchrl.envs import ConstraintCost
from cnfp_torchrl.training.constraint_counts import (
    NOT_COUNTED,
    ConstraintTally,
    UncountedConstraintWarning,
)
from cnfp_torchrl.training.evaluation import evaluate
from cnfp_torchrl.training.metrics import Metrics
from tests.walls import HOLDS, MISSED, Wall, Walls, Window, walls

AGENTS, LENGTH = 8, 10


def push(tensordict: TensorDictBase) -> TensorDictBase:
    """Act at the anchor: inside of what holds, and as near as it may be to what cannot."""
    return tensordict.set("action", tensordict["constraints", "anchor"].clone())


def reckless(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.ones_like(tensordict["constraints", "anchor"]))


@pytest.mark.parametrize("batch", [3, 8])
def test_an_evaluation_tells_a_relaxed_constraint_from_a_broken_one(batch: int) -> None:
    # Agent i begins with limit i, and four limits take turns: three hold, one is missed by 2.
    base = Walls([HOLDS, HOLDS, MISSED, HOLDS], batch, length=4)
    wall = evaluate(walls(base), push, episodes=5).constraints["wall"]
    assert wall.steps == {"active": 15, "relaxed": 5, "dropped": 0}
    assert wall.violations_while == {"active": 0, "relaxed": 5, "dropped": 0}
    assert wall.violations == 5
    assert 2 < wall.mean_relaxation <= wall.largest_relaxation < 2.01

    wall = evaluate(walls(base), reckless, episodes=5).constraints["wall"]
    assert wall.violations_while == {"active": 15, "relaxed": 5, "dropped": 0}


def test_what_cannot_be_widened_is_dropped() -> None:
    env = walls(Walls(agents=AGENTS, judged=["window", "wall"]), Wall(), Window("window"))
    result = evaluate(env, push, episodes=AGENTS)
    assert result.steps == AGENTS * LENGTH
    half = AGENTS * LENGTH // 2
    window = result.constraints["window"]
    assert window.steps == {"active": half, "relaxed": 0, "dropped": half}
    assert window.largest_relaxation == window.mean_relaxation == 0
    assert window.violations_while == {"active": 0, "relaxed": 0, "dropped": half}
    # Of the wall's own unit.
    assert 2 < result.constraints["wall"].largest_relaxation < 2.01
    said = evaluation_table({"pushing": result.report(None)})
    assert "pushing: wall relaxed by up to 2 action units in 50 % of steps" in said
    assert "pushing: window dropped in 50 % of steps" in said
    assert f"violations: 0 while active, {half} while relaxed, 0 while dropped" in said


def test_nothing_is_said_of_what_holds() -> None:
    report = evaluate(walls(Walls([HOLDS])), push, episodes=4).report(None)
    assert report["violations"] == {"wall": 0}
    assert len(evaluation_table({"pushing": report}).splitlines()) == 2


@pytest.mark.parametrize("judged", [(), ("collision",)], ids=["missing", "other"])
def test_what_nothing_judges_is_not_counted(judged: Sequence[str]) -> None:
    env = walls(Walls(judged=judged))
    with pytest.warns(UncountedConstraintWarning, match=r"\['wall'\].*not counted"):
        result = evaluate(env, reckless, episodes=4)
    assert result.violations == {**dict.fromkeys(judged, 40), "wall": None}
    assert result.constraints["wall"].violations_while == {}
    assert NOT_COUNTED in evaluation_table({"reckless": result.report(None)})


def test_a_judge_of_the_same_name_is_enough() -> None:
    env = walls(Walls(judged=()))
    env.append_transform(
        ConstraintCost({"wall": lambda before, after: before["action"][..., 0] > 0})
    )
    assert evaluate(env, reckless, episodes=4).violations == {"wall": 40}


def test_without_geometry_costs_are_counted_all_the_same() -> None:
    base = Walls(judged=["other"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tally = ConstraintTally.of(base)
    rollout = base.rollout(3, break_when_any_done=False)
    tally.add(rollout)
    counts = tally.counts()["other"]
    assert counts.violations == rollout["next", "cost"].sum()
    assert counts.steps == counts.violations_while == {}


def test_the_log_has_shares_and_amounts_since_the_last_entry(tmp_path: Path) -> None:
    def rows(name: str) -> list[list[float]]:
        lines = (tmp_path / "log" / "scalars" / f"{name}.csv").read_text().splitlines()
        return [[float(number) for number in line.split(",")] for line in lines]

    env = walls(Walls([HOLDS] * 3 + [MISSED], agents=4))
    env.append_transform(RewardSum())
    logger = CSVLogger("log", log_dir=str(tmp_path))
    metrics = Metrics([logger], ConstraintTally.of(env), total_frames=80, interval=40)
    for policy in (push, reckless):
        steps = env.rollout(10, policy, break_when_any_done=False).reshape(-1)
        metrics.add_steps(steps)
        metrics.log_if_due()
    metrics.finish()
    assert rows("relaxed/wall") == [[40, 0.25], [80, 0.25]]
    assert rows("dropped/wall") == [[40, 0], [80, 0]]
    assert rows("violations/wall") == [[40, 10], [80, 50]]
    for name in ("relaxation/wall", "mean_relaxation/wall"):
        assert all(2 < value < 2.01 for _, value in rows(name))
    wall = metrics.counts()["wall"]
    assert wall.steps == {"active": 60, "relaxed": 20, "dropped": 0}
    assert wall.violations_while == {"active": 30, "relaxed": 20, "dropped": 0}


def test_a_judge_of_nearly_the_name_is_refused() -> None:
    with pytest.raises(ValueError, match=r"constraint 'wall': .* given one named 'walls'"):
        ConstraintTally.of(walls(Walls(judged=["walls"])))
