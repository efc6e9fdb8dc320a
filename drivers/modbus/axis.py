"""Positioning drives on Modbus, each family described by a register map: Leadshine, Oriental Motor AZ.

The drive makes its own profiles; the kit's bank decides when a command goes out. Velocity by jog makes use of the
dead-man of drives that have one: the motion ends in the drive when the host falls silent.

    [device.mod0]
    driver = "modbus-axis"
    map = "leadshine"
    line = { serial = "/dev/ttyUSB0", baud = 115200 }
    poll_hz = 50.0
    [[device.mod0.axis]]
    name = "xaxis"
    address = 1
    travel_per_turn = 0.01
    pulses_per_turn = 10000
    position_min = 0.0
    position_max = 0.5
    velocity_max = 0.2
    acceleration_max = 2.0
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from sioms.motion import AxisSettings, Homing
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.drive_axes import check_axes, polled
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings
from sioms.sdk.tables import from_table, table_type

from .drive import DriveUnit
from .registers import Gearing
from .regmap import RegisterMap
from .regmap_files import named_map
from .unit import MappedUnit, Misfit, golden_of, unit_on

MAPS = Path(__file__).parent / "maps"
ALWAYS_MODES = (
    ControlMode.SPECIFIED_TIME
    | ControlMode.WAIT_FOR_EXTERNAL_SYNCH
    | ControlMode.SPECIFIED_MAX_VEL_ACC
    | ControlMode.SPECIFIED_WAIT_MARKER
    | ControlMode.SPECIFIED_SIGNAL_MARKER
)
"""What the bank adds to the modes that a drive has."""
KEY_OF = {
    "speed": "velocity_max",
    "velocity": "velocity_max",
    "acceleration": "acceleration_max",
    "deceleration": "acceleration_max",
}
"""Quantity of a command: key of the axis that limits it."""
DEAD_MAN_SHARE = 0.75
"""Part of a device's dead-man time that a round of polls may take."""

_SERVO_KEYS = (
    "kind",
    "modes",
    "homing",
    "jerk_max",
    "force_max",
    "k",
    "kz",
    "kp",
    "kb",
    "ki",
    "force_offset",
)
AxisTable: Any = table_type(
    AxisSettings,
    without=(*_SERVO_KEYS, "velocity_filter_s", "following_error_max", "start_velocity"),
    extra={
        "address": (int, 1),
        "travel_per_turn": (float, 2 * math.pi),
        "pulses_per_turn": (float, 10000.0),
        "velocity_by": (Literal["jog", "path"] | None, None),
        "homing": (bool, False),
        "home_required": (bool, False),
        "enable": (bool, True),
        "override": (dict[str, Any], {}),
    },
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

address: of the unit; travel_per_turn: m or rad in one turn of the motor, negative to reverse the axis;
pulses_per_turn: of the drive's position; velocity_by: "jog" or "path", jog where the map has it as dead-man;
homing: the drive's own homing may be used; enable: switch the drive on when it is opened; override: keys put over the
    map's.
"""


class ModbusAxisSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        map: name of a shipped register map, or the path of a file.
        line: the line that the drives are on.
        axis: the drives, one axis each.
        poll_hz: rate at which each drive is read.
        capacity: commands that each axis buffers.
        history: snapshots kept for readers.
    """

    map: str
    line: LineSettings
    axis: list[AxisTable]
    poll_hz: float = 50.0
    capacity: int = 4096
    history: int = 64


class ModbusAxis(LineDriver):
    """Drives on one line, a unit each, so that a dead one does not stop the others.

    Concurrency: the one thread of the driver process.
    """

    Settings = ModbusAxisSettings

    @classmethod
    def describe(cls, name: str, settings: ModbusAxisSettings) -> Description:
        """Tell the axes, one block a unit; raises ValueError for what a drive could not carry out."""
        check_axes(settings.axis, "drive", "address", None, settings.poll_hz, 1000)
        drives = [_Drive(settings, axis) for axis in settings.axis]
        _check_dead_man(settings, drives)
        alone = len(drives) == 1
        specs = [
            BlockSpec(
                "" if alone else drive.axis.name, NodeClass.AXIS, (drive.channel(),),
                history=settings.history, capacity=settings.capacity,
            )
            for drive in drives
        ]  # fmt: skip
        return polled(specs, settings.poll_hz)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return the golden frames of the register map."""
        return golden_of(named_map(settings.map, MAPS)) if settings is not None else ()

    def __init__(self, name: str, settings: ModbusAxisSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        specs = self.describe(name, settings).blocks
        drives = [_Drive(settings, axis) for axis in settings.axis]
        self.line = settings.line
        self._units = [
            DriveUnit(
                f"{name} {drive.axis.name}", drive.mapped, drive.settings(), spec, kit,
                jogs=drive.jogs, enable=drive.axis.enable,
            )
            for drive, spec in zip(drives, specs, strict=True)
        ]  # fmt: skip
        rmap = drives[0].mapped.rmap
        silence_s = 0.0
        if settings.line.serial is not None:
            baud = settings.line.baud
            silence_s = 0.00175 if baud > 19200 else 3.5 * settings.line.bits_per_character / baud
        self.gap_s = max(silence_s, rmap.gap_s)
        self.recovery_s = rmap.turnaround_s

    @property
    def units(self) -> Sequence[LineUnit]:
        """The drives."""
        return self._units


class _Drive:
    """One axis as configured: its map, its gearing, and what both allow.

    Raises:
        ValueError: the map is wrong, or limits of the axis fit no register.
    """

    def __init__(self, settings: ModbusAxisSettings, axis: Any) -> None:
        self.axis = axis
        try:
            gearing = Gearing(axis.travel_per_turn, axis.pulses_per_turn)
            rmap = named_map(settings.map, MAPS, axis.override)
            unit = unit_on(settings.line, axis.address, rmap.turnaround_s)
        except ValueError as error:
            lines = str(error).splitlines()  # a map tells all that is wrong with it
            raise ValueError("\n".join(f"axis {axis.name}: {line}" for line in lines)) from None
        if rmap.axis is None:
            raise ValueError(f"map = {settings.map}: describes no axis; want a map of a drive")
        self.mapped = MappedUnit(rmap, unit, gearing, f"{axis.name} (address {axis.address})")
        self.jogs = self._by_jog(rmap)
        self._check_limits(rmap)

    def _by_jog(self, rmap: RegisterMap) -> bool:
        can = {"jog_speed", "jog_plus", "jog_minus"} <= set(rmap.commands)
        if self.axis.velocity_by == "jog" and not can:
            raise ValueError(f"axis {self.axis.name}: velocity_by = jog: the map has no jog; want path")
        return can if self.axis.velocity_by is None else self.axis.velocity_by == "jog"

    def _check_limits(self, rmap: RegisterMap) -> None:
        axis = self.axis
        for end in ("position_min", "position_max"):
            quantities = {
                "position": getattr(axis, end) or 0.0,
                "speed": axis.velocity_max,
                "velocity": axis.velocity_max,
                "acceleration": axis.acceleration_max,
                "deceleration": axis.acceleration_max,
            }
            for name in ("jog_speed", "position", "velocity"):
                if name not in rmap.commands:
                    continue
                try:
                    self.mapped.check(rmap.commands[name], quantities)
                except Misfit as error:
                    raise ValueError(f"axis {axis.name}: {KEY_OF.get(error.source, end)}: {error}") from None

    def settings(self) -> AxisSettings:
        """Return the axis as the bank knows it."""
        axis = self.axis
        homing = None
        if axis.homing:
            # the drive homes by its own parameters; of these only "required" matters here
            homing = Homing(axis.velocity_max, axis.velocity_max, required=axis.home_required)
        return from_table(AxisSettings, axis, {"modes": self.modes(), "homing": homing})

    def modes(self) -> ControlMode:
        """Return the control modes that the drive has."""
        rmap_axis = self.mapped.rmap.axis
        modes = ALWAYS_MODES
        for name in rmap_axis.modes if rmap_axis else ():
            modes |= ControlMode[name]
        return modes | ControlMode.RELATIVE if modes & ControlMode.POSITION else modes

    def channel(self) -> ChannelInfo:
        """Tell the axis."""
        axis = self.axis
        limits = {"velocity": axis.velocity_max, "acceleration": axis.acceleration_max}
        return ChannelInfo(
            axis.name, axis.unit, axis.position_min, axis.position_max, modes=int(self.modes()), limits=limits,
            description=f"{self.mapped.rmap.title}, address {axis.address}",
        )  # fmt: skip

    def poll_s(self, line: LineSettings) -> float:
        """Return the time that a poll takes on the line, and the refresh of a jog [s]."""
        plan = self.mapped.plan(self.mapped.rmap.poll.get("always", ()))
        characters = sum(8 + read.pdu.size + 3 for read in plan) + (16 if self.jogs else 0)
        messages = len(plan) + self.jogs
        per_character = line.bits_per_character / line.baud if line.serial else 0.0
        silence_s = max(0.00175 if line.serial else 0.0, self.mapped.rmap.gap_s)
        return characters * per_character + messages * 2 * silence_s


def _check_dead_man(settings: ModbusAxisSettings, drives: Sequence[_Drive]) -> None:
    """Raise when a round of polls is too slow for the dead-man of a drive."""
    round_s = sum(drive.poll_s(settings.line) for drive in drives)
    for drive in drives:
        dead = drive.mapped.rmap.dead_man
        if dead.by == "none" or (dead.by == "refresh" and not drive.jogs):
            continue
        allowed_s = DEAD_MAN_SHARE * dead.timeout_s
        for what, is_s, cure in (
            (f"poll_hz = {settings.poll_hz:g}", 1 / settings.poll_hz, f"want at least {1 / allowed_s:.3g}"),
            (
                f"{len(drives)} drives on the line",
                round_s,
                "want a faster line, fewer drives or velocity_by = path",
            ),
        ):
            if is_s > allowed_s:
                limit = f"the drive stops after {1e3 * dead.timeout_s:g} ms"
                raise ValueError(f"{what}: a round takes {1e3 * is_s:.3g} ms and {limit}; {cure}")
