"""Trials of the device behind the driver: it restarts, loses its supply, refuses, freezes, obeys another master, or moves by itself.

They use verbs of the simulated device (``docs/driver-check.md``, "A simulated device"); what it has no verb for is not tried. What
moves and which outputs are on is what the device itself says, not what the driver reads.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass

from ..counterparts.rigs import Axis, Output
from .calm import Calm
from .death_trials import DEAD_MAN_S
from .line_trials import check_back, disturbed, has_class
from .motion_trials import SLOW, check_rest, forward, run, set_all, wait_moving
from .station import Station, Unanswered, wait_for
from .trial import Failed, NotApplicable, Trial

BRIEF_S = 0.04
"""A restart that ends before any link counts as lost [s]."""
OFF_S = 1.5
NOTICE_S = 3.0
"""Longest time from what happens in the device to its fault, or the loss of its link [s]."""
WATCH_S = 0.5
STOOD_S = 0.06
SILENT_S = 0.25
"""How long requests are lost or refused, beginning with the stop [s]."""
LONG_SILENCE_S = 2.0
SAFE_S = 4.0
FROZEN_S = 3.0
SAME_SPEED = 0.25
"""The device's speed before and after may differ by this part."""
TOO_FAST = 1.5
"""Times the speed limit."""


# --- what is needed, and what the device says -----------------------------------------------------------


def _first_axis(station: Station) -> Axis:
    if not station.rig.axes:
        raise NotApplicable("the device has no axes")
    return station.rig.axes[0]


def _device(station: Station, verb: str) -> Any:
    """Return the simulated device, if it has a verb."""
    if station.counterpart is None or verb not in station.verbs:
        raise NotApplicable(f"its simulated device has no verb {verb}")
    return station.counterpart


def _state(station: Station) -> dict[str, Any]:
    if station.counterpart is None or "state" not in station.verbs:
        return {}
    found = station.counterpart.tell("state")
    return found if isinstance(found, dict) else {}


def _usual_speed(station: Station, axis: Axis) -> float:
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


def _stays(station: Station, fast: float, seconds: float, after: str) -> None:
    """Check that the device itself does not move for a time."""
    began = time.monotonic()
    while (now := time.monotonic()) - began < seconds:
        speed = abs(station.speed() or 0.0)
        if speed > SLOW * fast:
            seen = f"the device moves at {speed:.6g} (usually {fast:.6g}), {1e3 * (now - began):.0f} ms after it stood"
            raise Failed(f"no motion after {after}", seen)
        time.sleep(0.001)


def _rests(station: Station, fast: float, after: str, seconds: float = NOTICE_S) -> None:
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


def _in_fault(node: Any) -> bool:
    """Whether an axis is in fault, its place or its link lost."""
    try:
        return bool(node.read().status[0] & (AxisStatus.FAULT | AxisStatus.POSITION_LOST))
    except OSError:
        return True


def _noticed(station: Station, node: Any, what: str, seconds: float = NOTICE_S) -> float:
    """Wait for a fault or a lost link; return how long that took [s]."""
    began = time.monotonic()
    if not wait_for(lambda: _in_fault(node) or not station.is_good(), seconds):
        raise Failed(
            f"a fault or a lost link within {seconds:g} s after {what}",
            f"the link is good, status {node.read().status[0]:#x}, position {node.read().position[0]:.6g}",
        )
    return time.monotonic() - began


def _reset(node: Any) -> None:
    with contextlib.suppress(OSError):
        node.reset()
    wait_for(lambda: not _in_fault(node), 1.0)


def _restore(station: Station, node: Any, axis: Axis, place: float = 0.0) -> None:
    """Make an axis fit for work: reset it, and where its place was lost, say where it is."""
    _reset(node)
    with contextlib.suppress(OSError):
        node.calibrate(place)
    _reset(node)
    if _in_fault(node):
        raise Failed("an axis fit for work after reset and calibration", station.last_fault())


def _check_armed(station: Station, before: dict[str, Any], after: str) -> None:
    if before.get("armed") and not wait_for(lambda: _state(station).get("armed"), NOTICE_S):
        raise Failed(f"the dead-man armed after {after}", "the device says that none is")


# --- restarts and supply ----------------------------------------------------------------------------------


def stale(station: Station, full: bool) -> str:
    """End a motion in every way that opens the device's loop, then close the loop again: nothing may move."""
    axis = _first_axis(station)
    fast = _usual_speed(station, axis)
    occasions: list[tuple[str, Callable[[Station, Any, float], None]]] = [
        ("an emergency stop and its reset", _stopped),
        ("the cable was put back", _cable),
    ]
    if "power_cycle" in station.verbs:
        occasions.append(("a power cycle", _supply))
    goers = [("running", run)]
    if station.has(ControlMode.FORCE):
        goers.append(("pushing", _push))
    count = 0
    for name, go in goers:
        for what, do in occasions:
            with station.cell.open(axis.node, "rw", timeout=5.0) as node:
                _restore(station, node, axis)
                go(station, node, axis)
                if go is run:
                    wait_moving(station, node.read, axis)
                else:
                    time.sleep(0.2)
                do(station, node, fast)
                after = f"{what} ({name} before)"
                _stays(station, fast, WATCH_S, after)
                _reset(node)
                _stays(station, fast, WATCH_S, f"{after}, and RESET")
                _restore(station, node, axis)
                _stays(station, fast, WATCH_S, f"{after}, RESET and calibration")
            count += 1
    return f"stood still after {count} ways of closing the loop"


def _push(station: Station, node: Any, axis: Axis) -> None:
    limit = node.info.channels[0].limits.get("force", 1.0)
    node.command(force=forward(node, axis) * 0.2 * limit)


def _stopped(station: Station, node: Any, fast: float) -> None:
    station.cell.emergency_stop(why="driver check")
    _rests(station, fast, "an emergency stop")
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
        _stays(station, fast, WATCH_S, "the cable was put back")
    check_back(station)
    _rests(station, fast, "the cable was put back")


def _supply(station: Station, node: Any, fast: float) -> None:
    _device(station, "power_cycle").tell("power_cycle 0.3")
    _noticed(station, node, "a power cycle")  # until then what the client commanded may be going on
    check_back(station)
    _rests(station, fast, "a power cycle")


def restarted(station: Station, full: bool) -> str:
    """Restart the device so briefly that no link is lost: dead-man and limits must be set again, and the fault told."""
    device = _device(station, "power_cycle")
    if not station.rig.axes:
        return _block_restarted(station)
    axis = _first_axis(station)
    fast, before = _usual_speed(station, axis), _state(station)
    texts = []
    for moving in (False, True):
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            if moving:
                run(station, node, axis)
                wait_moving(station, node.read, axis)
            device.tell(f"power_cycle {BRIEF_S:g}")
            what = "a restart in motion" if moving else "a restart at rest"
            noticed_s = _noticed(station, node, what)
            check_back(station)
            _rests(station, fast, what)
            _stays(station, fast, WATCH_S, what)
            _restore(station, node, axis)
            _stays(station, fast, WATCH_S, f"{what}, and RESET")
            _check_armed(station, before, what)
        again = _usual_speed(station, axis)
        if abs(again - fast) > SAME_SPEED * fast:
            raise Failed(f"the speed as before {what}: {fast:.6g}", f"the device moves at {again:.6g}")
        texts.append(f"{what}: told after {1e3 * noticed_s:.0f} ms")
    return ", ".join(texts)


def _block_restarted(station: Station) -> str:
    before = _state(station)
    _device(station, "power_cycle").tell(f"power_cycle {BRIEF_S:g}")
    time.sleep(WATCH_S)
    check_back(station)
    _check_armed(station, before, "a restart")
    return f"good again{', dead-man armed' if before.get('armed') else ''}"


def power_cycled(station: Station, full: bool) -> str:
    """Switch the supply off and on: a place that was lost is a fault that a reset alone does not forget."""
    device = _device(station, "power_cycle")
    axis = _first_axis(station)
    fast = _usual_speed(station, axis)
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        _restore(station, node, axis)
        node.move(axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
        place = node.read().position[0]
        device.tell(f"power_cycle {OFF_S:g}")
        wait_for(lambda: not station.is_good() or _in_fault(node), OFF_S)
        time.sleep(OFF_S)
        check_back(station)
        time.sleep(WATCH_S)
        _stays(station, fast, WATCH_S, "a power cycle")
        shown = node.read().position[0]
        if abs(shown - place) <= max(2 * axis.tolerance, 0.02 * axis.reach):
            _restore(station, node, axis, place)
            return f"its place is kept over the supply: {shown:.6g}"
        told = _in_fault(node)
        _reset(node)
        try:
            node.move(0.5 * axis.reach, timeout=2.0)
        except OSError as error:
            text = f"place lost ({place:.4g} reads {shown:.4g}), told, and moves refused: {error.strerror}"
        else:
            seen = f"place {place:.6g} reads {shown:.6g}, {'a fault' if told else 'no fault'}, and after RESET a move is taken"
            raise Failed("no move to a position until somebody has said where the axis is", seen)
        _restore(station, node, axis)
        node.move(0.25 * axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
    return text


def reopened(station: Station, full: bool) -> str:
    """Open the device a second and a third time; its dead-man must hold as the first time."""
    before = _state(station)
    if "armed" not in before:
        raise NotApplicable("its simulated device does not say whether a dead-man is armed")
    if not before["armed"]:
        return "the device has no dead-man, or the configuration sets none"
    for count in ("second", "third"):
        station.end_daemon()
        time.sleep(2.0 if count == "third" else 0.2)  # also with the dead-man run out meanwhile
        station.start_daemon()
        check_back(station)
        _check_armed(station, before, f"the {count} opening")
    return f"armed after three openings, {_dead_man(station)}"


def _dead_man(station: Station) -> str:
    """Cut the line and see the device end what it does by itself."""
    if not station.wires:
        return "not tried: no line"
    outputs = [o for o in station.rig.outputs if o.width and "outputs" in _state(station)]
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
            _rests(station, fast, "the cable was pulled (third opening)", 2 * DEAD_MAN_S)
        finally:
            station.tell_wire("plug")
        check_back(station)
    return "at rest by itself"


def _outputs_alone(station: Station, output: Output) -> str:
    with station.cell.open(output.node, "rw", timeout=5.0) as node:
        set_all(node, output)
        if not wait_for(lambda: _state(station)["outputs"] == int(output.another), 2.0):
            raise Failed(
                f"outputs {int(output.another):#x} after a write", f"{_state(station)['outputs']:#x}"
            )
        station.tell_wire("unplug")
        try:
            if not wait_for(lambda: not _state(station)["outputs"] & int(output.another), SAFE_S):
                seen = f"{_state(station)['outputs']:#x} {SAFE_S:g} s later"
                raise Failed("outputs off by the dead-man after the cable was pulled (third opening)", seen)
        finally:
            station.tell_wire("plug")
        check_back(station)
    return "outputs off by themselves"


# --- stops and safe values that are lost or refused ----------------------------------------------------------


def lost_stop(station: Station, full: bool) -> str:
    """Lose the request of a stop, lose its reply, let the device refuse it: the axis must come to rest all the same."""
    axis = _first_axis(station)
    fast = _usual_speed(station, axis)
    texts = []
    for name, begin, end in _hindrances(station):
        for way in ("stop", "emergency stop", "close"):
            with station.cell.open(f"{axis.node}.readonly") as seen:
                node = station.cell.open(axis.node, "rw", timeout=5.0)
                try:
                    _restore(station, node, axis)
                    run(station, node, axis)
                    wait_moving(station, node.read, axis)
                    begin()
                    began = time.monotonic()
                    with contextlib.suppress(OSError):
                        _stop(station, node, way)
                    time.sleep(SILENT_S)
                    end()
                    _rests(station, fast, f"{way}, {name}")
                    texts.append(1e3 * (time.monotonic() - began))
                    check_back(station)
                    _stays(station, fast, WATCH_S / 2, f"{way}, {name}")
                    wait_for(lambda: not seen.read().in_motion[0], 2.0)
                finally:
                    end()
                    with contextlib.suppress(OSError):
                        node.close()
                    station.cell.reset()
    return f"{len(texts)} stops, the slowest at rest after {max(texts):.0f} ms, {1e3 * SILENT_S:.0f} of them hindered"


def _stop(station: Station, node: Any, way: str) -> None:
    if way == "stop":
        node.stop()
    elif way == "close":
        node.close()
    else:
        station.cell.emergency_stop(why="driver check")


def _hindrances(station: Station) -> list[tuple[str, Callable[[], Any], Callable[[], Any]]]:
    """Return what can hinder a stop: name, begin, end."""
    found: list[tuple[str, Callable[[], Any], Callable[[], Any]]] = []
    if station.wires:
        found.append(("its request lost", lambda: station.fault(deaf=1.0), station.fault))
        found.append(("its reply lost", lambda: station.fault(lose=1.0), station.fault))
    if "refuse" in station.verbs and station.counterpart is not None:
        device = station.counterpart
        found.append(("refused", lambda: device.tell("refuse 2"), lambda: device.tell("refuse 0")))
    if not found:
        raise NotApplicable("the driver has no line, and its simulated device refuses nothing")
    return found


def lost_outputs(station: Station, full: bool) -> str:
    """Lose or refuse the safe value: outputs must become safe as soon as the device listens, under a latched stop, too."""
    outputs = [o for o in station.rig.outputs if o.safe is not None]
    if not outputs:
        raise NotApplicable("the device has no outputs with a safe value")
    output, count = outputs[0], 0
    hindrances = _hindrances(station)
    for name, begin, end in hindrances:
        for way in ("emergency stop", "close"):
            with station.cell.open(f"{output.node}.readonly") as seen:
                node = station.cell.open(output.node, "rw", timeout=5.0)
                try:
                    set_all(node, output)
                    wait_for(lambda: output.shown(seen, output.another), 3.0)
                    begin()
                    time.sleep(0.1)
                    with contextlib.suppress(OSError):
                        _stop(station, node, way)
                    time.sleep(LONG_SILENCE_S)
                    end()
                    check_back(station)
                    _becomes_safe(station, output, seen, f"{way}, {name} for {LONG_SILENCE_S:g} s")
                    count += 1
                finally:
                    end()
                    with contextlib.suppress(OSError):
                        node.close()
                    station.cell.reset()
    return f"safe after {count} hindered stops"


def _becomes_safe(station: Station, output: Output, seen: Any, after: str) -> None:
    safe = output.safe or 0.0
    state = _state(station)
    if output.width and "outputs" in state:
        if not wait_for(lambda: _state(station)["outputs"] == int(safe), SAFE_S):
            seen_text = f"the device's outputs are {_state(station)['outputs']:#x} {SAFE_S:g} s later"
            raise Failed(f"outputs {int(safe):#x} after {after}", seen_text)
    elif not wait_for(lambda: output.shown(seen, safe), SAFE_S):
        raise Failed(f"{output.node} = {safe:g} after {after}", f"{seen.read().data[0]:g}")


def revived(station: Station, full: bool) -> str:
    """Let the device drop its outputs, then write one bit: what was dropped stays off."""
    outputs = [o for o in station.rig.outputs if o.width > 1]
    if not outputs or "outputs" not in _state(station):
        raise NotApplicable("the device has no port of outputs, or does not say which are on")
    device, output = _device(station, "power_cycle"), outputs[0]
    low, high = f"{output.node}.bit0", f"{output.node}.bit{output.width - 1}"
    top = 1 << (output.width - 1)
    with (
        station.cell.open(low, "rw", timeout=5.0) as first,
        station.cell.open(high, "rw", timeout=5.0) as last,
    ):
        first.set(1)
        last.set(0)
        if not wait_for(lambda: _state(station)["outputs"] & 1, 2.0):
            raise Failed("bit 0 on after a write", f"{_state(station)['outputs']:#x}")
        device.tell("power_cycle 0.3")
        time.sleep(0.5)
        check_back(station)
        dropped = not _state(station)["outputs"] & 1
        last.set(1)
        if not wait_for(lambda: _state(station)["outputs"] & top, 2.0):
            raise Failed("the bit that was written on", f"{_state(station)['outputs']:#x}")
        time.sleep(0.2)
        if dropped and _state(station)["outputs"] & 1:
            raise Failed(
                "bit 0 off, as the device left it", f"{_state(station)['outputs']:#x}: it is on again"
            )
        last.set(0)
    return "dropped bits stay off" if dropped else "the device keeps its outputs over a power cycle"


# --- bytes, frozen readings, other masters, defects --------------------------------------------------------------


def misframed(station: Station, full: bool) -> str:
    """Add bytes to requests and lose bytes of them: the device must be reached again, by stops above all."""
    if station.rig.line != "serial":
        raise NotApplicable("only a serial line loses and adds bytes")
    checked = station.rig.checked  # without a checksum a lost digit is another command
    for faults in ({"stray": 0.3}, {"short": 0.3}) if checked else ({"stray": 0.3},):
        disturbed(station, 5.0 if full else 0.5, judge=checked, **faults)
    if not station.rig.axes:
        return "reached again"
    axis = station.rig.axes[0]
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        _restore(station, node, axis)  # the disturbance may have lost the link
    fast = _usual_speed(station, axis)
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        for way in ("stop", "emergency stop"):
            _restore(station, node, axis)
            run(station, node, axis)
            wait_moving(station, node.read, axis)
            station.fault(stray=1.0, count=1)
            with contextlib.suppress(OSError):
                _stop(station, node, way)
            _rests(station, fast, f"{way} behind a stray byte")
            check_back(station)
            station.cell.reset()
    return "reached again; two stops behind a stray byte"


def frozen(station: Station, full: bool) -> str:
    """Let the readings of a streaming device stand still: that is a lost device, not a quiet one."""
    device = _device(station, "freeze")
    with station.cell.open(station.nodes[0].reader) as node:
        if "stream" not in node.statistics(1):
            raise NotApplicable("the device is asked; that its answers stand still cannot be told from rest")
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
        finally:
            device.tell("freeze 0")
        check_back(station)
    return f"lost after {1e3 * lost_s:.0f} ms"


def other_master(station: Station, full: bool) -> str:
    """Let somebody else command the device, behind the driver's back and before it opens the device."""
    device = _device(station, "foreign")
    if not station.rig.axes:
        return _foreign_outputs(station)
    axis = _first_axis(station)
    fast = _usual_speed(station, axis)
    with station.cell.open(
        f"{axis.node}.readonly"
    ) as seen:  # else the motion is taken for the end of the last stop
        wait_for(lambda: not seen.read().in_motion[0], 2.0)
    try:
        device.tell(f"foreign velocity {0.5 * fast:.9g}")
    except Unanswered as error:
        raise NotApplicable(f"its simulated device: {error}") from None
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        _rests(station, 0.5 * fast, "another master's velocity")
        told = _in_fault(node)
        _restore(station, node, axis)
        _stays(station, fast, WATCH_S, "another master's velocity, and RESET")
    if not told:
        raise Failed("a fault of motion that nobody here commanded", "none")
    station.end_daemon()
    device.tell(f"foreign velocity {0.5 * fast:.9g}")
    time.sleep(0.1)
    station.start_daemon()
    check_back(station)
    _rests(station, 0.5 * fast, "the opening of a device that another master left running")
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        _restore(station, node, axis)
        _stays(station, fast, WATCH_S, "the opening, and RESET")
        node.move(0.5 * axis.reach, timeout=2.0)
        node.wait_until_idle(20.0)
        node.move(0.0, timeout=2.0)
        node.wait_until_idle(20.0)
    return "stopped and told; stopped by the opening, moves as ever"


def _foreign_outputs(station: Station) -> str:
    outputs = [o for o in station.rig.outputs if o.safe is not None and o.width]
    device = _device(station, "foreign")
    if not outputs or "outputs" not in _state(station):
        raise NotApplicable("the device has no outputs that another master could set")
    output = outputs[0]
    with station.cell.open(f"{output.node}.readonly") as seen:
        station.cell.emergency_stop(why="driver check")
        try:
            device.tell(f"foreign output {int(output.another)}")
            time.sleep(0.1)
            _becomes_safe(station, output, seen, "another master's write under a latched stop")
        finally:
            station.cell.reset()
    return "safe again under a latched stop"


def shoved(station: Station, full: bool) -> str:
    """Let the motor turn by itself, and faster than its limit: both are faults, told at once."""
    device = _device(station, "shove")
    axis = _first_axis(station)
    fast = _usual_speed(station, axis)
    limit = station.cell.info(axis.node).channels[0].limits["velocity"]
    above = TOO_FAST * limit / axis.velocity * fast
    texts = []
    for what, speed, moving in (("by itself", 0.5 * fast, False), ("above its limit", above, True)):
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            _restore(station, node, axis)
            if moving:
                run(station, node, axis)
                wait_moving(station, node.read, axis)
            way = forward(node, axis)
            device.tell(f"shove {way * speed:.9g}")
            try:
                noticed_s = _noticed(station, node, f"motion {what}", 1.0)
            finally:
                device.tell("shove 0")
            _rests(station, fast, f"motion {what}")
            check_back(station)
            _restore(station, node, axis)
            _stays(station, fast, WATCH_S / 2, f"motion {what}, and RESET")
        texts.append(f"motion {what}: told after {1e3 * noticed_s:.0f} ms")
    return ", ".join(texts)


def streams_again(station: Station, full: bool) -> str:
    """Switch a sensor's supply off and on: it is lost or good, and good again at the end."""
    device = _device(station, "power_cycle")
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
            raise Failed(
                "no reading of another range, rate or zero without a flag", calm.wrong[0], calm.traffic
            )
    return f"good again {1e3 * took_s:.0f} ms after the supply"


TRIALS = (
    Trial("stale", "the device's loop closed again behind a motion", stale, wire=False),
    Trial("restart", "a restart of the device too brief to lose its link", restarted, wire=False),
    Trial("power cycle", "the device's supply off and on", power_cycled, wire=False),
    Trial("sensor power cycle", "the sensor's supply off and on", streams_again, wire=False),
    Trial("reopened", "a second and a third opening of the device", reopened, wire=False),
    Trial("lost stop", "a stop whose request or reply is lost, or that is refused", lost_stop, wire=False),
    Trial("lost outputs", "a safe value that is lost or refused", lost_outputs, wire=False),
    Trial("revived", "one bit written after the device has dropped its outputs", revived, wire=False),
    Trial("misframed", "bytes added to requests and lost from them", misframed),
    Trial("frozen", "readings that stand still", frozen, wire=False),
    Trial("other master", "another master's commands", other_master, wire=False),
    Trial("shoved", "motion by itself, and above the speed limit", shoved, wire=False),
)
