import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.paper.records import RecordError, Series, load_record, load_records
from tests.paper.synthetic import make_outcome, make_record, make_records

Document = dict[str, Any]


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    written = make_records(seeds=2)
    for record in written:
        record.save(tmp_path)
    read, problems = load_records(tmp_path)
    assert problems == []
    assert read == sorted(written, key=lambda record: (record.method, record.seed))


def test_violations_are_those_of_training_and_both_evaluations() -> None:
    record = dataclasses.replace(
        make_record(),
        training_violations={"obstacle": 5, "battery": 0},
        evaluation={"stochastic": make_outcome(1, 2), "deterministic": make_outcome(1, 3)},
    )
    assert record.violations == {"obstacle": 10, "battery": 5}


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


BROKEN: dict[str, tuple[Callable[[Document], None], str]] = {
    "other format": (put("format", "results"), "format: expected 'cnfp_torchrl paper record'"),
    "newer version": (put("version", 2), "version: expected 1, given 2"),
    "field missing": (drop("seconds"), "seconds: expected this field, but it is missing"),
    "field too many": (put("score", 1.0), "score: expected no such field"),
    "deep field missing": (
        drop("evaluation", "stochastic", "score"),
        "evaluation.stochastic.score: expected this field",
    ),
    "mode missing": (drop("evaluation", "deterministic"), "evaluation.deterministic: expected"),
    "NaN": (put("evaluation", "stochastic", "score", float("nan")), "NaN is not a finite number"),
    "infinity": (put("seconds", float("inf")), "Infinity is not a finite number"),
    "huge": (put("seconds", 10**400), "seconds: expected a finite number"),
    "truth for number": (put("seconds", True), "seconds: expected a finite number, given True"),
    "fraction for count": (put("steps", 1.5), "steps: expected a whole number >= 0, given 1.5"),
    "negative count": (
        put("training_violations", "battery", -1),
        "training_violations: expected an object of whole numbers >= 0",
    ),
    "no text": (put("method", ""), "method: expected a text, given ''"),
    "seed of another run": (put("seed", 7), "config.seed: expected 7 as in 'seed', given 0"),
    "commit": (put("commit", 3), "commit: expected a text or null, given 3"),
    "no return": (drop("curves", "train/return"), "curves: expected .* are missing"),
    "no cost curve": (drop("curves", "violations/battery"), "violations/battery'] are missing"),
    "steps fall": (
        put("curves", "train/return", {"steps": [500, 400], "values": [0.0, 0.0]}),
        "curves.train/return.steps: expected rising numbers",
    ),
    "steps repeat": (
        put("curves", "train/return", {"steps": [500, 500], "values": [0.0, 0.0]}),
        "curves.train/return.steps: expected rising numbers",
    ),
    "empty curve": (
        put("curves", "train/return", {"steps": [], "values": []}),
        "curves.train/return.values: expected as many as steps, at least one",
    ),
    "value missing": (
        put("curves", "train/return", {"steps": [500, 1000], "values": [0.0]}),
        "given 1 values and 2 steps",
    ),
    "beyond the end": (
        put("curves", "train/return", {"steps": [30_000], "values": [0.0]}),
        "curves.train/return.steps: expected at most 20000, given 30000",
    ),
    "counts that fall": (
        put("curves", "violations/battery", {"steps": [500, 1000], "values": [3.0, 0.0]}),
        "curves.violations/battery.values: expected counts that never fall and end at 0",
    ),
    "counts of another run": (
        put("training_violations", "battery", 4),
        "curves.violations/battery.values: expected counts that never fall and end at 4",
    ),
    "other constraints": (
        put("afterwards", "second rectangle", "stochastic", "violations", {"obstacle": 0}),
        "afterwards.second rectangle.stochastic.violations: expected the constraints",
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
        load_record(bad)
    assert str(bad) in str(caught.value)
    records, problems = load_records(tmp_path)
    assert [record.path(tmp_path) for record in records] == [good]
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
    records, problems = load_records(tmp_path)
    assert [record.seed for record in records] == [0, 2]
    assert len(problems) == 1
    assert "exact, seed 1: config: expected that of the method's other runs" in problems[0]


def test_other_budgets_between_methods_are_named(tmp_path: Path) -> None:
    make_record("exact", steps=20_000).save(tmp_path)
    make_record("squash", steps=8_000).save(tmp_path)
    records, (problem,) = load_records(tmp_path)
    assert len(records) == 2
    assert problem == "steps: expected one budget for all methods, given exact 20,000, squash 8,000"


def test_missing_runs_are_named(tmp_path: Path) -> None:
    make_record("exact", 0).save(tmp_path)
    make_record("exact", 1).save(tmp_path)
    make_record("squash", 1).save(tmp_path)
    _, problems = load_records(tmp_path, [("penalty", 0)])
    assert problems == ["penalty, seed 0: no record", "squash, seed 0: no record"]


def test_no_folder_is_no_record(tmp_path: Path) -> None:
    assert load_records(tmp_path / "absent") == ([], [])


def test_a_record_is_never_written_over_another(tmp_path: Path) -> None:
    path = make_record(score=1.0).save(tmp_path)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"seed_0\.json: expected no file or the record of"):
        make_record(score=0.5).save(tmp_path)
    path.write_text("a note")
    with pytest.raises(FileExistsError):
        make_record(score=1.0).save(tmp_path)
    assert path.read_text() == "a note"
    path.write_bytes(before)
    assert make_record(score=1.0).save(tmp_path) == path


def test_a_record_may_gain_results_afterwards_but_not_lose_any(tmp_path: Path) -> None:
    full = make_record()
    without = dataclasses.replace(full, afterwards={})
    without.save(tmp_path)
    path = full.save(tmp_path)
    assert load_record(path) == full
    with pytest.raises(FileExistsError):
        without.save(tmp_path)


def test_a_record_that_could_not_be_read_leaves_nothing(tmp_path: Path) -> None:
    broken = dataclasses.replace(make_record(), seconds=float("nan"))
    with pytest.raises(RecordError, match="NaN"):
        broken.save(tmp_path)
    curves = {**make_record().curves, "train/return": Series((2, 1), (0.0, 0.0))}
    with pytest.raises(RecordError, match="rising"):
        dataclasses.replace(make_record(), curves=curves).save(tmp_path)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
