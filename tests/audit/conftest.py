"""Tiny runs of the real trainer."""

from tests.training.conftest import make_config, tiny_run

__all__ = ["make_config", "tiny_run"]
