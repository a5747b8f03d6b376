"""The console commands as they are installed: Ctrl-C ends them with a line, at any time.

Each is imported when it is called, for imports take the first seconds.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from importlib import import_module
from typing import NoReturn


def _command(name: str) -> Callable[[], None]:
    """Return the command of a file of this folder."""

    def tell() -> None:
        sys.stderr.write(f"\ncnfp-{name}: stopped by Ctrl-C\n")

    def leave(*_: object) -> NoReturn:
        # Not by an exception, which some of the packages that are imported swallow.
        tell()
        sys.stderr.flush()
        os._exit(130)

    def command() -> None:
        is_usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if is_usual:
            signal.signal(signal.SIGINT, leave)
        main = import_module(f"{__package__}.{name}").main
        try:
            if is_usual:
                signal.signal(signal.SIGINT, signal.default_int_handler)
            main()
        except KeyboardInterrupt:
            if os.environ.get("HYDRA_FULL_ERROR") == "1":
                raise
            tell()
            sys.exit(130)

    return command


audit = _command("audit")
evaluate = _command("evaluate")
explain = _command("explain")
export = _command("export")
new = _command("new")
sweep = _command("sweep")
train = _command("train")
view = _command("view")
