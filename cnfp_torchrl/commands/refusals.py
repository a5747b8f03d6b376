"""What a command of Hydra's says when it refuses what it was given: a sentence, no traceback."""

from __future__ import annotations

import dis
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches

from hydra.errors import CompactHydraException, InstantiationException
from omegaconf import MissingMandatoryValue
from omegaconf.errors import InterpolationResolutionError


@contextmanager
def told_in_a_sentence() -> Iterator[None]:
    """Let Hydra print this package's refusals without a traceback, unless HYDRA_FULL_ERROR is set.

    A refusal is a `ValueError`, `TypeError` or `OSError` that a raise statement of this package
    raised, a target that cannot be built, of which Hydra hides the cause, or a value that is taken
    from a setting that is not there. All other errors keep their traceback: nobody foresaw them, so
    that the place matters.

    Raises:
        CompactHydraException: in place of a refusal, with its words.
    """
    # Not sys.exit, which would end a sweep with its first refused job.
    try:
        yield
    except MissingMandatoryValue as error:
        key = error.full_key
        raise CompactHydraException(f"{key}: expected a value, given none; add {key}=...") from None
    except InterpolationResolutionError as error:
        first = str(error).partition("\n")[0]
        raise CompactHydraException(
            f"{error.full_key}: its value is taken from a setting that is not there: {first}; give "
            f"{error.full_key}=..., or the setting"
        ) from None
    except InstantiationException as error:
        raise CompactHydraException(_why_not_built(error)) from error
    except (ValueError, TypeError, OSError) as error:
        if not _raised_by_this_package(error):
            raise
        raise CompactHydraException(_words(error)) from error


def _words(error: BaseException) -> str:
    return "\n".join([str(error), *getattr(error, "__notes__", [])])


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
    # A syntax error names its place itself.
    frames = [] if isinstance(cause, SyntaxError) else traceback.extract_tb(cause.__traceback__)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{begin}{target} cannot be built: {type(cause).__name__}: {_words(cause)}{place}"


def _raised_by_this_package(error: BaseException) -> bool:
    """Tell a raise statement of this package from an operation that failed in it or elsewhere."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return False
    frame = trace.tb_frame
    module = str(frame.f_globals.get("__name__"))
    is_own = module.partition(".")[0] == __name__.partition(".")[0]
    return is_own and frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]
