"""Tiny runs of the real trainer."""

from tests.training.conftest import tiny_run

__all__ = ["tiny_run"]
