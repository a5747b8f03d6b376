"""What a command of Hydra's says when it refuses what it was given: a sentence, no traceback."""

from __future__ import annotations

import dis
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.errors import CompactHydraException
from omegaconf import MissingMandatoryValue


@contextmanager
def told_in_a_sentence() -> Iterator[None]:
    """Let Hydra print this package's refusals without a traceback, unless HYDRA_FULL_ERROR is set.

    A refusal is a `ValueError`, `TypeError` or `OSError` that a raise statement of this package
    raised. All other errors keep their traceback: nobody foresaw them, so that the place matters.

    Raises:
        CompactHydraException: in place of a refusal, with its words.
    """
    # Not sys.exit, which would end a sweep with its first refused job.
    try:
        yield
    except MissingMandatoryValue as error:
        key = error.full_key
        raise CompactHydraException(
            f"{key}: expected a value, given none; add {key}=..."
        ) from error
    except (ValueError, TypeError, OSError) as error:
        if not _raised_by_this_package(error):
            raise
        words = [str(error), *getattr(error, "__notes__", [])]
        raise CompactHydraException("\n".join(words)) from error


def _raised_by_this_package(error: Exception) -> bool:
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
