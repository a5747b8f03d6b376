import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.paper.figures_flow import KeptPolicy
from experiments.paper.records import (
    HostileRuns,
    Kept,
    Record,
    RecordError,
    Series,
    differences,
    load_records,
    record_path,
)
from tests.paper.synthetic import changed, make_evaluation, make_record, make_runs

Document = dict[str, Any]
ROOT = Path(__file__).resolve().parents[2]


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    written = [record for runs in make_runs(seeds=2).values() for record in runs]
    for record in written:
        record.save(tmp_path)
    read, problems = load_records(tmp_path)
    assert problems == []
    assert read == sorted(written, key=lambda record: (record.method, record.seed))


def test_the_kept_records_can_be_read() -> None:
    records, problems = load_records(ROOT / "experiments" / "paper" / "data")
    assert problems == []
    for record in records:
        path = record_path(ROOT / "experiments" / "paper" / "data", record.method, record.seed)
        assert json.loads(record.model_dump_json()) == json.loads(path.read_text())


def test_violations_are_those_of_training_and_both_evaluations() -> None:
    record = changed(
        make_record(),
        training_violations={"obstacle": 5, "battery": 1},
        evaluation=make_evaluation(1, 2),
    )
    assert record.violations == 5 + 1 + 2 * (2 + 2)


def drop(*names: str) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        for name in names[:-1]:
            document = document[name]
        del document[names[-1]]

    return change


def put(*names_and_value: Any) -> Callable[[Document], None]:
    *names, last, value = names_and_value

    def change(document: Document) -> None:
        for name in names:
            document = document[name]
        document[last] = value

    return change


def curve(name: str, steps: list[int], values: list[float]) -> Callable[[Document], None]:
    return put("curves", name, {"steps": steps, "values": values})


BROKEN: dict[str, tuple[Callable[[Document], None], str]] = {
    "other format": (put("format", "results"), "format"),
    "newer version": (put("version", 2), "version"),
    "field missing": (drop("seconds"), "seconds"),
    "field too many": (put("score", 1.0), "score"),
    "deep field missing": (
        drop("evaluation", "stochastic", "score"),
        "evaluation.stochastic.score",
    ),
    "mode missing": (drop("evaluation", "deterministic"), "evaluation.deterministic"),
    "NaN": (put("evaluation", "stochastic", "score", float("nan")), "evaluation.stochastic.score"),
    "infinity": (put("seconds", float("inf")), "seconds"),
    "huge": (put("seconds", 10**400), "seconds"),
    "truth for number": (put("seconds", True), "seconds"),
    "text for number": (put("seconds", "1"), "seconds"),
    "fraction for count": (put("steps", 1.5), "steps"),
    "negative count": (put("training_violations", "battery", -1), "training_violations.battery"),
    "no text": (put("method", ""), "method"),
    "seed of another run": (put("seed", 7), "config.seed: expected 7"),
    "commit": (put("commit", 3), "commit"),
    "no return": (drop("curves", "train/return"), "curves: expected .* are missing"),
    "no cost curve": (drop("curves", "violations/battery"), "violations/battery'] are missing"),
    "steps fall": (curve("train/return", [500, 400], [0.0, 0.0]), "curves.train/return: .* rise"),
    "steps repeat": (curve("train/return", [500, 500], [0.0, 0.0]), "curves.train/return: .* rise"),
    "empty curve": (curve("train/return", [], []), "curves.train/return.steps"),
    "value missing": (
        curve("train/return", [500, 1000], [0.0]),
        "curves.train/return: .* 1 values and 2 steps",
    ),
    "beyond the end": (
        curve("train/return", [30_000], [0.0]),
        "curves.train/return.steps: expected at most 20000, given 30000",
    ),
    "counts that fall": (
        curve("violations/battery", [500, 1000], [3.0, 0.0]),
        "curves.violations/battery.values: expected counts that never fall",
    ),
    "counts of another run": (
        put("training_violations", "battery", 4),
        "curves.violations/battery.values: expected counts that never fall and end at 4",
    ),
    "other constraints": (
        put("afterwards", "second rectangle", "stochastic", "violations", {"obstacle": 0}),
        "second rectangle: violations: expected the constraints",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_record_is_named_and_left_out(name: str, tmp_path: Path) -> None:
    change, message = BROKEN[name]
    good = make_record(seed=1).save(tmp_path)
    bad = make_record(seed=0).save(tmp_path)
    document = json.loads(bad.read_text())
    change(document)
    bad.write_text(json.dumps(document))
    with pytest.raises(RecordError, match=message.replace("[", r"\[")) as caught:
        Record.read(bad)
    assert str(bad) in str(caught.value)
    records, problems = load_records(tmp_path)
    assert [record_path(tmp_path, record.method, record.seed) for record in records] == [good]
    assert [str(caught.value) in problem for problem in problems] == [True]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_cut_file_is_named(share: float, tmp_path: Path) -> None:
    path = make_record().save(tmp_path)
    text = path.read_text()
    path.write_text(text[: int(share * len(text))])
    records, (problem,) = load_records(tmp_path)
    assert records == []
    assert str(path) in problem


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"[1, 2]", b"hello", b"{}"])
def test_a_foreign_file_is_named(content: bytes, tmp_path: Path) -> None:
    foreign = tmp_path / "exact" / "notes.json"
    make_record().save(tmp_path)
    foreign.write_bytes(content)
    records, (problem,) = load_records(tmp_path)
    assert len(records) == 1
    assert str(foreign) in problem


GAUSSIAN = {"loc": [0, 0], "scale": [1, 1]}
PLACES = ("flow", "permissive", "restrictive")


@pytest.mark.parametrize(
    ("kind", "content", "field"),
    [
        (HostileRuns, {}, "rows"),
        (HostileRuns, {"rows": []}, "rows"),
        (HostileRuns, {"rows": [1]}, "rows.0"),
        (HostileRuns, {"rows": [{"flow": "exact"}]}, "rows.0.network"),
        (KeptPolicy, {"source": "x"}, "gaussians"),
        (KeptPolicy, {"source": "x", "gaussians": {}}, "gaussians: expected"),
        (KeptPolicy, {"source": "", "gaussians": dict.fromkeys(PLACES, GAUSSIAN)}, "source"),
        (
            KeptPolicy,
            {"source": "x", "gaussians": dict.fromkeys(PLACES, GAUSSIAN | {"scale": [1, 0]})},
            "gaussians.flow.scale.1",
        ),
    ],
)
def test_other_kept_files_are_checked_too(
    kind: type[Kept], content: Document, field: str, tmp_path: Path
) -> None:
    path = tmp_path / "kept.json"
    path.write_text(json.dumps(content))
    with pytest.raises(RecordError, match=field) as caught:
        kind.read(path)
    assert str(path) in str(caught.value)


def test_copies_count_once(tmp_path: Path) -> None:
    path = make_record().save(tmp_path)
    for copy in (path.with_name("seed_1.json"), tmp_path / "squash" / "seed_0.json"):
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(path.read_bytes())
    records, problems = load_records(tmp_path)
    assert len(records) == 1
    assert sum("a copy or a misplaced file" in problem for problem in problems) == 2


def test_another_configuration_within_a_method_is_left_out(tmp_path: Path) -> None:
    for seed, steps in ((0, 20_000), (1, 8_000), (2, 20_000)):
        make_record(seed=seed, steps=steps).save(tmp_path)
    records, (problem,) = load_records(tmp_path)
    assert [record.seed for record in records] == [0, 2]
    assert "exact, seed 1: config" in problem


def test_other_budgets_between_methods_are_named(tmp_path: Path) -> None:
    make_record("exact", steps=20_000).save(tmp_path)
    make_record("squash", steps=8_000).save(tmp_path)
    records, (problem,) = load_records(tmp_path)
    assert len(records) == 2
    assert "exact 20,000, squash 8,000" in problem


def test_missing_runs_are_named(tmp_path: Path) -> None:
    for method, seed in (("exact", 0), ("exact", 1), ("squash", 1)):
        make_record(method, seed).save(tmp_path)
    assert load_records(tmp_path)[1] == ["squash, seed 0: no record"]
    assert load_records(tmp_path / "absent") == ([], [])


def test_a_record_is_never_written_over(tmp_path: Path) -> None:
    path = make_record(score=1.0).save(tmp_path)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"seed_0\.json"):
        make_record(score=0.5).save(tmp_path)
    assert path.read_bytes() == before
    assert len(list(path.parent.iterdir())) == 1


def test_a_record_that_contradicts_itself_cannot_be_made() -> None:
    with pytest.raises(ValueError, match="finite"):
        Record(**{**dict(make_record()), "seconds": float("nan")})
    with pytest.raises(ValueError, match="rise"):
        Series(steps=(2, 1), values=(0.0, 0.0))


def test_differences_name_both_values_and_what_is_absent() -> None:
    usual = {"flow": {"_target_": "package.Exact", "order": ["a", "b"]}, "lr": 0.1, "same": None}
    other = {"flow": {"_target_": "package.Exact", "order": ["b", "a"]}, "new": {}, "same": None}
    assert differences(usual, other) == {
        "flow.order": ('["a", "b"]', '["b", "a"]'),
        "lr": ("0.1", None),
        "new": (None, "{}"),
    }
    assert differences(usual, usual) == {}
