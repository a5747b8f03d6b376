"""Paths on the command line, of any characters, where Hydra's grammar knows few."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

PATHS = ("run", "resume")
"""The keys whose values are paths."""


def quoted_paths(arguments: Sequence[str]) -> list[str]:
    """Return arguments in which paths are quoted as Hydra reads them.

    A run that goes on writes into its own folder, which takes the place of Hydra's.

    Raises:
        SystemExit: when there is no folder to go on in, before Hydra makes one of this name.
    """
    result = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        is_path = key in PATHS and equals and value not in ("", "null", "???")
        if not is_path or value[0] in "'\"":
            result.append(argument)
            continue
        result.append(f"{key}={quoted(value)}")
        if key == "resume":
            if not Path(value).is_dir():
                sys.exit(f"resume: expected the folder of a run, given {value}, which is none")
            result.append(f"hydra.run.dir={quoted(value)}")
    return result


def quoted(text: str) -> str:
    """Return a text as Hydra's grammar and OmegaConf's interpolation read it unchanged.

    To both a backslash means itself, unless it stands before what it could escape.
    """
    kept = re.sub(r"(\\*)\$\{", r"\1\1\\${", text)
    return "'" + re.sub(r"(\\*)('|\Z)", _escaped, kept) + "'"


def _escaped(found: re.Match[str]) -> str:
    backslashes, quote = found.groups()
    return 2 * backslashes + ("\\'" if quote else "")
