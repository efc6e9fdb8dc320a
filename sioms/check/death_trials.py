"""Trials of deaths: SIGKILL of client, driver and daemon in motion, and a cable pulled in motion."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sioms.protocol.flags import ControlMode

from .device import check_armed, state_of
from .motion_trials import REST_S, SLOW, STILL_S, check_rest, run, slowly, wait_moving
from .rigs import Output
from .station import Client, Station, wait_for
from .trial import Failed, NotApplicable, Trial

GONE_S = 5.0
KILLS = 3
"""Of the driver; the daemon puts a device in fault after five deaths a minute."""
BRAKE_S = 0.1
"""From the last command to rest, and a poll to read it [s]."""
DEAD_MAN_S = 1.5
"""How long a device without its host is watched."""
RUN = """
node = cell.open(sys.argv[2], 'rw', timeout=5.0)
words = dict(pair.split('=') for pair in sys.argv[3:])
node.command(**{key: float(value) for key, value in words.items()})
print('ready', flush=True)
time.sleep(1000)
"""
HOME = """
node = cell.open(sys.argv[2], 'rw', timeout=5.0)
node.home()
print('ready', flush=True)
time.sleep(1000)
"""
SET = """
node = cell.open(sys.argv[2], 'rw', timeout=5.0)
node.set(*[float(sys.argv[3])] * len(node.info.channels))
print('ready', flush=True)
time.sleep(1000)
"""


def _runner(station: Station, read: Callable[[], Any]) -> Client:
    """Start a client of its own that runs the first axis."""
    axis = station.rig.axes[0]
    way = -1.0 if read().position[0] > 0 else 1.0
    words = {"velocity": way * axis.velocity}
    if not station.has(ControlMode.VELOCITY):
        words = {"position": way * 20 * axis.reach, **slowly(station, axis)}
    return station.start_client(RUN, axis.node, *(f"{key}={value}" for key, value in words.items()))


def client_killed(station: Station, full: bool) -> str:
    """SIGKILL of the client: its axis halts and is free, its outputs become safe."""
    texts = []
    for _ in range(5 if full else 1):
        if station.rig.axes:
            axis = station.rig.axes[0]
            with station.cell.open(f"{axis.node}.readonly") as seen:
                client = _runner(station, seen.read)
                try:
                    fast = wait_moving(station, seen.read, axis)
                finally:
                    client.kill()
                took_s = check_rest(station, seen.read, axis, fast, "SIGKILL of its client")
            texts.append(f"at rest after {1e3 * took_s:.0f} ms")
    texts += _outputs_of_killed(station)
    if not texts:
        raise NotApplicable("the device takes no commands")
    return ", ".join(texts)


def _outputs_of_killed(station: Station) -> list[str]:
    return [_output_of_killed(station, output) for output in station.rig.outputs if output.safe is not None]


def _output_of_killed(station: Station, output: Output) -> str:
    safe = output.safe or 0.0
    with station.cell.open(f"{output.node}.readonly") as seen:
        client = station.start_client(SET, output.node, f"{output.another:g}")
        shown = wait_for(lambda: output.shown(seen, output.another), 3.0)
        client.kill()
        if not shown:
            raise Failed(f"{output.node} = {output.another:g} after a write", f"{seen.read().data[0]:g}")
        if not wait_for(lambda: output.shown(seen, safe), 3.0):
            raise Failed(
                f"{output.node} = {safe:g}, the safe value, after SIGKILL of its writer",
                f"{seen.read().data[0]:g}",
            )
    return f"{output.node} safe"


def driver_killed(station: Station, full: bool) -> str:
    """SIGKILL of the driver, in full also while it homes: a new one comes, the device rests, nothing resumes."""
    ways = [_set_going] * (KILLS if full else 1)
    if full and "homing = true" in station.rig.tables:
        ways.append(_set_homing)
    texts: list[str] = []
    for way in ways:
        if texts:
            station.settle()  # the device's own dead-man may have put it in fault meanwhile
        texts.append(_kill_driver(station, way))
    return ", ".join(texts)


def _kill_driver(station: Station, set_going: Callable[[Station], tuple[float, Client | None]]) -> str:
    before, device = station.status(), state_of(station)
    fast, client = set_going(station)
    os.kill(before["pid"], signal.SIGKILL)
    began = time.monotonic()
    text = ""
    try:
        if fast:
            text = f"device at rest after {1e3 * _device_rests(station, fast, 'SIGKILL of the driver'):.0f} ms, "
    finally:
        if client is not None:
            client.kill()
    if not wait_for(lambda: station.status()["generation"] > before["generation"], GONE_S):
        raise Failed(f"a new driver process within {GONE_S:g} s", f"the device is {station.status()['state']}")
    station.wait_good()
    check_armed(station, device, "the opening by the new driver")
    text += f"new driver good after {1e3 * (time.monotonic() - began):.0f} ms"
    _check_still(station, "the driver's death")
    return text


def daemon_killed(station: Station, full: bool) -> str:
    """SIGKILL of the daemon: the drivers stop everything, let go of the line, and end."""
    pid = station.status()["pid"]
    fast, client = _set_going(station)
    if station.daemon is not None:
        station.daemon.process.kill()
    began = time.monotonic()
    text = ""
    try:
        if fast:
            text = f"device at rest after {1e3 * _device_rests(station, fast, 'SIGKILL of the daemon'):.0f} ms, "
        if not wait_for(lambda: _is_gone(pid), GONE_S):
            raise Failed(f"the driver process to end within {GONE_S:g} s", f"process {pid} is still there")
        text += f"driver gone after {1e3 * (time.monotonic() - began):.0f} ms"
    finally:
        if client is not None:
            client.kill()
        station.end_daemon(kill=True)
        station.start_daemon()
    station.wait_good()
    _check_still(station, "the daemon's death")
    return text


def _is_gone(pid: int) -> bool:
    """Whether a process has ended, be it that nobody has reaped it yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


def pulled_in_motion(station: Station, full: bool) -> str:
    """Pull the cable in motion and put it back: the device is stopped, and nothing resumes."""
    if not station.rig.axes:
        raise NotApplicable("the device has no axes")
    axis = station.rig.axes[0]
    with station.cell.open(axis.node, "rw", timeout=5.0) as node:
        run(station, node, axis)
        fast = wait_moving(station, node.read, axis)
        station.tell_wire("unplug")
        try:
            if not wait_for(lambda: not station.is_good(), 5.0):
                raise Failed("a lost link", "the link is told to be good")
            text = _by_itself(station, fast)
        finally:
            station.tell_wire("plug")
        station.wait_good()
        took_s = check_rest(station, node.read, axis, fast, "the cable was put back")
    return f"{text}at rest {1e3 * took_s:.0f} ms after the link was good again"


def _by_itself(station: Station, fast: float) -> str:
    """Tell whether the device ends its motion without its host; '' where it does not say how it moves."""
    if not fast:
        return ""
    began = time.monotonic()
    if wait_for(lambda: abs(station.speed() or 0.0) <= SLOW * fast, DEAD_MAN_S):
        return f"by itself at rest {1e3 * (time.monotonic() - began):.0f} ms after the loss, "
    return f"MOVES ON without its host: no dead-man within {DEAD_MAN_S:g} s, or open() sets none; "


def _set_going(station: Station) -> tuple[float, Client | None]:
    """Run the first axis by a client of its own; return the device's speed, 0 when it does not tell, and the client."""
    if not station.rig.axes:
        return 0.0, None
    axis = station.rig.axes[0]
    with station.cell.open(f"{axis.node}.readonly") as seen:
        client = _runner(station, seen.read)
        try:
            return wait_moving(station, seen.read, axis), client
        except BaseException:
            client.kill()
            raise


def _set_homing(station: Station) -> tuple[float, Client | None]:
    """Let a client of its own home the first axis; return the device's speed, and the client."""
    axis = station.rig.axes[0]
    with station.cell.open(f"{axis.node}.readonly") as seen:
        if station.simulator is not None and "reference" in station.verbs:
            station.simulator.tell("reference")
        client = station.start_client(HOME, axis.node)
        if not wait_for(lambda: seen.read().in_motion[0], 3.0):
            client.kill()
            raise Failed("an axis that homes", "it does not move")
    time.sleep(BRAKE_S)
    return abs(station.speed() or 0.0), client


def _device_rests(station: Station, fast: float, after: str) -> float:
    began = time.monotonic()
    if not wait_for(lambda: abs(station.speed() or 0.0) <= SLOW * fast, REST_S):
        raise Failed(f"the device at rest within {REST_S:g} s after {after}", f"it moves at {station.speed():.6g}")
    return time.monotonic() - began


def _check_still(station: Station, after: str) -> None:
    """Check that no axis moves."""
    for axis in station.rig.axes[:1]:
        with station.cell.open(f"{axis.node}.readonly") as seen:
            time.sleep(BRAKE_S)
            place = seen.read().position[0]
            time.sleep(STILL_S)
            reading = seen.read()
            if abs(reading.position[0] - place) > 2 * axis.tolerance or reading.in_motion[0]:
                seen_text = f"it went from {place:.6g} to {reading.position[0]:.6g}, in_motion {reading.in_motion[0]}"
                raise Failed(f"rest after {after}, and nothing to resume", seen_text)


TRIALS = (
    Trial("kill client", "SIGKILL of the client in motion", client_killed, wire=False),
    Trial("pulled", "the cable pulled in motion and put back", pulled_in_motion),
    Trial("kill driver", "SIGKILL of the driver in motion", driver_killed, wire=False),
    Trial("kill daemon", "SIGKILL of the daemon in motion", daemon_killed, wire=False),
)
