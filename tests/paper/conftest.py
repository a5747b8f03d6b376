"""Fixtures of the trainer's tests, for runs that are to be recorded."""

from tests.training.conftest import make_config, tiny_run

__all__ = ["make_config", "tiny_run"]
