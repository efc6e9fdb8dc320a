"""Motion: command buffers, profiles, limits and control laws of axes. Pure: no I/O and no clock.

A Bank is the axes of one device: AxisBank closes the loop on the host, DriveBank feeds drives that close their own.
Positions are in the unit of the axis (m or rad), forces in N or N*m, instants in integer ns of CLOCK_MONOTONIC.
"""

from .actions import ActionKind, DriveAction
from .bank import Bank
from .commands import Command
from .drives import DriveBank
from .host_loop import AxisBank
from .queue import Judged, Judgement
from .settings import (
    SWITCH_HOME,
    SWITCH_MINUS,
    SWITCH_PLUS,
    Arrival,
    AxisKind,
    AxisSettings,
    Backlash,
    Homing,
    Restore,
    Watch,
)
from .types import CommandError, Event, EventKind, Keeper, MarkerPort

__all__ = [
    "SWITCH_HOME",
    "SWITCH_MINUS",
    "SWITCH_PLUS",
    "ActionKind",
    "Arrival",
    "AxisBank",
    "AxisKind",
    "AxisSettings",
    "Backlash",
    "Bank",
    "Command",
    "CommandError",
    "DriveAction",
    "DriveBank",
    "Event",
    "EventKind",
    "Homing",
    "Judged",
    "Judgement",
    "Keeper",
    "MarkerPort",
    "Restore",
    "Watch",
]
