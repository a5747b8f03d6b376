"""A command whose packages are missing says which extra brings them."""

import sys
from importlib import import_module

import pytest

from cnfp_torchrl.commands.extras import needs_extra


def test_what_is_missing_and_what_to_install_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hydra", None)
    message = r"pip install 'cnfp_torchrl\[train\]' \(hydra is not installed\)"
    with pytest.raises(SystemExit, match=message), needs_extra("train"):
        import_module("hydra")


def test_a_broken_package_of_our_own_is_no_missing_extra() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_room"), needs_extra("train"):
        import_module("cnfp_torchrl.no_such_room")
