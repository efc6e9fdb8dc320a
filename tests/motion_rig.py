"""Rig for tests of the motion core: a bank on the real marker table, ticked by an invented clock."""

from __future__ import annotations

import errno
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sioms.motion import ActionKind, AxisBank, AxisSettings, CommandError, DriveBank, Event, EventKind, Keeper
from sioms.motion.commands import WIRE_DTYPE
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.markers import TABLE_SIZE, MarkerTable, split_token, token_of
from sioms.protocol.records import read_rows

TICK_NS = 1_000_000
MODE = ControlMode


class Markers:
    """The marker table as a port, with keys that a test can name. ``signals`` lists (number, now_ns)."""

    def __init__(self) -> None:
        self.table = MarkerTable(memoryview(bytearray(TABLE_SIZE)))
        self.signals: list[tuple[int, int]] = []

    def reserve(self, number: int) -> int:
        """Reserve a number and return its token."""
        self.table.reserve(number, 1000 + number)
        return token_of(number, 1000 + number)

    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        """Resolve as the kit does."""
        number, key = split_token(token_or_number)
        if not self.table.is_reserved(number):
            raise CommandError(errno.EINVAL, f"marker {number} is not reserved")
        if signal and not self.table.is_key(number, key):
            raise CommandError(errno.EPERM, f"marker {number}: wrong key")
        return number, self.table.generation(number)

    def state(self, number: int, generation: int) -> bool | None:
        """Look at the table."""
        if self.table.is_signalled(number, generation):
            return True
        return None if self.table.generation(number) != generation else False

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        """Signal and remember when."""
        if self.table.signal(number, generation, now_ns):
            self.signals.append((number, now_ns))


def records(**fields: Any) -> np.ndarray:
    """Return write records; ``mode`` is control_mode, sequences become several records."""
    fields["control_mode"] = fields.pop("mode")
    size = max((len(v) for v in fields.values() if isinstance(v, Sequence | np.ndarray)), default=1)
    written = np.zeros(size, dtype=WIRE_DTYPE)
    for name, value in fields.items():
        if name == "control_mode":
            value = [int(m) for m in value] if isinstance(value, list) else int(value)
        written[name] = value
    return written


def axis(**changes: Any) -> AxisSettings:
    """Return a quick axis with round numbers: 2 m/s, 5 m/s^2, 100 m/s^3, +-3 m, 10 N."""
    given = {
        "name": "x", "position_min": -3.0, "position_max": 3.0, "velocity_max": 2.0, "acceleration_max": 5.0,
        "jerk_max": 100.0, "force_max": 10.0, "k": 100.0,
    }  # fmt: skip
    return AxisSettings(**{**given, **changes})


class Rig:
    """A bank whose plant follows the commanded position exactly, unless ``plant`` says otherwise.

    plant: called with the actuator command and the step [s], returns the new raw positions.
    """

    def __init__(
        self,
        settings: Sequence[AxisSettings],
        *,
        tick_ns: int = TICK_NS,
        start: Sequence[float] | None = None,
        plant: Callable[[np.ndarray, float], np.ndarray] | None = None,
        keeper: Keeper | None = None,
        **arguments: Any,
    ) -> None:
        self.markers = Markers()
        self.bank = AxisBank(settings, tick_s=tick_ns * 1e-9, markers=self.markers, **arguments)
        self.bank.keeper = keeper
        self.axes = list(range(len(settings)))
        self.now_ns = 1_000_000_000
        self.tick_ns = tick_ns
        self.raw = np.array([0.0] * len(settings) if start is None else start, dtype=np.float64)
        self.plant = plant
        self.switches: Callable[[np.ndarray], np.ndarray] | None = None
        self.events: list[Event] = []
        self.history: list[dict[str, np.ndarray]] = []
        self.tick()

    def tick(self, ticks: int = 1, *, plan: bool = True) -> None:
        """Advance by ticks; history collects a copy of fields of each."""
        for _ in range(ticks):
            self.now_ns += self.tick_ns
            switches = None if self.switches is None else self.switches(self.raw)
            output = self.bank.tick(self.now_ns, self.raw, switches)
            if self.plant is not None:
                self.raw = self.plant(output, self.tick_ns * 1e-9)
            else:
                self.raw = self.raw + self.bank.rows["following_error"]
            if plan:
                self.bank.plan_ahead()
            self.history.append(read_rows(NodeClass.AXIS, self.bank.fields.copy()))
            self.events += self.bank.take_events()

    def run(self, most: int = 20_000) -> float:
        """Tick until all axes are idle; return the time it took [s]."""
        for i in range(most):
            if self.bank.is_idle(self.axes):
                return i * self.tick_ns * 1e-9
            self.tick()
        raise AssertionError(f"not idle after {most} ticks")

    def write(self, *, replace: bool = False, **fields: Any) -> None:
        """Append records at the present instant."""
        self.bank.append(records(**fields), self.axes, self.now_ns, replace=replace)

    def field(self, name: str, i: int = 0) -> float:
        """Return a published field of axis i."""
        value: float = self.bank.rows[name][i].item()
        return value

    def trace(self, name: str, i: int = 0) -> np.ndarray:
        """Return a field of axis i over all ticks."""
        return np.array([h[name][i] for h in self.history])

    def kinds(self) -> list[EventKind]:
        """Return the kinds of all events so far."""
        return [e.kind for e in self.events]


DRIVE_MODES = (
    MODE.POSITION | MODE.VELOCITY | MODE.RELATIVE | MODE.SPECIFIED_TIME | MODE.WAIT_FOR_EXTERNAL_SYNCH
    | MODE.SPECIFIED_WAIT_MARKER | MODE.SPECIFIED_SIGNAL_MARKER | MODE.SPECIFIED_MAX_VEL_ACC
)  # fmt: skip
POLL_NS = 10_000_000


class Drive:
    """A drive of its own loop: moves with constant velocity to its target; takes one poll to begin.

    ``shove`` is a velocity that a defective board adds to what it was told.
    """

    def __init__(self):
        self.shove = self._shoved = 0.0
        self.position, self.velocity, self.target, self.wish = 0.0, 0.0, None, None
        self.fault, self.log = "", []

    def take(self, action):
        self.log.append(action.kind)
        if action.kind is ActionKind.START:
            c = action.command
            if c.control_mode & MODE.POSITION:
                self.target, self.wish = c.position, action.velocity_max
            else:
                self.target, self.wish = None, c.velocity
        elif action.is_stop:
            self.target, self.wish, self.velocity, self._shoved = None, 0.0, 0.0, 0.0
        elif action.kind is ActionKind.RESET:
            self.fault = ""

    def step(self, dt):
        self._go(dt)
        self.position += self.shove * dt
        self.velocity += self.shove - self._shoved
        self._shoved = self.shove

    def _go(self, dt):
        if self.wish is None:
            return
        if self.target is None:
            self.velocity = self.wish
            self.position += self.velocity * dt
            self._shoved = 0.0
            return
        left = self.target - self.position
        go = np.clip(left, -abs(self.wish) * dt, abs(self.wish) * dt)
        self.position += go
        self.velocity = go / dt if abs(left) > 0 else 0.0
        self._shoved = 0.0


class Cell:
    """Drives of their own loops behind a DriveBank, polled by an invented clock."""

    def __init__(self, n=2, start=0.0, **settings):
        self.markers = Markers()
        self.bank = DriveBank([axis(modes=DRIVE_MODES, k=None, **settings) for _ in range(n)], markers=self.markers)
        self.drives = [Drive() for _ in range(n)]
        for drive, position in zip(self.drives, np.broadcast_to(start, n).tolist(), strict=True):
            drive.position = position
        self.holds = np.ones(n, dtype=bool)
        self.now_ns, self.axes, self.events, self.starts = 10**9, list(range(n)), [], []
        self.poll()

    def poll(self, count=1):
        for _ in range(count):
            self.now_ns += POLL_NS
            for d in self.drives:
                d.step(POLL_NS * 1e-9)
            velocity = np.array([d.velocity for d in self.drives])
            moving = np.abs(velocity) > 0
            self.bank.poll(
                self.now_ns, np.array([d.position for d in self.drives]), velocity, moving, ~moving,
                [d.fault for d in self.drives], holds=self.holds,
            )  # fmt: skip
            self.send()
            self.events += self.bank.take_events()

    def send(self):
        for action in self.bank.take_actions():
            self.drives[action.axis].take(action)
            if action.kind is ActionKind.START:
                self.starts.append((self.now_ns, action.axis))
            self.bank.action_done(action, self.now_ns)

    def write(self, *, replace=False, **fields):
        self.bank.append(records(**fields), self.axes, self.now_ns, replace=replace)
        self.send()

    def status(self, i=0):
        return int(self.bank.rows["status"][i])
