"""Controllers with Grbl 1.1, grblHAL or FluidNC on a serial line or TCP, three to nine axes.

All motion is jogging, which can be cancelled without losing the position. A velocity is a chain of short jogs to absolute
positions, so it ends by itself soon after the host falls silent; Grbl has no other dead-man. The controller has one
planner: axes whose commands go out together (synch) move together on a straight line, other commands follow one another.

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

import errno
import math
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np

from sioms.motion import ActionKind, DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk import drive_axes
from sioms.sdk.blocks import BlockSpec, Description
from sioms.sdk.codec import grbl
from sioms.sdk.codec.grbl import Answer, Report
from sioms.sdk.drive_axes import BANK_MODES, POSITION_MODES, AxesUnit, drive_table
from sioms.sdk.driver import Kit, LineDriver, LineUnit
from sioms.sdk.exchange import DeviceError, LinkError, Pause, Send, Steps
from sioms.sdk.golden import Golden
from sioms.sdk.settings import LineSettings

MODES = (POSITION_MODES | ControlMode.VELOCITY | BANK_MODES) & ~ControlMode.SPECIFIED_MAX_VEL_ACC
"""The acceleration is a setting of the controller: a command cannot carry its own."""
TIMEOUT_S = 0.5
RESET_S = 3.0
HOLD_S = 5.0
TOGETHER_S = 0.0005
"""How long a start waits for the starts of other axes that go out with it."""
AT_MM = 0.002
"""So near to its target an axis has arrived [mm or degrees]; reports have three digits."""
SPEED, ACCELERATION, INCHES = 110, 120, 13
PLANNER_BLOCKS = 15
OFFSET_REPORTS = 35
"""The work offset comes with every 30th report at the latest."""
NOT_READY = {
    "Hold": "feed hold; release it at the controller", "Door": "the safety door is open", "Sleep": "the controller sleeps",
    "Check": "the controller is in check mode", "Run": "the controller runs a program of somebody else",
}  # fmt: skip

AxisTable: Any = drive_table(
    {"letter": (Literal["X", "Y", "Z", "A", "B", "C", "U", "V", "W"], "X"), "home_required": (bool, False)}
)
"""Keys of an axis: those of AxisSettings that a drive of its own loop leaves, and

letter: of the axis in the controller; home_required: no motion before homing. A unit of "rad" takes the controller's number for degrees.
"""


class GrblSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        line: to the controller.
        axis: its axes in use.
        version: text that its version must contain, e.g. "1.1h"; '' takes any.
        homing: the controller's homing ($H, all axes) may be used.
        homing_timeout_s: longest time that homing may take [s].
        quick_stop: "reset" stops at once and loses the position, "cancel" brakes and keeps it.
        poll_hz: rate of status reports; 5 to 10 is the firmware's advice, 20 to 50 works on an idle line.
        capacity: commands that each axis buffers.
        history: snapshots kept for readers.
    """

    line: LineSettings
    axis: list[AxisTable]
    version: str = ""
    homing: bool = False
    homing_timeout_s: float = 120.0
    quick_stop: Literal["reset", "cancel"] = "reset"
    poll_hz: float = 20.0
    capacity: int = 4096
    history: int = 64


class GrblUnit(AxesUnit):
    """One controller."""

    def __init__(self, name: str, settings: GrblSettings, spec: BlockSpec, kit: Kit, **given: Any) -> None:
        super().__init__(name, _axes(settings), spec, kit, **given)
        self._settings = settings
        n = len(settings.axis)
        self._letters = [axis.letter for axis in settings.axis]
        self._index = [grbl.LETTERS.index(letter) for letter in self._letters]
        self._per_unit = np.array([1000.0 if axis.unit == "m" else 180 / math.pi for axis in settings.axis])
        self._in_report = 1.0
        self._work_offset: tuple[float, ...] = ()
        self._alarm = 0
        self._state = ""
        self._rest = b""
        self._targets = np.full(n, np.nan)
        self._wanted = np.zeros(n)
        self._asked: dict[int, tuple[float, float]] = {}
        self._refused: dict[int, DeviceError] = {}
        self._jog_end = np.zeros(n)
        self._jogged_ns = 0
        self._homing_ns = 0
        self._homing_end: str | None = None
        self._last: tuple[int, Any] | None = None
        self._replaces = [False] * n
        self._clean = False

    # --- hooks ----------------------------------------------------------------------------------

    def open(self) -> Steps:
        """Stop what moves, identify the controller, and compare its limits with the configuration."""
        self._homing_ns, self._alarm, self._last = 0, 0, None
        self._forget()
        yield Send(b"\n" + grbl.JOG_CANCEL, "end a cut line, cancel jogs")
        yield Pause(0.1)
        try:
            report, _ = yield grbl.status(TIMEOUT_S)
        except LinkError:  # booting, or deaf because it homes: only a reset ends that
            yield grbl.reset(RESET_S)
            report, _ = yield grbl.status(TIMEOUT_S)
        if report.state in ("Run", "Hold"):
            yield from self._hold_and_reset()
        answer: Answer = yield grbl.command("$I", TIMEOUT_S, repeatable=True)
        version = answer.tagged("VER")
        if not version or self._settings.version not in version:
            text = f"identify {self.name}: version {version or 'not told'}; the configuration says "
            raise DeviceError(errno.ENODEV, f"{text}{self._settings.version or 'a Grbl controller'}")
        found: Answer = yield grbl.command("$$", TIMEOUT_S, repeatable=True)
        self._compare(found.settings())
        for _ in range(OFFSET_REPORTS):
            if self._note(report).machine is not None or self._work_offset:
                break
            report, _ = yield grbl.status(TIMEOUT_S)

    def poll(self) -> Steps:
        """Read the status, and keep velocities going."""
        if self._homing_ns:  # the controller is deaf while it homes; its ok is overheard
            if self._homing_end == "":
                report, _ = yield grbl.status(TIMEOUT_S)
                self._raw = self._machine(self._note(report)) / self._per_unit
            self._report_homing()
            return
        report, lines = yield grbl.status(TIMEOUT_S)
        self._hear(lines)
        self._take(report)
        if self._wanted.any() and self._state in ("Idle", "Jog"):
            yield from self._chain(report)

    def act(self, action: DriveAction) -> Steps:
        """Note a move that is asked for, so that those of other axes that go out now share its line."""
        axis, command = action.axis, action.command
        self._asked.pop(axis, None)
        moves = command is not None and bool(command.control_mode & ControlMode.POSITION)
        if action.kind is not ActionKind.RESET:
            goes = (
                self._state == "Jog"
                and abs(self._raw[axis] * self._per_unit[axis] - self._targets[axis]) > AT_MM
            )
            self._replaces[axis] = goes or (moves and self._wanted[axis] != 0)
            self._targets[axis] = np.nan
            if moves or command is None:
                self._wanted[axis] = 0.0
        if action.kind is ActionKind.START and moves and command is not None:
            self._asked[axis] = (command.position, action.velocity_max)
        return super().act(action)

    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Jog to a position, together with all axes whose moves were asked for at the same time."""
        if axis in self._asked:
            self._asked[axis] = (position, speed)
            yield Pause(TOGETHER_S)
            yield from self._end_replaced(axis)
            together, self._asked = self._asked, {}
            if together:
                yield from self._jog_to(together)
        if error := self._refused.pop(axis, None):
            raise error

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Begin, change or end a chain of jogs; polls keep it going."""
        if velocity == 0:
            self._wanted[axis] = 0.0
            yield Send(grbl.JOG_CANCEL, "cancel jogs")
            return
        yield from self._end_replaced(axis)
        if self._wanted[axis] == 0:
            self._jog_end[axis] = self._raw[axis] * self._per_unit[axis]
        self._wanted[axis] = velocity
        self._clean = False

    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Cancel jogs and keep the position; or reset, which is the fastest and the only end of homing."""
        self._wanted[axis], self._targets[axis] = 0.0, np.nan
        self._jogged_ns = 0
        if not self._homing_ns and not (fastest and self._settings.quick_stop == "reset"):
            yield Send(grbl.JOG_CANCEL, "cancel jogs")
            return
        if self._clean:
            return  # nothing was started since the reset for another axis
        lines = yield grbl.reset(RESET_S)
        self._clean, self._homing_ns = True, 0
        self._hear(lines)

    def stop(self) -> Steps:
        """Stop whatever goes on."""
        self._clean = False
        self._forget()
        yield from super().stop()

    def home(self, axis: int) -> Steps:
        """Begin homing, of all axes; those that are told to home together home once."""
        if self._homing_ns:
            return
        self._homing_ns, self._homing_end, self._clean = self.clock(), None, False
        self._targets[:] = np.nan
        yield Send(b"$H\n", "home all axes")

    def reset(self, axis: int) -> Steps:
        """Unlock the controller; a critical alarm needs a reset before."""
        report, lines = yield grbl.status(TIMEOUT_S)
        self._hear(lines)
        if report.state in ("Alarm", "Sleep", "Hold", "Door"):
            yield grbl.reset(RESET_S)
            yield grbl.command("$X", TIMEOUT_S)
        elif report.state == "Check":
            yield grbl.command("$C", TIMEOUT_S)
        self._alarm = 0

    def overhear(self, data: bytes, now_ns: int) -> None:
        """Take what the controller says unasked: alarms, the end of homing, the banner after a reset of its own."""
        self._rest += data
        lines = grbl.lines_of(self._rest)
        self._rest = self._rest[self._rest.rfind(b"\n") + 1 :][-grbl.LINE_LIMIT :]
        self._hear(lines)
        if not self._homing_ns:
            return
        for line in lines:  # told to the bank by the next poll, which publishes it
            if line == "ok":
                self._homing_end = ""
            elif line.startswith(("error:", "ALARM:")):
                self._homing_end = grbl.alarm_text(self._alarm) if self._alarm else f"homing refused: {line}"

    # --- inside ----------------------------------------------------------------------------------

    def _forget(self) -> None:
        self._targets[:], self._wanted[:] = np.nan, 0.0
        self._asked.clear()
        self._refused.clear()
        self._jogged_ns = 0

    def _hold_and_reset(self) -> Steps:
        """End a program with its position kept: hold, wait for rest, reset."""
        yield Send(grbl.HOLD, "feed hold")
        limit_ns = self.clock() + int(HOLD_S * 1e9)
        while self.clock() < limit_ns:
            yield Pause(0.05)
            report, _ = yield grbl.status(TIMEOUT_S)
            if (report.state, report.sub) == ("Hold", 0) or report.state == "Idle":
                break
        yield grbl.reset(RESET_S)

    def _compare(self, found: dict[int, float]) -> None:
        """Compare the controller's limits with the configured ones; FluidNC does not tell them by number."""
        self._in_report = 25.4 if found.get(INCHES) else 1.0
        for axis, (index, per_unit) in enumerate(zip(self._index, self._per_unit, strict=True)):
            settings = self.bank.settings[axis]
            speed, rate = found.get(SPEED + index), found.get(ACCELERATION + index)
            if speed is None or rate is None:
                self._kit.log(
                    "warning", f"{self.name} {settings.name}: the controller does not tell its limits"
                )
                continue
            speed, rate = speed / 60 / per_unit, rate / per_unit
            if settings.velocity_max > speed * 1.001:
                text = f"velocity_max = {settings.velocity_max:g}, but ${SPEED + index} of the controller is {speed:g}"
                raise DeviceError(
                    errno.ERANGE, f"open {self.name}: axis {settings.name}: {text}; want at most that"
                )
            if not 0.95 < settings.acceleration_max / rate < 1.05:
                text = f"acceleration_max = {settings.acceleration_max:g}, but ${ACCELERATION + index} of the controller"
                raise DeviceError(
                    errno.ERANGE, f"open {self.name}: axis {settings.name}: {text} is {rate:g}; want that"
                )

    def _hear(self, lines: Sequence[str]) -> None:
        number = grbl.alarm_of(lines)
        if number:
            self._alarm = number
            if number not in grbl.POSITION_KEPT:
                self.bank.set_homed(range(self.bank.n), False)

    def _take(self, report: Report) -> None:
        """Tell the bank what a report says."""
        now_ns = self.clock()
        position = self._machine(self._note(report)) / self._per_unit
        velocity = np.zeros(self.bank.n)
        if self._last is not None and now_ns > self._last[0]:
            velocity = (position - self._last[1]) / ((now_ns - self._last[0]) / 1e9)
        self._last = now_ns, position
        busy = report.state == "Jog" or (report.state == "Hold" and report.sub == 1)
        if not busy and report.state != "Alarm":
            velocity[:] = 0.0
        arrived = np.abs(position * self._per_unit - self._targets) <= AT_MM
        moving = (
            np.full(self.bank.n, busy) & ~arrived & (np.isfinite(self._targets) | (self._wanted != 0) | busy)
        )
        fault = self._fault(report)
        self.report(position, velocity, moving, arrived, [fault] * self.bank.n)

    def _note(self, report: Report) -> Report:
        """Keep what not every report tells."""
        self._state = report.state
        self._work_offset = report.offset or self._work_offset
        return report

    def _machine(self, report: Report) -> Any:
        """Return the machine positions of our axes [mm or degrees]."""
        values = report.machine
        if values is None and report.work is not None and len(self._work_offset) == len(report.work):
            values = tuple(w + o for w, o in zip(report.work, self._work_offset, strict=True))
        if values is None or max(self._index) >= len(values):
            known = len(values) if values is not None else 0
            text = f"read {self.name}: the report tells {known} machine positions; {max(self._index) + 1} are needed"
            raise DeviceError(errno.ENODEV, f"{text}, set $10=1 or look at the letters of the axes")
        return np.array([values[index] for index in self._index]) * self._in_report

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
        self._replaces[axis], self._jogged_ns = False, 0
        yield Send(grbl.JOG_CANCEL, "cancel jogs")
        limit_ns = self.clock() + int(HOLD_S * 1e9)
        while self.clock() < limit_ns:
            yield Pause(0.02)
            report, lines = yield grbl.status(TIMEOUT_S)
            self._hear(lines)
            self._take(report)
            if report.state not in ("Jog", "Hold"):
                return

    def _jog_to(self, together: dict[int, tuple[float, float]]) -> Steps:
        """Send one line for these axes, so fast that none passes its own speed."""
        targets = {axis: position * float(self._per_unit[axis]) for axis, (position, _) in together.items()}
        ways = {axis: abs(targets[axis] - float(self._raw[axis] * self._per_unit[axis])) for axis in targets}
        length = math.hypot(*ways.values())
        slowest_s = max(ways[a] / (speed * self._per_unit[a]) for a, (_, speed) in together.items())
        first = next(iter(together))
        feed = length / slowest_s if slowest_s else together[first][1] * self._per_unit[first]
        line = grbl.jog({self._letters[axis]: target for axis, target in targets.items()}, 60 * float(feed))
        self._clean = False
        for axis, target in targets.items():
            self._targets[axis] = target
        try:
            yield grbl.command(line, TIMEOUT_S)
        except (DeviceError, ValueError) as error:
            refusal = error if isinstance(error, DeviceError) else DeviceError(errno.EINVAL, str(error))
            for axis in targets:
                self._targets[axis], self._refused[axis] = np.nan, refusal

    def _chain(self, report: Report) -> Steps:
        """Lengthen the chain of jogs until it reaches far enough ahead to run at full speed and to brake at its end."""
        now_ns = self.clock()
        if 0 <= report.free_blocks < 2:
            return
        rates = np.array([s.acceleration_max for s in self.bank.settings])
        ahead_s = max(
            3 / self._settings.poll_hz,
            float((np.abs(self._wanted) / rates).max()) / 2 + 2 / self._settings.poll_hz,
        )
        begin_ns = max(self._jogged_ns, now_ns)
        duration_s = now_ns / 1e9 + ahead_s - begin_ns / 1e9
        if duration_s < max(0.01, ahead_s / (PLANNER_BLOCKS - 3)):
            return
        offset = (self.bank.fields[0] - self._raw) * self._per_unit
        low, high = self._soft_limits()
        targets = self._jog_end + self._wanted * self._per_unit * duration_s
        targets = np.clip(targets, low * self._per_unit - offset, high * self._per_unit - offset)
        targets = np.where(self._wanted != 0, targets, self._jog_end)
        way = targets - self._jog_end
        if float(np.abs(way).max()) < 1e-4:
            return  # at the soft limit: the chain ends there
        words = {self._letters[a]: float(targets[a]) for a in np.flatnonzero(self._wanted).tolist()}
        full = float(np.linalg.norm(self._wanted * self._per_unit))
        wanted = self._wanted.copy()
        yield grbl.command(grbl.jog(words, 60 * full), TIMEOUT_S)
        if (self._wanted == wanted).all():
            self._jog_end, self._jogged_ns = targets, begin_ns + int(duration_s * 1e9)

    def _soft_limits(self) -> tuple[Any, Any]:
        limits = self.bank.get_limits(range(self.bank.n))
        low = np.array([-np.inf if v is None else v for v in limits["position_min"]])
        high = np.array([np.inf if v is None else v for v in limits["position_max"]])
        return low, high

    def _report_homing(self) -> None:
        """Tell the bank that it homes, or how that ended."""
        n = self.bank.n
        if (
            self._homing_end is None
            and self.clock() - self._homing_ns > self._settings.homing_timeout_s * 1e9
        ):
            self._homing_end = f"homing took longer than {self._settings.homing_timeout_s:g} s"
        ended, fault = self._homing_end is not None, self._homing_end or ""
        done = np.full(n, ended and not fault)
        self.report(self._raw, np.zeros(n), np.full(n, not ended), done, [fault] * n)
        if fault and self._alarm == 0:
            return  # it may still search: the stop that the fault brings ends it by a reset
        if ended:
            self._homing_ns, self._last = 0, None
        if ended and not fault:
            self.bank.set_homed(range(n))


class Grbl(LineDriver):
    """One controller on its line.

    Concurrency: the one thread of the driver process.
    """

    Settings = GrblSettings

    @classmethod
    def describe(cls, name: str, settings: GrblSettings) -> Description:
        """Tell the axes; raises ValueError for what the controller could not carry out."""
        if not settings.axis:
            raise ValueError("axis: none given; want a table [[...axis]] for each axis")
        drive_axes.check_rate(settings.poll_hz, 50)
        letters = [axis.letter for axis in settings.axis]
        for letter in letters:
            if letters.count(letter) > 1:
                raise ValueError(f"axis: {letters.count(letter)} axes have letter = {letter}; want one each")
        if settings.line.udp:
            raise ValueError("line = udp: Grbl speaks on serial and tcp")
        spec = drive_axes.axis_spec("", _axes(settings), "Grbl axis", settings.capacity, settings.history)
        return Description((spec,), settings.poll_hz, lease_s=max(0.5, 5 / settings.poll_hz))

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
        unit = GrblUnit(name, settings, self.describe(name, settings).blocks[0], kit, settle_s=0.1)
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
