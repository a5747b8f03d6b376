"""Configurations: where the shipped ones are, what settings may be, what a run's may call."""

from cnfp_torchrl.configuration.directory import config_directory
from cnfp_torchrl.configuration.settings import require_fields, require_setting, require_settings
from cnfp_torchrl.configuration.trust import foreign_packages

__all__ = [
    "config_directory",
    "foreign_packages",
    "require_fields",
    "require_setting",
    "require_settings",
]
