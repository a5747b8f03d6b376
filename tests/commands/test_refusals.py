"""The cause of an error comes first; what nobody foresaw keeps its traceback below it."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from cnfp_torchrl.commands.refusals import errors_in_a_sentence
from cnfp_torchrl.configuration import compose_config, settings
from cnfp_torchrl.modules.constraint_bijector import in_order
from cnfp_torchrl.training.run_folder import RunFolder

Capture = pytest.CaptureFixture[str]


def written(function: Callable[[], object], capsys: Capture) -> str:
    with pytest.raises(SystemExit) as ended, errors_in_a_sentence("cnfp-test", status=7):
        function()
    assert ended.value.code == 7
    text = capsys.readouterr().err
    assert text.startswith("cnfp-test: error: ")
    return text.removeprefix("cnfp-test: error: ")


@pytest.mark.parametrize(
    ("refused", "named"),
    [
        (lambda: settings.require_setting("seed", "abc"), "seed"),
        (lambda: in_order([object()], None), "ConstraintBijector"),  # type: ignore[list-item]
        (lambda: RunFolder.open("nowhere"), "nowhere"),
        (lambda: OmegaConf.create({"run": "???"}).run, "run=..."),
        (lambda: Path("nowhere/file").read_text(), "nowhere/file: No such file"),
        (lambda: OmegaConf.create({"a": "${gone}"}).a, r"^a: [^\n]*gone[^\n]*$"),
        (lambda: OmegaConf.create({"a": {"b": "${oc.dict.keys:c.d}"}}).a.b, r"^a\.b: [^\n]*c\.d"),
        (lambda: OmegaConf.create({"a": "${b}", "b": "???"}).a, "^a: "),
    ],
    ids=[
        "ValueError",
        "TypeError",
        "OSError",
        "file",
        "missing",
        "gone",
        "section gone",
        "from missing",
    ],
)
def test_a_refusal_is_one_line(refused: Callable[[], object], named: str, capsys: Capture) -> None:
    text = written(refused, capsys)
    assert re.search(named, text.rstrip())
    assert text.count("\n") == 1


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("sed=3", "^sed: .* such as seed "),
        ("loss.gama=0.9", "^loss.gama: expected a setting of loss .* such as gamma"),
        ("optim.x=1", "^optim.x: .* one of .*lr"),
    ],
)
def test_of_an_unknown_setting_those_that_are_there_are_told(
    override: str, named: str, capsys: Capture
) -> None:
    def composed() -> None:
        compose_config(override)

    text = written(composed, capsys)
    assert re.search(named, text)
    assert text.count("\n") == 1


def test_notes_are_told_too(capsys: Capture) -> None:
    def refused() -> None:
        try:
            settings.require_setting("seed", "abc")
        except ValueError as error:
            error.add_note("said besides")
            raise

    assert re.search(r"seed[^\n]*\nsaid besides", written(refused, capsys))


@pytest.mark.parametrize(
    "failed",
    [
        lambda: int("abc"),
        # An operation that fails within the package: a number cannot be iterated over.
        lambda: in_order(3, None),  # type: ignore[arg-type]
    ],
    ids=["elsewhere", "within"],
)
def test_what_nobody_foresaw_keeps_its_traceback_below_the_cause(
    failed: Callable[[], object], capsys: Capture
) -> None:
    first, empty, *trace = written(failed, capsys).splitlines()
    assert re.search(r"(ValueError|TypeError): .* \(.*\.py, line \d+\)", first)
    assert not empty
    assert trace[0].startswith("Traceback")


MODULES = {
    "unparsed": "def make(:",
    "lacking": "import no_such_package",
    "failing": "def make():\n    return 1 / 0",
    "refusing": "from cnfp_torchrl.geometry import Box\n\n\ndef make():\n    Box(1, 0)",
}


@pytest.mark.parametrize(
    ("target", "cause"),
    [
        ("not_there_at_all.make", "no module 'not_there_at_all' is found.*PYTHONPATH"),
        ("unparsed.make", r"SyntaxError.*unparsed\.py, line 1"),
        ("lacking.make", r"No module named 'no_such_package' \(.*lacking\.py, line 1\)"),
        ("failing.make", r"ZeroDivisionError.*failing\.py, line 2"),
        ("failing.mak", "failing has no 'mak'; there is make"),
        ("failing.deeper.make", "failing has no 'deeper'"),
        ("refusing.make", "^Box, field 'low': expected"),
    ],
)
def test_of_a_target_that_cannot_be_built_the_first_cause_is_told_in_one_line(
    target: str, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    for name, content in MODULES.items():
        (tmp_path / f"{name}.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    config = OmegaConf.create({"env": {"base": {"_target_": target}}})
    text = written(lambda: instantiate(config.env.base), capsys)
    assert re.search(cause, text)
    assert text.count("\n") == 1
