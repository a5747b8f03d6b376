"""Write a task of the user's own to start from: the command ``cnfp-new``."""

from __future__ import annotations

import argparse
import keyword
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from cnfp_torchrl.commands.extras import needs_extra

with needs_extra("train"):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from cnfp_torchrl.commands.refusals import errors_in_a_sentence
    from cnfp_torchrl.configuration import config_directory

_TEMPLATE = Path(__file__).parent / "new_task"
# The template is a package of this one, so that it is checked and tested like the rest.
_PACKAGE = f"{__package__}.{_TEMPLATE.name}"
_FILES = {
    "__init__.py": "{name}/__init__.py",
    "environment.py": "{name}/environment.py",
    "judge.py": "{name}/judge.py",
    "geometry.py": "{name}/geometry.py",
    "task.yaml": "conf/env/{name}.yaml",
    "test_task.py": "test_{name}.py",
}
"""The files of a task: those of the template, and what they become."""


def new_task(name: str, parent: Path = Path()) -> Path:
    """Write a task, a point mass with a speed limit, and return its new folder.

    Args:
        name: The name of its package, its configuration and its folder.
        parent: The folder to make the new one in.

    Raises:
        ValueError: for a name that Python, the command line or a module has a use for already.
        OSError: where something of this name stands in `parent`, or nothing can be written.
    """
    _require_writable_name(name)
    folder = parent / name
    if folder.exists() or folder.is_symlink():
        raise FileExistsError(f"{folder}: expected a new folder, but it exists; nothing is written")
    _require_free_name(name)
    # Under its name once it is whole: renaming replaces no folder that has anything in it.
    with TemporaryDirectory(prefix=f".{name}.", dir=parent) as partial:
        whole = Path(partial) / name
        for source, target in _FILES.items():
            path = whole / target.format(name=name)
            path.parent.mkdir(parents=True, exist_ok=True)
            text = (_TEMPLATE / source).read_text(encoding="utf-8")
            path.write_text(text.replace(_PACKAGE, name), encoding="utf-8")
        whole.rename(folder)
    return folder


def _require_writable_name(name: str) -> None:
    """Refuse what Python or the command line cannot read as a name."""
    if not (name.isidentifier() and name.isascii()) or keyword.iskeyword(name) or name[0] == "_":
        raise ValueError(
            "name: expected a Python identifier of ASCII letters, digits and underscores, no "
            f"keyword and no underscore first, such as my_task, given {name!r}"
        )
    if OverridesParser.create().parse_override(f"env={name}").value() != name:
        raise ValueError(f"name: expected one that env={name} can name, given {name!r}, a value")


def _require_free_name(name: str) -> None:
    """Refuse the name of a module or of an environment that is there."""
    if name in sys.modules or find_spec(name) is not None:
        raise ValueError(
            f"name: expected one that no module has, given {name!r}, which Python imports from "
            "elsewhere; take another"
        )
    if any(path.stem == name for path in (config_directory() / "env").iterdir()):
        raise ValueError(
            f"name: expected one that no configuration has, given {name!r}, which env={name} "
            "takes from this package; take another"
        )


def _next_steps(folder: Path) -> str:
    """Return the commands that test, audit and train a task, as they would be typed."""
    name = folder.name
    options = f"--config-dir conf env={name}"
    commands = [
        f"cd {name}",
        "export PYTHONPATH=.",
        f"python -m pytest test_{name}.py",
        f"cnfp-audit {options}",
        f"cnfp-train {options}",
    ]
    return "next: " + "; ".join(commands)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a task into the current folder, and print its files and what to do next."""
    parser = argparse.ArgumentParser(
        prog="cnfp-new",
        description="Write a task of your own to start from, in a new folder: environment, judge, "
        "geometry, configuration, and a test that passes at once.",
    )
    parser.add_argument("name", help="of the task, a Python identifier such as my_task")
    name = parser.parse_args(arguments).name
    with errors_in_a_sentence(parser.prog, status=2):
        folder = new_task(name)
    files = "\n".join(str(folder / target.format(name=name)) for target in _FILES.values())
    sys.stdout.write(f"{files}\n{_next_steps(folder)}\n")


if __name__ == "__main__":
    main()
