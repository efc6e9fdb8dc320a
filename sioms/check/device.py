"""What the simulated device behind a driver tells and can be told, and what is checked of it in several trials.

What moves and which outputs are on is what the device itself says, not what the driver reads. A verb that it lacks
makes a trial not applicable (``docs/driver-check.md``, "A simulated device").
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

from sioms.protocol.flags import AxisStatus

from .motion_trials import SLOW, check_rest, run, wait_moving
from .rigs import Axis, Output
from .station import Station, wait_for
from .trial import Failed, NotApplicable

NOTICE_S = 3.0
"""Longest time from what happens in the device to its fault, or the loss of its link [s]."""
WATCH_S = 0.5
STAYS_S = 0.25
"""In which a device that its driver is about to move does so: a dozen polls of the slowest line [s]."""
STOOD_S = 0.06
SAFE_S = 4.0


def first_axis(station: Station) -> Axis:
    if not station.rig.axes:
        raise NotApplicable("the device has no axes")
    return station.rig.axes[0]


def device_with(station: Station, verb: str) -> Any:
    """Return the simulated device, if it has a verb."""
    if station.simulator is None or verb not in station.verbs:
        raise NotApplicable(f"its simulated device has no verb {verb}")
    return station.simulator


def state_of(station: Station) -> dict[str, Any]:
    if station.simulator is None or "state" not in station.verbs:
        return {}
    found = station.simulator.tell("state")
    return found if isinstance(found, dict) else {}


def place_of(station: Station) -> float | None:
    """Return where the device itself is, in its own unit; None when its simulator does not say."""
    state = state_of(station)
    place = state.get("place", state.get("position"))
    return float(place) if isinstance(place, int | float) else None


def usual_speed(station: Station, axis: Axis) -> float:
    """Run the axis at the rig's velocity and stop it; return the device's own speed meanwhile."""
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        run(station, node, axis)
        wait_moving(station, node.read, axis)
        time.sleep(0.1)
        fast = abs(station.speed() or 0.0)
        node.stop()
        check_rest(station, node.read, axis, fast, "a stop")
    if not fast:
        raise NotApplicable("its simulated device does not say how fast it moves")
    return fast


def check_still(station: Station, fast: float, after: str, seconds: float = STAYS_S) -> None:
    """Check that the device itself does not move for a time."""
    began = time.monotonic()
    while (now := time.monotonic()) - began < seconds:
        speed = abs(station.speed() or 0.0)
        if speed > SLOW * fast:
            seen = f"the device moves at {speed:.6g} (usually {fast:.6g}), {1e3 * (now - began):.0f} ms after it stood"
            raise Failed(f"no motion after {after}", seen)
        time.sleep(0.004)


def check_stops(station: Station, fast: float, after: str, seconds: float = NOTICE_S) -> None:
    """Wait until the device stands, and has stood for a moment: a motor that swings passes a speed of 0, too."""
    deadline, since = time.monotonic() + seconds, 0.0
    while True:
        speed, now = abs(station.speed() or 0.0), time.monotonic()
        since = (since or now) if speed <= SLOW * fast else 0.0
        if since and now - since > STOOD_S:
            return
        if now > deadline and not since:
            raise Failed(
                f"the device at rest within {seconds:g} s after {after}",
                f"it moves at {speed:.6g} (usually {fast:.6g})",
            )
        time.sleep(0.002)


def in_fault(node: Any) -> bool:
    """Whether an axis is in fault, its place or its link lost."""
    try:
        return bool(node.read().status[0] & (AxisStatus.FAULT | AxisStatus.POSITION_LOST))
    except OSError:
        return True


def wait_told(station: Station, node: Any, what: str, seconds: float = NOTICE_S) -> float:
    """Wait for a fault or a lost link; return how long that took [s]."""
    began = time.monotonic()
    if not wait_for(lambda: in_fault(node) or not station.is_good(), seconds):
        raise Failed(
            f"a fault or a lost link within {seconds:g} s after {what}",
            f"the link is good, status {node.read().status[0]:#x}, position {node.read().position[0]:.6g}",
        )
    return time.monotonic() - began


def reset(node: Any) -> None:
    with contextlib.suppress(OSError):
        node.reset()
    wait_for(lambda: not in_fault(node), 1.0)


def restore(station: Station, node: Any, axis: Axis, place: float = 0.0) -> None:
    """Make an axis fit for work: reset it, and where its place was lost, say where it is."""
    reset(node)
    with contextlib.suppress(OSError):
        node.calibrate(place)
    reset(node)
    if in_fault(node):
        raise Failed("an axis fit for work after reset and calibration", station.last_fault())


def check_armed(station: Station, before: dict[str, Any], after: str) -> None:
    if before.get("armed") and not wait_for(lambda: state_of(station).get("armed"), NOTICE_S):
        raise Failed(f"the dead-man armed after {after}", "the device says that none is")


def stop_by(station: Station, node: Any, way: str) -> None:
    if way == "stop":
        node.stop()
    elif way == "close":
        node.close()
    else:
        station.cell.emergency_stop(why="driver check")


def check_safe(station: Station, output: Output, seen: Any, after: str) -> None:
    safe = output.safe or 0.0
    state = state_of(station)
    if output.width and "outputs" in state:
        if not wait_for(lambda: state_of(station)["outputs"] == int(safe), SAFE_S):
            seen_text = f"the device's outputs are {state_of(station)['outputs']:#x} {SAFE_S:g} s later"
            raise Failed(f"outputs {int(safe):#x} after {after}", seen_text)
    elif not wait_for(lambda: output.shown(seen, safe), SAFE_S):
        raise Failed(f"{output.node} = {safe:g} after {after}", f"{seen.read().data[0]:g}")
