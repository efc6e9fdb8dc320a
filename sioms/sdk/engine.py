"""What the runtime needs of an engine: what a tick does for one of the three kinds of driver."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from .blocks import AnyBlock
from .exchange import Steps
from .handles import Handle
from .outputs import Change

if TYPE_CHECKING:
    pass


class Engine(Protocol):
    """What the runtime needs of an engine."""

    tick_hz: float

    @property
    def publishes(self) -> bool:
        """Whether every tick publishes all blocks."""

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return the instant before which everything shows in a publication that is made now [ns]."""

    def tick(self, now_ns: int) -> None:
        """Do the work of one tick and publish."""

    def write_outputs(
        self, handle: Handle, number: int, block: AnyBlock, changes: Mapping[int, Change]
    ) -> Any:
        """Set outputs for a client."""

    def make_safe(self, block: AnyBlock) -> None:
        """Send the safe values that are wanted of a block (Runtime.outputs) now; later looks send what was lost."""

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Run the steps that answer a client's request."""

    def commands_written(self, block: AnyBlock) -> None:
        """A bank's buffers have changed between two ticks."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Stop the motion of blocks as fast as the device can (the banks have been told already)."""

    def recover(self, reason: str) -> None:
        """Give up what is under way, so that stops can go out: a hook has raised what it should not have."""

    def is_quiet(self) -> bool:
        """Whether everything that was asked of the device has been done."""

    def close(self) -> None:
        """Leave the device safe."""
