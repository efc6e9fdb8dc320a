"""Whatever the order of requests, readings, ticks and replies: no reading is older than what was acknowledged.

The suite tries a few thousand orders; ``SIOMS_INTERLEAVINGS=1000000 pytest tests/properties/test_own_writes.py`` a
million, with SIOMS_SEED=2 others. ``sioms bench stale`` plays them on real processes, compiled and not.
"""

from __future__ import annotations

import errno
import os
import random
import time
import tomllib
from collections.abc import Callable
from typing import Any

import pytest
from daemon_rig import axes
from own_writes_devices import Device, OnLine, Pushing
from own_writes_rig import CLOCK, DEVICE, Client, World, worlds

from sioms.client import shown
from sioms.client.command import command
from sioms.client.node_core import NodeCore
from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.io import SimIo
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import AxisStatus, Request
from sioms.protocol.markers import token_of
from sioms.protocol.records import BINARY_WRITE

STEPS = int(os.environ.get("SIOMS_INTERLEAVINGS", "3000")) // 4
pytestmark = pytest.mark.timeout(120 + STEPS // 100)
STOPPED, STOPPING = int(AxisStatus.EMERGENCY_STOP), int(AxisStatus.STOPPING)
WAITING_SYNCH, WAITING_MARKER = int(AxisStatus.WAITING_SYNCH), int(AxisStatus.WAITING_MARKER)


class Promises:
    """What readings must show, by topic; a request withdraws the topics that it may change until it is acknowledged."""

    def __init__(self) -> None:
        self.held: dict[str, tuple[int, Callable[[Any], bool], str]] = {}
        self.acknowledged = 0
        self.checked = 0
        self._versions: dict[str, int] = {}

    def withdraw(self, *topics: str) -> dict[str, int]:
        """Take back what is promised of some topics; return what ``make`` needs to know whether it still may."""
        for topic in topics:
            self.held.pop(topic, None)
            self._versions[topic] = self._versions.get(topic, 0) + 1
        return {topic: self._versions[topic] for topic in topics}

    def make(self, state: dict[str, int], what: str, **promises: Callable[[Any], bool]) -> Callable[[Any], None]:
        """Return what is done with an answer: the promises hold from then on, unless it is a refusal."""

        def done(answer: Any) -> None:
            if isinstance(answer, OSError):
                return
            self.acknowledged += 1
            for topic, promise in promises.items():
                if self._versions[topic] == state[topic]:
                    self._versions[topic] += 1
                    self.held[topic] = (self._versions[topic], promise, what)

        return done

    def glance(self, node: NodeCore) -> None:
        """Read if that need not wait."""
        if node.is_shown():
            self.read(node)

    def read(self, node: NodeCore) -> None:
        """Read, and look whether all shows that was promised before, and has not been touched since."""
        before = dict(self.held)
        snapshot = node.read()
        for topic, (version, promise, what) in before.items():
            if self._versions[topic] == version:
                self.checked += 1
                assert promise(snapshot), f"{what}: {topic} is stale on {node.name}: {snapshot}"


def _play(world: World, promises: Promises, eyes: list[NodeCore], acts: list[Callable[[], None]], steps: int) -> None:
    chance = world.chance
    for _ in range(steps):
        chance.choice(acts)()
        for _ in range(chance.randrange(3)):
            world.turn()
        for _ in range(chance.randrange(1, 3)):
            promises.read(chance.choice(eyes))
    assert promises.acknowledged > steps / 8 and promises.checked > steps / 8


@pytest.fixture
def make_world() -> Any:
    with worlds() as make:
        yield make


def _axis_acts(
    world: World, promises: Promises, owner: Client, other: Client | None, number: int
) -> list[Callable[[], None]]:
    """Return all that can be asked of an axis, and of its workcell; some of it in the middle of a tick, too."""
    chance = world.chance
    markers: list[tuple[int, int]] = []
    gates = [0]  # written since the axis was told to stop
    unique = iter(range(1, 1 << 60))

    def moving(snapshot: Any) -> bool:
        return bool(snapshot.in_motion[0])

    def halting(snapshot: Any) -> bool:
        return bool(snapshot.status[0] & STOPPING) or not snapshot.in_motion[0]

    def latched(snapshot: Any) -> bool:
        return bool(snapshot.status[0] & STOPPED)

    def jog() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        speed = chance.choice([-1e-3, 1e-3])
        records = command(velocity=speed)
        owner.write(
            records,
            promises.make(state, "jog", motion=moving, queue=lambda s: s.buffered[0] == 0),
            replace=True,
        )

    def gains() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        k = 1000.0 + next(unique) % 1000
        records = command(velocity=1e-3, k=k, kz=0.0, kp=0.0, kb=0.0)
        done = promises.make(state, "gains", gains=lambda s: s.array("k")[0] == k)
        owner.write(records, done, replace=True)

    def stop() -> None:
        gates[0] = 0
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        done = promises.make(state, "stop", motion=halting, queue=lambda s: s.buffered[0] == 0)
        owner.ioctl(Request.STOP, None, done)

    def gated() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        count = chance.randrange(1, 4)
        gates[0] += 1
        records = command(velocity=1e-3, synch=True) + command(velocity=2e-3) * (count - 1)
        owner.write(records, promises.make(state, "gated write", queue=lambda s: s.buffered[0] >= count))

    def long() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        gates[0] += 1
        records = command(velocity=1e-3, synch=True) + command(velocity=2e-3) * 39
        owner.write(records, promises.make(state, "long write", queue=lambda s: s.buffered[0] >= 40))

    def flush() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        owner.ioctl(Request.FLUSH, None, promises.make(state, "flush", queue=lambda s: s.buffered[0] == 0))

    def synch() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        alone = gates[0] <= 1  # else the next gate may have its turn
        done = promises.make(state, "synch", gate=lambda s: not alone or not s.status[0] & WAITING_SYNCH)
        owner.ioctl(Request.SEND_EXTERNAL_SYNCH, time.monotonic_ns() + 1000, done)

    def await_marker() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        key = next(unique)
        marker = 1 + key % 999  # the daemon reserves none twice that somebody waits for: its wait would end
        markers.append((marker, world.markers.reserve(marker, key)))
        token = token_of(marker, key)
        done = promises.make(state, "wait for marker", queue=lambda s: s.buffered[0] >= 1)
        owner.write(command(velocity=1e-3, wait=token), done)

    def signal() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains")
        for marker, generation in markers:
            world.markers.signal(marker, generation, time.monotonic_ns())
        markers.clear()
        shown.acknowledged_by_daemon(time.monotonic_ns())
        promises.make(state, "signal", gate=lambda s: not s.status[0] & WAITING_MARKER)(None)

    def calibrate() -> None:
        state = promises.withdraw("place")
        place = chance.uniform(-0.5, 0.5)
        done = promises.make(state, "calibrate", place=lambda s: abs(s.position[0] - place) < 1e-3)
        owner.ioctl(Request.CALIBRATE_DEVICE, [place], done)

    def idle() -> None:
        state = promises.withdraw("motion")
        owner.ioctl(
            Request.WAIT_UNTIL_IDLE,
            None,
            promises.make(state, "wait until idle", motion=lambda s: not s.in_motion[0]),
        )

    def stop_node(by_daemon: bool) -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains", "latch")
        done = promises.make(state, "emergency stop", latch=latched, motion=halting, queue=lambda s: s.buffered[0] == 0)
        if by_daemon:
            world.order(DriverVerb.NODE_STOP, 0, [number], -1, "somebody", world.latch.resets, CLOCK())
            done(None)
        else:
            owner.ioctl(Request.EMERGENCY_STOP, None, done)

    def reset_node(by_daemon: bool) -> None:
        state = promises.withdraw("latch", "place")
        done = promises.make(state, "reset", latch=lambda s: not s.status[0] & STOPPED)
        if not by_daemon:
            owner.ioctl(Request.RESET, None, done)
        elif not world.latch.stopped_ns:
            world.order(DriverVerb.NODE_RESET, 0, [number], -1, "somebody", world.latch.resets, CLOCK(), CLOCK())
            done(None)

    def stop_all() -> None:
        state = promises.withdraw("motion", "queue", "gate", "place", "gains", "latch")
        world.latch.stop(time.monotonic_ns(), "somebody")
        shown.acknowledged_by_daemon(time.monotonic_ns())
        promises.make(state, "workcell stop", latch=latched, motion=halting, queue=lambda s: s.buffered[0] == 0)(None)

    def reset_all() -> None:
        state = promises.withdraw("latch", "place")
        if world.latch.stopped_ns:
            world.latch.reset(CLOCK(), world.runtime.stops._seen[2])
            shown.acknowledged_by_daemon(time.monotonic_ns())
            promises.make(state, "workcell reset", latch=lambda s: not s.status[0] & STOPPED)(None)

    def somebody_else() -> None:
        if other is not None:
            other.write(command(velocity=chance.choice([-1e-3, 1e-3])), replace=True)

    acts = [jog, stop, gated, long, flush, synch, await_marker, signal, calibrate, idle, somebody_else]
    acts += [lambda b=b: stop_node(b) for b in (False, True)]  # type: ignore[misc]
    acts += [lambda b=b: reset_node(b) for b in (False, True)] * 2  # type: ignore[misc]
    acts += [stop_all, reset_all, reset_all, reset_all]
    between = [stop_all, signal, lambda: stop_node(True), lambda: reset_node(True)]
    between += [lambda: promises.glance(owner.node)] * 12
    world.between = lambda: chance.choice(between)()
    return acts if isinstance(world.runtime.driver, OnLine) else [*acts, gains]


def test_axes_whose_loop_is_closed_here(make_world: Any) -> None:
    table = tomllib.loads(axes("mod0", "xaxis", "yaxis"))["device"]["mod0"]
    del table["driver"]
    world = make_world(SimAxes, table, 1)
    owner, other = world.open(0, [0], exclusive=True), world.open(0, [1], exclusive=True)
    eyes = [owner.node, world.open(0, [0, 1], exclusive=False).node, world.open(0, [0], exclusive=False).node]
    promises = Promises()
    _play(world, promises, eyes, _axis_acts(world, promises, owner, other, 0), STEPS)
    assert world.ticks / 4 < world.quiet < world.ticks * 0.9, "ticks of both kinds"


def test_a_drive_and_outputs_on_a_line(make_world: Any) -> None:
    world = make_world(OnLine, {}, 2, Device(random.Random(3)))
    drive, eye = world.open(0, [0], exclusive=True), world.open(0, [0], exclusive=False)
    out, out_eye = world.open(1, [0], exclusive=True), world.open(1, [0], exclusive=False)
    number = world.open(2, [0], exclusive=False)
    axis, port, sensor = Promises(), Promises(), Promises()
    acts = _axis_acts(world, axis, drive, None, 0)
    tares = iter(range(1, 1 << 40))

    def write() -> None:
        state = port.withdraw("data")
        value = world.chance.randrange(16)
        done = port.make(state, "write of outputs", data=lambda s: s.data[0] == value)
        out.write(BINARY_WRITE.pack(0, 0, value, 0), done)

    def tare() -> None:
        state, value = sensor.withdraw("data"), float(next(tares))
        number.ioctl(Request.CALIBRATE_DEVICE, value, sensor.make(state, "tare", data=lambda s: s.data[0] == value))

    for _ in range(STEPS):
        world.chance.choice([world.chance.choice(acts), write, tare])()
        for _ in range(world.chance.randrange(4)):
            world.turn()
        axis.read(world.chance.choice([drive.node, eye.node]))
        port.read(world.chance.choice([out.node, out_eye.node]))
        sensor.read(number.node)
    for one in (axis, port, sensor):
        assert one.acknowledged > STEPS / 10 and one.checked > STEPS / 5


def test_outputs_that_the_next_tick_sets(make_world: Any) -> None:
    world = make_world(SimIo, {"outputs": 8, "safe": 0}, 4)
    owner, eye = world.open(0, [0], exclusive=True), world.open(0, [0], exclusive=False)
    promises = Promises()

    def write() -> None:
        state, value = promises.withdraw("data"), world.chance.randrange(256)
        done = promises.make(state, "write", data=lambda s: s.data[0] == value)
        owner.write(BINARY_WRITE.pack(0, 0, value, 0), done)

    def stop() -> None:
        state = promises.withdraw("data")
        if world.chance.random() < 0.5:
            owner.ioctl(Request.EMERGENCY_STOP, None, promises.make(state, "stop", data=lambda s: s.data[0] == 0))
        else:
            world.order(DriverVerb.NODE_STOP, 0, [0], -1, "somebody", world.latch.resets, CLOCK())
            promises.make(state, "stop by the daemon", data=lambda s: s.data[0] == 0)(None)

    def reset() -> None:
        owner.ioctl(Request.RESET)

    _play(world, promises, [owner.node, eye.node], [write, write, write, stop, reset, reset], STEPS)


@pytest.mark.parametrize("kind", ["ticks", "pushes"])
def test_zero_gains_and_tare_of_sensors(make_world: Any, kind: str) -> None:
    pushes = kind == "pushes"
    bias = {"noise": [0.0] * 6, "resolution": [0.0] * 6, "bias": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]}
    if pushes:
        world = make_world(Pushing, {}, 5, Device(random.Random(6), pushes=True))
    else:
        world = make_world(SimForce, bias, 7)
    count = 1 if pushes else 6
    one, eye = (world.open(0, list(range(count)), exclusive=False) for _ in range(2))
    promises = Promises()
    tares = iter(range(1, 1 << 40))

    def expected(value: float) -> Callable[[Any], bool]:
        return lambda s: abs(s.data[0] - value) < 1e-9

    def zero() -> None:
        state = promises.withdraw("data")
        done = promises.make(state, "zero", data=expected(0.0))
        one.ioctl(Request.ZERO_DEVICE, world.chance.randrange(1, 4), done)

    def gains() -> None:
        if not one.pending:  # without an offset the reading tells the gain
            world.runtime.blocks[0].offset[:] = 0.0
            state, factor = promises.withdraw("data"), world.chance.uniform(0.5, 2.0)
            done = promises.make(state, "gains", data=expected(factor * bias["bias"][0]))
            one.ioctl(Request.SET_GAINS, [factor] * count, done)

    def tare() -> None:
        if not one.pending:
            world.runtime.blocks[0].offset[:] = 0.0
            state, value = promises.withdraw("data"), next(tares)
            done = promises.make(state, "tare", data=expected(float(value)))
            one.ioctl(Request.CALIBRATE_DEVICE, value, done)

    _play(world, promises, [one.node, eye.node], [zero, tare if pushes else gains], STEPS // 2)


def test_what_the_process_was_told_in_the_systems_time_is_not_owed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a test of a real daemon, whose time is far ahead of the rig's, a reading waited for ever."""
    monkeypatch.setattr(shown, "_everywhere_ns", 1 << 62)
    with worlds() as make:
        world = make(SimIo, {"outputs": 8, "safe": 0}, 12)
        assert world.open(0, [0], exclusive=True).node.owed_ns <= time.monotonic_ns()


def test_a_line_that_is_lost_while_a_reading_waits(make_world: Any) -> None:
    """The reading that waits for the publication gets the error that any reading gets then."""
    device = Device(random.Random(8))
    world = make_world(OnLine, {}, 9, device)
    out = world.open(1, [0], exclusive=True)
    answers: list[Any] = []
    out.write(BINARY_WRITE.pack(0, 0, 5, 0), answers.append)
    while not answers:
        world.turn()

    def gone(_: bytes) -> None:
        raise OSError(errno.EIO, "unplugged")

    device.write = gone  # type: ignore[method-assign]
    with pytest.raises(OSError, match="unplugged") as caught:
        out.node.read()
    assert caught.value.errno == errno.EIO and DEVICE


def test_what_is_asked_behind_a_write_that_is_on_its_way(make_world: Any) -> None:
    """A flush ends it; who waits until the axis is idle waits for it."""
    world = make_world(OnLine, {}, 10, Device(random.Random(11)))
    axis = world.open(0, [0], exclusive=True)
    answers: list[Any] = []
    long = command(velocity=1e-3) * 40
    world.runtime._spare_until_ns = 0
    axis.write(long, answers.append)
    axis.ioctl(Request.FLUSH, None, answers.append)
    refused, flushed = answers
    assert refused.errno == errno.ECANCELED and "flushed" in refused.strerror and flushed is None
    for _ in range(20):
        world.turn()
        assert axis.node.read().buffered[0] == 0

    world.runtime._spare_until_ns = 0
    axis.write(long + command(position=0.0), lambda _: answers.append("written"))
    axis.ioctl(Request.WAIT_UNTIL_IDLE, None, lambda _: answers.append("idle"))
    assert len(answers) == 2
    while "idle" not in answers:
        world.turn()
    assert answers[2:] == ["written", "idle"]
