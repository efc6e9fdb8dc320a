"""What a driver process does when the driver has raised what it should not have."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable

from .engine import Engine
from .exchange import HookError
from .parts import Log
from .stops import Reason, Stop, Stops


def fail(error: Exception, stops: Stops, engine: Engine, run_line: Callable[[], None], log: Log) -> None:
    """Stop first, report second.

    Args:
        error: what has been raised.
        stops, engine: of the device.
        run_line: lets the line send what is left to send.
        log: writes to the daemon's log.
    """
    what = ""
    if isinstance(error, HookError) and isinstance(error.__cause__, Exception):
        what, error = f" in {error}", error.__cause__
    trace = "".join(traceback.format_exception(error)[-3:])
    attempts: list[Callable[[], None]] = [
        lambda: stops.safe_stop(Reason(Stop.FAILURE, f"the driver failed: {error!r}", errno.EIO)),
        engine.close,
        run_line,
    ]
    for attempt in attempts:
        try:
            attempt()
        except Exception as second:  # nothing may keep the others from being stopped, nor this from being told
            trace += f" (and while stopping: {second!r})"
    log("error", f"driver failed{what}: {error!r}: {trace}")
