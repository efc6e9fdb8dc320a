"""ODrive 3.x boards (firmware 0.5) on their ASCII protocol, over a UART or USB.

Positions follow the board's trapezoidal trajectories, velocities its ramp, torques go out at once. The board's watchdog
is the dead-man: every poll feeds it, and without that the axis lets go.

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
from collections.abc import Generator, Sequence
from typing import Any, Literal

import numpy as np

from sioms.motion import DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.codec.uptime import Uptime
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, DriveSettings, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, Pause, Send, StateLost, Step, Steps
from sioms.sdk.golden import Golden

from . import codec as odrive
from .codec import CLOSED_LOOP, HOMING, IDLE, confirmed

MODES = BANK_MODES | POSITION_MODES | ControlMode.VELOCITY | ControlMode.FORCE
OLDEST = (0, 5, 1)
BROKEN_OFF = "the homing was broken off, by another master or a request of idle; RESET, then HOME again"
"""Before it positions were encoder counts."""
KNOWN = (0, 5)
PARTS = ("motor", "encoder", "controller")
SWITCH_ON_S = 0.1
SWITCH_ON_PAUSES = 4
SWITCH_ON_NS = int(SWITCH_ON_S * 1e9)
"""How long the board may take to go into a state that it was told."""
UPTIME = "system_stats.uptime"
LET_GO_TRIES = 6
LET_GO_S = 0.003
"""Between two requests to let go; the board's thread looks every millisecond."""
FLUSH_S = 0.02
AWAY_TURNS, AWAY_S = 0.5, 0.1
"""So far the set-point of a move may be from where the axis is [turns], and so much more for a moving one [turns /
(turns/s)].
"""

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

number: of the axis on the board; travel_per_turn: m or rad in one turn, negative to reverse; standstill: speed below
which the axis rests [turns/s]; homing: the board's homing may be used (needs an end switch there); enable: closed loop
when it is opened and reset.
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
    """One board.

    What the board must be, and what it is found to be, is kept apart. ``_fixed`` holds what the opening has set and
    proved, dead-man and speed limit; ``_set`` the set-points and modes of a command that the board has confirmed. Each
    poll reads one property of these, and the board's time since its start: whatever differs was not set from here, or
    is gone with a restart.
    """

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
        self._uptime = Uptime(0.001, 2**32, digits=9)
        self._homes, self._has_homed = [False] * n, [False] * n
        self._broken_off = [False] * n
        self._may_hold = [False] * n
        self._is_idle = [False] * n
        self._fixed: list[dict[str, float]] = [{} for _ in range(n)]
        self._set: list[dict[str, float]] = [{} for _ in range(n)]
        self._turn = 0
        self._speeds = np.zeros(n)
        self._faults = [""] * n
        self._homing_since_ns = [0] * n
        self._closed_ns = [0] * n
        self._errors = [0] * n

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Identify the board, stop its motors, set its watchdog and close the loops."""
        n = len(self._numbers)
        self._homes, self._has_homed = [False] * n, [False] * n
        self._may_hold, self._is_idle = [False] * n, [False] * n
        self._fixed, self._set = [{} for _ in range(n)], [{} for _ in range(n)]
        yield from self._flush()
        paths = [f"fw_version_{part}" for part in ("major", "minor", "revision")]
        version = tuple(int(v[0]) for v in (yield odrive.read(paths, self._timeout_s)))
        shown = ".".join(map(str, version))
        if version < OLDEST:
            text = f"identify {self.name}: firmware {shown} counts positions in encoder counts; want at least 0.5.1"
            raise DeviceError(errno.ENODEV, text)
        if version[:2] != KNOWN:
            self._kit.log("warning", f"{self.name}: firmware {shown}; this driver was made for 0.5")
        asked_ns = self.clock()
        ((uptime,),) = yield odrive.read([UPTIME], self._timeout_s)
        if self._has_restarted(asked_ns, self.clock(), int(uptime)):
            self._uptime.forget()
            self._uptime.judge(asked_ns, self.clock(), int(uptime))
        for axis in range(n):
            yield from self._open_axis(axis)

    def poll(self) -> Steps:
        """Feed the watchdog, read what all axes do, and prove that the board is as it was set."""
        n = len(self._numbers)
        sets = [f"u {number}" for number in self._numbers]
        watched, was_idle = self._next_watched(), list(self._is_idle)
        reads = [f"r {UPTIME}", *(f"r {path}" for path, _ in watched)]
        reads += [text for number in self._numbers for text in _reads(number)]
        asked_ns = self.clock()
        values = yield odrive.exchange(sets, reads, self._timeout_s, repeatable=True)
        if restarted := self._has_restarted(asked_ns, self.clock(), int(values[0][0])):
            raise StateLost(f"{self.name}: {restarted}")
        first = 1 + len(watched)
        turns, speeds = np.zeros(n), np.zeros(n)
        done, moving, holds = (np.zeros(n, dtype=bool) for _ in range(3))
        states = [0] * n
        for axis in range(n):
            (bits,), (state,), (arrived,), (turns[axis], speeds[axis]) = values[first + 4 * axis :][:4]
            states[axis] = int(state)
            moving[axis] = not self.rests(axis, bool(abs(speeds[axis]) <= self._standstill[axis]))
            done[axis], holds[axis] = bool(arrived), state == CLOSED_LOOP
            if self._homes[axis]:
                yield from self._follow_homing(axis, int(state), int(bits), moving, done)
            yield from self._judge(axis, int(bits), int(state))
        self._speeds = speeds
        self.report(turns * self._travel, speeds * self._travel, moving, done, self._faults, holds=holds)
        self._check_watched(watched, values[1:first])
        for axis in range(n):
            if was_idle[axis]:
                self._check_idle(axis, states[axis])

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Plan from where the axis is, and go."""
        yield from self._ready(axis)
        number, turns = self._numbers[axis], position / self._travel[axis]
        limit, ramp = abs(speed / self._travel[axis]), abs(action.acceleration_max / self._travel[axis])
        path = f"axis{number}."
        wanted = {
            f"{path}trap_traj.config.vel_limit": limit, f"{path}trap_traj.config.accel_limit": ramp,
            f"{path}trap_traj.config.decel_limit": ramp,
        }  # fmt: skip
        # The board plans from its set-point, which a velocity run leaves behind. The setter of the mode takes the
        # present place as the set-point. It is sent twice: should it be lost, the axis would run back to where the run
        # began.
        modes = _modes(path, odrive.POSITION, odrive.TRAPEZOID)
        here = f"w {path}controller.config.control_mode {odrive.POSITION}"
        sets = [*_writes(wanted), here, here, f"t {number} {turns:.7g}", f"w {path}controller.input_vel 0"]
        modes |= {f"{path}controller.input_pos": turns, f"{path}controller.input_vel": 0.0}
        set_point = f"{path}controller.pos_setpoint"
        values = yield from self._command(axis, sets, wanted | modes, modes, also=[f"r {set_point}", f"f {number}"])
        (begin,), (place, velocity) = values[-2:]
        if abs(begin - place) > AWAY_TURNS + AWAY_S * abs(velocity):
            yield from self.halt(axis, fastest=True)
            text = f"{set_point} reads {begin:g} turns while the axis is at {place:g}; stopped, send the move again"
            raise DeviceError(errno.EIO, text)

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Run up the ramp."""
        yield from self._ready(axis)
        ramp = abs(action.acceleration_max / self._travel[axis])
        yield from self._velocity(axis, velocity / self._travel[axis], ramp)

    def start_force(self, axis: int, force: float, action: DriveAction) -> Steps:
        """Hold a torque; a force F along the travel of a turn is the torque F travel / (2 pi)."""
        yield from self._ready(axis)
        number, torque = self._numbers[axis], force * self._travel[axis] / (2 * math.pi)
        path = f"axis{number}."
        wanted = _modes(path, odrive.TORQUE, odrive.PASSTHROUGH) | {f"{path}controller.input_torque": torque}
        # a trajectory that ends between the first two lines goes back to the mode of positions
        go = f"c {number} {torque:.7g}"
        sets = [go, f"w {path}controller.config.input_mode {odrive.PASSTHROUGH}", go]
        yield from self._command(axis, sets, wanted, wanted)

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Brake along the ramp and hold; the fastest stop lets go, or brakes with all there is. Sent until it is
        confirmed.
        """
        has_homed = self._has_homed[axis]
        searches = self._homes[axis] and not has_homed
        self._homes[axis] = self._has_homed[axis] = False
        if searches or (fastest and self._settings.quick_stop == "idle"):
            yield from self._let_go(axis)
        elif fastest:
            yield from self._velocity(axis, 0.0, None)
        else:
            yield from self._velocity(axis, 0.0, abs(self.bank.settings[axis].acceleration_max / self._travel[axis]))
        if searches:
            yield from self._see_zero(axis)
        elif has_homed:
            yield from self._is_zero_off_the_switch(axis)

    def home(self, axis: int) -> Steps:
        """Begin the board's homing."""
        yield from self._ready(axis)
        number = self._numbers[axis]
        self._set[axis] = {}
        homed, begin = f"axis{number}.is_homed", f"w axis{number}.requested_state {HOMING}"
        yield confirmed([f"w {homed} 0"], [(homed, 0.0)], self._timeout_s, repeatable=True)
        yield odrive.exchange([begin], [f"f {number}"], self._timeout_s)
        self._homing_since_ns[axis] = self.clock()
        self._homes[axis], self._has_homed[axis] = True, False

    def reset(self, axis: int) -> Steps:
        """Clear the board's errors and close the loop again."""
        number = self._numbers[axis]
        yield odrive.exchange([f"u {number}", "sc"], [f"f {number}"], self._timeout_s)
        self._broken_off[axis] = False
        yield from self._close_loop(axis)
        (bits,), (state,) = yield odrive.read([f"axis{number}.error", f"axis{number}.current_state"], self._timeout_s)
        yield from self._judge(axis, int(bits), int(state))
        if self._faults[axis]:
            raise DeviceError(errno.EIO, self._faults[axis])

    def close(self) -> Steps:
        """Let go, and switch the watchdog off so that it does not leave an error behind."""
        for axis, number in enumerate(self._numbers):
            yield from self._let_go(axis)
            path = f"axis{number}.config.enable_watchdog"
            yield confirmed([f"w {path} 0"], [(path, 0.0)], self._timeout_s, repeatable=True)

    # --- opening ----------------------------------------------------------------------------------

    def _flush(self) -> Steps:
        """End whatever half line the board has heard: it waits for its end without a time-out."""
        yield Send(b"\n\n", "end a cut line")
        yield Pause(FLUSH_S)

    def _open_axis(self, axis: int) -> Steps:
        """Stop an axis that may run, check its speed limit, set its watchdog, close its loop unless a stop is
        latched.
        """
        table = self._settings.axis[axis]
        number, path = table.number, f"axis{table.number}"
        limit_at, torque_at = f"{path}.controller.config.vel_limit", f"{path}.motor.config.torque_lim"
        (state,), (limit,), (torque,) = yield odrive.read(
            [f"{path}.current_state", limit_at, torque_at], self._timeout_s
        )
        settings = self.bank.settings[axis]
        wanted = settings.velocity_max / abs(self._travel[axis])
        most = settings.force_max * abs(self._travel[axis]) / (2 * math.pi)
        for what, mine, unit, at, boards in (
            ("velocity_max", wanted, "turns/s", limit_at, limit),
            ("force_max", most, "N m", torque_at, torque),  # a greater torque would be cut without a word
        ):
            if mine > boards * 1.001:
                text = f"{what} is {mine:g} {unit}, but {at} is {boards:g}; want at most that"
                raise DeviceError(errno.ERANGE, f"open {self.name} {table.name}: {text}")
        if state == CLOSED_LOOP:
            yield from self.halt(axis, fastest=self.bank.is_latched(axis))
        elif state != IDLE:  # the homing or calibration of somebody else
            yield from self._let_go(axis)
        yield from self._arm(axis, path)
        limits = {limit_at: limit, torque_at: torque}  # the board ships without a limit of the torque
        self._fixed[axis] |= {at: value for at, value in limits.items() if math.isfinite(value)}
        # the last host's watchdog may have run out since the state was read
        (bits,), (state,) = yield odrive.read([f"{path}.error", f"{path}.current_state"], self._timeout_s)
        if int(bits) == odrive.WATCHDOG_EXPIRED:  # what the last host left behind when it died
            yield odrive.exchange([f"u {number}", "sc"], [f"f {number}"], self._timeout_s)
            bits = 0
        self._may_hold[axis] = state == CLOSED_LOOP
        self._is_idle[axis] = state == IDLE
        if state != CLOSED_LOOP and not bits:
            yield from self._close_loop(axis)

    def _arm(self, axis: int, path: str) -> Steps:
        """Set the watchdog and read it back; a new time-out counts from the next feeding on."""
        timeout_s = self._settings.watchdog_s
        switch, time = f"{path}.config.enable_watchdog", f"{path}.config.watchdog_timeout"
        sets, back = [f"w {switch} 0"], {switch: 0.0}
        if timeout_s:
            sets += [f"w {time} {timeout_s:.7g}", f"u {self._numbers[axis]}", f"w {switch} 1"]
            back = {switch: 1.0, time: timeout_s}
        yield confirmed(sets, list(back.items()), self._timeout_s, repeatable=True)
        self._fixed[axis] = back

    # --- what the board proves at each poll ---------------------------------------------------------

    def _next_watched(self) -> list[tuple[str, float]]:
        """Return the property that the next poll compares, in turn, and the value that it must have."""
        everything = [item for d in (*self._fixed, *self._set) for item in d.items()]
        self._turn += 1
        return [everything[self._turn % len(everything)]] if everything else []

    def _has_restarted(self, asked_ns: int, heard_ns: int, uptime: int) -> str:
        """Return "" or how the board's time tells that it has restarted: its encoders have counted from 0 since."""
        told = self._uptime.judge(asked_ns, heard_ns, uptime)
        if not told:
            return ""
        text = f"the board has restarted, its place is lost: {told}"
        for axis in range(self.bank.n):
            self.lose_place(axis, text)
        return text

    def _check_watched(self, watched: list[tuple[str, float]], values: Sequence[Sequence[float]]) -> None:
        for (path, wanted), (got,) in zip(watched, values, strict=True):
            if not odrive.agrees(got, wanted):
                text = f"{path} reads {got:g}, but {wanted:g} was set; somebody else commands this board"
                raise StateLost(f"{self.name}: {text}")

    def _check_idle(self, axis: int, state: int) -> None:
        if self._settings.axis[axis].enable and self._is_idle[axis] and state != IDLE:
            text = f"axis{self._numbers[axis]}.current_state reads {state}, but the axis was left idle"
            raise StateLost(f"{self.name}: {text}; somebody else commands this board")

    # --- inside ----------------------------------------------------------------------------------

    def _ready(self, axis: int) -> Steps:
        """Close the loop again that an emergency stop has opened; let a torque that turns the axis go over smoothly."""
        if not self._may_hold[axis]:
            yield from self._close_loop(axis)
        yield from self._seed(axis)

    def _seed(self, axis: int) -> Steps:
        """Take the present speed as the set-point of an axis that a torque has set in motion: what follows begins from
        it.
        """
        path, speed = f"axis{self._numbers[axis]}.controller.", float(self._speeds[axis])
        if self._set[axis].get(f"{path}config.control_mode") != odrive.TORQUE or abs(speed) <= self._standstill[axis]:
            return
        self._set[axis] = {}
        yield confirmed([f"w {path}input_vel {speed:.7g}"], [(f"{path}input_vel", speed)], self._timeout_s,
                        repeatable=True)  # fmt: skip

    def _close_loop(self, axis: int) -> Steps:
        """Switch an axis on; it holds where it is, and one that turns yet brakes: to hold it would be to turn it back.

        The board keeps its inputs while it is idle, and obeys them as soon as the loop is closed: first they are made
        zero, and read back. Nothing is switched on while a stop is latched, or after a stop that has overtaken this.
        """
        if not self._settings.axis[axis].enable or self.bank.is_latched(axis):
            return
        number, epoch = self._numbers[axis], self._epoch[axis]
        path = f"axis{number}."
        feeds = [f"u {each}" for each in self._numbers]
        self._set[axis] = {}
        ((_, speed),) = yield odrive.exchange(feeds, [f"f {number}"], self._timeout_s, repeatable=True)
        mode = odrive.VELOCITY if abs(speed) > self._standstill[axis] else odrive.POSITION
        wanted = _modes(path, mode, odrive.PASSTHROUGH)
        wanted |= {f"{path}controller.input_vel": 0.0, f"{path}controller.input_torque": 0.0}
        sets = [*feeds, f"v {number} 0 0", *_writes(wanted)]
        yield confirmed(sets, list(wanted.items()), self._timeout_s, repeatable=True)
        sets = [*feeds, f"w {path}requested_state {CLOSED_LOOP}"]
        for _ in range(SWITCH_ON_PAUSES):
            if epoch != self._epoch[axis]:
                return
            self._is_idle[axis] = False
            ((state,),) = yield odrive.exchange(sets, [f"r {path}current_state"], self._timeout_s)
            if state == CLOSED_LOOP:
                break
            yield Pause(SWITCH_ON_S / SWITCH_ON_PAUSES)
            sets = feeds
        if epoch == self._epoch[axis]:
            self._closed_ns[axis] = self.clock()
            self._may_hold[axis], self._set[axis] = True, wanted

    def _let_go(self, axis: int) -> Steps:
        """Request idle until the board says that it is, and leave nothing that the next closing of the loop would
        obey.
        """
        number = self._numbers[axis]
        self._may_hold[axis], self._set[axis] = False, {}
        sets = [f"w axis{number}.requested_state {IDLE}", f"v {number} 0 0"]
        refusal: DeviceError | None = None
        for _ in range(LET_GO_TRIES):
            try:
                ((state,),) = yield odrive.exchange(
                    sets, [f"r axis{number}.current_state"], self._timeout_s, repeatable=True, urgent=True
                )
            except DeviceError as error:
                refusal = error
            else:
                if state == IDLE:
                    self._is_idle[axis] = True
                    return
            yield Pause(LET_GO_S)
        text = f"let go of {self.name} {self._settings.axis[axis].name}: {refusal or f'it is in state {state:g} yet'}"
        raise DeviceError(errno.EIO, f"{text}; wanted {IDLE}")

    def _velocity(self, axis: int, turns: float, ramp: float | None) -> Steps:
        """Run at a velocity up a ramp, or stop at once (None)."""
        yield from self._seed(axis)
        number = self._numbers[axis]
        path = f"axis{number}.controller."
        mode = odrive.PASSTHROUGH if ramp is None else odrive.VELOCITY_RAMP
        wanted = _modes(f"axis{number}.", odrive.VELOCITY, mode)
        wanted |= {f"{path}input_vel": turns, f"{path}input_torque": 0.0}
        ramps = {} if ramp is None else {f"{path}config.vel_ramp_rate": ramp}
        go, how = f"v {number} {turns:.7g} 0", f"w {path}config.input_mode {mode}"
        # The ramp begins at the present set-point, so it comes first. Without one the set-point is the input: that
        # comes first.
        sets = [go, how, go] if ramp is None else [*_writes(ramps), how, go]
        # velocity 0 may be sent again: it is a stop
        yield from self._command(axis, sets, wanted | ramps, wanted, repeatable=turns == 0, urgent=turns == 0)

    def _command(
        self, axis: int, sets: Sequence[str], back: dict[str, float], kept: dict[str, float], **options: Any
    ) -> Generator[Step, Any, list[list[float]]]:
        """Send set-points and modes, and see that the board has them; the polls watch those that are ``kept``."""
        self._set[axis] = {}
        epoch = self._epoch[axis]
        values: list[list[float]] = yield confirmed(sets, list(back.items()), self._timeout_s, **options)
        if epoch == self._epoch[axis]:
            self._set[axis] = kept
        return values

    def _follow_homing(self, axis: int, state: int, bits: int, moving: Any, done: Any) -> Steps:
        """Tell that the axis homes until it is homed, its loop closed again, and it stands.

        The board lets go when its homing ends, at whatever speed the axis then has, and it runs on until the loop is
        closed. An error ends the homing by a stop.
        """
        stands, moving[axis], done[axis] = not moving[axis], True, False
        if bits:
            moving[axis] = not stands
        elif self._has_homed[axis]:
            if stands and (state == CLOSED_LOOP or not self._settings.axis[axis].enable):
                self._homes[axis] = self._has_homed[axis] = moving[axis] = False
                done[axis] = yield from self._is_zero_off_the_switch(axis)
        elif state != HOMING and self.clock() - self._homing_since_ns[axis] > SWITCH_ON_NS:
            ((homed,),) = yield odrive.read([f"axis{self._numbers[axis]}.is_homed"], self._timeout_s)
            if homed:
                self._has_homed[axis] = True
                yield from self._close_loop(axis)
            else:
                self._homes[axis], self._broken_off[axis], moving[axis] = False, True, not stands

    def _is_zero_off_the_switch(self, axis: int) -> Generator[Step, Any, bool]:
        """Say that the place is lost where a homing has ended on its switch.

        Whatever requests another state in the half millisecond in which the board closes its loop at the switch makes
        it take that place for its zero, and say that it is homed: the axis has not gone by the offset.
        """
        path = f"axis{self._numbers[axis]}.min_endstop."
        try:
            (pressed,), (offset,) = yield odrive.read([f"{path}endstop_state", f"{path}config.offset"], self._timeout_s)
        except DeviceError:  # a firmware that does not tell
            return True
        if pressed and offset > 0:
            self.lose_place(axis, f"its homing has ended on the switch, not {offset:g} turns off it; HOME again")
        return not (pressed and offset > 0)

    def _see_zero(self, axis: int) -> Steps:
        """Say that the place is lost where the board has set its zero though its homing was stopped.

        It does in the turn in which it ends; and where it is stopped while it closes its loop at the switch, it takes
        that place for its zero.
        """
        ((homed,),) = yield odrive.read([f"axis{self._numbers[axis]}.is_homed"], self._timeout_s)
        if homed:
            self.lose_place(axis, "its homing was stopped while the board set its zero; RESET, then HOME again")

    def _judge(self, axis: int, bits: int, state: int) -> Steps:
        """Say why an axis cannot move; the details are read once a change."""
        number = self._numbers[axis]
        if bits != self._errors[axis] and bits:
            values = yield odrive.read([f"axis{number}.{part}.error" for part in PARTS], self._timeout_s)
            details = [(f"{part}.error", int(value[0])) for part, value in zip(PARTS, values, strict=True)]
            self._faults[axis] = odrive.error_text(number, bits, details)
        self._errors[axis] = bits
        if not bits and self._broken_off[axis]:
            self._faults[axis] = BROKEN_OFF
        elif not bits:
            settled = self.clock() - self._closed_ns[axis] > SWITCH_ON_NS
            searches = self._homes[axis] and not self._has_homed[axis]
            off = self._may_hold[axis] and settled and state == IDLE and not searches
            self._faults[axis] = "the axis is idle; check its calibration" if off else ""


def _reads(number: int) -> tuple[str, ...]:
    path = f"r axis{number}."
    return f"{path}error", f"{path}current_state", f"{path}controller.trajectory_done", f"f {number}"


def _modes(path: str, control: int, inputs: int) -> dict[str, float]:
    path = f"{path}controller.config."
    return {f"{path}control_mode": float(control), f"{path}input_mode": float(inputs)}


def _writes(wanted: dict[str, float]) -> list[str]:
    return [f"w {path} {value:.7g}" for path, value in wanted.items()]


class Odrive(LineDriver):
    """One board on its line.

    Concurrency: the one thread of the driver process.
    """

    Settings = OdriveSettings

    @classmethod
    def describe(cls, name: str, settings: OdriveSettings) -> Description:
        """Tell the axes; raises ValueError for what the board could not carry out."""
        drive_axes.check_axes(settings.axis, "axis", "number", (0, 1), settings.poll_hz, 400)
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
        return drive_axes.polled((spec,), settings.poll_hz)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return lines of the documentation, with their checksums."""
        texts = ("v 0 1 0*103", "f 0*118", "c 0 0.1*124", "p 0 -2 0 0*95")
        lines = [Golden(text, odrive.line(text.partition("*")[0]), (text + "\n").encode().hex()) for text in texts]
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
        drive_axes.axis_settings(axis, MODES, homing=axis.homing, required=axis.home_required) for axis in settings.axis
    ]
