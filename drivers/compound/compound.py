"""A device made of devices: its axes are coordinates, and what moves are axes of other devices, which it holds.

Coordinates are axes as any other: buffered commands, markers, synch, stops, limits. In every tick the positions of the
held axes become coordinates, and the velocities of the coordinates, with what brings back their error, become
velocities of the held axes. The time stamp of a reading is that of the oldest position in it.

    [device.bridge]
    driver = "gantry"
    axes = ["mod0.x", "mod0.y1", "mod1.y2"]
    span_m = 1.0
    [[device.bridge.axis]]
    name = "x"
    velocity_max = 0.2
    acceleration_max = 1.0
    ...

While nothing is commanded, the held axes hold by themselves. All halt when one of them is stopped, in fault or lost,
and when a coordinate is; after a reset they hold where they are. A target out of their reach, or where the map is
singular, is refused; in motion the coordinates stop before they come there.

A coordinate with a ``force_node`` takes force commands, if it has a ``damper``: it goes at damper * (wanted - felt).
When that node has no valid, young reading, all coordinates are in fault at once.
"""

from __future__ import annotations

import errno
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NoReturn

import msgspec
import numpy as np

from sioms.kinematics import Joint, Reach, Transform, forces
from sioms.motion import AxisBank, AxisKind, AxisSettings, CommandError
from sioms.motion.axis_step import FORCE, HOLD, SETTLING, STOP
from sioms.motion.settings import EVERY_MODE
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.records import WRITE
from sioms.sdk.blocks import AnyBlock, AxisBlock, BlockSpec, Description
from sioms.sdk.driver import AtLimitError, HeldNode, Kit, TickDriver
from sioms.sdk.exchange import LinkError
from sioms.sdk.inputs import NotMeasuredError
from sioms.sdk.tables import from_table, table_type

from .bounds import check
from .readings import LATCHED, Past, Reading, Readings

MODES = EVERY_MODE & ~(
    ControlMode.FORCE
    | ControlMode.FORCE_VELOCITY
    | ControlMode.SPECIFIED_GAINS
    | ControlMode.SPECIFIED_FORCE_OFFSET
    | ControlMode.SPECIFIED_MAX_FORCE
)
_POSITION, _RELATIVE = int(ControlMode.POSITION), int(ControlMode.RELATIVE)
_TARGET = list(WRITE[NodeClass.AXIS]).index("position")
_LOST = int(AxisStatus.POSITION_LOST)
_SATURATED = int(AxisStatus.SATURATED)

_SETTLE_NS = 250_000_000
"""How long the error of coordinates at rest is brought back before the held axes hold by themselves."""
_LATE = 4
"""Ticks by which held axes may follow late."""
_SPARE = 0.5
"""Part of the margin of its speed that a coordinate may use to catch up."""
_JUMP = 2.0
"""Speeds, in velocity limits, at which a set-point has not moved but begun anew elsewhere."""

CoordinateTable: Any = table_type(
    AxisSettings,
    without=(
        "kind", "unit", "modes", "k", "kz", "kp", "kb", "ki", "force_offset", "homing", "backlash", "restore",
        "start_velocity", "arrival",
    ),
    extra={
        "gain": (float, 20.0),
        "damper": (float, 0.0),
        "force_node": (str, ""),
        "force_scale": (float, 1.0),
        "force_age_s": (float, 0.1),
        "description": (str, ""),
    },
)  # fmt: skip
"""Keys of a coordinate: those of AxisSettings, and

``gain``: how fast an error is brought back [1/s];
``force_node``: analog node of one channel with the force along the coordinate [N or N m], times ``force_scale``;
``force_age_s``: a force that is older stops the coordinates with a fault [s];
``damper``: velocity per missing force [unit/(s N) or unit/(s N m)], 0: it takes no force commands.
"""


class CompoundSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of every device made of devices.

    Attributes:
        axes: nodes of the held axes, in the order of the map; a node of several axes stands for these.
        axis: the coordinates, in the order of the map.
        tick_hz: rate of the control loop.
        capacity: commands that each coordinate buffers.
        history: snapshots kept for readers.
        late_max_s: a tick later than this stops all motion with a fault.
    """

    axes: list[str]
    axis: list[CoordinateTable]
    tick_hz: float = 500.0
    capacity: int = 16384
    history: int = 64
    late_max_s: float = 0.05


class Compound(TickDriver):
    """A device made of devices; a kind says which coordinates and which map.

    Concurrency: the one thread of the driver process.
    """

    Settings: ClassVar[type[msgspec.Struct]] = CompoundSettings
    realtime_priority = 0
    COORDINATES: ClassVar[Mapping[str, str]]
    """Unit of each coordinate by name, in the order of the map."""

    @classmethod
    @abstractmethod
    def transform(cls, settings: Any) -> Transform:
        """Return the map; raises ValueError with a sentence."""

    @classmethod
    def presses(cls, settings: Any, axis: Any) -> bool:
        """Return whether a coordinate takes force commands."""
        return bool(axis.force_node)

    @classmethod
    def yields(cls, settings: Any, axis: Any) -> bool:
        """Return whether a command of a coordinate may say a greatest force: the kind sees to what that does."""
        return False

    @classmethod
    def describe(cls, name: str, settings: Any) -> Description:
        """Tell the coordinates, and what is held and read."""
        cls.transform(settings)
        names, wanted = [axis.name for axis in settings.axis], list(cls.COORDINATES)
        if names != wanted:
            raise ValueError(f"axis: {', '.join(names) or 'none given'}; want {', '.join(wanted)}, in this order")
        if not settings.axes:
            raise ValueError("axes: none given; want the nodes of the axes that are held")
        check(settings)
        for axis in settings.axis:
            if (axis.damper > 0.0) != bool(axis.force_node):
                raise ValueError(
                    f"axis {axis.name}: damper {axis.damper:g} with force_node {axis.force_node!r}; want a positive "
                    "number and a node, or neither"
                )
        for given in _settings(cls, settings):
            assert given.modes
        channels = tuple(
            _channel(cls.COORDINATES[axis.name], axis, _modes(cls, settings, axis)) for axis in settings.axis
        )
        block = BlockSpec("", NodeClass.AXIS, channels, history=settings.history, capacity=settings.capacity)
        felt = tuple(dict.fromkeys(axis.force_node for axis in settings.axis if axis.force_node))
        return Description((block,), settings.tick_hz, felt, holds=tuple(settings.axes))

    def __init__(self, name: str, settings: Any, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        spec = self.describe(name, settings).blocks[0]
        self.bank = AxisBank(
            _settings(type(self), settings),
            tick_s=1 / settings.tick_hz,
            markers=kit.markers,
            capacity=settings.capacity,
            late_max_s=settings.late_max_s,
            derived=True,
        )
        self._block = AxisBlock(spec, self.bank, admits=self.admit)
        self._map = self.transform(settings)
        self._reach = Reach(self._map, ())
        self._readings = Readings((), {}, {})
        self._angles = [i for i, unit in enumerate(self.COORDINATES.values()) if unit == "rad"]
        self._all = np.arange(self.bank.n)
        self._set_points = Past()
        self._errors: list[float] = []
        self._joints: list[float] = []
        self._at: list[float] = []
        self._moved_ns = 0
        self._seen_ns = dict.fromkeys(settings.axes, 0)
        self._drives = False
        self._halted = False

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The coordinates."""
        return (self._block,)

    @property
    def _held(self) -> list[HeldNode]:
        return [self.kit.held[name] for name in self.settings.axes]

    def admit(self, records: Sequence[tuple[Any, ...]], axes: Sequence[int]) -> None:
        """Refuse targets that the held axes cannot reach.

        A command of one coordinate is judged with the others where their own commands take them.

        Raises:
            CommandError: ERANGE, what cannot be reached and why.
        """
        if not self._at:
            return  # the bank refuses it
        ends = self.bank.ends()
        goal = [here if math.isnan(end) else end for here, end in zip(self._shown(), ends, strict=True)]
        knots: list[dict[int, float]] = []
        seen: dict[int, int] = {}
        for record in records:
            if not 0 <= record[0] < len(axes):
                return  # the bank refuses it
            axis, mode = int(axes[record[0]]), int(record[1])
            number = seen[axis] = seen.get(axis, -1) + 1
            if number == len(knots):
                knots.append({})
            if mode & _POSITION:
                position = float(record[_TARGET])
                knots[number][axis] = position + (goal[axis] if mode & _RELATIVE else 0.0)
        for knot in knots:
            for axis, position in knot.items():
                goal[axis] = position
            if not all(math.isfinite(position) for position in goal):
                return  # the bank refuses it
            try:
                self._reach.check(self._raw(goal), self._at, self._joints)
            except ValueError as error:
                raise CommandError(errno.ERANGE, f"out of reach: {error}") from None

    def open(self) -> None:
        """Wait for all that is held."""
        missing = [held.name for held in self._held if not held.is_there]
        if missing:
            raise LinkError(f"{missing[0]}: it cannot be held; want its device up")
        joints = [
            Joint(
                f"{held.name}: {channel.name}" if len(held.channels) > 1 else held.name, channel.unit,
                -math.inf if channel.minimum is None else channel.minimum,
                math.inf if channel.maximum is None else channel.maximum,
                channel.limits.get("velocity", math.inf),
            )
            for held in self._held for channel in held.channels
        ]  # fmt: skip
        if len(joints) != self.bank.n:
            raise LinkError(f"axes: {len(joints)} axes are held; want {self.bank.n}")
        self._reach = Reach(self._map, joints)
        self._readings = Readings(self.settings.axes, self.kit.inputs, self.kit.held)
        self.bank.believe()  # their own devices say whether they have lost their places
        for held in self._held:
            held.trouble()
        self._read(self.kit.now_ns())

    def tick(self, now_ns: int) -> None:
        """Read the held axes, move the coordinates, drive the held axes."""
        taken = self._read(now_ns)
        trouble = [error for held in self._held if (error := held.trouble()) is not None]
        if any(not held.is_there for held in self._held):
            self._lose(str(trouble[0]) if trouble else "an axis is no longer held")
        self.bank.tick(now_ns, np.array(self._at), seen_ns=self._block.stamp_ns)
        if taken.status & _LOST:
            self.bank.lose_place(self._all, "a held axis has lost its place", now_ns)
        self._follow(now_ns)
        loop = self.bank.arrays
        wrong = [error for error in trouble if not isinstance(error, AtLimitError)]
        if wrong or (taken.latched and not self._halted):
            text = str(wrong[0].strerror) if wrong else taken.latched
            self.bank.fault(self._all, text, now_ns)
        elif trouble:  # it came there later, or sooner, than could be foreseen
            self._end_reach(str(trouble[0].strerror), now_ns)
        if np.count_nonzero(loop["latched"] & LATCHED):
            self._halt(now_ns)
        elif self._halted:
            self._go_on()
        else:
            self._move(now_ns)
        self.bank.rows["force"][:] = forces(self._map, self._at, taken.load)

    def close(self) -> None:
        """Stop the held axes."""
        self._stop()

    def _read(self, now_ns: int) -> Reading:
        """Take what the held axes show.

        Raises:
            LinkError: one is lost, or the coordinates mean nothing there.
        """
        try:
            taken = self._readings.take(now_ns)
        except LinkError as error:
            self._lose(str(error))
        joints = self.bent(taken)
        try:
            found = list(self._map.forward(joints))
        except ValueError as error:
            self._lose(str(error))
        if self._at:
            for i in self._angles:  # no jump where an angle is wrapped
                found[i] = self._at[i] + math.remainder(found[i] - self._at[i], math.tau)
        self._joints, self._at, self._block.stamp_ns = joints, found, taken.stamp_ns
        return taken

    def bent(self, taken: Reading) -> list[float]:
        """Return where the joints are behind what gives between their encoders and the mechanics; here nothing does.

        Args:
            taken: what the held axes show.
        """
        return taken.joints

    def _lose(self, why: str) -> NoReturn:
        self._stop()
        raise LinkError(why)

    def _stop(self) -> None:
        for held in self._held:
            held.stop()
        self._drives = False

    def _halt(self, now_ns: int) -> None:
        """Let everything stand as long as a coordinate is latched: all are, then."""
        if not self._halted:
            self._stop()
        self._halted = True
        for name in self.settings.axes:
            self._seen_ns[name] = self.kit.inputs[name].as_of_ns
        latched = self.bank.arrays["latched"] & LATCHED
        if not latched.all():
            axis = int(latched.argmax())
            why = self.bank.fault_text(axis) or "emergency stop"
            name = self.bank.settings[axis].name
            self.bank.fault(np.flatnonzero(latched == 0), f"{name} was halted ({why}); reset all together", now_ns)
        self.bank.let_go(self._all)

    def _go_on(self) -> None:
        """Begin again after a reset: the bank holds where it is, the held axes are reset, too.

        They are reset after what they showed while the coordinates were halted: whatever has stopped them since is not
        what has been reset.
        """
        self._halted, self._moved_ns = False, 0
        for held in self._held:
            held.reset(self._seen_ns[held.name])

    def _move(self, now_ns: int) -> None:
        if self._rests(now_ns):
            if self._drives:
                self._stop()
            return
        wanted = self._wanted(now_ns)
        try:
            self._reach.check(self._ahead(wanted), self._at, self._joints)
        except ValueError as error:
            self._end_reach(str(error), now_ns)
        rates, share = self._reach.rates(self._at, wanted)
        if share < 1.0:
            self.bank.rows["status"][:] |= _SATURATED
        self._drive(rates)
        self._drives = True

    def _end_reach(self, why: str, now_ns: int) -> None:
        kind = self.bank.arrays["kind"]
        going = np.flatnonzero((kind != HOLD) & (kind != STOP))
        if going.size:
            self.bank.abandon(going, now_ns, errno.ERANGE, f"the end of reach: {why}")

    def _rests(self, now_ns: int) -> bool:
        """Tell whether the held axes are to hold by themselves.

        After a motion to its end the coordinates are driven for a while, which brings their error back. After a stop
        nothing is brought back: they hold where they are, and the held axes brake what is left by themselves, at once.
        """
        bank, kind = self.bank, self.bank.arrays["kind"]
        resting = (kind == HOLD) | (kind == SETTLING)
        ended = np.flatnonzero(bank.stopped & resting)
        if ended.size:
            bank.stay(ended)
            if resting.all():
                return True
        if not bank.is_idle(self._all) or bank.is_on_its_way():
            self._moved_ns = now_ns
        return bool(resting.all()) and not (self._drives and now_ns - self._moved_ns <= _SETTLE_NS)

    def _drive(self, rates: Sequence[float]) -> None:
        first = 0
        for held in self._held:
            last = first + len(held.channels)
            held.drive(rates[first:last])
            first = last

    def _ahead(self, wanted: Sequence[float]) -> list[float]:
        """Return where the coordinates would stand if they braked some ticks from now: held axes follow late."""
        loop, found = self.bank.arrays, []
        late_s = _LATE / self.settings.tick_hz
        for i, rate in enumerate(wanted):
            if loop["kind"][i] == FORCE:
                at, speed = self._at[i], rate
            else:
                at, speed = float(loop["desired"][i] - loop["offset"][i]), float(loop["desired_velocity"][i])
            found.append(at + speed * late_s + speed * abs(speed) / (2.0 * float(loop["acceleration_limit"][i])))
        return found

    def _wanted(self, now_ns: int) -> list[float]:
        """Return the velocities of the coordinates."""
        loop = self.bank.arrays
        found = []
        for i, axis in enumerate(self.settings.axis):
            if loop["kind"][i] == FORCE:
                try:
                    rate = self.pressing(i, float(loop["actuator"][i]), now_ns)
                except NotMeasuredError as unknown:
                    self.bank.fault(self._all, f"axis {axis.name}: no force is known: {unknown}", now_ns)
                    return [0.0] * self.bank.n
                most = float(loop["velocity_limit"][i])
                found.append(min(max(rate, -most), most))
            else:
                speed, limit = float(loop["desired_velocity"][i]), float(loop["velocity_limit"][i])
                most = max(limit * (1.0 + _SPARE * axis.watch.speed_margin), abs(speed))
                found.append(min(max(speed + axis.gain * self._errors[i], -most), most))
        return found

    def _follow(self, now_ns: int) -> None:
        """Find the errors of the coordinates: where they were to be when they were read, minus where they were."""
        loop, past = self.bank.arrays, self._set_points
        wanted = self._raw(loop["desired"].tolist())
        last_ns, last = past.last
        most = _JUMP * loop["velocity_limit"] * (now_ns - last_ns) * 1e-9
        if not last or (np.abs(np.subtract(wanted, last)) > most).any():
            past = self._set_points = Past()  # it goes on from somewhere else
        past.add(now_ns, wanted)
        self._errors = [w - a for w, a in zip(past.at(self._block.stamp_ns), self._at, strict=True)]

    def pressing(self, index: int, wanted: float, now_ns: int) -> float:
        """Return the velocity of a coordinate that shall press with a force.

        Args:
            index: of the coordinate.
            wanted: the force [N or N m].
            now_ns: time of the tick.

        Raises:
            NotMeasuredError: no force is known.
        """
        axis = self.settings.axis[index]
        oldest_ns = now_ns - round(axis.force_age_s * 1e9)
        felt = float(self.kit.inputs[axis.force_node].measured(now_ns, oldest_ns)[0]) * axis.force_scale
        return float(axis.damper * (wanted - felt))

    def _shown(self) -> list[float]:
        return [float(p) for p in self.bank.rows["position"]]

    def _raw(self, shown: Sequence[float]) -> list[float]:
        """Return coordinates without what a client has calibrated."""
        return [float(p - o) for p, o in zip(shown, self.bank.arrays["offset"], strict=True)]


def _modes(kind: type[Compound], settings: Any, axis: Any) -> ControlMode:
    force = ControlMode.FORCE if kind.presses(settings, axis) else ControlMode(0)
    most = ControlMode.SPECIFIED_MAX_FORCE if kind.yields(settings, axis) else ControlMode(0)
    return MODES | force | most


def _k(axis: Any) -> float:
    """Return the gain with which the bank's law is at the end of its force where ``gain`` is at that of the velocity.

    The held axes are driven by velocities, not by that force; but it tells when a coordinate cannot follow any more,
    and a stop has to begin where it is instead of where its set-point has run to.
    """
    return float(axis.force_max * axis.gain / axis.velocity_max) if axis.velocity_max > 0.0 else 0.0


def _settings(kind: type[Compound], settings: Any) -> list[AxisSettings]:
    return [
        from_table(
            AxisSettings,
            axis,
            {
                "kind": AxisKind.SERVO,
                "unit": kind.COORDINATES[axis.name],
                "modes": _modes(kind, settings, axis),
                "k": _k(axis),
            },
        )
        for axis in settings.axis
    ]


def _channel(unit: str, axis: Any, modes: ControlMode) -> ChannelInfo:
    limits = {"velocity": axis.velocity_max, "acceleration": axis.acceleration_max}
    if axis.jerk_max is not None:
        limits["jerk"] = axis.jerk_max
    if modes & (ControlMode.FORCE | ControlMode.SPECIFIED_MAX_FORCE):
        limits["force"] = axis.force_max
    return ChannelInfo(
        axis.name, unit, axis.position_min, axis.position_max, 0, int(modes), limits, axis.description
    )  # fmt: skip
