"""Refusals are told in their own words; what nobody foresaw keeps its traceback."""

from collections.abc import Callable

import pytest
from hydra.errors import CompactHydraException
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
    ],
    ids=["ValueError", "TypeError", "OSError", "missing"],
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
