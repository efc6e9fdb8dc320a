"""Open files of nodes: reading, writing and waiting, and who keeps an output alive.

A file that can be written is a node that is held, with a lease. Nobody renews it but ``Keeper``, and only while a
process is known that uses the file, is there and is not stopped: so a writer that is killed or stopped halts its axes
as any other client does, and so does a mount that hangs or is killed.

Concurrency: calls of one file may come from any thread, at the same time.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import copy_context
from typing import Any

from sioms.client.workcell import Workcell
from sioms.protocol.flags import NodeClass, Request
from sioms.protocol.page import NotReadable

from . import lines
from .callers import Caller, Process, is_being_stopped

LOOK_S = 0.005
"""How often it is looked whether the caller of a call that waits has been interrupted [s]."""
PIECE_S = 0.02
"""The same of calls that only wait and move nothing [s]."""
MOST_WAITING = 48
"""Calls that wait at the same time; the threads beyond them serve stops and all else."""
READ, WRITE, ERROR = 0x001, 0x004, 0x008
"""Events of poll(2)."""
_WAITS = (Request.WAIT_MARKER, Request.WAIT_UNTIL_EVENT, Request.WAIT_UNTIL_IDLE)


class Patience:
    """Carries out what waits, and ends it when its caller is interrupted.

    Args:
        interrupted: tells of the call that this thread serves whether its caller has been.
    """

    def __init__(self, interrupted: Callable[[], bool]) -> None:
        self._interrupted = interrupted
        self._pool = ThreadPoolExecutor(MOST_WAITING, "wait")
        self._free = threading.BoundedSemaphore(MOST_WAITING)

    @contextmanager
    def _turn(self) -> Iterator[None]:
        if not self._free.acquire(blocking=False):
            raise OSError(errno.EAGAIN, f"{MOST_WAITING} calls wait in this mount already; end one of them")
        try:
            yield
        finally:
            self._free.release()

    def run(self, what: Callable[[], Any], end: Callable[[], None]) -> Any:
        """Do something that waits, in another thread.

        Args:
            what: is done.
            end: makes it end.

        Raises:
            OSError: EINTR, the caller was interrupted; EAGAIN, too many wait already; what it raises itself.
        """
        with self._turn():
            done = self._pool.submit(copy_context().run, what)
            while not wait([done], LOOK_S).done:
                if self._interrupted():
                    end()
                    wait([done], 1.0)
                    raise OSError(errno.EINTR, "interrupted; the motion has been stopped")
            return done.result()

    def repeat(self, what: Callable[[float], Any], timeout_s: float | None, over: Callable[[], bool]) -> Any:
        """Wait for something again and again, each time for a little while [s], until it comes.

        Args:
            what: waits as long as it is told, and raises TimeoutError then.
            timeout_s: how long in all [s], None = for ever.
            over: whether waiting on has no use.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        with self._turn():
            while not self._interrupted():
                left_s = PIECE_S if end_s is None else end_s - time.monotonic()
                try:
                    return what(max(0.0, min(left_s, PIECE_S)))
                except TimeoutError:
                    if left_s <= 0 or over():
                        raise
        raise OSError(errno.EINTR, "interrupted while waiting")


class NodeFile:
    """A node that somebody has open.

    Args:
        cell: its session; ``owned``: it ends with the file.
        node: the open node.
        binary: whether records are read and written instead of text.
        nonblock: whether calls wait.
        who: opened it.
        patience: for what waits.

    Attributes:
        who: opened it.
        rest: the beginning of a line whose end has not been written yet.
        is_closing: whether a descriptor of it has been closed since it was used last.
    """

    def __init__(
        self, cell: Workcell, node: Any, who: Caller, patience: Patience, *, binary: bool, nonblock: bool, owned: bool
    ) -> None:
        self.node, self._cell, self._owned, self.who = node, cell, owned, who
        self._binary, self._nonblock, self._patience = binary, nonblock, patience
        self._users: dict[int, Process] = {}
        self._seen, self._bytes = 0, b""
        self._why = ""
        self.rest = b""
        self.is_closing = False
        self.use(who.process.pid, who.process)
        if owned:
            node._channel.keepalive_s = 0.0  # a call that waits is no sign of life of its caller

    @property
    def is_output(self) -> bool:
        """Whether it can be written."""
        return self._owned

    # --- who uses it -----------------------------------------------------------------------------

    def knows(self, tid: int) -> bool:
        """Tell whether a thread has used it."""
        return tid in self._users

    def use(self, tid: int, process: Process) -> None:
        """Note who uses it."""
        self._users[tid] = process

    def beat(self) -> None:
        """Renew the lease of an output, if one of its processes is there and none is stopped."""
        users = dict(self._users)  # at once: other threads let more processes in meanwhile
        states = {process: process.state for process in set(users.values())}
        for tid, process in users.items():
            if states[process] == "gone" and self._users.get(tid) == process:
                del self._users[tid]
        if "runs" in states.values() and "stopped" not in states.values() and not self._why:
            with suppress(OSError):  # who uses it next hears of it
                self.node.keepalive()

    def end(self, why: str) -> None:
        """Let go of the node; its axes halt."""
        self._why = self._why or why
        with suppress(OSError):
            self.node.close()

    def close(self) -> None:
        """Close it: what it held halts, and is free."""
        with suppress(OSError):
            self.node.close()
        if self._owned:
            self._cell.close()

    def _check(self) -> None:
        self.is_closing = False
        if self._why:
            raise OSError(errno.ETIMEDOUT, f"{self.node.name}: {self._why}; close the file, and open it again")

    # --- reading ---------------------------------------------------------------------------------

    def read(self, size: int, offset: int) -> bytes:
        """Return a part of a snapshot; a new one is taken when it is read from the beginning."""
        self._check()
        if offset == 0:
            snapshot = self.node.read()
            self._seen = snapshot.number
            info = self.node.info
            self._bytes = lines.packed(snapshot, info) if self._binary else lines.shown(snapshot, info).encode()
        return self._bytes[offset : offset + size]

    # --- writing ---------------------------------------------------------------------------------

    def write(self, data: bytes, tid: int) -> int:
        """Write records or lines, all or none; wait for the end of the motion, unless waiting is not wanted.

        Raises:
            OSError: the refusal; EINTR, a signal came, and the motion has been stopped.
        """
        self._check()
        info = self.node.info
        if self._binary:
            records, replace = lines.whole_records(data, info), False
        else:
            text, self.rest = lines.ended(self.rest, data)
            if len(self.rest) > lines.LONGEST:
                self.rest = b""
                raise lines.bad(info, f"a line of more than {lines.LONGEST} bytes")
            if not text:
                return len(data)
            records, replace = self._records_of(text, info)
        if self._nonblock or info.node_class is not NodeClass.AXIS:
            self.node.write(records, 0.0, replace=replace)
        else:
            self._wait(lambda: self._move(records, replace), tid)
        return len(data)

    def _records_of(self, text: bytes, info: Any) -> tuple[bytes, bool]:
        try:
            return lines.records(text.decode("utf-8", "replace"), info)
        except OSError:
            self.rest = b""  # what comes next is not its end
            raise

    def _move(self, records: bytes, replace: bool) -> None:
        self.node.write(records, None, replace=replace)
        self.node.wait_until_idle()

    def settle(self, tid: int) -> None:
        """Wait until the motion has ended (fsync)."""
        self._check()
        if self._owned and self.node.info.node_class is NodeClass.AXIS:
            self._wait(self.node.wait_until_idle, tid)

    def _wait(self, what: Callable[[], Any], tid: int) -> Any:
        def stop() -> None:
            if is_being_stopped(tid):
                self.end("its process was stopped while it waited for the end of a motion")
            with suppress(OSError):  # the channel has ended, and the motion with it
                self.node.stop()

        return self._patience.run(what, stop)

    # --- requests --------------------------------------------------------------------------------

    def ioctl(self, request: Request, argument: Any, timeout_s: float | None, tid: int) -> Any:
        """Send a request; one that waits ends when its caller is interrupted."""
        self._check()
        if request is Request.GET_IO_STRUCT_INFO:
            return _described(self.node.info)
        if request is Request.WAIT_UNTIL_IDLE and self._owned:
            return self._wait(lambda: self.node.ioctl(request, argument, timeout_s), tid)
        if request not in _WAITS:
            return self.node.ioctl(request, argument, timeout_s)
        if request is Request.WAIT_UNTIL_EVENT and self.node.info.node_class is NodeClass.BINARY:
            last = self.node.read()
            mask = -1 if argument is None else argument
            return self._repeat(lambda wait_s: self.node.wait_event(mask, last, wait_s), timeout_s)
        return self._repeat(lambda wait_s: self.node.ioctl(request, argument, wait_s), timeout_s)

    def _repeat(self, what: Callable[[float], Any], timeout_s: float | None) -> Any:
        return self._patience.repeat(what, timeout_s, lambda: bool(self._why) or self.node._channel.ended)

    # --- poll ------------------------------------------------------------------------------------

    def events(self) -> int:
        """Return which of READ, WRITE and ERROR hold now."""
        if self._why or self.node.closed:
            return ERROR | READ
        try:
            self.node.readings.check(time.monotonic_ns())
            found = READ if self.node.readings.head > self._seen else 0
            if self._owned:
                is_axis = self.node.info.node_class is NodeClass.AXIS
                found |= WRITE if not is_axis or self.node.room() > 0 else 0
        except (OSError, NotReadable, ValueError):
            return ERROR | READ
        return found

    def drain(self) -> None:
        """Forget the publications that have woken somebody."""
        with suppress(OSError, ValueError):
            self.node.readings.drain()

    def wake_fd(self) -> int:
        """Return a descriptor that becomes readable with the next publication."""
        return int(self.node.fileno())


def _described(info: Any) -> dict[str, Any]:
    return {
        "name": info.name, "class": info.node_class.name.lower(), "read_only": info.read_only,
        "channels": [{key: getattr(c, key) for key in ("name", "unit", "minimum", "maximum")} for c in info.channels],
        "read_size": info.read_struct_size, "write_size": info.write_struct_size, "tick_hz": info.tick_hz,
        "buffer_capacity": info.buffer_capacity, "protocol_version": info.protocol_version,
    }  # fmt: skip
