"""The report: verdicts and tables follow the records, and nothing is silently left out."""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from experiments.paper import intersections, report
from experiments.paper.claims import AIMS, BASELINE_CLAIMS, FLOW_CLAIMS, Evidence
from experiments.paper.records import HostileRun, Record
from experiments.paper.report import gather, judge, main, pages, write_report
from experiments.paper.tables import in_words
from tests.paper.synthetic import changed, hostile_run, make_evaluation, make_record, make_runs
from tests.pictures import is_a_picture

HOSTILE = {"exact": [hostile_run("exact")]}
FIRST_AIM = len(FLOW_CLAIMS) + len(BASELINE_CLAIMS) + 1

pytestmark = pytest.mark.usefixtures("coarse")


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
    runs: Mapping[str, Sequence[Record]],
    hostile: Mapping[str, Sequence[HostileRun]] = HOSTILE,
) -> dict[int, tuple[str, ...]]:
    """Return the words of each verdict by number, one for each flow that it is about."""
    return {
        judgment.number: tuple(judgment.verdict(flow).strip("*") for flow in judgment.found)
        for judgment in judge(Evidence(runs, hostile))
    }


def test_verdicts_of_good_data() -> None:
    found = verdicts(make_runs(3))
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


def break_evaluation(run: Record) -> Record:
    return changed(run, evaluation=make_evaluation(run.evaluation.stochastic.score, 1))


def break_training(run: Record) -> Record:
    return changed(run, training_violations={"obstacle": 1, "battery": 0})


def break_afterwards(run: Record) -> Record:
    return changed(run, afterwards=dict.fromkeys(run.afterwards, make_evaluation(1, 1)))


def lower(run: Record) -> Record:
    return changed(run, evaluation=make_evaluation(run.evaluation.stochastic.score - 0.5))


@pytest.mark.parametrize(
    ("change", "number", "verdict"),
    [
        (break_training, FIRST_AIM, ("partly",)),
        (break_evaluation, FIRST_AIM, ("partly",)),
        (break_evaluation, 5, ("not reproduced", "partly")),
        (lower, FIRST_AIM + 1, ("not met",)),
        (lower, 8, ("reproduced", "not reproduced")),
        (break_afterwards, FIRST_AIM + 5, ("not met",)),
    ],
)
def test_data_turn_the_verdict(
    change: Callable[[Record], Record], number: int, verdict: tuple[str, ...]
) -> None:
    runs = make_runs(3)
    assert verdicts(runs)[number] != verdict
    assert verdicts({**runs, "exact": [change(run) for run in runs["exact"]]})[number] == verdict


def test_one_violation_of_a_hostile_network_turns_the_verdict() -> None:
    violated = {"exact": [*HOSTILE["exact"], hostile_run("exact", 1)]}
    assert verdicts(make_runs(2), violated)[FIRST_AIM + 4] == ("not met",)
    assert verdicts(make_runs(2), {})[FIRST_AIM + 4] == ("not tested",)


@pytest.mark.parametrize("method", ["squash", "projection", "penalty", "lagrangian"])
def test_a_missing_baseline_leaves_the_aim_untested(method: str) -> None:
    runs = {name: record for name, record in make_runs(2).items() if name != method}
    assert verdicts(runs)[FIRST_AIM + 1] == ("not tested",)


def left_out(text: str) -> str:
    return text.split("## What was left out")[1].split("\n## ")[0]


def anchors(text: str) -> set[str]:
    """Return the anchors that GitHub gives to headings."""
    heads = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads}


def test_report_is_written_and_repeated(tmp_path: Path) -> None:
    for runs in make_runs(2, steps=5000).values():
        for run in runs:
            run.save(tmp_path / "data")
    assert write_report(tmp_path) == tmp_path / "README.md"
    page, details = ((tmp_path / name).read_text() for name in ("README.md", "details.md"))
    shown = set(re.findall(r"\]\(images/(.*?)\)", page))
    assert shown == {path.name for path in (tmp_path / "images").iterdir()}
    assert all(is_a_picture(tmp_path / "images" / name) for name in shown)
    assert set(re.findall(r"\(details\.md#(.*?)\)", page)) <= anchors(details)
    assert set(re.findall(r"\(README\.md#(.*?)\)", details)) <= anchors(page)
    assert str(tmp_path) not in page + details
    assert left_out(details).strip() == "Nothing."
    assert pages(gather(tmp_path)) == {"README.md": page, "details.md": details}


def test_what_is_wrong_is_named_and_left_out(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for method, seed in (("exact", 0), ("exact", 1), ("exact", 2), ("squash", 0)):
        make_record(method, seed).save(data)
    cut = data / "exact" / "seed_1.json"
    cut.write_text(cut.read_text()[:500])
    (data / "notes.txt").write_text("mine")
    (tmp_path / "policy.json").write_text("{}")
    page, details = pages(gather(tmp_path, hostile=tmp_path / "gone.json")).values()
    for named in ("exact/seed_1.json", "notes.txt", "squash, seed 2", "gone.json", "policy.json"):
        assert named in left_out(details)
    assert "problems with the data" in page
    assert "| exact flow (ours) | 2 |" in details
    assert "standard normal" in page
    assert str(tmp_path) not in page + details


def test_no_record_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 1
    assert "expected a record or more" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_kept_page_is_that_of_the_kept_records() -> None:
    """Every number of the first page's tables, without drawing or resampling much."""
    kept = (report.HERE / "README.md").read_text()
    found = pages(gather(report.HERE))["README.md"]
    strip = re.compile(r" \[[−\d][^\]]*\]")
    assert strip.sub("", found.split("## Training")[0]) == strip.sub(
        "", kept.split("## Training")[0]
    )


def test_what_is_special_about_a_configuration_in_words() -> None:
    special = {
        "flow._target_": (json.dumps("package.Exact"), json.dumps("package.module.Other")),
        "lr": ("0.1", None),
        "penalty": ("null", None),
        "penalty.penalty": (None, "100.0"),
    }
    assert in_words(special) == "`flow: Other`, `lr: absent`, `penalty.penalty: 100.0`"
    assert in_words({}) == "nothing"
