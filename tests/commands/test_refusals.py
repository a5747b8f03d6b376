"""Refusals are told in their own words; what nobody foresaw keeps its traceback."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.errors import CompactHydraException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from cnfp_torchrl.commands.refusals import told_in_a_sentence
from cnfp_torchrl.configuration import settings
from cnfp_torchrl.modules.constraint_bijector import in_order
from cnfp_torchrl.training.run_folder import RunFolder


@pytest.mark.parametrize(
    ("refused", "named"),
    [
        (lambda: settings.require_setting("seed", "abc"), "seed"),
        (lambda: in_order([object()], None), "ConstraintBijector"),  # type: ignore[list-item]
        (lambda: RunFolder.open("nowhere"), "nowhere"),
        (lambda: OmegaConf.create({"run": "???"}).run, "run=..."),
        (lambda: OmegaConf.create({"a": "${gone}"}).a, r"^a: [^\n]*gone[^\n]*$"),
        (lambda: OmegaConf.create({"a": {"b": "${oc.dict.keys:c.d}"}}).a.b, r"^a\.b: [^\n]*c\.d"),
        (lambda: OmegaConf.create({"a": "${b}", "b": "???"}).a, "^a: "),
    ],
    ids=["ValueError", "TypeError", "OSError", "missing", "gone", "section gone", "from missing"],
)
def test_a_refusal_becomes_a_sentence(refused: Callable[[], object], named: str) -> None:
    with pytest.raises(CompactHydraException, match=named), told_in_a_sentence():
        refused()


def test_notes_are_told_too() -> None:
    def refused() -> None:
        try:
            settings.require_setting("seed", "abc")
        except ValueError as error:
            error.add_note("said besides")
            raise

    with pytest.raises(CompactHydraException, match=r"seed[^\n]*\nsaid besides"):  # noqa: SIM117
        with told_in_a_sentence():
            refused()


@pytest.mark.parametrize(
    "failed",
    [
        lambda: int("abc"),
        # An operation that fails within the package: a number cannot be iterated over.
        lambda: in_order(3, None),  # type: ignore[arg-type]
    ],
    ids=["elsewhere", "within"],
)
def test_what_nobody_foresaw_keeps_its_traceback(failed: Callable[[], object]) -> None:
    with pytest.raises((ValueError, TypeError)) as caught, told_in_a_sentence():
        failed()
    assert not isinstance(caught.value, CompactHydraException)


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
    target: str, cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, content in MODULES.items():
        (tmp_path / f"{name}.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    config = OmegaConf.create({"env": {"base": {"_target_": target}}})
    with pytest.raises(CompactHydraException, match=cause) as caught, told_in_a_sentence():
        instantiate(config.env.base)
    assert "\n" not in str(caught.value)
