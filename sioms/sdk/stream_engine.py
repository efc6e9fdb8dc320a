"""The engine of a StreamDriver: a device that pushes."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from typing import Any

from sioms.protocol.flags import PageState

from .blocks import AnyBlock
from .connected import FIRST_PAUSE_NS, LONGEST_PAUSE_NS, Connected
from .driver import StreamDriver
from .exchange import DeviceError, LinkError
from .handles import Handle
from .line import Priority
from .outputs import Change
from .parts import Parts


class StreamEngine(Connected):
    """Runs a StreamDriver: opens the stream, feeds the driver, watches that good frames come."""

    publishes = False

    def __init__(self, parts: Parts, driver: StreamDriver) -> None:
        super().__init__(parts, driver, driver.gap_s, driver.recovery_s)
        self._driver = driver
        self._is_up = False
        self._busy = False
        self._closed = False
        self._due_ns = 0
        self._good_ns = 0
        self._heard = False
        self._heartbeat_ns = 0

    def unsolicited(self) -> Any:
        """Samples are what nobody asked for, one by one."""
        return self._feed

    def connected(self, now_ns: int) -> None:
        """Open the stream."""
        self._is_up = self._busy = False
        self._due_ns = now_ns

    def tick(self, now_ns: int) -> None:
        """Open, keep alive, and watch the stream."""
        if self._closed or not self.connect(now_ns) or self.line is None or self._busy:
            return
        line = self.line
        if not self._is_up:
            if now_ns >= self._due_ns:
                self._busy = True
                self.guarded(lambda: line.submit(self._driver.open(), Priority.POLL, self._opened, now_ns), now_ns)
        elif now_ns - self._good_ns > self._driver.silence_s * 1e9:
            trouble = self._driver.trouble
            self._stalled(
                f"no good frame for {(now_ns - self._good_ns) / 1e9:.3f} s{trouble and ': ' + trouble}",
                now_ns,
            )
        elif self._driver.heartbeat_s and now_ns >= self._heartbeat_ns and line.is_free:
            self._heartbeat_ns = now_ns + int(self._driver.heartbeat_s * 1e9)
            self.guarded(
                lambda: line.submit(self._driver.heartbeat(), Priority.POLL, lambda v, e: None, now_ns),
                now_ns,
            )

    def _stalled(self, reason: str, now_ns: int) -> None:
        """Begin anew: at once when the stream ran, else after a pause that grows."""
        self._is_up = False
        if not self._heard:
            reason += f" after the start of the stream{self._driver.advice and '; ' + self._driver.advice}"
            self._due_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        else:
            self._due_ns = now_ns
        if self.line is not None and self.line.connection.settings.path is not None:
            self.line_lost(reason, now_ns)  # a device that has gone keeps its open file silent for ever
        else:
            self._stops.lose(self._driver.blocks, reason)

    def _opened(self, _: Any, error: Exception | None) -> None:
        self._busy = False
        now_ns = self._loop.now_ns()
        if error is None:
            self._is_up, self._good_ns, self._heard = True, now_ns, False
            self._heartbeat_ns = now_ns + int(self._driver.heartbeat_s * 1e9)
            return
        kind = PageState.FAULT if isinstance(error, DeviceError) else PageState.LINK_LOST
        self._pages.set_link(self._driver.blocks, kind, str(error))
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)

    def _feed(self, data: bytes, now_ns: int) -> None:
        if not self._is_up:
            return
        try:
            good = self._driver.feed(data, now_ns)
        except LinkError as error:  # what comes is another stream than the one that was opened
            self._stalled(str(error), now_ns)
            return
        if good:
            if self._good_ns == 0 or not self._pages.is_good(self._driver.blocks):
                self._pages.set_link(self._driver.blocks, PageState.GOOD, "")
                self._pause_ns = FIRST_PAUSE_NS
            self._good_ns, self._heard = now_ns, True
            self._loop.after_publication(now_ns, self._driver.blocks)

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return when the sample was taken: what the device was told after that, it cannot show."""
        return min(stamp_ns, self._loop.now_ns())

    def write_outputs(self, handle: Handle, number: int, block: AnyBlock, changes: Mapping[int, Change]) -> Any:
        """Refuse: a stream has no outputs."""
        raise OSError(errno.EBADF, f"write {block.spec.name}: this device only sends")

    def drop_writes(self, block: AnyBlock, masks: Mapping[int, int]) -> None:
        """Nothing is on its way: a stream has no outputs."""

    def make_safe(self, block: AnyBlock) -> None:
        """Nothing: a stream has no outputs."""

    def commands_written(self, block: AnyBlock) -> None:
        """Nothing: a stream has no axes."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Nothing moves."""

    def is_quiet(self) -> bool:
        """Whether the line has nothing left to do."""
        return self.line is None or self.line.is_free

    def close(self) -> None:
        """Stop the stream; no later tick may start it again."""
        self._closed = True
        line, now_ns = self.line, self._loop.now_ns()
        if line is not None and self._is_up:
            self._is_up = False
            self.guarded(lambda: line.submit(self._driver.close(), Priority.ACT, lambda v, e: None, now_ns), now_ns)
