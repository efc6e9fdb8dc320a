"""The engine of a TickDriver: the host closes the loop."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sioms.protocol.flags import PageState

from .blocks import AnyBlock
from .connected import FIRST_PAUSE_NS, LONGEST_PAUSE_NS
from .driver import Refusal, TickDriver
from .exchange import LinkError, Steps
from .handles import Handle

if TYPE_CHECKING:
    from .runtime import Runtime

SELDOM_HZ = 250.0
"""Ticks that come less often find the processor asleep and the caches cold."""
WAKE_NS = 100_000
WARM_NS = 400_000


class TickEngine:
    """Runs a TickDriver.

    Attributes:
        tick_hz: ticks a second.
        lead_ns: how long before a tick to wake and warm up [ns]; 0 for ticks that come often.
    """

    def __init__(self, runtime: Runtime, driver: TickDriver, tick_hz: float) -> None:
        self.tick_hz = tick_hz
        has_work = type(driver).slack is not TickDriver.slack
        self.lead_ns = 0 if tick_hz > SELDOM_HZ else WAKE_NS + WARM_NS * has_work
        self._runtime = runtime
        self._driver = driver
        self._is_open = False
        self._retry_ns = 0
        self._pause_ns = FIRST_PAUSE_NS

    def tick(self, now_ns: int) -> None:
        """Tick the driver and publish all blocks."""
        if not self._is_open and not self._open(now_ns):
            return
        try:
            self._driver.tick(now_ns)
        except LinkError as error:  # the device is gone; open will find it again
            self._is_open, self._retry_ns = False, now_ns + self._pause_ns
            self._runtime.lose(self._driver.blocks, str(error))

    def _open(self, now_ns: int) -> bool:
        if now_ns < self._retry_ns:
            return False
        try:
            self._driver.open()
        except (LinkError, OSError) as error:
            self._runtime.set_link(self._driver.blocks, PageState.LINK_LOST, str(error))
            self._retry_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            return False
        self._is_open, self._pause_ns = True, FIRST_PAUSE_NS
        self._runtime.set_link(self._driver.blocks, PageState.GOOD, "")
        return True

    @property
    def publishes(self) -> bool:
        """Whether there are readings to publish."""
        return self._is_open

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return when this tick began: nothing is served in the middle of one."""
        return self._runtime.looked_ns

    def write_outputs(
        self,
        handle: Handle | None,
        number: int,
        block: AnyBlock,
        channels: Sequence[int],
        values: Sequence[float],
    ) -> Any:
        """Hand the values to the driver; they take effect in the next tick."""
        try:
            self._driver.write_outputs(block.spec, channels, values)
        except Refusal as error:
            raise OSError(error.errno, str(error)) from None
        for channel, value in zip(channels, values, strict=True):
            self._runtime.outputs[(id(block), channel)] = value
        return self._runtime.tick

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Refuse: a driver without a line has none to send steps on."""
        raise TypeError(f"{what}: {type(self._driver).__name__} has no line for steps")

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Let the driver use the time that is left."""
        self._driver.slack(now_ns, until_ns)

    def warm_up(self, until_ns: int) -> int:
        """Do the work of the slack just before the tick, begin the tick on time; return how long the work took [ns]."""
        began_ns = time.monotonic_ns()
        self._driver.slack(began_ns, until_ns)
        ended_ns = time.monotonic_ns()
        while time.monotonic_ns() < until_ns:  # for at most the lead: a sleep so short would end late
            pass
        return ended_ns - began_ns

    def commands_written(self, block: AnyBlock) -> None:
        """Nothing: the next tick sees it."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Nothing: the banks command the device in the next tick."""

    def recover(self, reason: str) -> None:
        """Nothing is under way between two ticks."""

    def is_quiet(self) -> bool:
        """A tick is all there is."""
        return True

    def close(self) -> None:
        """Leave the device safe."""
        if self._is_open:
            self._driver.close()
