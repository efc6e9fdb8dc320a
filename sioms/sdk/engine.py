"""Engines, what a tick does for one of the three kinds of driver; and the loop that they run in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from .blocks import AnyBlock
from .exchange import Steps
from .handles import Handle
from .outputs import Change


class Loop(Protocol):
    """The loop of a driver process as its parts know it: time, and descriptors."""

    @property
    def tick(self) -> int:
        """Number of the present tick."""

    @property
    def period_ns(self) -> int:
        """Time between two ticks [ns]."""

    @property
    def looked_ns(self) -> int:
        """When it was last looked for stops and orders [ns]."""

    @property
    def running(self) -> bool:
        """Whether the process is to go on."""

    def now_ns(self) -> int:
        """Return the time [ns, CLOCK_MONOTONIC]."""

    def as_of_ns(self) -> int:
        """Return an instant before which all that was asked for has been heeded."""

    def deadline(self, timeout_s: float | None) -> int | None:
        """Return when a time-out that begins now ends [ns]."""

    def has_time(self) -> bool:
        """Whether what can be done in pieces may do another before the next tick."""

    def heed(self) -> None:
        """Heed the daemon's orders, and stops."""

    def watch(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back when a descriptor is readable or hung up."""

    def unwatch(self, fd: int) -> None:
        """Stop watching; call before closing."""

    def set_line_timer(self, when_ns: int | None) -> None:
        """Have the engine's ``line_due`` called at a time, None = not."""

    def tick_early(self) -> None:
        """Have a tick as soon as there can be one."""

    def publish(self, block: AnyBlock, stamp_ns: int) -> None:
        """Publish a block and wake who subscribed to it."""

    def after_publication(self, now_ns: int, shown: Sequence[AnyBlock]) -> None:
        """Look at what a publication of some blocks may have brought about."""


class Engine(Protocol):
    """What the loop and the other parts need of an engine."""

    tick_hz: float

    @property
    def publishes(self) -> bool:
        """Whether every tick publishes all blocks."""

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return the instant before which everything shows in a publication that is made now [ns]."""

    def tick(self, now_ns: int) -> None:
        """Do the work of one tick and publish."""

    def write_outputs(self, handle: Handle, number: int, block: AnyBlock, changes: Mapping[int, Change]) -> Any:
        """Set outputs for a client."""

    def drop_writes(self, block: AnyBlock, masks: Mapping[int, int]) -> None:
        """Let no write go on that is on its way to these outputs: of each channel these bits, -1: all."""

    def make_safe(self, block: AnyBlock) -> None:
        """Send the safe values that are wanted of a block (Outputs) now; later looks send what was lost."""

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Run the steps that answer a client's request."""

    def commands_written(self, block: AnyBlock) -> None:
        """A bank's buffers have changed between two ticks."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Stop the motion of blocks as fast as the device can (the banks have been told already)."""

    def recover(self, reason: str) -> None:
        """Give up what is under way, so that stops can go out: a hook has raised what it should not have."""

    def line_due(self) -> None:
        """The time has come that was set by Loop.set_line_timer()."""

    def is_quiet(self) -> bool:
        """Whether everything that was asked of the device has been done."""

    def close(self) -> None:
        """Leave the device safe."""
