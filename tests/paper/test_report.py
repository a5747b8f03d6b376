"""The report: verdicts and tables follow the records, and nothing is silently left out."""

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from cnfp_torchrl.visual.figures.canvas import save_png
from experiments.paper import figures, intersections, statistics
from experiments.paper.claims import AIMS, BASELINE_CLAIMS, FLOW_CLAIMS
from experiments.paper.figures_flow import UNTRAINED
from experiments.paper.hostile import HostileRun
from experiments.paper.records import Outcome, Record
from experiments.paper.report import Gathered, compose, gather, main, write_report
from tests.paper.synthetic import make_record, make_records

HOSTILE = [HostileRun("exact", "calm", 1000, {"obstacle": 0, "battery": 0})]

Change = Callable[[Record], Record]


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    def save(figure: Figure, path: Path, *, dpi: int) -> Path:
        return save_png(figure, path, dpi=35)

    monkeypatch.setattr(figures, "save_png", save)
    monkeypatch.setattr(statistics, "RESAMPLES", 200)


@pytest.fixture(autouse=True, scope="module")
def few_intersections() -> Iterator[None]:
    def forget() -> None:
        intersections.intersecting.cache_clear()
        intersections.incompatible.cache_clear()

    forget()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(intersections, "CASES", 60)
        patch.setattr(intersections, "SAMPLES", 200)
        yield
    forget()


def verdicts(
    records: list[Record], hostile: list[HostileRun] | None = None
) -> dict[int, tuple[str, ...]]:
    """Return the words in bold of each numbered row."""
    tried = HOSTILE if hostile is None else hostile
    text = compose(Gathered(records, [], tried, UNTRAINED))
    rows = re.findall(r"^\| (\d+) \| (.*) \|$", text, flags=re.MULTILINE)
    return {int(number): tuple(re.findall(r"\*\*(.*?)\*\*", row)) for number, row in rows}


def broken(outcome: Outcome) -> Outcome:
    return dataclasses.replace(outcome, violations={"obstacle": 1, "battery": 0})


def break_evaluation(run: Record) -> Record:
    worse = {**run.evaluation, "stochastic": broken(run.evaluation["stochastic"])}
    return dataclasses.replace(run, evaluation=worse)


def break_training(run: Record) -> Record:
    return dataclasses.replace(run, training_violations={"obstacle": 1, "battery": 0})


def break_afterwards(run: Record) -> Record:
    after = {
        change: {mode: broken(outcome) for mode, outcome in modes.items()}
        for change, modes in run.afterwards.items()
    }
    return dataclasses.replace(run, afterwards=after)


def lower(run: Record) -> Record:
    worse = {m: dataclasses.replace(o, score=o.score - 0.5) for m, o in run.evaluation.items()}
    return dataclasses.replace(run, evaluation=worse)


FIRST_AIM = len(FLOW_CLAIMS) + len(BASELINE_CLAIMS) + 1


def test_verdicts_of_good_data() -> None:
    found = verdicts(make_records(3))
    assert len(found) == len(FLOW_CLAIMS) + len(BASELINE_CLAIMS) + len(AIMS)
    assert found[1] == ("not reproduced", "reproduced")
    assert found[3] == ("reproduced", "reproduced")
    assert found[4] == ("partly", "reproduced")
    assert found[5] == ("not reproduced", "reproduced")
    assert found[6] == ("not reproduced", "not reproduced")
    assert found[8] == ("reproduced", "reproduced")
    assert found[10] == ("not tested", "not tested")
    aims = [found[FIRST_AIM + i] for i in range(len(AIMS))]
    assert aims == [("met",), ("met",), ("met",), ("partly",), ("met",), ("met",)]


@pytest.mark.parametrize(
    ("change", "row", "verdict"),
    [
        (break_training, FIRST_AIM, ("partly",)),
        (break_evaluation, FIRST_AIM, ("partly",)),
        (break_evaluation, 5, ("not reproduced", "partly")),
        (lower, FIRST_AIM + 1, ("not met",)),
        (lower, 8, ("reproduced", "not reproduced")),
        (break_afterwards, FIRST_AIM + 5, ("not met",)),
    ],
)
def test_data_turn_the_verdict(change: Change, row: int, verdict: tuple[str, ...]) -> None:
    records = make_records(3)
    assert verdicts(records)[row] != verdict
    worse = [change(run) if run.method == "exact" else run for run in records]
    assert verdicts(worse)[row] == verdict


def test_one_violation_of_a_hostile_network_turns_the_verdict() -> None:
    violated = [*HOSTILE, HostileRun("exact", "wild", 1000, {"obstacle": 0, "battery": 1})]
    found = {n: verdicts(make_records(2), h)[FIRST_AIM + 4] for n, h in enumerate((violated, []))}
    assert found == {0: ("not met",), 1: ("not tested",)}


@pytest.mark.parametrize("method", ["squash", "projection", "penalty", "lagrangian"])
def test_a_missing_baseline_leaves_the_aim_untested(method: str) -> None:
    records = [run for run in make_records(2) if run.method != method]
    assert verdicts(records)[FIRST_AIM + 1] == ("not tested",)


def left_out(text: str) -> str:
    return text.split("## What was left out")[1].split("\n## ")[0]


def test_report_is_written_and_repeated(tmp_path: Path) -> None:
    for run in make_records(2, steps=5000):
        run.save(tmp_path / "data")
    path = write_report(tmp_path / "data", tmp_path / "data" / "..")
    assert path.samefile(tmp_path / "README.md")
    text = path.read_text()
    shown = set(re.findall(r"\]\(images/(.*?)\)", text))
    assert shown == {each.name for each in (tmp_path / "images").iterdir()}
    assert str(tmp_path) not in text
    assert left_out(text).strip() == "Nothing."
    assert compose(gather(tmp_path / "data", tmp_path)) == text


def test_what_is_wrong_is_named_and_left_out(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for run in [make_record("exact", seed) for seed in range(3)] + [make_record("squash", 0)]:
        run.save(data)
    cut = data / "exact" / "seed_1.json"
    cut.write_text(cut.read_text()[:500])
    (data / "notes.txt").write_text("mine")
    (tmp_path / "policy.json").write_text("{}")
    text = compose(gather(data, tmp_path, hostile=tmp_path / "gone.json"))
    for named in ("exact/seed_1.json", "notes.txt", "squash, seed 2", "gone.json", "policy.json"):
        assert named in left_out(text)
    assert "problems with the data" in text
    assert "| exact flow (ours) | 2 |" in text
    assert "standard normal" in text
    assert str(tmp_path) not in text


def test_no_record_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path / "unconstrained"), "--output", str(tmp_path)]) == 1
    assert "expected a record or more" in capsys.readouterr().err
    assert not (tmp_path / "README.md").exists()
