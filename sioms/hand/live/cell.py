"""Carry out skills on a hand of a running workcell: the same generators as on a simulated plane.

    with Workcell() as cell, CellHand(cell) as hand:
        skills = Skills(hand.hand, hand.reading)
        held = hand.run(skills.hold_parallel(5.0))

With every publication of the hand's node the skill is sent a `Reading` and its `Setpoint` becomes a write of six
commands (`sioms.hand.follow`). A simulated hand in slow motion (`sioms.hand.slow`) says its pace in its node `force`:
skills are shown its own time, and their velocities are slowed down with it.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any, Self, TypeVar

from sioms.client.node import AxisNode
from sioms.client.stream import Stream
from sioms.client.workcell import Workcell
from sioms.hand.control import Gains
from sioms.hand.felt import felt, internal_force, lightly, no_shape
from sioms.hand.follow import D, Follower, Order, standing
from sioms.hand.kinematics import Hand, Six
from sioms.hand.model import HandModel
from sioms.hand.running import carried_out
from sioms.hand.touch import Felt, Manner, Reading, Setpoint
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE

T = TypeVar("T")
FINGERS, MEANS = ("touch1.shape", "touch2.shape"), ("touch1.mean", "touch2.mean")
LEASE_S = 0.25
_NAMES = list(WRITE[NodeClass.AXIS])
_MODE, _VELOCITY, _FORCE, _MAX_FORCE = map(_NAMES.index, ("control_mode", "velocity", "force", "max_force"))
_JOG = int(ControlMode.VELOCITY)
_PRESS = int(ControlMode.FORCE)
_MOST = int(ControlMode.SPECIFIED_MAX_FORCE)
_NEW_S = 1.0
_FIRST_S = 10.0
_WATCHED = 40
_ENOUGH = 0.5
MANNER = Manner(light_n=0.4, tap_n=0.06, tap_frames=480, let_rad=math.radians(0.3))
"""Light touches are a little firmer than on the plane, and felt for longer: a frame of a live finger tells a contact
from 0.14 N on, a mean of 40 from 0.02 N on, and the platen holds an object against one finger with 0.1 to 0.2 N."""
_TOUCH = ("touched1", "touched2", "force1", "force2")
_BLIND = Felt(None)


class CellHand:
    """A hand of a running workcell, held for writing.

    Args:
        cell: the session.
        name: of the hand's node.
        fingers: nodes of what each finger feels.
        means: nodes of what means of their frames feel; objects are felt round where they and the hand's node ``touch``
            are there.
        gains: of the laws, in the hand's time; the damper's are the driver's own.
        length_m: of the contact along a finger.
        lease_s: of the hand's node, in the hand's time.

    Attributes:
        pace: of the hand's time.
        model: what the hand is known to be, as its node ``model`` shows it.
        reading: the last one, in the hand's time.
        told: what each finger told for it, not corrected by the model.
        manner: how skills do it here.
        seen: called with every reading and the set-point that answered it.

    Raises:
        OSError: a node that cannot be opened or read; EINVAL, one that is no shape of a calibrated finger; ETIME, the
            cell's loops fall behind on this machine, and nothing has moved.

    Concurrency: one thread.
    """

    def __init__(
        self, cell: Workcell, name: str = "hand", fingers: Sequence[str] = FINGERS, *,
        means: Sequence[str] = MEANS, gains: Gains = Gains(), length_m: float = 20e-3, lease_s: float = LEASE_S,  # noqa: B008
    ) -> None:  # fmt: skip
        self._length_m = length_m
        self.pace = _watched(cell, f"{name}.force", fingers)
        self.model = _known(cell, f"{name}.model")
        self.hand: Hand = self.model.maps()
        self.manner = replace(MANNER, friction=min(MANNER.friction, self.model.friction))
        self.seen: Callable[[Reading, Setpoint], None] | None = None
        with ExitStack() as stack:
            self._node: AxisNode = stack.enter_context(cell.open(name, "rw", 10.0, lease=lease_s / self.pace))
            limits = [channel.limits.get("velocity", math.inf) for channel in self._node.info.channels]
            self._follower = Follower(gains, [0.999 * limit / self.pace for limit in limits])
            self._fingers: list[Any] = [stack.enter_context(cell.open(f"{node}")) for node in fingers]
            there = {one.name for one in cell.nodes()}
            self._light: list[Any] = []
            if {touch := f"{name}.touch", *means} <= there:
                self._light = [stack.enter_context(cell.open(node)) for node in (touch, *means)]
            else:  # a finger that is not told to yield pushes the object away
                self.manner = replace(self.manner, taps=0)
            most = self._node.info.channels[D].limits.get("force", math.inf)
            self._most_n = most if self._light else math.inf
            for node in (*self._fingers, *self._light[1:]):
                if why := no_shape(node.name, [channel.name for channel in node.info.channels]):
                    raise OSError(errno.EINVAL, f"take the hand: {why}")
            self._stream = Stream(self._node, ahead=8)
            self.told, self._stamps_ns = [_BLIND, _BLIND], [0, 0]
            self._number, self._time_s = 0, 0.0
            self._begin_ns = time.monotonic_ns()
            self.reading = self._read()
            while self._time_s < _FIRST_S and any(one.touched is None for one in self.reading.light or ()):
                self.reading = self._read()  # the first mean is still to come
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the hand: it halts, and what it holds is held by whatever force there is."""
        self._stack.close()

    def run(self, ticks: Generator[Setpoint, Reading, T], most_s: float = 120.0) -> T:
        """Carry out a skill to its end; return what it found.

        Raises:
            Failed: as the skill does; the hand stands, whatever ends it.
            OSError: the hand was stopped, is in fault, or is not there any more.
            TimeoutError: it takes longer than `most_s`, in the hand's time.
        """
        try:
            found = carried_out(ticks, self.tick, self.reading.time_s, most_s)
        except BaseException:
            with suppress(OSError):  # a hand that is not there any more has been halted by its daemon
                self.stop()
            raise
        self.keep()
        return found

    def tick(self, setpoint: Setpoint) -> Reading:
        """Have the set-point carried out; return the next reading."""
        if setpoint.frozen:
            self.stop()
        else:
            self._write(self._follower.orders(setpoint, self._at, self.force, self._sample_s), setpoint.most_n)
        self.reading = self._read()
        if self.seen is not None:
            self.seen(self.reading, setpoint)
        return self.reading

    def keep(self) -> None:
        """Stand, and go on pressing as before."""
        self._write(standing())
        self._stream.drain()

    def stop(self) -> None:
        """Stop all motion."""
        self._stream.drain()
        self._node.stop()

    @property
    def coordinates(self) -> Six:
        """The six coordinates at the last reading."""
        return self._at

    @property
    def force(self) -> float:
        """The internal force that both fingers tell [N], 0 while it is not known."""
        return internal_force(*self.reading.fingers) or 0.0

    def _write(self, orders: Sequence[Order], most_n: float = math.inf) -> None:
        most = [min(most_n, self._most_n) if axis == D else math.inf for axis, *_ in orders]
        records = [_record(*order, self.pace, one) for order, one in zip(orders, most, strict=True)]
        self._stream.write(b"".join(records), replace=True)

    def _read(self) -> Reading:
        """Wait for the next publication of the hand; read what the fingers feel by then."""
        shown = self._node.wait_new(self._number, _NEW_S)
        self._number = shown.number
        now_ns = time.monotonic_ns()
        pace_s = self.pace * 1e-9
        time_s = (now_ns - self._begin_ns) * pace_s
        self._sample_s = max(time_s - self._time_s, 1e-4)
        self._time_s = time_s
        at: Any = tuple(shown.position)
        self._at: Six = at
        for i, node in enumerate(self._fingers):
            try:
                frame = node.read()
            except OSError:  # it is told by the age of its last frame
                continue
            self._stamps_ns[i] = frame.stamp_ns
            self.told[i] = felt(frame.data, self._length_m)
        ages = [max((now_ns - stamp_ns) * pace_s, 0.0) for stamp_ns in self._stamps_ns]
        one, two = (self.model.corrected(felt, i) for i, felt in enumerate(self.told))
        return Reading(
            time_s,
            self.hand.inverse(self._at),
            (one, two),
            (ages[0], ages[1]),
            light=self._lightly() if self._light else None,
        )

    def _lightly(self) -> tuple[Felt, Felt]:
        """Return what each finger feels of the lightest touch; not known where a node cannot be read."""
        try:
            touch, *means = (node.read() for node in self._light)
            told = [touch.measured(name) for name in _TOUCH]
        except OSError:
            return _BLIND, _BLIND
        feels = [self.model.corrected(felt(mean.data, self._length_m), i) for i, mean in enumerate(means)]
        return lightly(told[0], told[2], feels[0]), lightly(told[1], told[3], feels[1])


def _known(cell: Workcell, name: str) -> HandModel:
    """Return the model that a hand shows."""
    with cell.open(name) as node:
        shown: Any = node.wait_new(0, _FIRST_S)
        told = [float(shown.measured(i)) for i in range(9)]
    link, mount, stiffness, gain = ((told[i], told[i + 1]) for i in range(0, 8, 2))
    return HandModel(link, mount, stiffness, gain, told[8])


def _watched(cell: Workcell, force: str, fingers: Sequence[str]) -> float:
    """Watch the loops of a hand and its fingers for some ticks; return the pace that the hand shows.

    Raises:
        OSError: ETIME, one of them is at less than half of its rate.
    """
    with ExitStack() as stack:
        nodes: list[Any] = [stack.enter_context(cell.open(name)) for name in (force, *fingers)]
        first = [node.wait_new(0, _FIRST_S).number for node in nodes]
        begun_ns = time.monotonic_ns()
        time.sleep(_WATCHED / min(node.info.tick_hz for node in nodes))
        shown = [node.read() for node in nodes]
        for node, one, since in zip(nodes, shown, first, strict=True):
            rate = (one.number - since) / ((time.monotonic_ns() - begun_ns) * 1e-9)
            if rate < _ENOUGH * node.info.tick_hz:
                raise OSError(
                    errno.ETIME,
                    f"take the hand: {node.name} shows {rate:.0f} readings a second here instead of "
                    f"{node.info.tick_hz:.0f}; want a quieter machine, or a simulated cell in slow motion "
                    "(sioms hand slow)",
                )
        return float(shown[0].measured("pace"))


def _record(axis: int, presses: bool, value: float, pace: float, most_n: float) -> bytes:
    """Return a command of a force [N], or of a velocity in the hand's time; a greatest force [N] if it is finite."""
    fields: list[Any] = [0] * len(_NAMES)
    fields[0], fields[_MODE] = axis, _PRESS if presses else _JOG
    if most_n < math.inf:
        fields[_MODE] |= _MOST
        fields[_MAX_FORCE] = most_n
    fields[_FORCE if presses else _VELOCITY] = value if presses else value * pace
    return AXIS_WRITE.pack(*fields)
