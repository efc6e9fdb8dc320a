"""Trials of stops: from every state that an axis can be in, in every way that a client has; and of safe outputs."""

from __future__ import annotations

import contextlib
import errno
import time
from collections.abc import Callable
from typing import Any

from sioms.protocol.flags import AxisStatus, ControlMode

from .rigs import Axis, Output
from .station import Station, wait_for
from .trial import Disturbed, Failed, NotApplicable, Trial

REST_S = 3.0
"""Longest time from a stop to rest [s]; braking from the rig's velocity takes a small part of it."""
STILL_S = 0.15
SLOW = 0.05
"""Part of the velocity below which the device counts as standing."""


def forward(node: Any, axis: Axis) -> float:
    """Return the direction in which there is room."""
    return -1.0 if node.read().position[0] > 0 else 1.0


def run(station: Station, node: Any, axis: Axis) -> None:
    """Let an axis go on for a while: at a velocity, or where it has none, to a far place."""
    way = forward(node, axis)
    if station.has(ControlMode.VELOCITY):
        node.command(velocity=way * axis.velocity)
    else:
        node.move(way * 20 * axis.reach, **slowly(station, axis))


def slowly(station: Station, axis: Axis) -> dict[str, float]:
    """Return the words that let a move take its time, none where the drive has its own speed alone."""
    if not station.has(ControlMode.SPECIFIED_MAX_VEL_ACC):
        return {}
    return {"max_velocity": axis.velocity, "max_acceleration": 10 * axis.velocity}


def wait_moving(station: Station, read: Callable[[], Any], axis: Axis) -> float:
    """Wait until an axis really moves; return how fast its device says that it does."""
    start = read().position[0]
    far = max(4 * axis.tolerance, 0.02 * axis.reach)

    def ends() -> bool:
        seen = read()
        return abs(seen.position[0] - start) > far or bool(seen.status[0] & AxisStatus.FAULT)

    wait_for(ends, 5.0)
    seen = read()
    if seen.status[0] & AxisStatus.FAULT:
        what = f"{axis.node} in fault at {seen.position[0]:.6g}: {station.last_fault() or 'no reason in the log'}"
        raise Disturbed("motion after the command", what, station.exchanges(12))
    if abs(seen.position[0] - start) <= far:
        status = AxisStatus(int(seen.status[0])).name
        told = f"status {status or 0}, in_motion {seen.in_motion[0]}, {seen.buffered[0]} buffered"
        text = f"{axis.node} stays at {seen.position[0]:.6g} ({told})"
        raise Failed("motion after the command", text, station.exchanges(12))
    return abs(station.speed() or 0.0)


def check_rest(station: Station, read: Callable[[], Any], axis: Axis, fast: float, after: str) -> float:
    """Check that the device comes to rest and stays there; return how long that took [s].

    Args:
        station: the driver at work.
        read: returns the axis' snapshot.
        axis: which.
        fast: speed of the device before the stop in its own unit, 0 when it does not tell.
        after: what stopped it.
    """
    began = time.monotonic()

    def stands() -> bool:
        speed = station.speed() if fast else None
        return not read().in_motion[0] and (speed is None or abs(speed) <= SLOW * fast)

    if not wait_for(stands, REST_S):
        reading, speed = read(), station.speed()
        seen = f"in_motion {reading.in_motion[0]}, position {reading.position[0]:.6g}"
        seen += f"; the device itself moves at {speed:.6g}" if speed else ""
        raise Failed(f"rest within {REST_S:g} s after {after}", seen)
    took_s = time.monotonic() - began
    time.sleep(0.05)
    place = read().position[0]
    time.sleep(STILL_S)
    moved = read().position[0] - place
    if abs(moved) > 2 * axis.tolerance or (fast and abs(station.speed() or 0.0) > SLOW * fast):
        raise Failed(
            f"rest after {after}",
            f"it moved {moved:.4g} in the {STILL_S:g} s after it was told to be at rest",
        )
    return took_s


def check_let_go(station: Station, read: Callable[[], Any], axis: Axis, fast: float, after: str) -> float:
    """Check that an axis in force mode pushes no more: after an emergency stop it may coast with force 0."""
    began = time.monotonic()
    limit = station.cell.info(axis.node).channels[0].limits.get("force", 1.0)
    if not wait_for(lambda: abs(read().force[0]) < 0.02 * limit or not read().in_motion[0], REST_S):
        raise Failed(f"force 0 or rest after {after}", f"force {read().force[0]:.4g}, in_motion {read().in_motion[0]}")
    return time.monotonic() - began


def _in_motion(station: Station, node: Any, axis: Axis) -> float:
    run(station, node, axis)
    return wait_moving(station, node.read, axis)


def _in_move(station: Station, node: Any, axis: Axis) -> float:
    way = forward(node, axis)
    node.move(way * 20 * axis.reach, **slowly(station, axis))
    return wait_moving(station, node.read, axis)


def _buffered(station: Station, node: Any, axis: Axis) -> float:
    for i in range(8):
        node.move((1 if i % 2 else -1) * axis.reach)
    return wait_moving(station, node.read, axis)


def _at_marker(station: Station, node: Any, axis: Axis) -> float:
    marker = station.cell.reserve_marker()
    node.move(-axis.reach, wait=marker)
    waits = AxisStatus.WAITING_MARKER
    if not wait_for(lambda: node.read().status[0] & waits, 3.0):
        raise Failed("an axis that waits for its marker", f"status {node.read().status[0]:#x}")
    return 0.0


def _at_synch(station: Station, node: Any, axis: Axis) -> float:
    node.move(-axis.reach, synch=True)
    if not wait_for(lambda: node.read().status[0] & AxisStatus.WAITING_SYNCH, 3.0):
        raise Failed("an axis that waits for the synch", f"status {node.read().status[0]:#x}")
    return 0.0


def send_home(station: Station, node: Any) -> None:
    """Begin a homing, of a device whose simulator has what it looks for near, if it can place it."""
    if station.simulator is not None and "reference" in station.verbs:
        station.simulator.tell("reference")
    try:
        node.home()
    except OSError as error:
        raise NotApplicable(f"it does not home: {error.strerror}") from None


def begin_homing(station: Station, node: Any, axis: Axis) -> float:
    """Begin a homing; return how fast the device is while it searches."""
    send_home(station, node)
    if not wait_for(lambda: node.read().in_motion[0], 3.0):
        raise NotApplicable("its homing ended at once")
    time.sleep(0.1)
    return abs(station.speed() or 0.0)


def _pushing(station: Station, node: Any, axis: Axis) -> float:
    if not station.has(ControlMode.FORCE):
        raise NotApplicable("it has no force mode")
    limit = node.info.channels[0].limits.get("force", 1.0)
    node.command(force=forward(node, axis) * 0.1 * limit)
    if not wait_for(lambda: node.read().in_motion[0], 3.0):
        return 0.0  # something holds it: how fast the device creeps says nothing
    time.sleep(0.1)
    return abs(station.speed() or 0.0)


def _idle(station: Station, node: Any, axis: Axis) -> float:
    return 0.0


STATES: dict[str, Callable[[Station, Any, Axis], float]] = {
    "idle": _idle, "running": _in_motion, "moving": _in_move, "buffered": _buffered, "at a marker": _at_marker,
    "at a synch": _at_synch, "homing": begin_homing, "pushing": _pushing,
}  # fmt: skip
WAYS = ("stop", "emergency stop", "close")
QUICK = {
    "idle": 1,
    "running": 3,
    "moving": 1,
    "buffered": 2,
    "at a marker": 1,
    "at a synch": 1,
    "homing": 1,
    "pushing": 1,
}
"""How many of the ways the quick selection tries from each state."""


def stops(state: str) -> Callable[[Station, bool], str]:
    """Return the trial that stops from a state in all ways."""

    def trial(station: Station, full: bool) -> str:
        if not station.rig.axes:
            raise NotApplicable("the device has no axes")
        first = list(STATES).index(state)
        ways = [WAYS[(first + i) % len(WAYS)] for i in range(len(WAYS) if full else QUICK[state])]
        return ", ".join(f"{way}: {1e3 * _stop(station, state, way):.0f} ms" for way in ways)

    return trial


def _stop(station: Station, state: str, way: str) -> float:
    """Stop once; return the time to rest [s]."""
    axis = station.rig.axes[0]
    after = f"{way} while {state}"
    with station.cell.open(f"{axis.node}.readonly") as seen:
        node = station.cell.open(axis.node, "rw", timeout=5.0)
        try:
            find_again(node)
            node.wait_until_idle(REST_S)
            fast = STATES[state](station, node, axis)
            if way == "stop":
                node.stop()
            elif way == "close":
                node.close()
            else:
                station.cell.emergency_stop(why="driver check")
            let_go = state == "pushing" and way == "emergency stop"
            check = check_let_go if let_go else check_rest
            took_s = check(station, seen.read, axis, fast, after)
            if seen.read().buffered[0]:
                raise Failed(f"an empty buffer after {after}", f"{seen.read().buffered[0]} commands")
            if not let_go:
                _check_latch(station, node, axis, way)
            station.cell.reset()
            wait_for(lambda: not seen.read().status[0] & AxisStatus.EMERGENCY_STOP, 3.0)
            return took_s
        finally:
            with contextlib.suppress(OSError):
                node.close()


def find_again(node: Any) -> None:
    """Say where an axis is if its place is lost, as that of some is when a stop ends their homing."""
    seen = node.read()
    if seen.status[0] & AxisStatus.POSITION_LOST:
        node.reset()
        node.calibrate(seen.position[0])


def _check_latch(station: Station, node: Any, axis: Axis, way: str) -> None:
    """After an emergency stop commands are refused; after its reset nothing resumes."""
    if way != "emergency stop":
        return
    try:
        node.move(0.0)
    except OSError as error:
        if error.errno != errno.EPERM:
            raise Failed("EPERM for a command after the emergency stop", f"{error.strerror}") from None
    else:
        raise Failed("commands refused until the reset", "a move was taken")
    place = node.read().position[0]
    station.cell.reset()
    wait_for(lambda: not node.read().status[0] & AxisStatus.EMERGENCY_STOP, 3.0)
    time.sleep(STILL_S)
    moved = node.read().position[0] - place
    if abs(moved) > 2 * axis.tolerance:
        raise Failed("nothing to resume after the reset", f"the axis moved {moved:.4g}")


def safe_outputs(station: Station, full: bool) -> str:
    """Outputs take their safe value with an emergency stop and with their writer's end."""
    if not station.rig.outputs:
        raise NotApplicable("the device has no outputs")
    outputs = [output for output in station.rig.outputs if output.safe is not None]
    if not outputs:
        raise NotApplicable("its outputs have no safe value: they keep the last")
    return ", ".join(_becomes_safe(station, output) for output in outputs)


def _becomes_safe(station: Station, output: Output) -> str:
    safe = output.safe or 0.0

    def shows(seen: Any, value: float, after: str) -> None:
        if not wait_for(lambda: output.shown(seen, value), 3.0):
            raise Failed(f"{output.node} = {value:g} after {after}", f"{seen.read().data[0]:g}")

    with station.cell.open(f"{output.node}.readonly") as seen:
        with station.cell.open(output.node, "rw", timeout=5.0) as node:
            set_all(node, output)
            shows(seen, output.another, "a write")
            station.cell.emergency_stop(why="driver check")
            shows(seen, safe, "the emergency stop")
            station.cell.reset()
            if not wait_for(lambda: _takes(node, output), 3.0):
                raise Failed("writes taken again after the reset", "they are refused")
            shows(seen, output.another, "a write")
        shows(seen, safe, "the close of its writer")
    return f"{output.node} {safe:g} after emergency stop and close"


def set_all(node: Any, output: Output) -> None:
    """Write another value than the safe one to all channels."""
    node.set(*[output.another] * len(node.info.channels))


def _takes(node: Any, output: Output) -> bool:
    try:
        set_all(node, output)
    except OSError:
        return False
    return True


TRIALS = (
    *(Trial(f"stop {state}", f"stops of an axis that is {state}", stops(state), wire=False) for state in STATES),
    Trial("outputs", "safe outputs after emergency stop and close", safe_outputs, wire=False),
)
