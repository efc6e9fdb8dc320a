"""Trinamic modules and evaluation boards on TMCL, up to six motors a module.

The module makes its own ramps. Its serial heartbeat (global parameter 68) is the dead-man: without a request for that
long the motors stop. A module that restarts has neither heartbeat nor ramps nor place; every poll proves that it has
not. One that is out of step, so that not even a stop reaches it, is brought back by single bytes
(sioms.drivers.tmcl.codec.Framing).

    [device.mod0]
    driver = "tmcl"
    line = { serial = "/dev/ttyUSB0", baud = 9600 }
    module = 1140
    [[device.mod0.axis]]
    name = "xaxis"
    motor = 0
    travel_per_turn = 0.01
    microsteps_per_turn = 51200
    velocity_max = 0.1
    acceleration_max = 1.0
"""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from sioms.motion import DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Pause, Send, StateLost, Steps
from sioms.sdk.golden import Golden

from .codec import SERIAL_HEARTBEAT, SIZE, TICKS, Axis, Framing, Module, Op, separator

MODES = BANK_MODES | POSITION_MODES | ControlMode.VELOCITY
HIGHEST_INTERNAL = 2047
DRIVER_FAULTS = {
    1: "stall", 2: "overtemperature", 8: "short to ground, coil A", 16: "short to ground, coil B",
}  # fmt: skip
"""Bits of axis parameter 208 on the TMC26x and TMC5130 drivers; 4 (warning), 32, 64 (open load) and 128 are no faults.
"""
EXTENDED_FAULTS = {1: "motor stalled", 2: "deviation from the encoder too large"}
"""Bits of axis parameter 207."""
FAULT_BITS = {Axis.DRIVER_ERRORS: DRIVER_FAULTS, Axis.EXTENDED_ERRORS: EXTENDED_FAULTS}
SURE = 0.8
"""Share of the heartbeat from which on the module may have been silent for all of it."""
NEAR_ZERO = 16
"""Microsteps within which a module has just been set to count from 0."""
SELDOM_NS = 500_000_000
LOST_REPLIES = 3
"""Replies that are lost in one poll before the module counts as silent: of 1 % two are lost in every 500th poll."""
PAD_S = 0.01
"""How long after a single byte, beside the time of the characters, the module has to say that it was the ninth."""
DRIFT, JITTER_MS, TICKS_MS = 0.1, 200, 1000
"""How far the module's clock may be from this one: part of the time since a reading, and more [ms]; after how long that
is renewed [ms].
"""
ROUNDING = {Axis.MAX_SPEED: 2, Axis.MAX_ACCELERATION: 256}
"""By how much, beside 2 %, a ramp may read otherwise than it was set: modules hold it in steps of their own."""

AxisTable: Any = drive_table(
    {
        "motor": (int, 0),
        "travel_per_turn": (float, 2 * math.pi),
        "microsteps_per_turn": (float, 51200.0),
        "pulse_divisor": (int, 3),
        "ramp_divisor": (int, 7),
        "homing": (bool, False),
        "home_required": (bool, False),
    }
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

motor: number in the module; travel_per_turn: m or rad in one turn, negative to reverse the axis; microsteps_per_turn:
full steps times microstep resolution; pulse_divisor, ramp_divisor: of the motor, for speed_unit = "internal" alone;
homing: the module's reference search (parameters 193 to 195) may be used.
"""


class TmclSettings(DriveSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of DriveSettings.

    Attributes:
        axis: its motors in use.
        address: of the module.
        host_address: that it answers to (global parameter 76).
        module: number that it must tell, e.g. 1140; 0 takes any.
        speed_unit: what the module counts speeds in: microsteps/s, or the internal units of TMC428/429.
        clock_hz: of a TMC428/429.
        heartbeat_s: time without a request after which the module stops its motors [s]; 0 = none.
        turnaround_s: longest time that the module needs to answer [s].
        recovery_s: silence after a bad or missing reply [s]: a reply tells its command but not which parameter it is
            of, so one that comes later than that would be taken for another.
        poll_hz: rate at which the module is read.
    """

    axis: list[AxisTable]
    address: int = 1
    host_address: int = 2
    module: int = 0
    speed_unit: Literal["microsteps/s", "internal"] = "microsteps/s"
    clock_hz: float = 16e6
    heartbeat_s: float = 0.5
    turnaround_s: float = 0.05
    recovery_s: float = 0.05
    poll_hz: float = 20.0


@dataclass(frozen=True, slots=True)
class Scale:
    """From the unit of an axis to what its motor counts in.

    Args:
        per_unit: microsteps in one m or rad, negative when the axis is reversed.
        per_speed: counts of a speed in one microstep/s.
        per_acceleration: counts of an acceleration in one microstep/s^2.
        highest: highest count of a speed or acceleration.
    """

    per_unit: float
    per_speed: float
    per_acceleration: float
    highest: int

    @staticmethod
    def of(axis: Any, settings: TmclSettings) -> Scale:
        """Return the scale of an axis.

        For TMC428/429: speed = clock v / (2^pulse_divisor 2048 32), acceleration = clock^2 a / 2^(pulse_divisor +
        ramp_divisor + 29), in microsteps/s and /s^2 (TMC429 datasheet, section 7.1).

        Raises:
            ValueError: zero gearing.
        """
        if not (axis.travel_per_turn and axis.microsteps_per_turn > 0):
            raise ValueError(
                f"axis {axis.name}: travel_per_turn = {axis.travel_per_turn:g}, microsteps_per_turn = "
                f"{axis.microsteps_per_turn:g}; want a travel other than 0 and a positive number"
            )
        per_unit = axis.microsteps_per_turn / axis.travel_per_turn
        if settings.speed_unit == "microsteps/s":
            return Scale(per_unit, 1.0, 1.0, 2**31 - 1)
        per_speed = 2**axis.pulse_divisor * 2048 * 32 / settings.clock_hz
        per_acceleration = 2 ** (axis.pulse_divisor + axis.ramp_divisor + 29) / settings.clock_hz**2
        return Scale(per_unit, per_speed, per_acceleration, HIGHEST_INTERNAL)

    def position(self, si: float) -> int:
        """Return a position in microsteps."""
        return round(si * self.per_unit)

    def speed(self, si: float) -> int:
        """Return the size of a speed as the module counts it, at least 1 for what is not 0."""
        return max(1, math.floor(abs(si * self.per_unit) * self.per_speed + 1e-9)) if si else 0

    def acceleration(self, si: float) -> int:
        """Return an acceleration as the module counts it, at least 1."""
        return max(1, math.floor(abs(si * self.per_unit) * self.per_acceleration + 1e-9))

    def check(self, axis: Any) -> None:
        """Raise ValueError when a limit of the axis does not fit what the module counts in."""
        for name, count in (
            ("velocity_max", self.speed(axis.velocity_max)),
            ("acceleration_max", self.acceleration(axis.acceleration_max)),
        ):
            if count > self.highest:
                raise ValueError(
                    f"axis {axis.name}: {name} is {count} in the module, which counts to {self.highest}; "
                    f"want {getattr(axis, name) * self.highest / count:.4g} or other divisors"
                )
        for name in ("position_min", "position_max"):
            value = getattr(axis, name)
            if value is not None and abs(self.position(value)) >= 2**31:
                raise ValueError(f"axis {axis.name}: {name} = {value:g} is beyond 2^31 microsteps")


class TmclUnit(AxesUnit):
    """One module."""

    def __init__(self, name: str, settings: TmclSettings, spec: BlockSpec, kit: Kit, **given: Any) -> None:
        super().__init__(name, _axes(settings), spec, kit, **given)
        self._settings = settings
        line = settings.line
        on_line_s = SIZE * line.bits_per_character / line.baud if line.serial else 0.0
        self._module = Module(settings.address, settings.host_address, settings.turnaround_s + on_line_s)
        self.framing = Framing(settings.address)
        self._pad_s = PAD_S + on_line_s * (SIZE + 1) / SIZE
        # a reply that is lost costs its time-out, the silence behind it and the single bytes; a poll has some seven
        lost_s = self._module.turnaround_s + settings.recovery_s + SIZE * self._pad_s
        self.silence_s = max(self.silence_s, LOST_REPLIES * lost_s)
        self._motors = [axis.motor for axis in settings.axis]
        self._scales = [Scale.of(axis, settings) for axis in settings.axis]
        self._ramps: dict[tuple[int, Axis], int] = {}
        self._has_ticks = True
        self._ticks: tuple[int, int, int] | None = None
        self._turn = 0
        self._lost = ""
        self._homes = [False] * len(self._motors)
        self._counted = [False] * len(self._motors)
        """Whether the module has counted something else than 0 since a search was asked for."""
        self._faults = [""] * len(self._motors)
        self._without: set[int] = set()
        self._seldom_ns = 0
        self._asked_ns = self._silent_ns = 0
        """When it was last asked, and the longest that it was not since a search began."""

    def open(self) -> Steps:
        """Identify the module, stop what moves it, arm its heartbeat and set its limits; all are read back."""
        settings, module = self._settings, self._module
        self._homes = [False] * len(self._motors)
        version = yield from self._ask(module.exchange(Op.VERSION, 1), search=True)
        number, firmware = version >> 16 & 0xFFFF, version & 0xFFFF
        if settings.module and number != settings.module:
            text = f"identify {self.name}: module {number}, firmware {firmware >> 8}.{firmware & 0xFF:02d}; the "
            raise DeviceError(errno.ENODEV, f"{text}configuration says {settings.module}; check address and wiring")
        yield from self._end_programs()
        yield from self.stop()
        self._lost = self._lost or (yield from self._what_is_lost())
        yield from self._arm()
        yield from self._limit()
        if self._lost:
            for axis in range(len(self._motors)):  # the module counts from 0 where it started
                self.lose_place(axis, f"position lost, it restarted: {self._lost}")
            self._lost = ""

    def _arm(self) -> Steps:
        """Set the heartbeat, and read it back."""
        wanted = round(self._settings.heartbeat_s * 1000)
        try:
            present = yield from self._ask(self._module.exchange(Op.GGP, SERIAL_HEARTBEAT))
            if present != wanted:  # never written without need: some modules keep it in their EEPROM
                yield from self._ask(self._module.exchange(Op.SGP, SERIAL_HEARTBEAT, 0, wanted), repeatable=True)
                present = yield from self._ask(self._module.exchange(Op.GGP, SERIAL_HEARTBEAT))
        except DeviceError as error:
            if wanted:
                text = f"{error}; the module has no heartbeat, heartbeat_s = 0 accepts that its motors go on"
                raise DeviceError(error.errno, f"{text} when the host dies") from None
            return
        if present != wanted:
            text = f"arm {self.name}: the serial heartbeat (global parameter 68) reads {present} ms, {wanted} was set"
            raise DeviceError(errno.EIO, f"{text}; heartbeat_s = {present / 1000:g} is what the module takes")

    def _limit(self) -> Steps:
        """Set the ramps of all motors to the limits of the axes, so that nobody's own are in force, and read them
        back.
        """
        for axis, scale in enumerate(self._scales):
            settings = self._settings.axis[axis]
            for parameter, value in (
                (Axis.MAX_ACCELERATION, scale.acceleration(settings.acceleration_max)),
                (Axis.MAX_SPEED, scale.speed(settings.velocity_max)),
            ):
                yield from self._ramp(axis, parameter, value)
                present = yield from self._ask(self._module.get(parameter, self._motors[axis]))
                if not _is_near(parameter, present, value):
                    text = (
                        f"limit motor {self._motors[axis]} of {self.name}: parameter {int(parameter)} reads {present}"
                    )
                    raise DeviceError(errno.ERANGE, f"{text}, {value} was set; the module cannot do it")

    def poll(self) -> Steps:
        """Read positions, speeds and ends of all motors, and now and then their errors."""
        yield from self._prove()
        n = len(self._motors)
        position, velocity = np.zeros(n), np.zeros(n)
        moving, done = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for axis, (motor, scale) in enumerate(zip(self._motors, self._scales, strict=True)):
            # the position last: the end of a search changes it, and what was read while it braked is not where it rests
            searches = self._homes[axis] and (yield from self._ask(self._module.exchange(Op.RFS, 2, motor))) != 0
            speed = yield from self._ask(self._module.get(Axis.ACTUAL_SPEED, motor))
            reached = yield from self._ask(self._module.get(Axis.POSITION_REACHED, motor))
            steps = yield from self._ask(self._module.get(Axis.ACTUAL_POSITION, motor))
            position[axis] = steps / scale.per_unit
            velocity[axis] = speed / (scale.per_speed * scale.per_unit)
            moving[axis], done[axis] = speed != 0, bool(reached)
            if self._homes[axis]:
                self._counted[axis] |= abs(steps) > NEAR_ZERO
                self._homes[axis] = moving[axis] = searches or speed != 0
                done[axis] = (
                    not moving[axis] and not (yield from self._breaks_off(axis)) and self._has_found(axis, steps)
                )
        if self.clock() >= self._seldom_ns:
            self._seldom_ns = self.clock() + SELDOM_NS
            yield from self._read_faults()
        self.report(position, velocity, moving, done, self._faults)

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Set the ramp, and move."""
        motor, scale = self._motors[axis], self._scales[axis]
        yield from self._ramp(axis, Axis.MAX_ACCELERATION, scale.acceleration(action.acceleration_max))
        yield from self._ramp(axis, Axis.MAX_SPEED, scale.speed(speed))
        yield from self._ask(self._module.exchange(Op.MVP, 0, motor, scale.position(position)))

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Turn right or left."""
        scale = self._scales[axis]
        yield from self._ramp(axis, Axis.MAX_ACCELERATION, scale.acceleration(action.acceleration_max))
        op = Op.ROR if velocity * scale.per_unit >= 0 else Op.ROL
        yield from self._ask(self._module.exchange(op, 0, self._motors[axis], scale.speed(velocity)))

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Stop a motor: MST brakes with the ramp's acceleration, and there is nothing faster; a search ends first.

        The ramp may be a slow one that a command has set: then the motor is told that of the axis while it brakes.
        """
        motor = self._motors[axis]
        if self._homes[axis]:
            self._homes[axis] = False
            with suppress(DeviceError):  # the stop must go out all the same
                yield from self._ask(self._module.exchange(Op.RFS, 1, motor), search=True, repeatable=True)
        yield from self._ask(self._module.exchange(Op.MST, 0, motor), search=True)
        hardest = self._scales[axis].acceleration(self._settings.axis[axis].acceleration_max)
        if self._ramps.get((axis, Axis.MAX_ACCELERATION), hardest) < hardest:
            yield from self._ramp(axis, Axis.MAX_ACCELERATION, hardest)

    def home(self, axis: int) -> Steps:
        """Begin the module's reference search."""
        motor = self._motors[axis]
        steps = yield from self._ask(self._module.get(Axis.ACTUAL_POSITION, motor))
        yield from self._ask(self._module.exchange(Op.RFS, 0, motor))
        self._homes[axis], self._silent_ns, self._counted[axis] = True, 0, abs(steps) > NEAR_ZERO

    def _has_found(self, axis: int, steps: int) -> bool:
        """Tell whether a search that is over has found its switch: the module then counts from 0 there.

        Whoever else sends RFS STOP ends it as well, and the module has no flag that says so; the count goes on.
        """
        if abs(steps) <= NEAR_ZERO and self._counted[axis]:
            return True
        self.break_off(axis, f"the reference search was broken off, by another master: the module counts {steps}, "
                             "and 0 where it has found its switch; RESET, then HOME again")  # fmt: skip
        return False

    def _breaks_off(self, axis: int) -> Generator[Any, Any, bool]:
        """Break off a search during which the module has not been asked for as long as its heartbeat lasts; return
        whether that was so.

        The heartbeat stops the motor, and the search is over then as one that has found its switch.
        """
        silent_s, heartbeat_s = self._silent_ns * 1e-9, self._settings.heartbeat_s
        if not heartbeat_s or silent_s < SURE * heartbeat_s:
            return False
        self._homes[axis] = False
        with suppress(DeviceError):  # the fault below stops the motor as well
            yield from self._ask(self._module.exchange(Op.RFS, 1, self._motors[axis]), repeatable=True)
        self.break_off(axis, f"the reference search was broken off: nothing was asked for {silent_s:.3g} s, and after "
                             f"{heartbeat_s:g} s the module stops its motors; home again")  # fmt: skip
        return True

    def reset(self, axis: int) -> Steps:
        """Read the errors again: reading the extended flags clears what has passed."""
        yield from self._read_faults()
        yield from self._read_faults()
        if self._faults[axis]:
            raise DeviceError(errno.EIO, self._faults[axis])

    # --- the line ----------------------------------------------------------------------------------

    def _ask(self, exchange: Exchange, *, search: bool = False, repeatable: bool = False) -> Generator[Any, Any, Any]:
        """Carry out an exchange; where it fails, bring the module into step, and repeat what may be.

        Args:
            exchange: to be carried out.
            search: the module may be of a kind that does not answer a wrong checksum, which takes long to find out.
            repeatable: though the codec does not know that it is.
        """
        now_ns = self.clock()
        self._silent_ns = max(self._silent_ns, now_ns - (self._asked_ns or now_ns))
        self._asked_ns = now_ns
        repeatable = repeatable or exchange.repeatable
        if self.framing.unanswered:
            yield from self._into_step(search=search)
        try:
            return (yield self.framing.watched(exchange))
        except LinkError as error:
            if error.heard and repeatable and not self.framing.refused:  # a damaged reply: it is in step
                with suppress(LinkError):
                    return (yield self.framing.watched(exchange))
            yield from self._into_step(search=search)
            if not repeatable:
                raise
        return (yield self.framing.watched(exchange))

    def _into_step(self, *, search: bool) -> Steps:
        """Send single bytes until the module answers that nine of them were no telegram.

        A stop may come in between and do the same; then there is nothing left to do.
        """
        for _ in range(SIZE):
            if not self.framing.unanswered:
                return
            yield Send(self.framing.next_pad(), "a single byte, to get into step")
            yield Pause(self._pad_s)
        if search:
            yield from self._search()

    def _search(self) -> Steps:
        """Find the step of a module that passes over a wrong checksum: shift by a byte and ask, nine times."""
        ask = self._module.exchange(Op.VERSION, 1)
        between = bytes((separator(ask.data),))
        for _ in range(SIZE):
            if not self.framing.unanswered:
                return
            yield Send(between, "a single byte, to get into step")
            with suppress(LinkError):
                yield self.framing.watched(ask)

    # --- what must hold ----------------------------------------------------------------------------

    def _prove(self) -> Steps:
        """Prove that the module has not restarted, and one by one that the heartbeat and all ramps are as they were
        set.

        Raises:
            StateLost: they are not; the kit opens the module again.
        """
        self._lost = yield from self._believed(self._time_jumped)
        heartbeat = [None] if self._settings.heartbeat_s else []
        turns = heartbeat + list(self._ramps)
        self._turn = (self._turn + 1) % len(turns)
        key, lost = turns[self._turn], self._lost
        if heartbeat and not lost and (key is None or not self._has_ticks):
            lost = yield from self._believed(self._heartbeat_lost)
        if key is not None and not lost:
            lost = yield from self._believed(partial(self._ramp_lost, *key))
        if lost:
            self._lost = self._lost or ("" if self._has_ticks else lost)
            raise StateLost(f"{self.name}: {lost}: it restarted, or somebody else has set it")

    def _what_is_lost(self) -> Generator[Any, Any, str]:
        """Return how a module that was opened before shows that it restarted since, so that its place is not to be
        trusted.
        """
        if not self._ramps:
            return ""
        lost: str = yield from self._believed(self._time_jumped)
        if self._has_ticks:
            return lost
        if self._settings.heartbeat_s:
            lost = yield from self._believed(self._heartbeat_lost)
        for axis, parameter in list(self._ramps):
            lost = lost or (yield from self._believed(partial(self._ramp_lost, axis, parameter)))
        return lost

    def _believed(self, look: Callable[[], Generator[Any, Any, str]]) -> Generator[Any, Any, str]:
        """Return what is found twice: a reply does not tell of which parameter it is, and one that came late is that of
        another.
        """
        found: str = yield from look()
        if not found:
            return ""
        yield Pause(self._settings.recovery_s)
        found = yield from look()
        if found:
            self._ticks = None
        return found

    def _time_jumped(self) -> Generator[Any, Any, str]:
        """Return what is wrong with the module's clock, '' when it went on as this one did, or when it has none."""
        if not self._has_ticks:
            return ""
        asked_ns = self.clock()
        try:
            ticks = yield from self._ask(self._module.exchange(Op.GGP, TICKS))
        except DeviceError:
            self._has_ticks = False
            return ""
        answered_ns = self.clock()
        before = self._ticks or (ticks, asked_ns, answered_ns)
        passed = (ticks - before[0]) % 2**32
        least, most = max(0, asked_ns - before[2]) / 1e6, (answered_ns - before[1]) / 1e6
        if least * (1 - DRIFT) - JITTER_MS <= passed <= most * (1 + DRIFT) + JITTER_MS:
            if most > TICKS_MS or self._ticks is None:
                self._ticks = ticks, asked_ns, answered_ns
            return ""
        return f"the module's clock (parameter 132) went from {before[0]} to {ticks} ms in {most:.0f} ms"

    def _heartbeat_lost(self) -> Generator[Any, Any, str]:
        wanted = round(self._settings.heartbeat_s * 1000)
        present = yield from self._ask(self._module.exchange(Op.GGP, SERIAL_HEARTBEAT))
        return "" if present == wanted else f"the heartbeat (global parameter 68) is {present} ms, not {wanted}"

    def _ramp_lost(self, axis: int, parameter: Axis) -> Generator[Any, Any, str]:
        wanted, motor = self._ramps[axis, parameter], self._motors[axis]
        present = yield from self._ask(self._module.get(parameter, motor))
        if _is_near(parameter, present, wanted):
            return ""
        return f"parameter {int(parameter)} of motor {motor} is {present}, not {wanted}"

    def _end_programs(self) -> Steps:
        """End what may start a motor again: a program in the module, and reference searches of a process before this
        one.
        """
        with suppress(DeviceError):  # an evaluation board runs none
            yield from self._ask(self._module.exchange(Op.END_PROGRAM), repeatable=True)
        for motor in self._motors:
            with suppress(DeviceError):  # there are modules without reference search
                yield from self._ask(self._module.exchange(Op.RFS, 1, motor), repeatable=True)

    def _ramp(self, axis: int, parameter: Axis, value: int) -> Steps:
        """Set a parameter of the ramp; each time, for a module that restarted since has forgotten it."""
        yield from self._ask(self._module.set(parameter, self._motors[axis], value), repeatable=True)
        self._ramps[axis, parameter] = value

    def _read_faults(self) -> Steps:
        """Read the error flags of all motors; a module without them has none."""
        for axis, motor in enumerate(self._motors):
            texts = []
            for parameter, bits in FAULT_BITS.items():
                if parameter in self._without:
                    continue
                try:
                    flags = yield from self._ask(self._module.get(parameter, motor))
                except DeviceError:
                    self._without.add(parameter)
                    continue
                texts += [text for bit, text in bits.items() if flags & bit]
            self._faults[axis] = ", ".join(dict.fromkeys(texts))


class Tmcl(LineDriver):
    """One module on its line.

    Concurrency: the one thread of the driver process.
    """

    Settings = TmclSettings

    @classmethod
    def describe(cls, name: str, settings: TmclSettings) -> Description:
        """Tell the axes; raises ValueError for what the module could not carry out."""
        drive_axes.check_axes(settings.axis, "motor", "motor", (0, 5), settings.poll_hz, 1000)
        for axis in settings.axis:
            Scale.of(axis, settings).check(axis)
        _check_heartbeat(settings)
        spec = drive_axes.axis_spec(
            "", _axes(settings), f"TMCL module {settings.address}", settings.capacity, settings.history
        )
        return drive_axes.polled((spec,), settings.poll_hz)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return telegrams of the firmware manuals."""
        one = Module(1, 2, 0.05)
        return (
            Golden("rotate right", one.exchange(Op.ROR, 0, 0, 1000), "01 01 00 00 00 00 03 e8 ed"),
            Golden("stop", one.exchange(Op.MST), "01 03 00 00 00 00 00 00 04"),
            Golden(
                "move to 10000", one.exchange(Op.MVP, 0, 0, 10000), "01 04 00 00 00 00 27 10 3c",
                "02 01 64 04 00 00 27 10 a2", 10000,
            ),
            Golden("move by -500", one.exchange(Op.MVP, 1, 0, -500), "01 04 01 00 ff ff fe 0c 0e"),
            Golden(
                "read the position", one.get(Axis.ACTUAL_POSITION, 0), "01 06 01 00 00 00 00 00 08",
                "02 01 64 06 00 00 27 10 a4", 10000,
            ),
            Golden("set the speed", one.set(Axis.MAX_SPEED, 0, 20000), "01 05 04 00 00 00 4e 20 78"),
        )  # fmt: skip

    def __init__(self, name: str, settings: TmclSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self.recovery_s = settings.recovery_s
        unit = TmclUnit(name, settings, self.describe(name, settings).blocks[0], kit)
        self.overheard = unit.framing.overheard
        self._units = (unit,)

    @property
    def units(self) -> Sequence[LineUnit]:
        """The module."""
        return self._units


def _axes(settings: TmclSettings) -> list[Any]:
    return [
        drive_axes.axis_settings(axis, MODES, homing=axis.homing, required=axis.home_required) for axis in settings.axis
    ]


def _is_near(parameter: Axis, present: int, wanted: int) -> bool:
    return abs(present - wanted) <= ROUNDING[parameter] + 0.02 * wanted


def _check_heartbeat(settings: TmclSettings) -> None:
    """Raise when the module would stop its motors between two polls."""
    if not 0 <= settings.heartbeat_s <= 60:
        raise ValueError(f"heartbeat_s = {settings.heartbeat_s:g}; want 0 (none) to 60")
    if settings.heartbeat_s and settings.heartbeat_s < 3 / settings.poll_hz:
        raise ValueError(
            f"heartbeat_s = {settings.heartbeat_s:g}: the module is polled every {1 / settings.poll_hz:g} s; want at "
            f"least {3 / settings.poll_hz:.3g} s or a higher poll_hz"
        )
