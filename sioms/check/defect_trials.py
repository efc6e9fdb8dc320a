"""Trials of a line that adds and loses bytes, readings that stand still, another master, and a motor that moves by
itself.
"""

from __future__ import annotations

import contextlib
import time

from .device import (
    WATCH_S,
    check_safe,
    check_still,
    check_stops,
    device_with,
    first_axis,
    in_fault,
    restore,
    state_of,
    stop_by,
    usual_speed,
    wait_told,
)
from .line_trials import check_back, disturbed, speaks_unasked
from .motion_trials import forward, run, wait_moving
from .station import Station, Unanswered, wait_for
from .trial import Failed, NotApplicable, Trial

FROZEN_S = 3.0
TOO_FAST = 1.5
"""Times the speed limit."""


def misframed(station: Station, full: bool) -> str:
    """Add bytes to requests and lose bytes of them: the device must be reached again, by stops above all."""
    if station.rig.line != "serial":
        raise NotApplicable("only a serial line loses and adds bytes")
    if speaks_unasked(station):
        raise NotApplicable("the device speaks unasked; it is sent no requests")
    checked = station.rig.checked  # without a checksum a lost digit is another command
    for faults in ({"stray": 0.3}, {"short": 0.3}) if checked else ({"stray": 0.3},):
        disturbed(station, 5.0 if full else 0.5, judge=checked, **faults)
    if not station.rig.axes:
        return "reached again"
    axis = station.rig.axes[0]
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        restore(station, node, axis)  # the disturbance may have lost the link
    fast = usual_speed(station, axis)
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        for way in ("stop", "emergency stop"):
            restore(station, node, axis)
            run(station, node, axis)
            wait_moving(station, node.read, axis)
            station.fault(stray=1.0, count=1)
            with contextlib.suppress(OSError):
                stop_by(station, node, way)
            check_stops(station, fast, f"{way} behind a stray byte")
            check_back(station)
            station.cell.reset()
    return "reached again; two stops behind a stray byte"


def frozen(station: Station, full: bool) -> str:
    """Let the readings of a streaming device stand still: that is a lost device, not a quiet one."""
    device = device_with(station, "freeze")
    if not speaks_unasked(station):
        raise NotApplicable("the device is asked; that its answers stand still cannot be told from rest")
    with station.cell.open(station.nodes[0].reader) as node:
        began = time.monotonic()
        device.tell("freeze")
        try:
            if not wait_for(lambda: not station.is_good(), FROZEN_S):
                flags = getattr(node.read(), "flags", ())
                raise Failed(
                    f"a lost link within {FROZEN_S:g} s of a frozen stream",
                    f"the link is good, flags {flags}",
                )
            lost_s = time.monotonic() - began
            if wait_for(station.is_good, WATCH_S):
                raise Failed("a link that stays lost while the stream stands still", "it is good again")
        finally:
            device.tell("freeze 0")
        check_back(station)
    return f"lost after {1e3 * lost_s:.0f} ms"


def other_master(station: Station, full: bool) -> str:
    """Let somebody else command the device, behind the driver's back and before it opens the device."""
    device = device_with(station, "foreign")
    if not station.rig.axes:
        return _foreign_outputs(station)
    axis = first_axis(station)
    fast = usual_speed(station, axis)
    with station.cell.open(f"{axis.node}.readonly") as seen:  # else the motion is taken for the end of the last stop
        wait_for(lambda: not seen.read().in_motion[0], 2.0)
    try:
        device.tell(f"foreign velocity {0.5 * fast:.9g}")
    except Unanswered as error:
        raise NotApplicable(f"its simulated device: {error}") from None
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        check_stops(station, 0.5 * fast, "another master's velocity")
        told = in_fault(node)
        restore(station, node, axis)
        check_still(station, fast, "another master's velocity, and RESET")
    if not told:
        raise Failed("a fault of motion that nobody here commanded", "none")
    station.end_daemon()
    device.tell(f"foreign velocity {0.5 * fast:.9g}")
    time.sleep(0.1)
    station.start_daemon()
    check_back(station)
    check_stops(station, 0.5 * fast, "the opening of a device that another master left running")
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        restore(station, node, axis)
        check_still(station, fast, "the opening, and RESET")
        node.move(0.5 * axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
        node.move(0.0, timeout=2.0)
        node.wait_until_idle(20.0)
    return "stopped and told; stopped by the opening, moves as ever"


def _foreign_outputs(station: Station) -> str:
    outputs = [o for o in station.rig.outputs if o.safe is not None and o.width]
    device = device_with(station, "foreign")
    if not outputs or "outputs" not in state_of(station):
        raise NotApplicable("the device has no outputs that another master could set")
    output = outputs[0]
    with station.cell.open(f"{output.node}.readonly") as seen:
        station.cell.emergency_stop(why="driver check")
        try:
            device.tell(f"foreign output {int(output.another)}")
            time.sleep(0.1)
            check_safe(station, output, seen, "another master's write under a latched stop")
        finally:
            station.cell.reset()
    return "safe again under a latched stop"


def shoved(station: Station, full: bool) -> str:
    """Let the motor turn by itself, and faster than its limit: both are faults, told at once."""
    device = device_with(station, "shove")
    axis = first_axis(station)
    fast = usual_speed(station, axis)
    limit = station.cell.info(axis.node).channels[0].limits["velocity"]
    above = TOO_FAST * limit / axis.velocity * fast
    texts = []
    for what, speed, moving in (("by itself", 0.5 * fast, False), ("above its limit", above, True)):
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            restore(station, node, axis)
            if moving:
                run(station, node, axis)
                wait_moving(station, node.read, axis)
            way = forward(node, axis)
            device.tell(f"shove {way * speed:.9g}")
            try:
                noticed_s = wait_told(station, node, f"motion {what}", 1.0)
            finally:
                device.tell("shove 0")
            check_stops(station, fast, f"motion {what}")
            check_back(station)
            restore(station, node, axis)
            check_still(station, fast, f"motion {what}, and RESET")
        texts.append(f"motion {what}: told after {1e3 * noticed_s:.0f} ms")
    return ", ".join(texts)


TRIALS = (
    Trial("misframed", "bytes added to requests and lost from them", misframed),
    Trial("frozen", "readings that stand still", frozen, wire=False),
    Trial("other master", "another master's commands", other_master, wire=False),
    Trial("shoved", "motion by itself, and above the speed limit", shoved, wire=False),
)
