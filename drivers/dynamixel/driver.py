"""Dynamixel X servos on protocol 2.0, several on one line, each an axis.

The operating mode is a choice of the configuration, for it lies in the servo's EEPROM and changes only with the torque
off. The bus watchdog is the dead-man: without a request for that long the servo stops. Every poll reads torque,
watchdog, profile and goal and compares them with what was written, and the servo's clock with this one: a servo that
restarted, or that somebody else has commanded, is opened again. A goal goes out in one packet with the profile that
limits it.

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
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from sioms.motion import DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Pause, Send, StateLost, Steps
from sioms.sdk.golden import Golden

from . import codec as dynamixel
from .codec import Bus, Status, signed

MODES = {
    "velocity": (1, BANK_MODES | ControlMode.VELOCITY),
    "position": (3, BANK_MODES | POSITION_MODES),
    "extended_position": (4, BANK_MODES | POSITION_MODES),
    "current": (0, (BANK_MODES | ControlMode.FORCE) & ~ControlMode.SPECIFIED_MAX_VEL_ACC),
}
"""Name of an operating mode: its number in register 11, and the control modes that it gives."""
REBOOT_S = 0.5
HARDWARE_ERRORS = {1: "input voltage", 4: "overheating", 8: "encoder", 16: "electrical shock", 32: "overload"}
"""Bits of register 70 as the e-Manual numbers them for the X series."""
WATCHDOG_TICK_S, WATCHDOG_EXPIRED = 0.02, 0xFF
NO_WATCHDOG = "firmware before 38 has none; watchdog_s = 0 accepts that the servo goes on when the host dies"
BRAKE_CHARACTERS, WAKE_S = 43, 0.0005
"""Between the reading of place and speed and the arrival of the goal made of them: reply and request, and the host."""
DRIVE_MODE, OPERATING_MODE, VELOCITY_LIMIT, TORQUE, RETURN_LEVEL, HARDWARE_ERROR = 10, 11, 44, 64, 68, 70
WATCHDOG, GOAL_CURRENT, GOAL_VELOCITY, PROFILE_ACCELERATION, PROFILE_VELOCITY = 98, 102, 104, 108, 112
GOAL_POSITION, TICK, MOVING, PRESENT_VELOCITY = 116, 120, 122, 128
IMAGE, IMAGE_SIZE = TORQUE, PRESENT_VELOCITY + 8 - TORQUE
TIME_BASED = 0x04
FARTHEST = 1_048_575
"""Goal of the extended position mode, 256 turns (e-Manual, Goal Position)."""
FLUSH = bytes(200)
"""More than the receiver holds of a packet whose length was damaged. Zeros cannot complete one: they make a CRC of 0
only of a CRC of 0.
"""
TICKS, DRIFT, JITTER_MS, TICKS_MS, LONGEST_MS = 32768, 0.1, 200, 1000, 20_000
"""The servo's clock: where it begins anew [ms], how far it may be from this one (part of the time since a reading, and
more [ms]), after how long that reading is renewed, and from where on it tells nothing [ms]."""
CONFIRM_S = 0.05
"""After what pause a finding is looked at again."""
OUTAGE_NS = 2_000_000_000
"""How long after a reading a servo that stood may be told to be in the same turn."""

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

id: of the servo; model: number that it must tell (1020 = XM430-W350), 0 takes any; mode: operating mode;
travel_per_turn: m or rad in one turn, negative to reverse; steps_per_turn, zero: of its position, and the position that
is 0; speed_unit_rpm [rev/min], acceleration_unit_rpm2 [rev/min^2], current_unit [A]: of its registers;
force_per_ampere: N*m or N in one ampere, for mode = "current".
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


class Image(NamedTuple):
    """Registers 64 to 135 at one time.

    Args:
        data: the registers.
        alert: the servo has a hardware error.
        asked_ns, answered_ns: between which it answered.
    """

    data: bytes
    alert: bool
    asked_ns: int
    answered_ns: int

    def get(self, address: int, size: int) -> int:
        """Return a register, signed when it has more than one byte."""
        if size == 1:
            return self.data[address - IMAGE]
        return signed(self.data, address - IMAGE, size)

    @property
    def tick(self) -> int:
        """The servo's clock [ms]."""
        return self.get(TICK, 2) % TICKS


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
        self._set: dict[int, tuple[int, int]] = {}
        self._writes = 0
        self._limits = (0, axis.steps_per_turn - 1)
        self._clock_read: Image | None = None
        self._last: Image | None = None
        self._fault = self._jumped = ""

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Identify the servo, stop it, prove its mode, limits and watchdog, and switch it on unless a stop is
        latched.
        """
        yield from self._begin(self.stop)

    def _begin(self, stop: Callable[[], Steps]) -> Steps:
        """Open; ``stop`` stops it, and makes starts void that wait for the line, or leaves them to follow a reset."""
        bus, servo, axis = self._bus, self._id, self._axis
        answer: Status = yield from self._sure(bus.ping(servo))
        model = int.from_bytes(answer.data[:2], "little")
        if axis.model and model != axis.model:
            text = f"identify {self.name}: servo {servo} is model {model}, firmware {answer.data[2]}"
            raise DeviceError(errno.ENODEV, f"{text}; the configuration says {axis.model}")
        # at a lower level it answers neither writes nor reads
        yield Send(dynamixel.packet(servo, dynamixel.Op.WRITE, bytes((RETURN_LEVEL, 0, 2))), "ask for replies")
        yield Pause(0.01)
        before: Image = yield from self._read()
        lost = self._lost_place(before)
        if lost:
            self.lose_place(0, lost)
        self._set.clear()
        self._fault = self._jumped = ""
        self._set[RETURN_LEVEL] = (2, 1)
        yield from self._set_mode()
        yield from stop()
        yield from self._write(WATCHDOG, 0, 1)
        yield from self._check_limits()
        yield from self._set_profile()
        yield from self._arm()
        if not before.alert and not self.bank.is_latched(0):
            yield from self._switch_on()

    def poll(self) -> Steps:
        """Read all that moves it and how it moves in one message, and prove that it is as it was set."""
        writes = self._writes
        image: Image = yield from self._read()
        if writes != self._writes:
            return  # a stop came in between: what was read is older than it
        yield from self._judge(image)
        speed = image.get(PRESENT_VELOCITY, 4) / self._speed * math.copysign(1, self._per_unit)
        position = (image.get(PRESENT_VELOCITY + 4, 4) - self._axis.zero) / self._per_unit
        force = image.get(MOVING + 4, 2) * self._axis.current_unit * self._axis.force_per_ampere
        moving = not self.rests(0, not image.get(MOVING, 1) and speed == 0)
        arrived = bool(image.get(MOVING + 1, 1) & 1)
        self._last = image
        one = np.array
        self.report(
            one([position]), one([speed]), one([moving]), one([arrived]), [self._fault], one([force]),
            one([bool(image.get(TORQUE, 1))]),
        )  # fmt: skip

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Set profile and goal at once."""
        goal = self._steps_of(position)
        yield from self._switch_on()
        yield from self._aim(self._count(action.acceleration_max * self._rate), self._count(speed * self._speed), goal)

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Set the profile, then the velocity: of the two in one message the servo may take the velocity first."""
        yield from self._switch_on()
        wanted = round(velocity * self._speed * math.copysign(1, self._per_unit))
        rate = self._count(action.acceleration_max * self._rate), 4
        if self._set.get(PROFILE_ACCELERATION) != rate:
            yield from self._write(PROFILE_ACCELERATION, *rate)
        yield from self._write(GOAL_VELOCITY, wanted, 4)

    def start_force(self, axis: int, force: float, action: DriveAction) -> Steps:
        """Set the current."""
        yield from self._switch_on()
        yield from self._write(GOAL_CURRENT, round(force / self._axis.force_per_ampere / self._axis.current_unit), 2)

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Brake and hold; the fastest stop frees the shaft."""
        if self._fault and not fastest:
            return
        if fastest and self._settings.quick_stop == "torque_off":
            yield from self._write(TORQUE, 0, 1, repeatable=True)
            return
        try:
            yield from self._rest()
        except DeviceError:
            # the goals of one whose watchdog has expired are read-only until that is cleared; RESET arms it again
            yield from self._write(WATCHDOG, 0, 1, repeatable=True)
            yield from self._rest()

    def reset(self, axis: int) -> Steps:
        """Restart a servo that has shut down; else renew its watchdog."""
        errors: Status = yield self._bus.read(self._id, HARDWARE_ERROR, 1)
        if errors.data[0]:
            yield self._bus.reboot(self._id)
            yield Pause(REBOOT_S)
        yield from self._begin(lambda: self.halt(0, fastest=True))
        if self._fault:
            raise DeviceError(errno.EIO, self._fault)

    # --- stops and starts --------------------------------------------------------------------------

    def _rest(self) -> Steps:
        """Come to rest and stay there, by the goals of the mode."""
        if self._axis.mode == "velocity":
            rate = self._count(self.bank.settings[0].acceleration_max * self._rate), 4
            slow = self._set.get(PROFILE_ACCELERATION) != rate
            yield from self._write_all(GOAL_VELOCITY, [(0, 4), rate], repeatable=True)
            if slow:  # it may brake with the profile of before
                yield from self._write(GOAL_VELOCITY, 0, 4, repeatable=True)
        elif self._axis.mode == "current":
            yield from self._write(GOAL_CURRENT, 0, 2, repeatable=True)
        else:
            yield from self._brake()

    def _brake(self) -> Steps:
        """Set the goal where braking ends: one nearer, as the place of now, the servo would overshoot and come back
        to.
        """
        highest = self.bank.settings[0].acceleration_max
        now: Status = yield from self._sure(self._bus.read(self._id, PRESENT_VELOCITY, 8))
        speed, place = signed(now.data, 0, 4) / self._speed, signed(now.data, 4, 4)
        way = speed * (self._stop_s + abs(speed) / (2 * highest)) * abs(self._per_unit)
        goal = place + round(way)
        if self._axis.mode == "position":  # beyond its limits the servo would refuse the goal, and go on
            goal = min(max(goal, self._limits[0]), self._limits[1])
        no_faster = self._count(abs(speed) * self._speed)
        yield from self._aim(self._count(highest * self._rate), no_faster, goal, repeatable=True)

    def _aim(self, acceleration: int, velocity: int, goal: int, *, repeatable: bool = False) -> Steps:
        """Write profile and goal at once, so that no goal goes without its limits."""
        values = [(acceleration, 4), (velocity, 4), (goal, 4)]
        yield from self._write_all(PROFILE_ACCELERATION, values, repeatable=repeatable)

    def _switch_on(self) -> Steps:
        """Switch the torque on, unless it is; no goal of before may be taken up, in whatever mode it was left."""
        torque: Status = yield self._bus.read(self._id, TORQUE, 1)
        if torque.data[0]:  # it was stopped and holds, or brakes yet
            self._set[TORQUE] = (1, 1)
            return
        yield from self._set_mode()
        yield from self._rest()
        for goal in (GOAL_POSITION, GOAL_VELOCITY):
            self._set.pop(goal, None)  # it may be set anew by the servo itself
        yield from self._write(TORQUE, 1, 1)

    # --- openings ----------------------------------------------------------------------------------

    def _set_mode(self) -> Steps:
        """Set operating mode and profile by velocity where they differ; they lie in the EEPROM, so with the torque off.

        A change of mode clears the profile and sets the goal current to its limit.
        """
        drive, mode = yield from self._modes()
        wanted = MODES[self._axis.mode][0]
        if not drive & TIME_BASED and mode == wanted:
            return
        yield from self._write(TORQUE, 0, 1, repeatable=True)
        for goal in (GOAL_CURRENT, PROFILE_ACCELERATION, PROFILE_VELOCITY):
            self._set.pop(goal, None)
        if drive & TIME_BASED:
            yield from self._write(DRIVE_MODE, drive & ~TIME_BASED, 1)
        if mode != wanted:
            yield from self._write(OPERATING_MODE, wanted, 1)
        drive, mode = yield from self._modes()
        if drive & TIME_BASED or mode != wanted:
            text = f"set the mode of {self.name}: registers 10 and 11 read {drive} and {mode}"
            raise DeviceError(errno.EIO, f"{text}; {drive & ~TIME_BASED} and {wanted} were written")

    def _modes(self) -> Any:
        now: Status = yield self._bus.read(self._id, DRIVE_MODE, 2)
        return now.data[0], now.data[1]

    def _check_limits(self) -> Steps:
        """Read the limits of velocity and position."""
        limit: Status = yield self._bus.read(self._id, VELOCITY_LIMIT, 12)
        self._limits = signed(limit.data, 8, 4), signed(limit.data, 4, 4)
        highest = signed(limit.data, 0, 4) / self._speed
        if self._axis.velocity_max > highest * 1.001:
            text = f"velocity_max = {self._axis.velocity_max:g}, but the servo's limit (register 44) is {highest:.4g}"
            raise DeviceError(errno.ERANGE, f"open {self.name}: {text}; want at most that")

    def _set_profile(self) -> Steps:
        """Set the profile to the limits of the axis: 0, as after a start, is without limit."""
        settings = self.bank.settings[0]
        values = [
            (self._count(settings.acceleration_max * self._rate), 4),
            (self._count(settings.velocity_max * self._speed), 4),
        ]
        yield from self._write_all(PROFILE_ACCELERATION, values, repeatable=True)

    def _arm(self) -> Steps:
        """Set the watchdog, and read it back."""
        ticks = round(self._settings.watchdog_s / WATCHDOG_TICK_S)
        if not ticks:
            return
        try:
            yield from self._write(WATCHDOG, ticks, 1)
        except DeviceError as error:
            raise DeviceError(error.errno, f"{error}; {NO_WATCHDOG}") from None
        present: Status = yield self._bus.read(self._id, WATCHDOG, 1)
        if present.data[0] != ticks:
            text = f"arm {self.name}: the bus watchdog (register 98) reads {present.data[0]}, {ticks} was written"
            raise DeviceError(errno.EIO, f"{text}; {NO_WATCHDOG}")

    # --- what must hold ----------------------------------------------------------------------------

    def _judge(self, image: Image) -> Steps:
        """Say why the servo cannot move, or that it is not as it was set.

        Raises:
            StateLost: it restarted, or somebody else has written to it; the kit opens it again.
        """
        if image.alert:
            errors: Status = yield self._bus.read(self._id, HARDWARE_ERROR, 1)
            names = [text for bit, text in HARDWARE_ERRORS.items() if errors.data[0] & bit]
            self._fault = f"hardware error {errors.data[0]:#x}, {', '.join(names)}; RESET restarts the servo"
            self._set.clear()
            return
        if WATCHDOG in self._set and image.get(WATCHDOG, 1) == WATCHDOG_EXPIRED:
            self._fault = "the bus watchdog expired: the servo heard nothing for too long"
            return
        self._fault = ""
        lost = self._time_jumped(image) or self._otherwise(image)
        if lost:  # a reply that came late tells of an earlier time
            writes = self._writes
            yield Pause(CONFIRM_S)
            image = yield from self._read()
            if writes != self._writes or image.alert:
                return
            self._jumped = self._time_jumped(image)
            lost = self._jumped or self._otherwise(image)
        if lost:
            raise StateLost(f"{self.name}: {lost}: it restarted, or somebody else has written to it")

    def _otherwise(self, image: Image) -> str:
        """Return which register is not as it was written, '' when all are."""
        for address, (value, size) in self._set.items():
            if image.get(address, size) != value:
                return f"register {address} reads {image.get(address, size)}, {value} was written"
        return ""

    def _time_jumped(self, image: Image) -> str:
        """Return what is wrong with the servo's clock, '' when it went on as this one did."""
        before = self._clock_read or image
        passed = (image.tick - before.tick + JITTER_MS) % TICKS - JITTER_MS
        least = max(0, image.asked_ns - before.answered_ns) / 1e6
        most = (image.answered_ns - before.asked_ns) / 1e6
        if most > LONGEST_MS or least * (1 - DRIFT) - JITTER_MS <= passed <= most * (1 + DRIFT) + JITTER_MS:
            if most > TICKS_MS or self._clock_read is None:
                self._clock_read = image
            return ""
        return f"the servo's clock (register 120) went from {before.tick} to {image.tick} ms in {most:.0f} ms"

    def _lost_place(self, image: Image) -> str:
        """Return how a servo that was opened before shows that it forgot its turns, '' when it knows them.

        A restart leaves the place within one turn. It is the same place when the servo stood and reads what it read.
        """
        last = self._last
        jumped = self._jumped or self._time_jumped(image)
        self._clock_read, self._last = image, None
        if last is None or self._axis.mode == "position":
            return ""
        off = WATCHDOG in self._set and not image.get(WATCHDOG, 1) and not image.get(TORQUE, 1)
        way = abs(image.get(PRESENT_VELOCITY + 4, 4) - last.get(PRESENT_VELOCITY + 4, 4))
        stood = not last.get(MOVING, 1) and image.asked_ns - last.answered_ns < OUTAGE_NS
        if not (jumped or off) or (stood and way < self._axis.steps_per_turn / 4):
            return ""
        return f"position lost: it restarted ({jumped or 'watchdog and torque are off'}) and counts within one turn"

    # --- the line ----------------------------------------------------------------------------------

    def _read(self) -> Any:
        """Return the image of the registers."""
        asked_ns = self.clock()
        answer: Status = yield self._bus.read(self._id, IMAGE, IMAGE_SIZE)
        return Image(answer.data, answer.alert, asked_ns, self.clock())

    def _sure(self, exchange: Exchange) -> Any:
        """Carry out an exchange that may be repeated; a receiver that waits for the end of a damaged packet is given
        one.
        """
        try:
            return (yield exchange)
        except LinkError:
            yield Send(FLUSH, "zeros, to end a damaged packet")
        return (yield exchange)

    def _write(self, address: int, value: int, size: int, *, repeatable: bool = False) -> Steps:
        yield from self._write_all(address, [(value, size)], repeatable=repeatable)

    def _write_all(self, address: int, values: Sequence[tuple[int, int]], *, repeatable: bool = False) -> Steps:
        """Write registers at once, and note what they must read from now on."""
        sizes = [size for _, size in values]
        places = [address + sum(sizes[:i]) for i in range(len(sizes))]
        self._writes += 1
        for place in places:
            self._set.pop(place, None)
        exchange = self._bus.write_all(self._id, address, values, repeatable=repeatable)
        if repeatable:
            yield from self._sure(exchange)
        else:
            yield exchange
        if address >= IMAGE:
            self._set.update(zip(places, values, strict=True))

    def _count(self, value: float) -> int:
        """Return a speed or acceleration of a profile, at least 1: 0 would be "without limit"."""
        return min(32767, max(1, math.floor(value + 1e-6)))

    def _steps_of(self, position: float) -> int:
        steps: int = round(position * self._per_unit) + self._axis.zero
        if self._axis.mode == "position" and not 0 <= steps < self._axis.steps_per_turn:
            text = (
                f"position {position:g} is step {steps} of the servo; 0 to {self._axis.steps_per_turn - 1} in this mode"
            )
            raise DeviceError(errno.ERANGE, text)
        if abs(steps) > FARTHEST:
            text = f"position {position:g} is step {steps} of the servo; want {-FARTHEST} to {FARTHEST}"
            raise DeviceError(errno.ERANGE, text)
        return steps


class Dynamixel(LineDriver):
    """Servos on one line, a unit each, so that a dead one does not stop the others.

    Concurrency: the one thread of the driver process.
    """

    Settings = DynamixelSettings

    @classmethod
    def describe(cls, name: str, settings: DynamixelSettings) -> Description:
        """Tell the axes, one block a servo; raises ValueError for what a servo could not carry out."""
        drive_axes.check_axes(settings.axis, "servo", "id", (0, 252), settings.poll_hz, 1000)
        if settings.watchdog_s and not max(0.02, 3 / settings.poll_hz) <= settings.watchdog_s <= 2.54:
            low = max(0.02, 3 / settings.poll_hz)
            raise ValueError(
                f"watchdog_s = {settings.watchdog_s:g}; want 0 (none) or {low:.3g} to 2.54 at this poll_hz"
            )
        for axis in settings.axis:
            if not (axis.travel_per_turn and axis.steps_per_turn > 0 and axis.speed_unit_rpm > 0):
                raise ValueError(f"axis {axis.name}: want a travel other than 0, and positive steps and units")
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
        return drive_axes.polled(specs, settings.poll_hz)

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
