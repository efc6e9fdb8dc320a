"""ODrive 3.x boards (firmware 0.5) on their ASCII protocol, over a UART or USB.

Positions follow the board's trapezoidal trajectories, velocities its ramp, torques go out at once. The board's watchdog is the
dead-man: every poll feeds it, and without that the axis lets go.

    [device.mod0]
    driver = "odrive"
    line = { serial = "/dev/ttyACM0" }
    [[device.mod0.axis]]
    name = "joint"
    number = 0
    unit = "rad"
    velocity_max = 10.0
    acceleration_max = 50.0
    force_max = 1.0
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
from sioms.sdk.codec import odrive
from sioms.sdk.codec.odrive import CLOSED_LOOP, HOMING, IDLE, confirmed
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Pause, Steps
from sioms.sdk.golden import Golden

MODES = BANK_MODES | POSITION_MODES | ControlMode.VELOCITY | ControlMode.FORCE
OLDEST = (0, 5, 1)
"""Before it positions were encoder counts."""
KNOWN = (0, 5)
PARTS = ("motor", "encoder", "controller")
SWITCH_ON_S = 0.1
SWITCH_ON_PAUSES = 4
SWITCH_ON_NS = int(SWITCH_ON_S * 1e9)
"""How long the board may take to go into a state that it was told."""

AxisTable: Any = drive_table(
    {
        "number": (Literal[0, 1], 0),
        "travel_per_turn": (float, 2 * math.pi),
        "standstill": (float, 0.02),
        "homing": (bool, False),
        "home_required": (bool, False),
        "enable": (bool, True),
    },
    force=True,
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

number: of the axis on the board; travel_per_turn: m or rad in one turn, negative to reverse; standstill: speed below which the axis
rests [turns/s]; homing: the board's homing may be used (needs an end switch there); enable: closed loop when it is opened and reset.
"""


class OdriveSettings(DriveSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of the device, beside those of DriveSettings.

    Attributes:
        axis: its axes in use.
        watchdog_s: time without a poll after which the axes let go [s]; 0 = none.
        quick_stop: "idle" lets the motors go, "hold" brakes them with all their torque and holds.
        timeout_s: longest time for a poll of all axes beyond the line's own [s].
    """

    axis: list[AxisTable]
    watchdog_s: float = 0.5
    quick_stop: Literal["idle", "hold"] = "idle"
    timeout_s: float = 0.1


class OdriveUnit(AxesUnit):
    """One board."""

    def __init__(self, name: str, settings: OdriveSettings, spec: BlockSpec, kit: Kit, **given: Any) -> None:
        super().__init__(name, _axes(settings), spec, kit, **given)
        self._settings = settings
        n = len(settings.axis)
        self._numbers = [axis.number for axis in settings.axis]
        self._travel = np.array([axis.travel_per_turn for axis in settings.axis])
        self._standstill = np.array([axis.standstill for axis in settings.axis])
        line = settings.line
        self._character_s = line.bits_per_character / line.baud if line.serial else 0.0
        self._timeout_s = settings.timeout_s + 80 * n * self._character_s
        self._homes = [False] * n
        self._may_hold = [False] * n
        self._faults = [""] * n
        self._homing_since_ns = [0] * n
        self._closed_ns = [0] * n
        self._errors = [0] * n

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Identify the board, stop its motors, set its watchdog and close the loops."""
        self._homes = [False] * len(self._numbers)
        paths = [f"fw_version_{part}" for part in ("major", "minor", "revision")]
        version = tuple(int(v[0]) for v in (yield odrive.read(paths, self._timeout_s)))
        shown = ".".join(map(str, version))
        if version < OLDEST:
            text = f"identify {self.name}: firmware {shown} counts positions in encoder counts; at least 0.5.1 is right"
            raise DeviceError(errno.ENODEV, text)
        if version[:2] != KNOWN:
            self._kit.log("warning", f"{self.name}: firmware {shown}; this driver was made for 0.5")
        for axis, number in enumerate(self._numbers):
            yield from self._open_axis(axis, f"axis{number}")

    def poll(self) -> Steps:
        """Feed the watchdog, and read what all axes do."""
        n = len(self._numbers)
        sets = [f"u {number}" for number in self._numbers]
        reads = [text for number in self._numbers for text in _reads(number)]
        values = yield odrive.exchange(sets, reads, self._timeout_s, repeatable=True)
        turns, speeds = np.zeros(n), np.zeros(n)
        done, moving = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        for axis in range(n):
            (bits,), (state,), (arrived,), (turns[axis], speeds[axis]) = values[4 * axis : 4 * axis + 4]
            moving[axis] = abs(speeds[axis]) > self._standstill[axis]
            done[axis] = bool(arrived)
            if self._homes[axis]:
                yield from self._follow_homing(axis, int(state), int(bits), moving, done)
            yield from self._judge(axis, int(bits), int(state))
        self.report(turns * self._travel, speeds * self._travel, moving, done, self._faults)

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Set the trajectory's limits, and go."""
        yield from self._ready(axis)
        number, turns = self._numbers[axis], position / self._travel[axis]
        limit, ramp = abs(speed / self._travel[axis]), abs(action.acceleration_max / self._travel[axis])
        path = f"axis{number}.trap_traj.config."
        sets = [f"w {path}{name} {value:.7g}" for name, value in _trapezoid(limit, ramp)]
        yield confirmed(
            sets, [(path + name, value) for name, value in _trapezoid(limit, ramp)], self._timeout_s
        )
        yield confirmed(
            [f"t {number} {turns:.7g}"], [(f"axis{number}.controller.input_pos", turns)], self._timeout_s
        )

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Run up the ramp."""
        yield from self._ready(axis)
        ramp = abs(action.acceleration_max / self._travel[axis])
        yield from self._velocity(axis, velocity / self._travel[axis], odrive.VELOCITY_RAMP, ramp)

    def start_force(self, axis: int, force: float, action: DriveAction) -> Steps:
        """Hold a torque; a force F along the travel of a turn is the torque F travel / (2 pi)."""
        yield from self._ready(axis)
        number, torque = self._numbers[axis], force * self._travel[axis] / (2 * math.pi)
        path = f"axis{number}.controller."
        sets = [f"w {path}config.input_mode {odrive.PASSTHROUGH}", f"c {number} {torque:.7g}"]
        back = [(f"{path}config.input_mode", odrive.PASSTHROUGH), (f"{path}input_torque", torque)]
        yield confirmed(sets, back, self._timeout_s)

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Brake along the ramp and hold; the fastest stop lets go, or brakes with all there is."""
        number = self._numbers[axis]
        homed, self._homes[axis] = self._homes[axis], False
        if homed or (fastest and self._settings.quick_stop == "idle"):
            self._may_hold[axis] = False
            sets = [f"w axis{number}.requested_state {IDLE}"]
            yield odrive.exchange(sets, [f"f {number}"], self._timeout_s, repeatable=True)
        elif fastest:
            yield from self._velocity(axis, 0.0, odrive.PASSTHROUGH, None)
        else:
            ramp = abs(self.bank.settings[axis].acceleration_max / self._travel[axis])
            yield from self._velocity(axis, 0.0, odrive.VELOCITY_RAMP, ramp)

    def home(self, axis: int) -> Steps:
        """Begin the board's homing."""
        yield from self._ready(axis)
        number = self._numbers[axis]
        yield odrive.exchange([f"w axis{number}.requested_state {HOMING}"], [f"f {number}"], self._timeout_s)
        self._homing_since_ns[axis] = self.clock()
        self._homes[axis] = True

    def reset(self, axis: int) -> Steps:
        """Clear the board's errors and close the loop again."""
        number = self._numbers[axis]
        yield odrive.exchange([f"u {number}", "sc"], [f"f {number}"], self._timeout_s)
        yield from self._close_loop(axis)
        (bits,), (state,) = yield odrive.read(
            [f"axis{number}.error", f"axis{number}.current_state"], self._timeout_s
        )
        yield from self._judge(axis, int(bits), int(state))
        if self._faults[axis]:
            raise DeviceError(errno.EIO, self._faults[axis])

    def close(self) -> Steps:
        """Let go, and switch the watchdog off so that it does not leave an error behind."""
        for number in self._numbers:
            sets = [f"w axis{number}.requested_state {IDLE}", f"w axis{number}.config.enable_watchdog 0"]
            yield odrive.exchange(sets, [f"f {number}"], self._timeout_s, repeatable=True)

    # --- inside ----------------------------------------------------------------------------------

    def _open_axis(self, axis: int, path: str) -> Steps:
        """Stop an axis that may run, check its speed limit, set its watchdog, close its loop."""
        settings, table = self._settings, self._settings.axis[axis]
        (state,), (limit,) = yield odrive.read(
            [f"{path}.current_state", f"{path}.controller.config.vel_limit"], self._timeout_s
        )
        wanted = self.bank.settings[axis].velocity_max / abs(self._travel[axis])
        if wanted > limit * 1.001:
            text = f"velocity_max is {wanted:g} turns/s, but {path}.controller.config.vel_limit is {limit:g}"
            raise DeviceError(errno.ERANGE, f"open {self.name} {table.name}: {text}; want at most that")
        if state == CLOSED_LOOP:
            yield from self.halt(axis, fastest=False)
        sets = [f"w {path}.config.enable_watchdog 0"]
        back = [(f"{path}.config.enable_watchdog", 0.0)]
        if settings.watchdog_s:
            sets += [f"w {path}.config.watchdog_timeout {settings.watchdog_s:.7g}", f"u {table.number}"]
            sets += [f"w {path}.config.enable_watchdog 1"]
            back = [
                (f"{path}.config.enable_watchdog", 1.0),
                (f"{path}.config.watchdog_timeout", settings.watchdog_s),
            ]
        yield confirmed(sets, back, self._timeout_s)
        # the last host's watchdog may have run out since the state was read
        (bits,), (state,) = yield odrive.read([f"{path}.error", f"{path}.current_state"], self._timeout_s)
        if int(bits) == odrive.WATCHDOG_EXPIRED:  # what the last host left behind when it died
            yield odrive.exchange([f"u {table.number}", "sc"], [f"f {table.number}"], self._timeout_s)
            bits = 0
        self._may_hold[axis] = table.enable
        if table.enable and state != CLOSED_LOOP and not bits:
            yield from self._close_loop(axis)

    def _ready(self, axis: int) -> Steps:
        """Close the loop again that an emergency stop has opened."""
        if not self._may_hold[axis]:
            yield from self._close_loop(axis)

    def _close_loop(self, axis: int) -> Steps:
        """Switch an axis on; it holds where it is, and one that turns yet brakes: to hold it would be to turn it back."""
        if not self._settings.axis[axis].enable:
            return
        number = self._numbers[axis]
        feeds = [f"u {each}" for each in self._numbers]
        ((_, speed),) = yield odrive.exchange(feeds, [f"f {number}"], self._timeout_s, repeatable=True)
        brake = [f"v {number} 0"] if abs(speed) > self._standstill[axis] else []
        sets = [*feeds, *brake, f"w axis{number}.requested_state {CLOSED_LOOP}"]
        for _ in range(SWITCH_ON_PAUSES):
            yield odrive.exchange(sets, [f"f {number}"], self._timeout_s)
            yield Pause(SWITCH_ON_S / SWITCH_ON_PAUSES)
            sets = feeds
        self._closed_ns[axis] = self.clock()
        self._may_hold[axis] = True

    def _velocity(self, axis: int, turns: float, input_mode: int, ramp: float | None) -> Steps:
        number = self._numbers[axis]
        path = f"axis{number}.controller."
        wanted = [(f"{path}config.input_mode", float(input_mode))]
        if ramp is not None:
            wanted.insert(0, (f"{path}config.vel_ramp_rate", ramp))
        sets = [f"w {name} {value:.7g}" for name, value in wanted]
        # velocity 0 may be sent again: it is a stop
        yield confirmed([*sets, f"v {number} {turns:.7g}"], [*wanted, (f"{path}input_vel", turns)], self._timeout_s,
                        repeatable=turns == 0)  # fmt: skip

    def _follow_homing(self, axis: int, state: int, bits: int, moving: Any, done: Any) -> Steps:
        """Tell the bank that it homes; afterwards the board is idle and its loop is closed again."""
        moving[axis], done[axis] = True, False
        if bits:
            self._homes[axis], moving[axis] = False, False
        elif state != HOMING and self.clock() - self._homing_since_ns[axis] > SWITCH_ON_NS:
            self._homes[axis], moving[axis], done[axis] = False, False, True
            yield from self._close_loop(axis)

    def _judge(self, axis: int, bits: int, state: int) -> Steps:
        """Say why an axis cannot move; the details are read once a change."""
        number = self._numbers[axis]
        if bits != self._errors[axis] and bits:
            values = yield odrive.read([f"axis{number}.{part}.error" for part in PARTS], self._timeout_s)
            details = [(f"{part}.error", int(value[0])) for part, value in zip(PARTS, values, strict=True)]
            self._faults[axis] = odrive.error_text(number, bits, details)
        self._errors[axis] = bits
        if not bits:
            settled = self.clock() - self._closed_ns[axis] > SWITCH_ON_NS
            off = self._may_hold[axis] and settled and state == IDLE and not self._homes[axis]
            self._faults[axis] = "the axis is idle; look at its calibration" if off else ""


def _reads(number: int) -> tuple[str, ...]:
    path = f"r axis{number}."
    return f"{path}error", f"{path}current_state", f"{path}controller.trajectory_done", f"f {number}"


def _trapezoid(limit: float, ramp: float) -> tuple[tuple[str, float], ...]:
    return ("vel_limit", limit), ("accel_limit", ramp), ("decel_limit", ramp)


class Odrive(LineDriver):
    """One board on its line.

    Concurrency: the one thread of the driver process.
    """

    Settings = OdriveSettings

    @classmethod
    def describe(cls, name: str, settings: OdriveSettings) -> Description:
        """Tell the axes; raises ValueError for what the board could not carry out."""
        if not settings.axis:
            raise ValueError("axis: none given; want a table [[...axis]] for each axis")
        drive_axes.check_rate(settings.poll_hz, 400)
        drive_axes.check_once("number", [axis.number for axis in settings.axis], 0, 1)
        for axis in settings.axis:
            if axis.travel_per_turn == 0 or axis.standstill <= 0:
                raise ValueError(
                    f"axis {axis.name}: travel_per_turn and standstill want to be other than 0, and positive"
                )
        if settings.watchdog_s and settings.watchdog_s < 3 / settings.poll_hz:
            raise ValueError(
                f"watchdog_s = {settings.watchdog_s:g}: it is fed every {1 / settings.poll_hz:g} s; want 0 (none), at "
                f"least {3 / settings.poll_hz:.3g} s or a higher poll_hz"
            )
        spec = drive_axes.axis_spec("", _axes(settings), "ODrive axis", settings.capacity, settings.history)
        return Description((spec,), settings.poll_hz, lease_s=max(0.5, 5 / settings.poll_hz))

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the documentation, with their checksums."""
        texts = ("v 0 1 0*103", "f 0*118", "c 0 0.1*124", "p 0 -2 0 0*95")
        lines = [
            Golden(text, odrive.line(text.partition("*")[0]), (text + "\n").encode().hex()) for text in texts
        ]
        reply = b"24.087744*32\r\n" + odrive.line("0.0 0.0").replace(b"\n", b"\r\n")
        read = Golden("read a property", odrive.read(["vbus_voltage"], 0.1), "", reply.hex(), [[24.087744]])
        return (*lines, read)

    def __init__(self, name: str, settings: OdriveSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = (OdriveUnit(name, settings, self.describe(name, settings).blocks[0], kit),)

    @property
    def units(self) -> Sequence[LineUnit]:
        """The board."""
        return self._units


def _axes(settings: OdriveSettings) -> list[Any]:
    return [
        drive_axes.axis_settings(axis, MODES, homing=axis.homing, required=axis.home_required)
        for axis in settings.axis
    ]
