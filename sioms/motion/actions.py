"""What a DriveBank wants its driver to send, and how its commands end."""

from __future__ import annotations

from enum import Enum

from msgspec import Struct

from . import modes
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


class DriveAction(Struct, frozen=True):
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


def ends_by_itself(command: Command) -> bool:
    """Tell whether a drive's own 'done' ends a command."""
    mode = command.control_mode
    return bool(mode & modes.POSITION) and not (mode & modes.TIME)


def is_force(command: Command | None) -> bool:
    """Tell whether a command is one of force."""
    return command is not None and bool(command.control_mode & modes.ANY_FORCE)


def is_open_ended(command: Command) -> bool:
    """Tell whether a command lasts until the next one arrives."""
    mode = command.control_mode
    if mode & modes.TIME:
        return command.time < 0
    return not mode & modes.POSITION
