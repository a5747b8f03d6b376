"""The figures: each is drawn once, coarsely, from records made up for tests."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnfp_torchrl.training.run_folder import RunFolder
from cnfp_torchrl.visual import explain
from cnfp_torchrl.visual.comparison import Look
from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.paper import statistics
from experiments.paper.fields import RecordError
from experiments.paper.figures import FIGURES, draw_figures
from experiments.paper.figures_comparison import draw_afterwards, draw_summary, draw_trade_off
from experiments.paper.figures_flow import (
    PLACES,
    UNTRAINED,
    find_policy,
    load_policy,
    policy_of,
    save_policy,
    snapshot,
)
from experiments.paper.figures_mappings import mapping_examples
from experiments.paper.figures_training import draw_training, violation_rate
from experiments.paper.hostile import HostileRun, load_hostile
from experiments.paper.labels import LABELS, Kind, in_order, label
from tests.paper.synthetic import CONSTRAINTS, make_record, make_records
from tests.visual.conftest import is_a_picture

TinyRun = Callable[..., tuple[RunFolder, dict[str, Any]]]

ROOT = Path(__file__).resolve().parents[2]
HOSTILE = [
    HostileRun("exact", "calm", 1000, {"obstacle": 0, "battery": 0}),
    HostileRun("squash", "calm", 1000, {"obstacle": 0, "battery": 90}),
]


NO_SCALE, FLAT = {"loc": [0, 0]}, {"loc": [0, 0], "scale": [1, 0]}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(statistics, "RESAMPLES", 100)


def test_all_figures(tmp_path: Path) -> None:
    paths = draw_figures(make_records(2, steps=5000), HOSTILE, UNTRAINED, tmp_path, dpi=45)
    assert {path.stem for path in paths} == set(FIGURES)
    assert all(is_a_picture(path) for path in paths)


def test_the_same_data_give_the_same_bytes(tmp_path: Path) -> None:
    records = make_records(2, steps=5000)
    one, two = (save_png(draw_summary(records), tmp_path / n).read_bytes() for n in ("a", "b"))
    assert one == two


def test_a_single_run_of_one_method() -> None:
    record = make_record("unconstrained", rate=0.2, score=0.1)
    figure = draw_summary([record])
    said = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert said.count("none of 1 runs reached it") == 2
    draw_trade_off([record])
    draw_training([record])


def test_zero_stands_on_the_axis_of_violations() -> None:
    axes = draw_trade_off([make_record("exact"), make_record("penalty", rate=0.1)]).axes[0]
    zero, one, ten = axes.transData.transform([(0, 1), (1, 1), (10, 1)])[:, 0]
    assert axes.transAxes.transform((0, 0))[0] < zero < one < ten


def test_no_run_after_a_change() -> None:
    record = dataclasses.replace(make_record(), afterwards={})
    texts = [text.get_text() for axes in draw_afterwards([record]).axes for text in axes.texts]
    assert texts == ["No run was evaluated after a change of its constraints."]


def test_violations_per_episode_add_up() -> None:
    record = make_record("penalty", rate=0.1)
    rates = violation_rate(record, CONSTRAINTS[0])
    curve = record.curves[f"violations/{CONSTRAINTS[0]}"]
    ends = statistics.round_ends(record)
    total = np.interp(ends[-1], curve.steps, curve.values)
    assert sum(rates.values) * ends[0] / 100 == pytest.approx(total)


def test_every_method_of_the_library_has_a_look_of_its_own() -> None:
    looks = [each.look for each in LABELS.values()]
    assert len({look.color for look in looks}) == len({look.marker for look in looks}) == len(looks)
    known = {path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml")}
    assert known & set(LABELS) >= {"exact", "squash", "penalty", "lagrangian", "unconstrained"}
    assert in_order(["unconstrained", "penalty_small", "mine", "exact", "penalty"]) == [
        "exact", "penalty", "penalty_small", "unconstrained", "mine",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("method", "name", "kind"),
    [
        ("exact", "exact flow (ours)", Kind.EXACT),
        ("penalty_small", "reward penalty, small", Kind.LEARNED),
        ("exact_visible", "exact flow (ours), visible", Kind.EXACT),
        ("mine", "mine", Kind.LEARNED),
    ],
)
def test_labels(method: str, name: str, kind: Kind) -> None:
    found = label(method)
    assert isinstance(found.look, Look)
    assert (found.look.label, found.kind) == (name, kind)


def test_mappings_map_into_their_sets() -> None:
    titles = [example.title for example in mapping_examples()]
    assert titles[:4] == [
        "box squash", "ball squash", "ellipsoid squash", "retraction of the bounds",
    ]  # fmt: skip
    assert len(titles) == len(set(titles)) == 9


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


def test_kept_policy_comes_from_a_run(tiny_run: TinyRun, tmp_path: Path) -> None:
    folder, _ = tiny_run("experiment=exact")
    policy = policy_of(folder)
    assert "seed" in policy.source
    assert set(policy.gaussians) == set(PLACES)
    assert all(min(scale) > 0 for _, scale in policy.gaussians.values())
    path = tmp_path / "policy.json"
    save_policy(policy, path)
    assert load_policy(path) == policy

    runs = tmp_path / "runs"
    (runs / "exact").mkdir(parents=True)
    (runs / "exact" / "seed_0").symlink_to(folder.path)
    kept = tmp_path / "new.json"
    assert find_policy(kept, runs) == policy
    assert load_policy(kept) == policy
    assert find_policy(tmp_path / "none.json", tmp_path / "nowhere") is UNTRAINED

    other, _ = tiny_run("experiment=squash")
    with pytest.raises(ValueError, match="expected one of the exact flow, given SquashFlow"):
        policy_of(other)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("{", "policy.json"),
        ({"source": "x"}, "gaussians"),
        ({"source": "x", "gaussians": {}}, "gaussians"),
        ({"source": "x", "gaussians": dict.fromkeys(PLACES, NO_SCALE)}, "scale"),
        (
            {"source": "x", "gaussians": dict.fromkeys(PLACES, FLAT)},
            "loc, scale",
        ),
    ],
)
def test_a_broken_policy_is_refused(content: object, named: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(RecordError, match=named):
        load_policy(path)


def test_kept_files_can_be_read() -> None:
    kept = load_hostile(ROOT / "experiments" / "results" / "hostile_networks.json")
    assert {run.flow for run in kept} >= {"exact", "radial"}
    load_policy(ROOT / "experiments" / "paper" / "policy.json")


@pytest.mark.parametrize(
    "content", ["[]", "{}", '{"rows": []}', '{"rows": [{"flow": "exact"}]}', '{"rows": [1]}']
)
def test_a_broken_hostile_result_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "hostile.json"
    path.write_text(content)
    with pytest.raises(RecordError, match="hostile"):
        load_hostile(path)
