"""Trials of a device that restarts, loses its supply, or is opened again."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sioms.protocol.flags import ControlMode, NodeClass

from .calm import Calm
from .death_trials import DEAD_MAN_S
from .device import (
    SAFE_S,
    WATCH_S,
    check_armed,
    check_still,
    check_stops,
    device_with,
    first_axis,
    in_fault,
    reset,
    restore,
    state_of,
    usual_speed,
    wait_told,
)
from .line_trials import check_back, has_class
from .motion_trials import SLOW, forward, run, set_all, wait_moving
from .rigs import Axis, Output
from .station import Station, wait_for
from .trial import Failed, NotApplicable, Trial

BRIEF_S = 0.04
"""A restart that ends before any link counts as lost [s]."""
OFF_S = 1.0
SAME_SPEED = 0.25
"""The device's speed before and after may differ by this part."""


def stale(station: Station, full: bool) -> str:
    """End a motion in every way that opens the device's loop, then close the loop again: nothing may move."""
    axis = first_axis(station)
    fast = usual_speed(station, axis)
    occasions: list[tuple[str, Callable[[Station, Any, float], None]]] = [
        ("an emergency stop and its reset", _stopped),
        ("the cable was put back", _cable),
    ]
    if "power_cycle" in station.verbs:
        occasions.append(("a power cycle", _supply))
    ways = [("running", run, *occasion) for occasion in occasions]
    if station.has(ControlMode.FORCE):
        ways += [("pushing", _push, *occasion) for occasion in (occasions if full else occasions[:1])]
    for name, go, what, do in ways:
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            restore(station, node, axis)
            go(station, node, axis)
            if go is run:
                wait_moving(station, node.read, axis)
            else:
                time.sleep(0.2)
            do(station, node, fast)
            after = f"{what} ({name} before)"
            check_still(station, fast, after)
            reset(node)
            check_still(station, fast, f"{after}, and RESET")
            restore(station, node, axis)
            check_still(station, fast, f"{after}, RESET and calibration")
    return f"stood still after {len(ways)} ways of closing the loop"


def _push(station: Station, node: Any, axis: Axis) -> None:
    limit = node.info.channels[0].limits.get("force", 1.0)
    node.command(force=forward(node, axis) * 0.2 * limit)


def _stopped(station: Station, node: Any, fast: float) -> None:
    station.cell.emergency_stop(why="driver check")
    check_stops(station, fast, "an emergency stop")
    station.cell.reset()


def _cable(station: Station, node: Any, fast: float) -> None:
    if not station.wires:
        raise NotApplicable("the driver has no line")
    station.tell_wire("unplug")
    try:
        wait_for(lambda: not station.is_good(), 5.0)
        alone = wait_for(lambda: abs(station.speed() or 0.0) <= SLOW * fast, DEAD_MAN_S)
    finally:
        station.tell_wire("plug")
    if alone:
        check_still(station, fast, "the cable was put back", WATCH_S)
    check_back(station)
    check_stops(station, fast, "the cable was put back")


def _supply(station: Station, node: Any, fast: float) -> None:
    device_with(station, "power_cycle").tell("power_cycle 0.3")
    wait_told(station, node, "a power cycle")  # until then what the client commanded may be going on
    check_back(station)
    check_stops(station, fast, "a power cycle")


def restarted(station: Station, full: bool) -> str:
    """Restart the device so briefly that no link is lost: dead-man and limits must be set again, and the fault told."""
    device = device_with(station, "power_cycle")
    if not station.rig.axes:
        return _block_restarted(station)
    axis = first_axis(station)
    fast, before = usual_speed(station, axis), state_of(station)
    texts = []
    for moving in (False, True):
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            if moving:
                run(station, node, axis)
                wait_moving(station, node.read, axis)
            device.tell(f"power_cycle {BRIEF_S:g}")
            what = "a restart in motion" if moving else "a restart at rest"
            noticed_s = wait_told(station, node, what)
            check_back(station)
            check_stops(station, fast, what)
            check_still(station, fast, what)
            restore(station, node, axis)
            check_still(station, fast, f"{what}, and RESET")
            check_armed(station, before, what)
        again = usual_speed(station, axis)
        if abs(again - fast) > SAME_SPEED * fast:
            raise Failed(f"the speed as before {what}: {fast:.6g}", f"the device moves at {again:.6g}")
        texts.append(f"{what}: told after {1e3 * noticed_s:.0f} ms")
    return ", ".join(texts)


def _block_restarted(station: Station) -> str:
    before = state_of(station)
    device_with(station, "power_cycle").tell(f"power_cycle {BRIEF_S:g}")
    time.sleep(WATCH_S)
    check_back(station)
    check_armed(station, before, "a restart")
    return f"good again{', dead-man armed' if before.get('armed') else ''}"


def power_cycled(station: Station, full: bool) -> str:
    """Switch the supply off and on: a place that was lost is a fault that a reset alone does not forget."""
    device = device_with(station, "power_cycle")
    axis = first_axis(station)
    fast = usual_speed(station, axis)
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        restore(station, node, axis)
        node.move(axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
        place = node.read().position[0]
        device.tell(f"power_cycle {OFF_S:g}")
        wait_for(lambda: not station.is_good() or in_fault(node), OFF_S)
        time.sleep(OFF_S)
        check_back(station)
        time.sleep(WATCH_S)
        check_still(station, fast, "a power cycle")
        shown = node.read().position[0]
        if abs(shown - place) <= max(2 * axis.tolerance, 0.02 * axis.reach):
            restore(station, node, axis, place)
            return f"its place is kept over the supply: {shown:.6g}"
        told = in_fault(node)
        reset(node)
        try:
            node.move(0.5 * axis.reach, timeout=2.0)
        except OSError as error:
            text = f"place lost ({place:.4g} reads {shown:.4g}), told, and moves refused: {error.strerror}"
        else:
            seen = (
                f"place {place:.6g} reads {shown:.6g}, {'a fault' if told else 'no fault'}, and after RESET a move is "
                "taken"
            )
            raise Failed("no move to a position until somebody has said where the axis is", seen)
        restore(station, node, axis)
        node.move(0.25 * axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
    return text


def reopened(station: Station, full: bool) -> str:
    """Open the device again, in full twice; its dead-man must hold as the first time.

    At once after the driver's end, with the dead-man still running, a device is opened in the trial ``kill driver``.
    """
    before = state_of(station)
    if "armed" not in before:
        raise NotApplicable("its simulated device does not say whether a dead-man is armed")
    if not before["armed"]:
        return "the device has no dead-man, or the configuration sets none"
    for pause_s in (0.2, 2.0) if full else (2.0,):  # the dead-man runs out in the longer one
        station.end_daemon()
        time.sleep(pause_s)
        station.start_daemon()
        check_back(station)
        check_armed(station, before, f"another opening {pause_s:g} s after the driver's end")
    return f"armed after another opening, {_dead_man(station)}"


def _dead_man(station: Station) -> str:
    """Cut the line and see the device end what it does by itself."""
    if not station.wires:
        return "not tried: no line"
    outputs = [o for o in station.rig.outputs if o.width and "outputs" in state_of(station)]
    if outputs:
        return _outputs_alone(station, outputs[0])
    if not station.rig.axes:
        return "nothing to end"
    axis = station.rig.axes[0]
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        run(station, node, axis)
        fast = wait_moving(station, node.read, axis)
        station.tell_wire("unplug")
        try:
            check_stops(station, fast, "the cable was pulled (after another opening)", 2 * DEAD_MAN_S)
        finally:
            station.tell_wire("plug")
        check_back(station)
    return "at rest by itself"


def _outputs_alone(station: Station, output: Output) -> str:
    with station.cell.open(output.node, "rw", timeout=5.0) as node:
        set_all(node, output)
        if not wait_for(lambda: state_of(station)["outputs"] == int(output.another), 2.0):
            raise Failed(f"outputs {int(output.another):#x} after a write", f"{state_of(station)['outputs']:#x}")
        station.tell_wire("unplug")
        try:
            if not wait_for(lambda: not state_of(station)["outputs"] & int(output.another), SAFE_S):
                seen = f"{state_of(station)['outputs']:#x} {SAFE_S:g} s later"
                raise Failed("outputs off by the dead-man after the cable was pulled (after another opening)", seen)
        finally:
            station.tell_wire("plug")
        check_back(station)
    return "outputs off by themselves"


def streams_again(station: Station, full: bool) -> str:
    """Switch a sensor's supply off and on: it is lost or good, and good again at the end."""
    device = device_with(station, "power_cycle")
    if station.rig.axes or not has_class(station, NodeClass.ANALOG) or station.rig.outputs:
        raise NotApplicable("not a sensor")
    for seconds in (BRIEF_S, OFF_S):
        before = station.status()
        with Calm(station) as calm:
            device.tell(f"power_cycle {seconds:g}")
            time.sleep(seconds)
            took_s = check_back(station)
            calm.watch(WATCH_S)
            after = station.status()
        if (after["pid"], after["deaths"]) != (before["pid"], before["deaths"]):
            raise Failed("the driver process to live on", after["reason"] or "it died")
        if calm.wrong and station.is_good():
            raise Failed("no reading of another range, rate or zero without a flag", calm.wrong[0], calm.traffic)
    return f"good again {1e3 * took_s:.0f} ms after the supply"


TRIALS = (
    Trial("stale", "the device's loop closed again behind a motion", stale, wire=False),
    Trial("restart", "a restart of the device too brief to lose its link", restarted, wire=False),
    Trial("power cycle", "the device's supply off and on", power_cycled, wire=False),
    Trial("sensor power cycle", "the sensor's supply off and on", streams_again, wire=False),
    Trial("reopened", "another opening of the device, its dead-man run out before", reopened, wire=False),
)
