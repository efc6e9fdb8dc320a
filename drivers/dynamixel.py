"""Dynamixel X servos on protocol 2.0, several on one line, each an axis.

The operating mode is a choice of the configuration, for it lies in the servo's EEPROM and changes only with the torque off.
The bus watchdog is the dead-man: without a request for that long the servo stops.

    [device.arm0]
    driver = "dynamixel"
    line = { serial = "/dev/ttyUSB0", baud = 1000000 }
    [[device.arm0.axis]]
    name = "shoulder"
    id = 1
    model = 1020
    unit = "rad"
    velocity_max = 3.0
    acceleration_max = 20.0
"""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from sioms.motion import DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.codec import dynamixel
from sioms.sdk.codec.dynamixel import Bus, Status, signed
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Pause, Send, Steps
from sioms.sdk.golden import Golden

MODES = {
    "velocity": (1, BANK_MODES | ControlMode.VELOCITY),
    "position": (3, BANK_MODES | POSITION_MODES),
    "extended_position": (4, BANK_MODES | POSITION_MODES),
    "current": (0, (BANK_MODES | ControlMode.FORCE) & ~ControlMode.SPECIFIED_MAX_VEL_ACC),
}
"""Name of an operating mode: its number in register 11, and the control modes that it gives."""
RETURN_DELAY_S = 0.0005
REBOOT_S = 0.5
HARDWARE_ERRORS = {1: "input voltage", 4: "overheating", 8: "encoder", 16: "electrical shock", 32: "overload"}
"""Bits of register 70 as the e-Manual numbers them for the X series."""
WATCHDOG_TICK_S, WATCHDOG_EXPIRED = 0.02, 0xFF
BRAKE_CHARACTERS, WAKE_S = 35, 0.0005
"""Between the reading of place and speed and the arrival of the goal made of them: reply and request, and the host."""
DRIVE_MODE, OPERATING_MODE, VELOCITY_LIMIT, TORQUE, RETURN_LEVEL, HARDWARE_ERROR = 10, 11, 44, 64, 68, 70
WATCHDOG, GOAL_CURRENT, GOAL_VELOCITY, PROFILE_ACCELERATION, PROFILE_VELOCITY = 98, 102, 104, 108, 112
GOAL_POSITION, MOVING, PRESENT_VELOCITY = 116, 122, 128
TIME_BASED = 0x04

AxisTable: Any = drive_table(
    {
        "id": (int, 1),
        "model": (int, 0),
        "mode": (Literal["velocity", "position", "extended_position", "current"], "extended_position"),
        "travel_per_turn": (float, 2 * math.pi),
        "steps_per_turn": (int, 4096),
        "zero": (int, 0),
        "speed_unit_rpm": (float, 0.229),
        "acceleration_unit_rpm2": (float, 214.577),
        "current_unit": (float, 0.00269),
        "force_per_ampere": (float, 0.0),
    },
    force=True,
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

id: of the servo; model: number that it must tell (1020 = XM430-W350), 0 takes any; mode: operating mode; travel_per_turn: m or rad in
one turn, negative to reverse; steps_per_turn, zero: of its position, and the position that is 0; speed_unit_rpm [rev/min],
acceleration_unit_rpm2 [rev/min^2], current_unit [A]: of its registers; force_per_ampere: N*m or N in one ampere, for mode = "current".
"""


class DynamixelSettings(DriveSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of DriveSettings.

    Attributes:
        axis: the servos, one axis each.
        watchdog_s: time without a request after which a servo stops, 0.02 to 2.54 s; 0 = none.
        quick_stop: "torque_off" frees the shaft, "hold" brakes and holds.
        turnaround_s: longest time that a servo needs before it answers [s].
    """

    axis: list[AxisTable]
    watchdog_s: float = 0.5
    quick_stop: Literal["torque_off", "hold"] = "torque_off"
    turnaround_s: float = 0.05


class ServoUnit(AxesUnit):
    """One servo."""

    def __init__(
        self, name: str, settings: DynamixelSettings, axis: Any, spec: BlockSpec, kit: Kit, **given: Any
    ) -> None:
        super().__init__(name, [_axis(axis)], spec, kit, **given)
        self._settings, self._axis, self._id = settings, axis, axis.id
        line = settings.line
        character_s = line.bits_per_character / line.baud if line.serial else 0.0
        self._bus = Bus(character_s, settings.turnaround_s)
        self._stop_s = BRAKE_CHARACTERS * character_s + WAKE_S
        self._per_unit = axis.steps_per_turn / axis.travel_per_turn
        self._speed = 60 / abs(axis.travel_per_turn) / axis.speed_unit_rpm
        self._rate = 3600 / abs(axis.travel_per_turn) / axis.acceleration_unit_rpm2
        self._ramps: dict[int, int] = {}
        self._torque = False
        self._fault = ""

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Identify the servo, stop it, look at its mode and limits, set its watchdog and switch the torque on."""
        bus, servo, axis = self._bus, self._id, self._axis
        self._ramps.clear()
        self._fault = ""
        answer: Status = yield bus.ping(servo)
        model = int.from_bytes(answer.data[:2], "little")
        if axis.model and model != axis.model:
            text = f"identify {self.name}: servo {servo} is model {model}, firmware {answer.data[2]}"
            raise DeviceError(errno.ENODEV, f"{text}; the configuration says {axis.model}")
        level: Status = yield bus.read(servo, RETURN_LEVEL, 1)
        if level.data[0] != 2:  # at a lower level a write draws no reply
            yield Send(
                dynamixel.packet(servo, dynamixel.Op.WRITE, bytes((RETURN_LEVEL, 0, 2))), "ask for replies"
            )
            yield Pause(0.01)
        yield bus.write(servo, WATCHDOG, 0, 1, repeatable=True)
        yield from self.stop()
        yield from self._set_mode()
        limit: Status = yield bus.read(servo, VELOCITY_LIMIT, 4)
        highest = signed(limit.data, 0, 4) / self._speed
        if axis.velocity_max > highest * 1.001:
            text = (
                f"velocity_max = {axis.velocity_max:g}, but the servo's limit (register 44) is {highest:.4g}"
            )
            raise DeviceError(errno.ERANGE, f"open {self.name}: {text}; want at most that")
        yield from self._watch()
        if not self._fault and not answer.alert:
            yield from self._switch_on()

    def poll(self) -> Steps:
        """Read watchdog, moving, current, velocity and position in one message."""
        answer: Status = yield self._bus.read(self._id, WATCHDOG, MOVING + 14 - WATCHDOG)
        expired, data = answer.data[0] == WATCHDOG_EXPIRED, answer.data[MOVING - WATCHDOG :]
        yield from self._judge(answer.alert, expired)
        speed = signed(data, 6, 4) / self._speed * math.copysign(1, self._per_unit)
        position = (signed(data, 10, 4) - self._axis.zero) / self._per_unit
        force = signed(data, 4, 2) * self._axis.current_unit * self._axis.force_per_ampere
        moving = bool(data[0]) or signed(data, 6, 4) != 0
        arrived = bool(data[1] & 1)
        one = np.array
        self.report(
            one([position]), one([speed]), one([moving]), one([arrived]), [self._fault], one([force])
        )  # fmt: skip

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Set the profile where it differs, and the goal."""
        yield from self._switch_on()
        yield from self._ramp(PROFILE_ACCELERATION, self._count(action.acceleration_max * self._rate))
        yield from self._ramp(PROFILE_VELOCITY, self._count(speed * self._speed))
        yield self._write(GOAL_POSITION, self._steps_of(position), 4)

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Set the profile where it differs, and the velocity."""
        yield from self._switch_on()
        yield from self._ramp(PROFILE_ACCELERATION, self._count(action.acceleration_max * self._rate))
        yield self._write(GOAL_VELOCITY, round(velocity * self._speed * math.copysign(1, self._per_unit)), 4)

    def start_force(self, axis: int, force: float, action: DriveAction) -> Steps:
        """Set the current."""
        yield from self._switch_on()
        yield self._write(
            GOAL_CURRENT, round(force / self._axis.force_per_ampere / self._axis.current_unit), 2
        )

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Brake and hold; the fastest stop frees the shaft."""
        if self._fault and not fastest:
            return
        if fastest and self._settings.quick_stop == "torque_off":
            self._torque = False
            yield self._write(TORQUE, 0, 1, repeatable=True)
        elif self._axis.mode == "velocity":
            yield self._write(GOAL_VELOCITY, 0, 4, repeatable=True)
        elif self._axis.mode == "current":
            yield self._write(GOAL_CURRENT, 0, 2, repeatable=True)
        else:
            yield from self._brake()

    def _brake(self) -> Steps:
        """Set the goal where braking ends: one nearer, as the place of now, the servo would overshoot and come back to."""
        highest = self.bank.settings[0].acceleration_max
        yield from self._ramp(PROFILE_ACCELERATION, self._count(highest * self._rate))
        now: Status = yield self._bus.read(self._id, PRESENT_VELOCITY, 8)
        speed, place = signed(now.data, 0, 4) / self._speed, signed(now.data, 4, 4)
        way = speed * (self._stop_s + abs(speed) / (2 * highest)) * abs(self._per_unit)
        goal = place + round(way)
        if self._axis.mode == "position":  # beyond its one turn the servo would refuse the goal, and go on
            goal = min(max(goal, 0), self._axis.steps_per_turn - 1)
        yield self._write(GOAL_POSITION, goal, 4, repeatable=True)

    def reset(self, axis: int) -> Steps:
        """Restart a servo that has shut down; else renew its watchdog."""
        errors: Status = yield self._bus.read(self._id, HARDWARE_ERROR, 1)
        if errors.data[0]:
            yield self._bus.reboot(self._id)
            yield Pause(REBOOT_S)
        yield from self.open()
        if self._fault:
            raise DeviceError(errno.EIO, self._fault)

    # --- inside ----------------------------------------------------------------------------------

    def _write(self, address: int, value: int, size: int, *, repeatable: bool = False) -> Any:
        return self._bus.write(self._id, address, value, size, repeatable=repeatable)

    def _count(self, value: float) -> int:
        """Return a speed or acceleration of a profile, at least 1: 0 would be "without limit"."""
        return min(32767, max(1, math.floor(value + 1e-6)))

    def _steps_of(self, position: float) -> int:
        steps: int = round(position * self._per_unit) + self._axis.zero
        if self._axis.mode == "position" and not 0 <= steps < self._axis.steps_per_turn:
            text = f"position {position:g} is step {steps} of the servo; 0 to {self._axis.steps_per_turn - 1} in this mode"
            raise DeviceError(errno.ERANGE, text)
        if abs(steps) >= 2**31:
            raise DeviceError(errno.ERANGE, f"position {position:g} is beyond 2^31 steps")
        return steps

    def _set_mode(self) -> Steps:
        """Set operating mode and profile by velocity where they differ; they lie in the EEPROM, so with the torque off."""
        now: Status = yield self._bus.read(self._id, DRIVE_MODE, 2)
        drive, mode = now.data[0] & ~TIME_BASED, MODES[self._axis.mode][0]
        if (drive, mode) == (now.data[0], now.data[1]):
            return
        yield self._write(TORQUE, 0, 1, repeatable=True)
        self._torque = False
        if drive != now.data[0]:
            yield self._write(DRIVE_MODE, drive, 1)
        if mode != now.data[1]:
            yield self._write(OPERATING_MODE, mode, 1)

    def _watch(self) -> Steps:
        ticks = round(self._settings.watchdog_s / WATCHDOG_TICK_S)
        if ticks:
            yield self._write(WATCHDOG, ticks, 1)

    def _switch_on(self) -> Steps:
        """Switch the torque on, unless it is; the goal of before must not be taken up."""
        if self._torque:
            return
        torque: Status = yield self._bus.read(self._id, TORQUE, 1)
        if torque.data[0]:  # it was stopped and holds, or brakes yet
            self._torque = True
            return
        if self._axis.mode in ("position", "extended_position"):
            yield from self._brake()  # it may coast yet
        elif self._axis.mode == "velocity":
            yield self._write(GOAL_VELOCITY, 0, 4)
        else:
            yield self._write(GOAL_CURRENT, 0, 2)
        yield self._write(TORQUE, 1, 1)
        self._torque = True

    def _ramp(self, address: int, value: int) -> Steps:
        if self._ramps.get(address) != value:
            self._ramps.pop(address, None)
            yield self._write(address, value, 4, repeatable=True)
            self._ramps[address] = value

    def _judge(self, alert: bool, expired: bool) -> Steps:
        """Say why the servo cannot move."""
        if alert:
            errors: Status = yield self._bus.read(self._id, HARDWARE_ERROR, 1)
            names = [text for bit, text in HARDWARE_ERRORS.items() if errors.data[0] & bit]
            self._fault = f"hardware error {errors.data[0]:#x}, {', '.join(names)}; RESET restarts the servo"
            return
        mute = expired and self._torque and self._settings.watchdog_s
        self._fault = "the bus watchdog expired: the servo heard nothing for too long" if mute else ""


class Dynamixel(LineDriver):
    """Servos on one line, a unit each, so that a dead one does not stop the others.

    Concurrency: the one thread of the driver process.
    """

    Settings = DynamixelSettings

    @classmethod
    def describe(cls, name: str, settings: DynamixelSettings) -> Description:
        """Tell the axes, one block a servo; raises ValueError for what a servo could not carry out."""
        if not settings.axis:
            raise ValueError("axis: none given; want a table [[...axis]] for each servo")
        drive_axes.check_rate(settings.poll_hz, 1000)
        drive_axes.check_once("id", [axis.id for axis in settings.axis], 0, 252)
        if settings.watchdog_s and not max(0.02, 3 / settings.poll_hz) <= settings.watchdog_s <= 2.54:
            low = max(0.02, 3 / settings.poll_hz)
            raise ValueError(
                f"watchdog_s = {settings.watchdog_s:g}; want 0 (none) or {low:.3g} to 2.54 at this poll_hz"
            )
        for axis in settings.axis:
            if not (axis.travel_per_turn and axis.steps_per_turn > 0 and axis.speed_unit_rpm > 0):
                raise ValueError(
                    f"axis {axis.name}: want a travel other than 0, and positive steps and units"
                )
            if axis.mode == "current" and axis.force_per_ampere == 0:
                raise ValueError(f"axis {axis.name}: mode = current wants force_per_ampere")
        alone = len(settings.axis) == 1
        specs = tuple(
            drive_axes.axis_spec(
                "" if alone else axis.name,
                [_axis(axis)],
                f"Dynamixel {axis.id}",
                settings.capacity,
                settings.history,
            )
            for axis in settings.axis
        )
        return Description(specs, settings.poll_hz, lease_s=max(0.5, 5 / settings.poll_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return packets of the e-Manual."""
        bus, one = Bus(1e-5, 0.02), Status
        return (
            Golden(
                "ping", bus.ping(1), "ff ff fd 00 01 03 00 01 19 4e", "ff ff fd 00 01 07 00 55 00 06 04 26 65 5d",
                one(1, b"\x06\x04\x26", False),
            ),
            Golden(
                "read the position", bus.read(1, 132, 4), "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15",
                "ff ff fd 00 01 08 00 55 00 a6 00 00 00 8c c0", one(1, b"\xa6\0\0\0", False),
            ),
            Golden(
                "write a goal", bus.write(1, 116, 512, 4), "ff ff fd 00 01 09 00 03 74 00 00 02 00 00 ca 89",
                "ff ff fd 00 01 04 00 55 00 a1 0c", one(1, b"", False),
            ),
            Golden(
                "sync read", dynamixel.sync_read([1, 2], 132, 4), "ff ff fd 00 fe 09 00 82 84 00 04 00 01 02 ce fa"
            ),
            Golden(
                "sync write", dynamixel.sync_write({1: 150, 2: 170}, 116, 4),
                "ff ff fd 00 fe 11 00 83 74 00 04 00 01 96 00 00 00 02 aa 00 00 00 82 87",
            ),
            Golden("reboot", bus.reboot(1), "ff ff fd 00 01 03 00 08 2f 4e"),
        )  # fmt: skip

    def __init__(self, name: str, settings: DynamixelSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        specs = self.describe(name, settings).blocks
        self.line = settings.line
        self.recovery_s = 0.02
        self._units = [
            ServoUnit(f"{name} {axis.name}", settings, axis, spec, kit)
            for axis, spec in zip(settings.axis, specs, strict=True)
        ]

    @property
    def units(self) -> Sequence[LineUnit]:
        """The servos."""
        return self._units


def _axis(axis: Any) -> Any:
    return drive_axes.axis_settings(axis, MODES[axis.mode][1])
