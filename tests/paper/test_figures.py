"""The figures, from records made up for tests."""

from pathlib import Path

import pytest

from cnfp_torchrl.visual import explain
from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.paper.figures_flow import (
    PLACES,
    UNTRAINED,
    KeptPolicy,
    find_policy,
    policy_of,
    snapshot,
)
from experiments.paper.figures_methods import (
    draw_afterwards,
    draw_summary,
    draw_trade_off,
    draw_training,
)
from experiments.paper.labels import LABELS, in_order, label
from tests.paper.synthetic import changed, make_record, make_runs
from tests.training.conftest import TinyRun

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.usefixtures("coarse")


def test_the_same_data_give_the_same_bytes(tmp_path: Path) -> None:
    runs = make_runs(2, steps=5000)
    one, two = (save_png(draw_summary(runs), tmp_path / name).read_bytes() for name in ("a", "b"))
    assert one == two


def test_a_single_run_of_one_method() -> None:
    runs = {"unconstrained": [make_record("unconstrained", rate=0.2, score=0.1)]}
    said = [text.get_text() for axes in draw_summary(runs).axes for text in axes.texts]
    assert said.count("none of 1 runs reached it") == 2
    draw_trade_off(runs)
    draw_training(runs)


def test_zero_stands_on_the_axis_of_violations() -> None:
    runs = {"exact": [make_record("exact")], "penalty": [make_record("penalty", rate=0.1)]}
    axes = draw_trade_off(runs).axes[0]
    zero, one, ten = axes.transData.transform([(0, 1), (1, 1), (10, 1)])[:, 0]
    assert axes.transAxes.transform((0, 0))[0] < zero < one < ten


def test_runs_without_an_evaluation_after_a_change() -> None:
    without = changed(make_record("squash"), afterwards={})
    texts = [t.get_text() for a in draw_afterwards({"squash": [without]}).axes for t in a.texts]
    assert texts == ["No run was evaluated after a change of its constraints."]
    both = draw_afterwards({"exact": [make_record()], "squash": [without]})
    rows = [tick.get_text() for tick in both.axes[0].get_yticklabels()]
    assert rows == [label("exact").name]


def test_every_method_of_the_library_has_a_look_of_its_own() -> None:
    looks = LABELS.values()
    assert len({look.color for look in looks}) == len({look.marker for look in looks}) == len(looks)
    known = {path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml")}
    assert known & set(LABELS) >= {"exact", "squash", "penalty", "lagrangian", "unconstrained"}
    assert in_order(["unconstrained", "penalty_small", "mine", "exact", "penalty"]) == [
        "exact", "penalty", "penalty_small", "unconstrained", "mine",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("method", "name", "baseline"),
    [
        ("exact", "exact flow (ours)", False),
        ("exact_visible", "exact flow (ours), visible", False),
        ("penalty_small", "reward penalty, small", True),
        ("mine", "mine", True),
    ],
)
def test_labels(method: str, name: str, baseline: bool) -> None:
    assert (label(method).name, label(method).baseline) == (name, baseline)


def test_places_are_what_they_are_called() -> None:
    shares = {name: explain(snapshot(UNTRAINED, name)).share_allowed for name in PLACES}
    assert shares["permissive"] == 1
    assert shares["restrictive"] < 0.5
    for name in ("flow", "restrictive"):
        drawn = snapshot(UNTRAINED, name)
        assert not drawn.dropped
        # Each constraint forbids something that the other one allows.
        bounds, battery, obstacle = drawn.region.sets
        samples = drawn.stages[0].samples
        assert bounds.contains(samples).all()
        assert (~battery.contains(samples) & obstacle.contains(samples)).any()
        assert (battery.contains(samples) & ~obstacle.contains(samples)).any()


def test_the_policy_comes_from_a_run_and_is_kept(tiny_run: TinyRun, tmp_path: Path) -> None:
    folder, _ = tiny_run("experiment=exact")
    policy = policy_of(folder)
    assert "seed" in policy.source
    assert set(policy.gaussians) == set(PLACES)

    attempt = tmp_path / "runs" / "exact" / "seed_0" / "attempt_1"
    attempt.parent.mkdir(parents=True)
    folder.path.rename(attempt)
    kept = tmp_path / "policy.json"
    assert find_policy(kept, tmp_path / "runs") == policy
    assert KeptPolicy.read(kept) == policy
    assert find_policy(kept, tmp_path / "nowhere") == policy
    assert find_policy(tmp_path / "none.json", tmp_path / "nowhere") is UNTRAINED

    other, _ = tiny_run("experiment=squash")
    with pytest.raises(ValueError, match="expected one of the exact flow, given"):
        policy_of(other)
