"""What a command says when it fails: the cause in one line, first, and a traceback only of bugs."""

from __future__ import annotations

import dis
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

import hydra
from hydra.errors import HydraException, InstantiationException
from omegaconf import MissingMandatoryValue
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, InterpolationResolutionError

WITH_TRACEBACKS = os.environ.get("HYDRA_FULL_ERROR") == "1"
"""Whether the user asks for tracebacks, in Hydra's way."""

_NOT_THE_USERS = (
    *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    str(Path(__file__).parents[1]),
    "<",
)
"""The beginnings of files that are Python's, installed, this package's, or none."""

_HYDRAS = str(Path(hydra.__file__).parent)
"""The folder from which a target is called, which says nothing of a call that does not fit it."""


@contextmanager
def errors_in_a_sentence(command: str = "", *, status: int = 1) -> Iterator[None]:
    """End the process with an error's cause in one line, unless HYDRA_FULL_ERROR is 1.

    Args:
        command: The command's name, for the beginning of the line.
        status: The exit code.

    Raises:
        SystemExit: in place of an error.
    """
    try:
        yield
    except Exception as error:
        if WITH_TRACEBACKS:
            raise
        write_error(error, f"{command}: error: " if command else "")
        sys.exit(status)


def write_error(error: Exception, prefix: str = "") -> str:
    """Write an error's cause to the standard error, and return it.

    A refusal is written without a traceback. Any other error keeps its own below the cause: nobody
    foresaw it, so that its origin matters.
    """
    sentence = refusal(error)
    cause = type_and_origin(error) if sentence is None else sentence
    sys.stderr.write(f"{prefix}{cause}\n")
    if sentence is None:
        sys.stderr.write("\n")
        traceback.print_exception(error)
    return cause


def refusal(error: BaseException) -> str | None:
    """Return the words of an error that says what the user may do, or None for any other error.

    Such are the errors that a raise statement of this package raised, those of the operating system
    about a file and what is raised from them, those of Hydra and OmegaConf for a configuration that
    cannot be composed, and a target that cannot be built, of which Hydra hides the cause.
    """
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key}: expected a value, given none; add {error.full_key}=..."
    if isinstance(error, InterpolationResolutionError):
        first = str(error).partition("\n")[0]
        return (
            f"{error.full_key}: its value is taken from a setting that is not there: {first}; give "
            f"{error.full_key}=..., or the setting"
        )
    if isinstance(error, InstantiationException):
        return _why_not_built(error)
    if isinstance(error, HydraException):
        unknown = error.__cause__
        if isinstance(unknown, ConfigAttributeError | ConfigKeyError):
            return _unknown_setting(unknown)
        return str(error)
    if _raised_by_this_package(error):
        return _words(error)
    # Python's logging names its own part alone, and Hydra's log file is the first that is opened.
    cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
    if isinstance(cause, OSError) and cause.filename is not None:
        return f"{cause.filename}: {cause.strerror}"
    return None


def _unknown_setting(error: ConfigAttributeError | ConfigKeyError) -> str:
    """Return which setting is not there, and which ones are."""
    section, _, name = str(error.full_key).rpartition(".")
    names = [str(key) for key in error.parent_node or () if key not in ("hydra", "_target_")]
    if not names:
        return (
            f"{error.full_key}: expected no setting of {section}, which has none as it is chosen; "
            f"choose another {section}=..., which --help lists"
        )
    close = get_close_matches(name, names)
    examples = " or ".join(close) if close else f"one of {', '.join(names)}"
    where = f"a setting of {section}" if section else "a setting"
    return (
        f"{error.full_key}: expected {where} that is there, such as {examples}; --cfg job prints "
        f"them all, and +{error.full_key}=... adds one"
    )


def _words(error: BaseException) -> str:
    # The text of a KeyError is that of its argument in quotation marks.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return "\n".join([text, *getattr(error, "__notes__", [])])


def _why_not_built(error: InstantiationException) -> str:
    """Return why a target could not be imported or called: the first cause, and where it is."""
    first, *details = str(error).splitlines()
    key = next((x.removeprefix("full_key: ") for x in details if x.startswith("full_key: ")), "")
    target = first.split("'")[1] if "'" in first else "_target_"
    cause: BaseException = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
        if _raised_by_this_package(cause):
            return _words(cause)
    begin = f"{key}: " if key else ""
    if isinstance(cause, ModuleNotFoundError) and f"{target}.".startswith(f"{cause.name}."):
        parent, _, missing = str(cause.name).rpartition(".")
        if not parent:
            return (
                f"{begin}expected {target} to be importable, but no module {missing!r} is found; "
                f"in the folder of {missing}.py: export PYTHONPATH=."
            )
        names = get_close_matches(missing, dir(sys.modules.get(parent)))
        hint = f"; there is {' and '.join(names)}" if names else ""
        return f"{begin}expected {target} to be importable, but {parent} has no {missing!r}{hint}"
    return f"{begin}{target} cannot be built: {type_and_origin(cause)}"


def type_and_origin(error: BaseException) -> str:
    """Return an error's type, words, and where it is from, if possible in the user's own code.

    That is the innermost line of it, where a library that it called raised the error.
    """
    # A syntax error names its file itself.
    frames = [] if isinstance(error, SyntaxError) else traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(_NOT_THE_USERS)]
    chosen = [*frames[-1:], *own][-1:]
    origin = "".join(
        f" ({frame.filename}, line {frame.lineno})"
        for frame in chosen
        if not frame.filename.startswith(_HYDRAS)
    )
    return f"{type(error).__name__}: {_words(error)}{origin}"


def _raised_by_this_package(error: BaseException) -> bool:
    """Tell a raise statement of this package from an operation that failed in it or elsewhere."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None or type(error) is AssertionError:
        return False
    frame = trace.tb_frame
    module = str(frame.f_globals.get("__name__"))
    is_own = module.partition(".")[0] == __name__.partition(".")[0]
    return is_own and frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]
