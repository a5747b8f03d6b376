"""The cause of an error comes first; what nobody foresaw keeps its traceback below it."""

import logging.config
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from cnfp_torchrl.commands.refusals import errors_in_a_sentence
from cnfp_torchrl.configuration import compose_config, refuse_unknown_settings, settings
from cnfp_torchrl.modules.constraint_bijector import in_order
from cnfp_torchrl.training.run_folder import RunFolder

Capture = pytest.CaptureFixture[str]

LOG = {
    "version": 1,
    "handlers": {"file": {"class": "logging.FileHandler", "filename": "nowhere/train.log"}},
}


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
        (lambda: logging.config.dictConfig(LOG), "nowhere/train.log: No such file"),
        (lambda: OmegaConf.create({"a": "${gone}"}).a, r"^a: [^\n]*gone[^\n]*$"),
        (lambda: OmegaConf.create({"a": {"b": "${oc.dict.keys:c.d}"}}).a.b, r"^a\.b: [^\n]*c\.d"),
        (lambda: OmegaConf.create({"a": "${b}", "b": "???"}).a, "^a: "),
    ],
    ids=[
        "ValueError",
        "TypeError",
        "OSError",
        "file",
        "log",
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
        ("visual.every=1", "^visual.every: expected no setting of visual.*choose another visual="),
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


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("+sed=4", "^sed: .* such as seed "),
        ("+env.gama=0.9", "^env.gama: expected a setting of env .* such as gamma"),
        ("+network.hiden=[3]", "^network.hiden: .* such as hidden"),
        ("+something.else=3", "^something: .* such as .*seed"),
        ("+visual.every=3", "^visual: expected none of every where it is off; add visual=file"),
    ],
)
def test_an_unknown_setting_that_was_added_is_refused(
    override: str, named: str, capsys: Capture
) -> None:
    text = written(lambda: refuse_unknown_settings(compose_config(override)), capsys)
    assert re.search(named, text)
    assert text.count("\n") == 1


@pytest.mark.parametrize(
    "overrides",
    [
        ["+env.reach=4", "env.agents=${env.reach}"],
        ["+env.view._target_=my_task.View"],
        ["experiment=penalty", "env.penalty.penalty=2"],
        ["algorithm=ppo"],
        ["+flow.sharpness=1"],
    ],
)
def test_a_setting_that_has_an_effect_may_be_added(overrides: list[str]) -> None:
    refuse_unknown_settings(compose_config(*overrides))


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


def test_of_an_error_in_a_library_the_users_own_line_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    """Such as of a judge that reads an entry of a name that is not there."""
    text = "from tensordict import TensorDict\n\n\ndef judge():\n    TensorDict({})['gone']\n"
    (tmp_path / "own_judge.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    first = written(import_module("own_judge").judge, capsys).partition("\n")[0]
    assert re.search(r"^KeyError: .*gone.*own_judge\.py, line 5\)$", first)


MODULES = {
    "unparsed": "def make(:",
    "lacking": "import no_such_package",
    "failing": "def make():\n    return 1 / 0",
    "narrow": "def make(width):\n    return width",
    "refusing": "from cnfp_torchrl.geometry import Box\n\n\ndef make():\n    Box(1, 0)",
}


@pytest.mark.parametrize(
    ("target", "cause"),
    [
        ("not_there_at_all.make", "no module 'not_there_at_all' is found.*PYTHONPATH"),
        ("unparsed.make", r"SyntaxError.*unparsed\.py, line 1"),
        ("lacking.make", r"No module named 'no_such_package' \(.*lacking\.py, line 1\)"),
        ("failing.make", r"ZeroDivisionError.*failing\.py, line 2"),
        ("narrow.make", "missing 1 required positional argument: 'width'$"),
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
