"""The axes of a Grbl controller: hooks that turn what the bank wants into jogs.

The controller has one planner. Moves that are asked for together become one line; what one axis has cancelled brakes
all, and those that nobody has stopped go on from where they came to rest.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from sioms.motion import ActionKind, AxisSettings, DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk.blocks import BlockSpec
from sioms.sdk.drive_axes import AxesUnit
from sioms.sdk.driver import Kit
from sioms.sdk.exchange import DeviceError, LinkError, Pause, Send, StateLost, Steps

from . import codec as grbl
from . import opening as grbl_opening
from .codec import Answer, Report
from .homing import GrblHoming
from .jog import CHAIN_BLOCKS, JogChain, straight_jog
from .machine import INCHES, SPEED, MachinePosition
from .moves import GrblMoves, Moves
from .opening import RESET_S, TIMEOUT_S

STATUS_S = 0.2
"""A status report comes within 5 to 20 ms; ten times that on a slow adapter."""
TOGETHER_S = 0.0005
"""How long a start waits for the starts of other axes that go out with it."""
LATE_S = 0.5
"""What braking may take longer than the motion itself: reports, and a line that waited."""
OWN_RESET_NS = 300_000_000
"""A second greeting so soon after that of a reset of ours belongs to it: the reset met a controller that was starting.
"""
STARTED_ANEW = "the controller has started anew: its place, modes and lines are gone"
SAME_PLACE = 0.01
"""What a place at rest may differ by from one report to another [mm or degrees]; reports have three digits."""
OFFSET_REPORTS = 35
"""The work offset comes with every 30th report at the latest."""
NOT_READY = {
    "Hold": "feed hold; release it at the controller",
    "Door": "the safety door is open",
    "Sleep": "the controller sleeps",
    "Check": "the controller is in check mode",
    "Run": "the controller runs a program of somebody else",
}


class Options(Protocol):
    """What the unit reads of the device's settings."""

    @property
    def axis(self) -> Sequence[Any]:
        """Its axes: letter, unit, acceleration_max."""

    @property
    def version(self) -> str:
        """Text that its version must contain."""

    @property
    def homing(self) -> bool:
        """$H may be used."""

    @property
    def homing_timeout_s(self) -> float:
        """Longest time that homing may take [s]."""

    @property
    def quick_stop(self) -> str:
        """The fastest stop: reset or cancel."""

    @property
    def poll_hz(self) -> float:
        """Rate of status reports."""


class GrblUnit(AxesUnit):
    """One controller: all motion is jogs, which can be cancelled with the position kept.

    Args:
        name: for messages.
        settings: of the device.
        axes: its axes as the bank knows them.
        spec: their block.
        kit: services.
        greets_each: it greets each new connection, so that a greeting at the opening is no restart.
        given: as of AxesUnit.

    Concurrency: the one thread of the driver process.
    """

    def __init__(
        self,
        name: str,
        settings: Options,
        axes: Sequence[AxisSettings],
        spec: BlockSpec,
        kit: Kit,
        *,
        greets_each: bool = False,
        **given: Any,
    ) -> None:
        super().__init__(name, axes, spec, kit, **given)
        self._settings = settings
        self._greets_each = greets_each
        n = len(settings.axis)
        self._letters = [axis.letter for axis in settings.axis]
        self._index = [grbl.LETTERS.index(letter) for letter in self._letters]
        self._place = MachinePosition(self._index, name)
        self._per_unit = np.array([1000.0 if axis.unit == "m" else 180 / math.pi for axis in settings.axis])
        self._alarm = 0
        self._state = ""
        self._rest = b""
        self._moves = GrblMoves(self._per_unit)
        rates = np.array([axis.acceleration_max for axis in settings.axis]) * self._per_unit
        self._chain = JogChain(self._letters, rates, settings.poll_hz)
        self._homing = GrblHoming()
        self._last: tuple[int, Any] | None = None
        self._seen: Any = None
        """Positions that were read last [unit]; None before the first report, and from a homing to its end."""
        self._seen_ns = [0, 0]
        """When the last report but one came, and the last."""
        self._still = False
        """The last report was of rest, and nothing that moves was sent since."""
        self._top = np.zeros(n)
        """Speeds that the controller can reach [unit/s]."""
        self._replaces = [False] * n
        self._clean = self._restarted = self._deaf = False
        """Nothing was started since all were stopped; the controller has greeted; it waits for a reset."""
        self._reset_ns = self._silent_until_ns = self._greets_until_ns = 0
        """Last reset of ours; until when it hears nothing behind an alarm, and a greeting is of that alarm's reset."""

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Stop what moves, identify the controller, and compare its limits with the configuration."""
        yield from self._noting_restart(self._open())

    def _open(self) -> Steps:
        self._alarm, self._last, self._clean = 0, None, False
        self._homing.forget()
        self._forget()
        was_locked = self._state == "Alarm"
        report, in_motion, greeted = yield from grbl_opening.to_rest(self.clock, self._hear_report)
        greeted = (greeted or self._restarted) and not self._greets_each
        self._reset_ns, self._restarted, self._deaf = self.clock(), False, False
        if in_motion:
            self._lose_places("it did not brake, so it was reset in motion")
        yield from grbl_opening.identify(self.name, self._settings.version)
        answer: Answer = yield grbl.command("$$", TIMEOUT_S, repeatable=True)
        found = answer.settings()
        self._place.in_report = 25.4 if found.get(INCHES) else 1.0
        told = [found.get(SPEED + index, 0.0) / 60 for index in self._index]
        own = np.array([axis.velocity_max for axis in self.bank.settings])
        self._top = np.maximum(np.array(told) / self._per_unit, own)
        axes, log = self.bank.settings, self._kit.log
        grbl_opening.compare(self.name, found, axes, self._index, self._per_unit.tolist(), log)
        for _ in range(OFFSET_REPORTS):
            self._state = report.state
            if self._place.note(report):
                break
            report, _ = yield grbl.status(TIMEOUT_S)
        here = self._place.of(report) / self._per_unit
        is_locked = report.state == "Alarm" and not was_locked
        if self._seen is not None and (greeted or is_locked or self._counts_anew(here)):
            self._lose_places(STARTED_ANEW)
        elif self._seen is not None and self._still and self._is_off(here - self._seen):
            self._lose_places("position lost: it rested, and is elsewhere than before the link was lost")
        self._note_place(here)

    def poll(self) -> Steps:
        """Read the status, and keep velocities going."""
        if self._homing.is_on:  # the controller is deaf while it homes; its ok is overheard
            if self._homing.failure == "":
                report, _ = yield grbl.status(STATUS_S)
                self._raw = self._positions(report)
            self._report_homing()
            return
        if self._is_silent():
            self._tell_alarm()
            return
        if self._deaf:
            yield from self._reset_now()
        try:
            report, lines = yield grbl.status(STATUS_S)
        except StateLost:
            self._note_restart()
            if self._restarted:
                self._lose_places(STARTED_ANEW)
            raise
        self._listen(lines)
        self._look_for_jump(report)
        if self._restarted:
            self._lose_places(STARTED_ANEW)
            raise StateLost(f"{self.name}: {STARTED_ANEW}")
        self._hear(lines)
        self._take(report)
        if self._moves.interrupted:
            yield from self._go_on()
        elif self._chain.wanted.any() and self._state in ("Idle", "Jog"):
            yield from self._lengthen(report)

    def act(self, action: DriveAction) -> Steps:
        """Note a move that is asked for, so that those of other axes that go out now share its line."""
        axis, command = action.axis, action.command
        self._moves.asked.pop(axis, None)
        moves = command is not None and bool(command.control_mode & ControlMode.POSITION)
        if action.kind is not ActionKind.RESET:
            goes = self._state == "Jog" and self._moves.is_on_its_way(axis, self._raw[axis])
            self._replaces[axis] = goes or (moves and self._chain.wanted[axis] != 0)
            self._moves.drop(axis)
            if moves or command is None:
                self._chain.wanted[axis] = 0.0
        if action.kind is ActionKind.START and moves and command is not None:
            self._moves.asked[axis] = (command.position, action.velocity_max)
        return self._noting_restart(super().act(action))

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Jog to a position, together with all axes whose moves were asked for at the same time."""
        if axis in self._moves.asked:
            self._moves.asked[axis] = (position, speed)
            yield Pause(TOGETHER_S)
            yield from self._end_replaced(axis)
            if together := self._moves.take(self._raw):
                yield from self._jog_to(together)
        if error := self._moves.refused.pop(axis, None):
            raise error

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Begin, change or end a chain of jogs; polls keep it going."""
        if velocity == 0:
            self._chain.wanted[axis] = 0.0
            yield self._cancel()
            return
        yield from self._end_replaced(axis)
        per_unit = float(self._per_unit[axis])
        self._chain.start(axis, velocity * per_unit, float(self._raw[axis]) * per_unit)
        self._clean = False

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Cancel jogs and keep the position; or reset, which is the only end of homing and loses it in motion."""
        self._chain.wanted[axis] = 0.0
        self._moves.drop(axis)
        if not self._homing.is_on and not fastest:
            yield self._cancel()
            return
        self._forget()
        if self._clean or self._is_silent():
            return  # nothing was started since all axes were stopped for another one, or an alarm has ended it
        rests = False
        if not self._homing.is_on and self._settings.quick_stop != "reset":
            rests = yield from grbl_opening.brake(self.clock, self._take_heard, self._braking_s())
        if not rests or self._state == "Hold":  # a hold keeps a program of somebody else
            yield from self._reset_now()
        self._clean = True

    def _braking_s(self) -> float:
        """Return how long the slowest axis takes to brake from its top speed, and what the line takes."""
        return max(axis.velocity_max / axis.acceleration_max for axis in self.bank.settings) + LATE_S

    def _reset_now(self) -> Steps:
        was = self._state
        if self._is_silent():
            yield Pause((self._silent_until_ns - self.clock()) / 1e9)
        self._reset_ns = self.clock()
        lines = yield grbl.reset(RESET_S)
        self._reset_ns = self.clock()
        self._homing.forget()
        self._hear(lines)
        self._deaf, self._silent_until_ns = False, 0
        if was in ("Jog", "Run", "Home"):
            self._lose_places(grbl.alarm_text(3))

    def stop(self) -> Steps:
        """Stop whatever goes on."""
        self._clean = False
        self._forget()
        yield from self._noting_restart(super().stop())

    def home(self, axis: int) -> Steps:
        """Begin homing, of all axes; those that are told to home together home once."""
        if self._homing.is_on:
            return
        self._homing.begin(self.clock())
        self._clean, self._seen, self._rest = False, None, b""  # the rest of a cut line was in a reply
        for each in range(self.bank.n):
            self._moves.drop(each)
        yield Send(b"$H\n", "home all axes")

    def reset(self, axis: int) -> Steps:
        """Unlock the controller; a critical alarm needs a reset before."""
        state = "Alarm"
        if self._is_silent():
            yield Pause((self._silent_until_ns - self.clock()) / 1e9)
        try:
            report, lines = yield grbl.status(TIMEOUT_S)
        except LinkError:  # some alarms wait for a reset, and hear nothing else
            pass
        else:
            self._hear(lines)
            state = report.state
        if state in ("Alarm", "Sleep", "Hold", "Door", "Check"):
            yield from self._reset_now()
        if state in ("Alarm", "Sleep"):
            yield grbl.command("$X", TIMEOUT_S)
        self._alarm = 0

    def overhear(self, data: bytes, now_ns: int) -> None:
        """Take unsolicited messages of the controller: alarms, the end of homing, its banner after a reset."""
        self._rest += data
        lines = grbl.lines_of(self._rest)
        self._rest = self._rest[self._rest.rfind(b"\n") + 1 :][-grbl.LINE_LIMIT :]
        self._hear(lines)
        if grbl.alarm_of(lines):
            self._silent_until_ns = self.clock() + int(grbl.ALARM_S * 1e9)
        self._listen(lines)
        if self._homing.is_on:  # told to the bank by the next poll, which publishes it
            self._homing.hear(lines, self._alarm)

    # --- inside ----------------------------------------------------------------------------------

    def _forget(self) -> None:
        self._moves.forget()
        self._chain.wanted[:] = 0.0
        self._chain.cut()

    def _cancel(self) -> Send:
        """Return what cancels the jogs of all axes; those that nobody has stopped go on after it."""
        self._chain.cut()
        self._moves.interrupted = bool(self._moves.bound.any() or self._chain.wanted.any())
        return Send(grbl.JOG_CANCEL, "cancel jogs")

    def _go_on(self) -> Steps:
        """Let the axes that nobody has stopped go on, once all have come to rest."""
        if self._state == "Jog":
            return
        if self._state == "Idle":
            self._chain.restart(self._raw * self._per_unit)
            if left := self._moves.left(self._raw):
                yield from self._jog_to(left)
            for axis in left:
                if error := self._moves.refused.pop(axis, None):
                    self.bank.fault(
                        [axis],
                        f"{self.name}: could not go on after a stop of another axis: {error}",
                        self.clock(),
                    )
        self._moves.interrupted = False

    def _hear(self, lines: Sequence[str]) -> None:
        number = grbl.alarm_of(lines)
        if number:
            self._alarm, self._deaf = number, number in grbl.DEAF
            until_ns = self.clock() + int(grbl.ALARM_S * 1e9)
            self._greets_until_ns = until_ns + OWN_RESET_NS if number in grbl.RESETTING else 0
            if number not in grbl.POSITION_KEPT:
                self._lose_places(grbl.alarm_text(number))

    def _is_silent(self) -> bool:
        """Tell whether it tells an alarm, and hears nothing meanwhile."""
        return self.clock() < self._silent_until_ns

    def _tell_alarm(self) -> None:
        """Tell the bank of an alarm where the controller cannot be asked: moving until it has told where it stands."""
        n, rows = self.bank.n, self.bank.rows
        self.report(
            self._raw, np.zeros(n), rows["in_motion"] > 0, np.zeros(n, bool), [grbl.alarm_text(self._alarm)] * n
        )

    def _listen(self, lines: Sequence[str]) -> None:
        """Hear that the controller has started anew; not of the greeting that a reset of ours has brought."""
        if grbl.greets(lines):
            self._note_restart()

    def _note_restart(self) -> None:
        """Note that it has greeted: the next poll tells; not of the second greeting that a reset of
        ours has brought.
        """
        if self.clock() - self._reset_ns > OWN_RESET_NS and self.clock() > self._greets_until_ns:
            self._restarted = True

    def _noting_restart(self, steps: Steps) -> Steps:
        """Carry out steps; a greeting in the middle of them is told by the next poll."""
        try:
            yield from steps
        except StateLost:
            self._note_restart()
            raise

    def _look_for_jump(self, report: Report) -> None:
        """Hear of a new start by the place, should the greeting be lost: it counts from 0, where no axis can have come
        so soon.
        """
        if self._seen is None or not self._place.note(report):
            return
        here = self._place.of(report) / self._per_unit
        # its report of before may be as old as the one before that, if this process or the line was late
        way = 1.1 * self._top * (self.clock() - self._seen_ns[0]) / 1e9
        if self._is_zero(here) and (np.abs(self._seen) > way + SAME_PLACE / self._per_unit).any():
            self._restarted = True

    def _is_zero(self, here: Any) -> bool:
        return bool((np.abs(here) * self._per_unit < SAME_PLACE / 10).all())

    def _counts_anew(self, here: Any) -> bool:
        """Tell whether the controller is at 0 and was not before the line was lost."""
        return self._is_zero(here) and self._is_off(self._seen)

    def _is_off(self, way: Any) -> bool:
        return bool((np.abs(way) * self._per_unit > SAME_PLACE).any())

    def _note_place(self, here: Any) -> None:
        self._seen, self._seen_ns = here, [self._seen_ns[1], self.clock()]

    def _lose_places(self, text: str) -> None:
        for axis in range(self.bank.n):
            self.lose_place(axis, text)

    def _hear_report(self, report: Report, lines: Sequence[str]) -> None:
        self._hear(lines)

    def _take_heard(self, report: Report, lines: Sequence[str]) -> None:
        self._hear(lines)
        self._listen(lines)
        self._look_for_jump(report)
        self._take(report)

    def _take(self, report: Report) -> None:
        """Tell the bank what a report says."""
        now_ns = self.clock()
        position = self._positions(report)
        self._note_place(position)
        self._still = report.state not in grbl_opening.MOVING
        self._still &= not (self._moves.bound.any() or self._chain.wanted.any())
        velocity = np.zeros(self.bank.n)
        if self._last is not None and now_ns > self._last[0]:
            velocity = (position - self._last[1]) / ((now_ns - self._last[0]) / 1e9)
        self._last = now_ns, position
        busy = report.state == "Jog" or (report.state == "Hold" and report.sub == 1)
        if not busy and report.state != "Alarm":
            velocity[:] = 0.0
        arrived = self._moves.arrived(position)
        goes = self._moves.bound | (self._chain.wanted != 0)
        moving = ~arrived & (np.full(self.bank.n, busy) | (goes & self._moves.interrupted))
        fault = self._fault(report)
        self.report(position, velocity, moving, arrived, [fault] * self.bank.n)

    def _positions(self, report: Report) -> Any:
        """Return the positions of our axes [unit], and keep what the report tells beside them."""
        self._state = report.state
        if report.state in ("Jog", "Run", "Home"):
            self._clean = False
        self._place.note(report)
        return self._place.of(report) / self._per_unit

    def _fault(self, report: Report) -> str:
        if report.state != "Alarm":
            return NOT_READY.get(report.state, "") if report.sub != 1 else ""
        if self._alarm or report.sub > 0:
            return grbl.alarm_text(self._alarm or report.sub)
        return "" if self._settings.homing else "the controller is locked; RESET unlocks it"

    def _end_replaced(self, axis: int) -> Steps:
        """Cancel the jog that a command replaces, and wait for rest: the planner would finish it first."""
        if not self._replaces[axis]:
            return
        self._replaces[axis] = False
        yield self._cancel()
        if not (yield from grbl_opening.brake(self.clock, self._take_heard, self._braking_s())):
            raise DeviceError(errno.EIO, "the jog that it replaces was cancelled, but the axes are still moving")

    def _jog_to(self, together: Moves) -> Steps:
        """Send one line for these axes."""
        line = straight_jog(self._letters, self._raw * self._per_unit, self._moves.begin(together))
        self._clean = self._still = False
        try:
            yield grbl.command(line, TIMEOUT_S)
        except StateLost as error:
            self._restarted = True
            self._moves.refuse(together, error)
        except (DeviceError, LinkError, ValueError) as error:
            errno_ = errno.EINVAL if isinstance(error, ValueError) else errno.EIO
            refusal = error if isinstance(error, DeviceError) else DeviceError(errno_, str(error))
            self._moves.refuse(together, refusal)

    def _lengthen(self, report: Report) -> Steps:
        """Lengthen the chain of jogs until it reaches far enough ahead to run at full speed and to brake at its end."""
        # many controllers are set not to tell how many places are free ($10), so its own are counted
        busy = self._chain.blocks(self._raw * self._per_unit) + int(self._moves.bound.sum())
        if 0 <= report.free_blocks < 2 or busy >= CHAIN_BLOCKS:
            return
        offset = self.bank.rows["position"] - self._raw
        low, high = self._soft_limits()
        found = self._chain.next(self.clock(), (low - offset) * self._per_unit, (high - offset) * self._per_unit)
        if found is None:
            return
        line, targets, until_ns = found
        wanted = self._chain.wanted.copy()
        self._still = False
        try:
            yield grbl.command(line, TIMEOUT_S)
        except StateLost:  # the line has gone out to a controller at another place; the opening cancels it
            self._lose_places(STARTED_ANEW)
            raise
        if (self._chain.wanted == wanted).all() and not self._moves.interrupted:
            self._chain.sent(targets, until_ns)

    def _soft_limits(self) -> tuple[Any, Any]:
        limits = self.bank.get_limits(range(self.bank.n))
        low = np.array([-np.inf if v is None else v for v in limits["position_min"]])
        high = np.array([np.inf if v is None else v for v in limits["position_max"]])
        return low, high

    def _report_homing(self) -> None:
        """Tell the bank that it homes, or how that ended."""
        n = self.bank.n
        self._homing.watch(self.clock(), self._settings.homing_timeout_s)
        ended, fault = self._homing.failure is not None, self._homing.failure or ""
        done = np.full(n, ended and not fault)
        self.report(self._raw, np.zeros(n), np.full(n, not ended), done, [fault] * n)
        if fault and self._alarm == 0:
            return  # it may still search: the stop that the fault brings ends it by a reset
        if ended:
            self._last = None
            self._homing.forget()
        if ended and not fault:
            self.bank.set_homed(range(n))
