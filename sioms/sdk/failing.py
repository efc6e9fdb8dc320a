"""What a driver process does when the driver has raised what it should not have, or gets no more memory."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable

from .engine import Engine
from .exchange import HookError
from .parts import Log
from .stops import Reason, Stop, Stops

TRIES = 4
"""A stop in which an allocation has failed is asked for again, all of it: what it freed on its way may do."""
RESERVE = 4 << 20
_reserve = bytearray(RESERVE)
"""Address space that nobody has touched, for the stops of a process that gets no more [bytes]."""


def free_reserve() -> None:
    """Give up the address space that was kept for failing."""
    _reserve.clear()


def fail(error: Exception, stops: Stops, engine: Engine, run_line: Callable[[], None], log: Log) -> None:
    """Stop first, report second.

    Args:
        error: what has been raised.
        stops, engine: of the device.
        run_line: lets the line send what is left to send.
        log: writes to the daemon's log.

    Raises:
        MemoryError: it may not have stopped everything; to be called again, TRIES times in all.
    """

    def stop() -> None:
        stops.safe_stop(Reason(Stop.FAILURE, f"the driver failed: {error!r}", errno.EIO))

    seconds: list[Exception] = []
    for attempt in (stop, engine.close, run_line):
        try:
            attempt()
        except Exception as second:  # nothing may keep the others from being stopped, nor this from being told
            seconds.append(second)
    if any(isinstance(each, MemoryError) or isinstance(each.__cause__, MemoryError) for each in seconds):
        raise MemoryError
    what = ""
    if isinstance(error, HookError) and isinstance(error.__cause__, Exception):
        what, error = f" in {error}", error.__cause__
    trace = "".join(traceback.format_exception(error)[-3:])
    trace += "".join(f" (and while stopping: {second!r})" for second in seconds)
    log("error", f"driver failed{what}: {error!r}: {trace}")
