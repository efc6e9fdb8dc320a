"""The engine of a TickDriver: the host closes the loop."""

from __future__ import annotations

import errno
import time
from collections.abc import Mapping, Sequence
from typing import Any

from sioms.protocol.flags import PageState

from .blocks import AnyBlock, BinaryBlock
from .connected import FIRST_PAUSE_NS, LONGEST_PAUSE_NS
from .driver import Refusal, TickDriver
from .exchange import HookError, LinkError, Steps
from .handles import Handle
from .outputs import Change
from .parts import Parts

SELDOM_HZ = 250.0
"""Ticks that come less often find the processor asleep and the caches cold."""
LEAD_NS, WORK_NS = 100_000, 400_000
"""How long before such a tick to wake up, and what is added where there is work to do."""


class TickEngine:
    """Runs a TickDriver.

    Attributes:
        tick_hz: ticks a second.
        lead_ns: how long before a tick to work, and then sleep [ns]; 0 for ticks that come often.
    """

    def __init__(self, parts: Parts, driver: TickDriver, tick_hz: float) -> None:
        self.tick_hz = tick_hz
        has_work = type(driver).slack is not TickDriver.slack
        self.lead_ns = 0 if tick_hz > SELDOM_HZ else LEAD_NS + WORK_NS * has_work
        self._loop, self._pages, self._stops = parts.loop, parts.pages, parts.stops
        self._outputs = parts.outputs
        self._driver = driver
        self._is_open = False
        self._is_ticking, self._shown_ns = False, 0
        self._writable = [block for block in driver.blocks if block.spec.writable]
        self._retry_ns = 0
        self._pause_ns = FIRST_PAUSE_NS

    def tick(self, now_ns: int) -> None:
        """Tick the driver and publish all blocks."""
        if not self._is_open and not self._open(now_ns):
            return
        mark = self._outputs.mark()
        self._is_ticking = True
        try:
            self._driver.tick(now_ns)
        except LinkError as error:  # the device is gone; open will find it again
            self._is_open, self._retry_ns = False, now_ns + self._pause_ns
            self._stops.lose(self._driver.blocks, str(error))
            return
        finally:
            self._is_ticking = False
        self._shown_ns = self._loop.looked_ns
        self._pause_ns = FIRST_PAUSE_NS
        for block in self._writable:
            self._stops.look_at_outputs(block, mark)

    def _open(self, now_ns: int) -> bool:
        if now_ns < self._retry_ns:
            return False
        try:
            self._driver.open()
        except (LinkError, OSError) as error:
            self._pages.set_link(self._driver.blocks, PageState.LINK_LOST, str(error))
            self._retry_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            return False
        self._is_open = True
        self._pages.set_link(self._driver.blocks, PageState.GOOD, "")
        for block in self._writable:
            self._stops.make_unowned_safe(block)
        return True

    @property
    def publishes(self) -> bool:
        """Whether there are readings to publish."""
        return self._is_open

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return when this tick began: nothing is served in the middle of one.

        What a driver publishes itself during its tick, for the sake of an edge, may be of before the last write.
        """
        return self._shown_ns if self._is_ticking else self._loop.looked_ns

    def write_outputs(self, handle: Handle, number: int, block: AnyBlock, changes: Mapping[int, Change]) -> Any:
        """Hand the values to the driver; they take effect in the next tick."""
        self._write(block, changes)
        return self._loop.tick

    def drop_writes(self, block: AnyBlock, masks: Mapping[int, int]) -> None:
        """Nothing is on its way: the driver has been handed every write."""

    def make_safe(self, block: AnyBlock) -> None:
        """Hand the safe values that are wanted to the driver; what it refuses is tried again after the next tick."""
        changes = self._outputs.unsent(block)
        if not changes or not self._is_open:
            return
        try:
            self._write(block, changes)
        except OSError as error:
            self._stops.tell_unsafe(block, error.strerror or str(error))

    def _write(self, block: AnyBlock, changes: Mapping[int, Change]) -> None:
        channels, values = self._outputs.merged(block, changes)
        edges = block.edges.copy() if isinstance(block, BinaryBlock) else None
        try:
            self._driver.write_outputs(block.spec, channels, values)
        except Refusal as error:
            raise OSError(error.errno, str(error)) from None
        except LinkError as error:
            raise OSError(errno.EIO, str(error)) from None
        except Exception as error:
            raise HookError(f"{type(self._driver).__name__}.write_outputs") from error
        self._outputs.acknowledge(block, channels, values)
        if edges is not None and (edges != block.edges).any():  # type: ignore[union-attr]
            self._loop.publish(block, time.monotonic_ns())  # an edge of its own, though the tick sees only the last

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Refuse: a driver without a line has none to send steps on."""
        raise TypeError(f"{what}: {type(self._driver).__name__} has no line for steps")

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Let the driver use the time that is left."""
        self._driver.slack(now_ns, until_ns)

    def commands_written(self, block: AnyBlock) -> None:
        """Nothing: the next tick sees it."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Have a tick soon: in it the banks command the device."""
        self._loop.tick_early()

    def recover(self, reason: str) -> None:
        """Nothing is under way between two ticks."""

    def line_due(self) -> None:
        """Nothing: there is no line."""

    def is_at_rest(self) -> bool:
        """Whether the next ticks may be left out, as far as the driver knows."""
        return self._is_open and self._driver.is_at_rest()

    def is_quiet(self) -> bool:
        """A tick is all there is."""
        return True

    def close(self) -> None:
        """Leave the device safe."""
        if self._is_open:
            self._driver.close()
