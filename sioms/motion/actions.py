"""What a DriveBank wants its driver to send."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from .commands import Command


class ActionKind(Enum):
    """What a drive shall do."""

    START = "start"
    STOP = "stop"
    """Stop at maximum deceleration and hold."""
    QUICK_STOP = "quick stop"
    """The fastest stop that the drive has (emergency stop, fault)."""
    HOME = "home"
    RESET = "reset"
    """Clear the drive's own fault."""


@dataclass(frozen=True, slots=True)
class DriveAction:
    """One thing that the driver shall send to one drive.

    Args:
        kind: what to do.
        axis: bank axis.
        command: for START the command; its position is absolute and in the drive's raw coordinates.
        velocity_max: velocity limit in force [unit/s].
        acceleration_max: acceleration limit in force [unit/s^2].
    """

    kind: ActionKind
    axis: int
    command: Command | None
    velocity_max: float
    acceleration_max: float

    @property
    def is_stop(self) -> bool:
        """Tell whether it stops the axis and must overtake everything else."""
        return self.kind in (ActionKind.STOP, ActionKind.QUICK_STOP)
