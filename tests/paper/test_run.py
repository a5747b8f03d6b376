"""The runner: with the real trainer once, and with quick processes in its place."""

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from experiments.paper import run
from experiments.paper.jobs import RunningJob
from experiments.paper.plan import Job
from experiments.paper.progress import Bars, Lines
from experiments.paper.records import load_records

ROOT = Path(__file__).resolve().parents[2]
TINY = (
    "training.warmup_frames=96",
    "training.update_ratio=0.05",
    "training.log_interval=64",
    "evaluation.episodes=4",
    "+env.base.max_steps=12",
)
GOOD = ["timeit", "-n1", "-r1", "pass"]
BAD = ["json.tool", "no such file"]
LONG = ["timeit", "-n1", "-r1", "import time; time.sleep(600)"]


class Told:
    """A display that remembers what was said."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.most = 0

    def say(self, line: str) -> None:
        self.lines.append(line)

    def show(self, running: Sequence[RunningJob], finished: int, failed: int) -> None:
        self.most = max(self.most, len(running))

    def __enter__(self) -> "Told":
        return self

    def __exit__(self, *_: object) -> None:
        return None


def replace_commands(
    monkeypatch: pytest.MonkeyPatch, train: dict[str, list[str]], collect: list[str] = GOOD
) -> None:
    monkeypatch.setattr(run, "PAUSE", 0.01)
    monkeypatch.setattr(RunningJob, "_train", property(lambda self: train[self.job.method]))
    monkeypatch.setattr(RunningJob, "_collect", property(lambda self: collect))


def test_a_failed_run_is_told_and_holds_up_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_commands(monkeypatch, {"exact": GOOD, "penalty": BAD})
    jobs = [Job(method, seed, 64) for seed in range(2) for method in ("penalty", "exact")]
    told = Told()
    failures = run.run_jobs(jobs, tmp_path, tmp_path / "data", parallel=2, progress=told)
    log = tmp_path / "penalty" / "seed_0" / "output.log"
    assert len(failures) == 2
    assert f"penalty, seed 0: exit status 2, log in {log}" in failures
    assert "no such file" in log.read_text()
    assert told.most == 2
    text = "\n".join(told.lines)
    assert text.count(": done") == 2
    assert text.count("FAILED") == 2
    assert "no such file" in text


def test_a_run_whose_record_fails_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_commands(monkeypatch, {"exact": GOOD}, collect=BAD)
    jobs = [Job("exact", 0, 64)]
    (failure,) = run.run_jobs(jobs, tmp_path, tmp_path, parallel=1, progress=Told())
    assert "exact, seed 0: exit status 2" in failure


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_stop_the_runs(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_commands(monkeypatch, {"exact": LONG})
    started = []
    start = RunningJob._start

    def remember(self: RunningJob, module: list[str]) -> subprocess.Popen[bytes]:
        process = start(self, module)
        started.append(process)
        return process

    monkeypatch.setattr(RunningJob, "_start", remember)

    def interrupt() -> None:
        while len(started) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    jobs = [Job("exact", seed, 64) for seed in range(3)]
    before = signal.getsignal(number)
    with pytest.raises(run.Stopped, match=str(int(number))), run.signals_noted() as signals:
        run.run_jobs(jobs, tmp_path, tmp_path, parallel=2, progress=Told(), signals=signals)
    thread.join()
    assert [process.poll() for process in started] == [-signal.SIGTERM] * 2
    assert signal.getsignal(number) is before


def test_two_commands_do_not_share_a_folder(tmp_path: Path) -> None:
    with (
        run.only_one(tmp_path),
        pytest.raises(run.PlanError, match="expected a folder that nobody else uses"),
        run.only_one(tmp_path),
    ):
        pass
    with run.only_one(tmp_path):
        pass


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seeds", "x"], "expected whole numbers and ranges such as 0,1,2 or 0-4, given 'x'"),
        (["--seeds=-1"], "given '-1'"),
        (["--parallel", "0"], "expected a whole number >= 1, given '0'"),
    ],
)
def test_bad_options(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run.main(arguments)
    assert message in capsys.readouterr().err


def test_a_bad_plan_starts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out"
    assert run.main(["--methods", "exct", "--output", str(output)]) == 2
    assert "given ['exct']" in capsys.readouterr().err
    assert not output.exists()


def test_displays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    replace_commands(monkeypatch, {"exact": LONG})
    job = RunningJob(Job("exact", 0, 400), tmp_path, tmp_path)
    try:
        assert job.steps == 0
        log = job.folder / "metrics/scalars/train/seconds.csv"
        log.parent.mkdir(parents=True)
        log.write_text("64,1.0\n128,2.0\n")
        assert job.steps == 128
        lines = Lines(3, 400, pause=0)
        lines.show([job], 1, 1)
        assert capsys.readouterr().err == ("1 of 3 runs done, 1 FAILED; exact, seed 0 at 128\n")
        stream = io.StringIO()
        monkeypatch.setattr(sys, "stderr", stream)
        with Bars(3, 400, 2) as bars:
            bars.show([job], 1, 1)
            assert "1 of 3 runs done, 1 FAILED" in stream.getvalue()
            assert "928/1200" in stream.getvalue()
            assert "exact, seed 0, training" in stream.getvalue()
    finally:
        job.ask_to_stop()
        job.stop()


@pytest.mark.slow
def test_the_real_trainer_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.paper", "--methods", "exact,unconstrained"]
    command += ["--seeds", "0", "--output", str(tmp_path / "a b=c"), "--no-report"]
    command += ["--parallel", "2"]

    def call(steps: int, *more: str) -> subprocess.CompletedProcess[str]:
        arguments = [*command, "--steps", str(steps), *TINY, *more]
        return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)

    first = call(192)
    assert first.returncode == 0, first.stderr
    records, problems = load_records(tmp_path / "a b=c" / "data")
    assert problems == []
    assert [record.method for record in records] == ["exact", "unconstrained"]
    assert all(record.steps == 192 and record.curves["train/return"] for record in records)
    exact, free = records
    assert set(exact.violations.values()) == {0}
    assert free.violations["obstacle"] > 0
    for outcomes in exact.afterwards.values():
        assert all(set(each.violations.values()) == {0} for each in outcomes.values())

    again = call(192)
    assert again.returncode == 0
    assert "2 of them done before" in again.stderr
    assert "started" not in again.stderr

    (tmp_path / "a b=c" / "data" / "exact" / "seed_0.json").unlink()
    collected = call(192)
    assert collected.returncode == 0
    assert load_records(tmp_path / "a b=c" / "data")[0][0].evaluation == exact.evaluation
    assert len(list((tmp_path / "a b=c" / "runs" / "exact").iterdir())) == 1

    other = call(256)
    assert other.returncode == 2
    assert "collector.total_frames (192, asked for 256)" in other.stderr


@pytest.mark.slow
def test_a_diverged_run_is_no_record(tmp_path: Path) -> None:
    arguments = ["--methods", "exact", "--seeds", "0", "--steps", "192", "--no-report"]
    diverging = ["training.update_ratio=1", "optim.lr=1e30"]
    command = [sys.executable, "-m", "experiments.paper", *arguments, "--output", str(tmp_path)]
    result = subprocess.run(
        [*command, *TINY, *diverging], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 1
    assert "FAILED: exact, seed 0" in result.stderr
    assert "nan" in result.stderr
    assert not (tmp_path / "data").exists()
