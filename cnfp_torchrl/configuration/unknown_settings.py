"""Settings that nothing reads: misspelled in a file, or added on the command line by a plus."""

from __future__ import annotations

import re
from difflib import get_close_matches
from functools import cache

import yaml
from omegaconf import DictConfig, OmegaConf

from cnfp_torchrl.configuration.directory import config_directory

_READ_IN_PLACE = {"env": ("view", "state_setter"), "network": ()}
"""The sections that are no arguments of a target, with what is read of them and shipped in none."""


def refuse_unknown_settings(config: DictConfig) -> None:
    """Refuse settings that have no effect, in a configuration that is not resolved yet.

    Arguments of targets are left to these, and a setting that another one is taken from,
    as in ``${env.limit}``, has the effect of that.

    Raises:
        ValueError: naming the setting, and those of nearly its name.
    """
    shown = config.get("visual")
    if shown and "_target_" not in shown:
        raise ValueError(
            f"visual: expected none of {', '.join(map(str, shown))} where it is off; add "
            "visual=file, or another one that shows"
        )
    text = OmegaConf.to_yaml(config)
    for section in ("", *_READ_IN_PLACE):
        found = config if not section else config.get(section)
        known = _known(section)
        for name in map(str, found or ()):
            if name in known or re.search(rf"\$\{{[^\n]*\b{re.escape(name)}\b", text):
                continue
            close = get_close_matches(name, known, n=2)
            where = f" of {section}" if section else ""
            raise ValueError(
                f"{f'{section}.' if section else ''}{name}: expected a setting{where} that is "
                f"there, such as {' or '.join(close) or ', '.join(sorted(known))}; nothing reads "
                "this one"
            )


@cache
def _known(section: str) -> frozenset[str]:
    """Return the names of the settings of a section in the shipped configuration."""
    directory = config_directory()
    names = set(_READ_IN_PLACE.get(section, ()))
    if not section:
        names |= {path.name for path in directory.iterdir() if path.is_dir()}
    for path in (directory / section).glob("*.yaml"):
        names |= set(map(str, yaml.safe_load(path.read_text(encoding="utf-8")) or ()))
    return frozenset(names - {"defaults"})
