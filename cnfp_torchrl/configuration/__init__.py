"""Configurations: the shipped ones, what settings may be, what a run's may call."""

from cnfp_torchrl.configuration.directory import compose_config, config_directory
from cnfp_torchrl.configuration.settings import require_fields, require_setting, require_settings
from cnfp_torchrl.configuration.trust import foreign_packages
from cnfp_torchrl.configuration.unknown_settings import refuse_unknown_settings

__all__ = [
    "compose_config",
    "config_directory",
    "foreign_packages",
    "refuse_unknown_settings",
    "require_fields",
    "require_setting",
    "require_settings",
]
