"""Trials of ends: what is told when a motion is told to be over, compared with what the device does then.

A wait that ends while the device still runs on, and a place that was read before it had come to rest, show alike: the
place of that moment is not the one in which the axis is found a little later.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sioms.protocol.flags import AxisStatus

from .device import place_of
from .motion_trials import REST_S, SLOW, STILL_S, begin_homing, find_again, forward, run, wait_moving
from .rigs import Axis
from .station import Station
from .trial import Failed, NotApplicable, Trial

HOMING_S = 30.0
"""Longest time of a homing [s]."""


def ends(station: Station, full: bool) -> str:
    """The end of a move, of a stop, of a homing and of a calibration: the device stands, and its place is that told."""
    if not station.rig.axes:
        raise NotApplicable("the device has no axes")
    axis = station.rig.axes[0]
    texts = []
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        find_again(node)
        for name, do in ENDS.items():
            for _ in range(3 if full else 1):
                node.wait_until_idle(REST_S)
                try:
                    fast = do(station, node, axis)
                except NotApplicable as reason:
                    texts.append(f"{name} not: {reason}")
                    break
                _check_end(station, node, axis, fast, f"the end of a {name}")
                _check_done(node, name)
            else:
                texts.append(name)
    return ", ".join(texts)


def _check_end(station: Station, node: Any, axis: Axis, fast: float, after: str) -> None:
    told, place, speed = node.read(), place_of(station), abs(station.speed() or 0.0)
    if told.in_motion[0]:
        raise Failed(f"no motion told at {after}", f"in_motion {told.in_motion[0]}, status {told.status[0]:#x}")
    if fast and speed > SLOW * fast:
        raise Failed(f"rest at {after}", f"the device itself moves at {speed:.6g}; it was {fast:.6g} before")
    time.sleep(STILL_S)
    later, moved = node.read(), place_of(station)
    off = abs(later.position[0] - told.position[0])
    if off > axis.tolerance:
        text = f"{told.position[0]:.6g} was told, {later.position[0]:.6g} after {STILL_S:g} s"
        if place is not None and moved is not None:
            text += f"; the device itself went from {place:.6g} to {moved:.6g}"
        raise Failed(f"the place told at {after}", text)


def _check_done(node: Any, name: str) -> None:
    homed = bool(node.read().status[0] & AxisStatus.HOMED)
    if name == "homing" and not homed:
        raise Failed("HOMED at the end of a homing", f"status {node.read().status[0]:#x}")


def _move(station: Station, node: Any, axis: Axis) -> float:
    node.move(forward(node, axis) * axis.reach)
    fast = wait_moving(station, node.read, axis)
    node.wait_until_idle(REST_S + 5.0)
    return fast


def _stop(station: Station, node: Any, axis: Axis) -> float:
    run(station, node, axis)
    fast = wait_moving(station, node.read, axis)
    node.stop()
    node.wait_until_idle(REST_S)
    return fast


def _home(station: Station, node: Any, axis: Axis) -> float:
    fast = begin_homing(station, node, axis)  # not every device tells its place meanwhile
    node.wait_until_idle(HOMING_S)
    return fast


def _calibrate(station: Station, node: Any, axis: Axis) -> float:
    place = node.read().position[0]
    for wanted in (place + 0.5 * axis.reach, place):
        node.calibrate(wanted)
        told = node.read().position[0]
        if abs(told - wanted) > axis.tolerance:
            raise Failed(f"{wanted:.6g} told once calibrated to it", f"{told:.6g}")
    return 0.0


ENDS: dict[str, Callable[[Station, Any, Axis], float]] = {
    "move": _move, "stop": _stop, "homing": _home, "calibration": _calibrate,
}  # fmt: skip
"""Each brings a motion to its end, waits for it, and returns how fast the device was before in its own unit."""

TRIALS = (Trial("ends", "what is told at the end of a move, stop, homing and calibration", ends, wire=False),)
