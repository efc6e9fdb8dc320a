"""The emergency stop of the workcell, whether or not the daemon answers.

Drivers brake before the client library is imported: ``sdev -e`` is started for that.
"""

from __future__ import annotations

import errno
import os
from time import monotonic, monotonic_ns, sleep

from sioms.protocol.socketpath import cell_address
from sioms.protocol.stopfile import StopRequest, open_stop_request

TYPE_CHECKING = False
if TYPE_CHECKING:
    from sioms.protocol.stopfile import Mark

TAKEN_S = 1.0
"""How long drivers may take to obey [s]; the slowest ticks are far shorter."""


def emergency_stop(why: str = "", path: str | None = None, name: str | None = None) -> str:
    """Stop the whole workcell and latch the stop until it is reset; needs no session and no daemon that answers.

    Args:
        why: for the log and for who asks why nothing moves.
        path: as of ``Workcell``; a gateway stops the cell without a daemon that answers, too.
        name: what this client calls itself.

    Returns:
        '' when the daemon has acknowledged it; else why it has not, the drivers having latched the stop without it.

    Raises:
        OSError: neither daemon nor drivers have taken the stop.
    """
    path = path or cell_address()
    request = None if "://" in path else open_stop_request(path)
    try:
        mark = None if request is None else request.request(monotonic_ns(), os.getpid(), why)  # heard within a tick
        from .workcell import Workcell

        if request is None or mark is None:
            with Workcell(path, name) as cell:
                cell.emergency_stop(why=why)
            return ""
        try:
            with Workcell(path, name, enough=lambda: request.taken(mark)) as cell:
                cell.emergency_stop(why=why)  # the daemon knows who it was
        except OSError as error:
            if error.errno == errno.EPERM or not taken(request, mark):
                raise
            return error.strerror or str(error)
        return ""
    finally:
        if request is not None:
            request.close()


def taken(request: StopRequest, mark: Mark) -> bool:
    """Wait until a request has been obeyed; False when nobody has within TAKEN_S."""
    deadline = monotonic() + TAKEN_S
    while not request.taken(mark):
        if monotonic() > deadline:
            return False
        sleep(0.002)
    return True
