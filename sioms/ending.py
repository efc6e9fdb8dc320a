"""Programs that serve until they are told to end: how they hear of it.

It is no failure then, so the exit status is 0: a service manager that ends a service this way does not report it as
failed.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn


def on_end(told: Callable[[], object]) -> None:
    """Have a function called when this program is told to end: by SIGINT, SIGTERM or SIGHUP, which is a terminal's end.

    It is called between two steps of the main thread, which calls this, too.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda _number, _frame: told())


def end_well() -> None:
    """Leave all ``with`` blocks, and end with status 0, when this program is told to end."""
    on_end(sys.exit)


def leave(status: int = 0) -> NoReturn:
    """End this program, which has closed everything, without taking interpreter and libraries apart: threads that some
    of them keep would still run meanwhile, in what has been freed.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # closed, or none
            stream.flush()
    os._exit(status)
