"""Trials of stops and safe values that are lost or refused, and of outputs that the device has dropped."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

from .device import (
    check_safe,
    check_still,
    check_stops,
    device_with,
    first_axis,
    restore,
    state_of,
    stop_by,
    usual_speed,
)
from .line_trials import check_back
from .motion_trials import run, set_all, wait_moving
from .station import Station, wait_for
from .trial import Failed, NotApplicable, Trial

SILENT_S = 0.25
"""How long requests are lost or refused, beginning with the stop [s]."""
LONG_SILENCE_S = 2.0


def lost_stop(station: Station, full: bool) -> str:
    """Lose the request of a stop, lose its reply, let the device refuse it: the axis must come to rest all the same."""
    axis = first_axis(station)
    fast = usual_speed(station, axis)
    texts = []
    for (name, begin, end), way in _tried(_hindrances(station), ("stop", "emergency stop", "close"), full):
        with station.cell.open(f"{axis.node}.readonly") as seen:
            node = station.cell.open(axis.node, "rw", timeout=5.0)
            try:
                restore(station, node, axis)
                run(station, node, axis)
                wait_moving(station, node.read, axis)
                begin()
                began = time.monotonic()
                with contextlib.suppress(OSError):
                    stop_by(station, node, way)
                time.sleep(SILENT_S)
                end()
                check_stops(station, fast, f"{way}, {name}")
                texts.append(1e3 * (time.monotonic() - began))
                check_back(station)
                check_still(station, fast, f"{way}, {name}")
                wait_for(lambda: not seen.read().in_motion[0], 2.0)
            finally:
                end()
                with contextlib.suppress(OSError):
                    node.close()
                station.cell.reset()
    return f"{len(texts)} stops, the slowest at rest after {max(texts):.0f} ms, {1e3 * SILENT_S:.0f} of them hindered"


Hindrance = tuple[str, Callable[[], Any], Callable[[], Any]]
"""Of a stop: its name, begin, end."""


def _tried(hindrances: Sequence[Hindrance], ways: Sequence[str], full: bool) -> list[tuple[Hindrance, str]]:
    """Return what is tried together: in full all pairs, else every hindrance and every way at least once.

    The ways are the kit's, and lead to one stop; what hinders it is for the driver to get over.
    """
    if full:
        return list(itertools.product(hindrances, ways))
    count = max(len(hindrances), len(ways))
    return list(itertools.islice(zip(itertools.cycle(hindrances), itertools.cycle(ways), strict=False), count))


def _hindrances(station: Station) -> list[Hindrance]:
    """Return what can hinder a stop."""
    found: list[Hindrance] = []
    if station.wires:
        found.append(("its request lost", lambda: station.fault(deaf=1.0), station.fault))
        found.append(("its reply lost", lambda: station.fault(lose=1.0), station.fault))
    if "refuse" in station.verbs and station.simulator is not None:
        device = station.simulator
        found.append(("refused", lambda: device.tell("refuse 2"), lambda: device.tell("refuse 0")))
    if not found:
        raise NotApplicable("the driver has no line, and its simulated device refuses nothing")
    return found


def lost_outputs(station: Station, full: bool) -> str:
    """Lose or refuse the safe value: outputs must become safe as soon as the device listens, under a latched stop,
    too.
    """
    outputs = [o for o in station.rig.outputs if o.safe is not None]
    if not outputs:
        raise NotApplicable("the device has no outputs with a safe value")
    output, count = outputs[0], 0
    for (name, begin, end), way in _tried(_hindrances(station), ("emergency stop", "close"), full):
        with station.cell.open(f"{output.node}.readonly") as seen:
            node = station.cell.open(output.node, "rw", timeout=5.0)
            try:
                set_all(node, output)
                wait_for(lambda: output.shown(seen, output.another), 3.0)
                begin()
                time.sleep(0.1)
                with contextlib.suppress(OSError):
                    stop_by(station, node, way)
                time.sleep(LONG_SILENCE_S)
                end()
                check_back(station)
                check_safe(station, output, seen, f"{way}, {name} for {LONG_SILENCE_S:g} s")
                count += 1
            finally:
                end()
                with contextlib.suppress(OSError):
                    node.close()
                station.cell.reset()
    return f"safe after {count} hindered stops"


def revived(station: Station, full: bool) -> str:
    """Let the device drop its outputs, then write one bit: what was dropped stays off."""
    outputs = [o for o in station.rig.outputs if o.width > 1]
    if not outputs or "outputs" not in state_of(station):
        raise NotApplicable("the device has no port of outputs, or does not say which are on")
    device, output = device_with(station, "power_cycle"), outputs[0]
    low, high = f"{output.node}.bit0", f"{output.node}.bit{output.width - 1}"
    top = 1 << (output.width - 1)
    with (
        station.cell.open(low, "rw", timeout=5.0) as first,
        station.cell.open(high, "rw", timeout=5.0) as last,
    ):
        first.set(1)
        last.set(0)
        if not wait_for(lambda: state_of(station)["outputs"] & 1, 2.0):
            raise Failed("bit 0 on after a write", f"{state_of(station)['outputs']:#x}")
        device.tell("power_cycle 0.3")
        time.sleep(0.5)
        check_back(station)
        dropped = not state_of(station)["outputs"] & 1
        last.set(1)
        if not wait_for(lambda: state_of(station)["outputs"] & top, 2.0):
            raise Failed("the bit that was written on", f"{state_of(station)['outputs']:#x}")
        time.sleep(0.2)
        if dropped and state_of(station)["outputs"] & 1:
            raise Failed("bit 0 off, as the device left it", f"{state_of(station)['outputs']:#x}: it is on again")
        last.set(0)
    return "dropped bits stay off" if dropped else "the device keeps its outputs over a power cycle"


TRIALS = (
    Trial("lost stop", "a stop whose request or reply is lost, or that is refused", lost_stop, wire=False),
    Trial("lost outputs", "a safe value that is lost or refused", lost_outputs, wire=False),
    Trial("revived", "one bit written after the device has dropped its outputs", revived, wire=False),
)
