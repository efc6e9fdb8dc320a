"""What the engines of lines and streams share: a connection that is opened again after every loss."""

from __future__ import annotations

import errno
from functools import partial
from typing import Any

from sioms.protocol.flags import PageState

from .blocks import AnyBlock
from .connection import Connection, open_connection
from .driver import LineDriver, StreamDriver
from .exchange import DeviceError, Steps
from .handles import LATER, Handle
from .line import Counters, Line, Priority
from .locks import NameLocks
from .parts import Parts
from .side_connection import SideConnection

HOUSEKEEPING_HZ = 200.0
FIRST_PAUSE_NS = 250_000_000
LONGEST_PAUSE_NS = 4_000_000_000


class Connected:
    """What line and stream drivers share: a connection that is opened again after every loss."""

    tick_hz = HOUSEKEEPING_HZ

    def __init__(self, parts: Parts, driver: LineDriver | StreamDriver, gap_s: float, recovery_s: float) -> None:
        self.counters = Counters()
        self.line: Line | None = None
        self._loop, self._pages, self._stops = parts.loop, parts.pages, parts.stops
        self._outputs, self._effects, self._log = parts.outputs, parts.effects, parts.log
        self._base = driver
        self._gap_s = gap_s
        self._recovery_s = recovery_s
        self._connecting: Connection | None = None
        self._locks = NameLocks(driver.claims(driver.settings), partial(parts.log, "warning"))
        self._retry_ns = 0
        self._pause_ns = FIRST_PAUSE_NS

    def connect(self, now_ns: int) -> bool:
        """Get the line up, a little at every tick; return whether it is."""
        if self.line is not None:
            return True
        try:
            if self._connecting is None:
                if now_ns < self._retry_ns:
                    return False
                self._locks.take()
                self._connecting = open_connection(self._base.line, self._count_stranger)
                self._limit_ns = now_ns + int(self._base.line.connect_timeout_s * 1e9)
            if not self._connecting.is_connected():
                if now_ns > self._limit_ns:
                    raise OSError(
                        errno.ETIMEDOUT,
                        f"connect to {self._base.line}: no answer within {self._base.line.connect_timeout_s:g} s; "
                        "check host, port and network",
                    )
                return False
        except OSError as error:
            if self._connecting is not None:
                self._connecting.close()
                self._connecting = None
            self._pages.set_link(self._base.blocks, PageState.LINK_LOST, error.strerror or str(error))
            self._retry_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            return False
        connection, self._connecting = self._connecting, None
        side_line = self._base.side_line
        self.line = Line(
            connection, self._gap_s, self._recovery_s, self.counters, self.unsolicited(),
            None if side_line is None else SideConnection(side_line), partial(self._log, "warning"),
        )  # fmt: skip
        self._loop.watch(connection.fd, self._readable)
        self.connected(now_ns)
        return True

    def _count_stranger(self) -> None:
        self.counters.strangers += 1

    def unsolicited(self) -> Any:
        """Return what takes bytes that no exchange waits for."""
        return None

    def connected(self, now_ns: int) -> None:
        """Begin: the line is up."""
        raise NotImplementedError

    def acted(self, block: AnyBlock) -> None:
        """What a client asked for has been done on the line."""

    def line_lost(self, reason: str, now_ns: int) -> None:
        """Close the line and try again later."""
        line, self.line = self.line, None
        if line is None:
            return
        self.counters.reconnects += 1
        self._loop.unwatch(line.connection.fd)
        line.close()
        self._retry_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        self._stops.lose(self._base.blocks, reason)
        line.abandon(reason)

    def guarded(self, action: Any, now_ns: int) -> None:
        """Do something on the line; when it is gone, say so and start again."""
        try:
            action()
        except OSError as error:
            self.line_lost(error.strerror or str(error), now_ns)
        self._arm()

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Run the steps that a client's request takes; its answer comes when they end."""
        line, now_ns = self.line, self._loop.now_ns()
        if line is None:
            raise OSError(errno.EIO, f"{what}: {self._base.line} is not connected")

        def done(value: Any, error: Exception | None) -> None:
            if error is None:
                self._effects.note()
                self.acted(handle.block)
                handle.answer(number, value)
            else:
                errno_ = error.errno if isinstance(error, DeviceError) else errno.EIO
                handle.refuse(number, errno_, f"{what}: {error}")

        self.guarded(lambda: line.submit(steps, Priority.ACT, done, now_ns), now_ns)
        return LATER

    def _readable(self) -> None:
        now_ns = self._loop.now_ns()
        if self.line is not None:
            line = self.line
            self.guarded(lambda: line.receive(now_ns), now_ns)

    def line_due(self) -> None:
        """The line has something to do by now."""
        now_ns = self._loop.now_ns()
        if self.line is not None:
            line = self.line
            self.guarded(lambda: line.advance_time(now_ns), now_ns)

    def _arm(self) -> None:
        self._loop.set_line_timer(self.line.deadline_ns if self.line is not None else None)

    def recover(self, reason: str) -> None:
        """Give up the jobs of the line."""
        if self.line is not None:
            self.line.abandon(reason)
