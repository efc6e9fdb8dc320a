"""Controllers with Grbl 1.1, grblHAL or FluidNC on a serial line or TCP, three to nine axes.

All motion is jogging, which can be cancelled without losing the position. A velocity is a chain of short jogs to
absolute positions, so it ends by itself soon after the host falls silent; Grbl has no other dead-man. The controller
has one
planner: axes whose commands go out together (synch) move together on a straight line, other commands follow one
another, and what one axis has cancelled brakes all; the others then go on.

    [device.mod0]
    driver = "grbl"
    line = { serial = "/dev/ttyUSB0" }
    [[device.mod0.axis]]
    name = "xaxis"
    letter = "X"
    velocity_max = 0.05
    acceleration_max = 0.1
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import Description
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.golden import Golden

from . import codec as grbl
from .codec import Report
from .unit import GrblUnit

MODES = (POSITION_MODES | ControlMode.VELOCITY | BANK_MODES) & ~ControlMode.SPECIFIED_MAX_VEL_ACC
"""The acceleration is a setting of the controller: a command cannot carry its own."""
ABOUT = "Grbl axis; one planner for all: what stops this axis brakes the others for a moment, and they go on"

AxisTable: Any = drive_table(
    {"letter": (Literal["X", "Y", "Z", "A", "B", "C", "U", "V", "W"], "X"), "home_required": (bool, False)}
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

letter: of the axis in the controller; home_required: no motion before homing. A unit of "rad" takes the controller's
    number for degrees.
"""


class GrblSettings(DriveSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of DriveSettings.

    Attributes:
        axis: its axes in use.
        version: text that its version must contain, e.g. "1.1h"; '' takes any.
        homing: the controller's homing ($H, all axes) may be used.
        homing_timeout_s: longest time that homing may take [s].
        quick_stop: "cancel" brakes and keeps the position, and resets what does not obey; "reset" stops at once and
            loses it.
        poll_hz: rate of status reports; 5 to 10 is the firmware's advice, 20 to 50 works on an idle line.
    """

    axis: list[AxisTable]
    version: str = ""
    homing: bool = False
    homing_timeout_s: float = 120.0
    quick_stop: Literal["cancel", "reset"] = "cancel"
    poll_hz: float = 20.0


class Grbl(LineDriver):
    """One controller on its line.

    Concurrency: the one thread of the driver process.
    """

    Settings = GrblSettings

    @classmethod
    def describe(cls, name: str, settings: GrblSettings) -> Description:
        """Tell the axes; raises ValueError for what the controller could not carry out."""
        drive_axes.check_axes(settings.axis, "axis", "letter", None, settings.poll_hz, 50)
        if settings.line.udp:
            raise ValueError("line = udp: Grbl speaks on serial and tcp")
        spec = drive_axes.axis_spec("", _axes(settings), ABOUT, settings.capacity, settings.history)
        return drive_axes.polled((spec,), settings.poll_hz)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the interface description; they carry no checksum."""
        text = b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
        report = Report("Idle", -1, (0.0, 0.0, 0.0), None, (0.0, 0.0, 0.0))
        return (
            Golden("status report", grbl.status(0.1), b"?".hex(), text.hex(), (report, ())),
            Golden("unlock", grbl.command("$X", 0.5), b"$X\n".hex()),
            Golden("stored settings", grbl.command("$$", 0.5), b"$$\n".hex()),
        )

    def __init__(self, name: str, settings: GrblSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        spec = self.describe(name, settings).blocks[0]
        axes, on_tcp = _axes(settings), bool(settings.line.tcp)
        unit = GrblUnit(name, settings, axes, spec, kit, greets_each=on_tcp, settle_s=0.1)
        self._units = (unit,)
        self.overheard = unit.overhear

    @property
    def units(self) -> Sequence[LineUnit]:
        """The controller."""
        return self._units


def _axes(settings: GrblSettings) -> list[Any]:
    return [
        drive_axes.axis_settings(axis, MODES, homing=settings.homing, required=axis.home_required)
        for axis in settings.axis
    ]
