"""Deaths while a hand holds an object and carries it: whatever dies or hangs, both modules come to rest.

The cell is simulated, in slow motion (`sioms.hand.slow`), so that it runs on a machine that is shared; its leases are
those of pace 1. Wrist sensors tell the force: what is tried is who notices whose death, and estimators would only take
time. A round grasps by the hand's own force command and carries the object to and fro, or goes on to it with one finger
that yields under a greatest force; then it does away with something, and looks at the modules that are left: when they
are commanded to move last, and when they move last. What was stopped then goes on, and no module may move by it.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from sioms.check.daemon import Daemon, wait_for
from sioms.client.command import command
from sioms.documents import toml_text
from sioms.hand.slow import slowed

from .figures import Bar, Report
from .killing import lives
from .options import Options

PACE = 0.1
FORCE_N, SPEED = 0.5, 0.01 * PACE
TOUCH_N = 0.06
LEASE_S, DRIVER_S, DAEMON_S, AGE_S = 0.25, 0.5, 0.5, 0.25
"""Leases of the program, of what a driver reads of another, of the daemon; age at which a force is none."""
MARGIN_S = 0.35
"""Beside the lease: a hand whose coordinates stand brings their error back for another 0.25 s."""
_SLOW = (0.25 * SPEED, 0.25 * SPEED, 0.05)
"""Velocities of a module below which it stands [m/s, rad/s]: encoders' steps show as some."""
SETTLE_S = 0.05 / PACE
"""How long after its commands a module may move: so long, at pace 1, its softest servo of 5 Hz takes."""
READY_S = 150.0
"""How long a cell may take to start, on a machine that does other work."""
WAKE_S, _STAYED = 1.0, (5e-4, 5e-4, 0.05)
"""How long modules are watched after what was stopped goes on, and how far they may be moved by it [m, rad]."""
MODULES = ("left", "right")
_TRIES = 5
LIMITS: Mapping[str, float] = {
    "program killed": 0.0, "program stopped": LEASE_S, "hand killed": 0.0, "hand stopped": LEASE_S,
    "world killed": 0.0, "world stopped": DRIVER_S, "left killed": 0.0, "left stopped": DRIVER_S,
    "wrist1 killed": AGE_S, "wrist1 stopped": AGE_S, "emergency stop": 0.0, "daemon killed": 0.0,
    "daemon stopped": DAEMON_S,
}  # fmt: skip
"""What happens in a round, and the lease within which it is noticed [s]."""


class Rest(NamedTuple):
    """When modules stood, after something was done away with.

    Args:
        told_ns: they were commanded to move last.
        moved_ns: they moved last.
    """

    told_ns: int
    moved_ns: int


def tables() -> dict[str, Any]:
    """Return the cell's configuration: a hand with wrist sensors at a millimetre from a disk."""
    devices: dict[str, Any] = {
        "world": {
            "driver": "sim-world", "object": {"shape": "disk", "radius_m": 0.02},
            "finger": [_finger(name) for name in MODULES],
        }
    }  # fmt: skip
    for name, sign in zip(MODULES, (-1.0, 1.0), strict=True):
        devices[name] = {
            "driver": "sim-axes", "carries": f"world.{name}_joints", "history": 1024,
            "axis": [
                _axis("x", "m", 1.4, 10.0, 0.5, sign * 0.0337), _axis("y", "m", 1.4, 10.0, 0.5, -sign * 0.14),
                _axis("th", "rad", 3e-4, 2e-3, 3.0, sign * 0.5 * math.pi),
            ],
        }  # fmt: skip
    for number, name in enumerate(MODULES, 1):
        contact = [
            {"node": f"world.{name}.fx", "direction": [1.0, 0.0, 0.0]},
            {"node": f"world.{name}.fy", "direction": [0.0, 1.0, 0.0]},
        ]
        quiet = {"noise": [0.002] * 3 + [1e-4] * 3, "resolution": [0.001] * 3 + [1e-4] * 3}
        devices[f"wrist{number}"] = {"driver": "sim-force", "tick_hz": 400.0, "contact": contact, **quiet}
    names = (("x", 0.3), ("y", 0.3), ("psi", 2.0), ("d", 0.4), ("phi1", 2.0), ("phi2", 2.0))
    devices["hand"] = {
        "driver": "hand", "axes": list(MODULES), "link_stiffness": 3.0, "history": 1024,
        "squeeze": {"wrists": ["wrist1", "wrist2"]}, "touch": {"wrists": ["wrist1", "wrist2"]},
        "axis": [{"name": name, "velocity_max": v, "acceleration_max": 10.0 * v, "gain": 10.0, "force_max": 4.0,
                  "watch": {"uncommanded": False, "tolerance": 1.0}} for name, v in names],
    }  # fmt: skip
    found = slowed({"workcell": {"name": "bench", "daemon_lease_s": DAEMON_S}, "device": devices}, PACE, Path())
    for device in found["device"].values():
        device.pop("process", None)  # each dies alone
        device |= {"lease_s": DRIVER_S, "realtime_priority": 10}
    for table in ("squeeze", "touch"):
        found["device"]["hand"][table]["age_max_s"] = AGE_S
    return found


def _finger(name: str) -> dict[str, Any]:
    axes = [f"{name}.plant.{joint}_position" for joint in ("x", "y", "th")]
    return {
        "name": name,
        "axes": axes,
        "mount": {"stiffness": 2.5e4, "turn_stiffness": 3.0, "mass": 0.2, "inertia": 2e-4},
    }


def _axis(name: str, unit: str, mass: float, viscous: float, velocity: float, start: float) -> dict[str, Any]:
    turns = unit == "rad"
    return {
        "name": name, "unit": unit, "velocity_max": velocity, "acceleration_max": 10.0 * velocity,
        "force_max": 0.8 if turns else 60.0, "bandwidth_hz": 5.06 if turns else 30.9, "following_error_max": 2.5,
        "watch": {"uncommanded": False, "tolerance": 1.0},
        "motor": {"mass": mass, "viscous": viscous, "encoder_step": 1e-6, "start": start},
    }  # fmt: skip


def toucher(daemon: Daemon, velocity: float) -> Callable[[], None]:
    """Return what a program does that goes on to the object with the left finger, which yields."""

    def program() -> None:
        hand, _ = _begun(daemon)
        speed = abs(velocity)
        hand.write([command(0, velocity=0.5 * speed), command(3, velocity=-speed, max_force=TOUCH_N)])
        while True:
            time.sleep(LEASE_S / 5)
            hand.keepalive()

    return program


def _begun(daemon: Daemon) -> tuple[Any, Any]:
    """Return the hand of a program that has just begun, and its session."""
    with contextlib.suppress(OSError):  # as its devices, where it may
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    cell = daemon.cell("holder")
    return cell.open("hand", "rw", 10.0, lease=LEASE_S), cell


def holder(daemon: Daemon, velocity: float) -> Callable[[], None]:
    """Return what a program does that squeezes, and then carries what it holds along x."""

    def program() -> None:
        hand, cell = _begun(daemon)
        force = cell.open("hand.force")
        hand.write(command(3, force=FORCE_N))
        while abs(float(force.read().data[0]) - FORCE_N) > 0.3 * FORCE_N:
            time.sleep(LEASE_S / 5)
            hand.keepalive()
        hand.write(command(0, velocity=velocity))
        while True:
            time.sleep(LEASE_S / 5)
            hand.keepalive()

    return program


def bench_holding(options: Options, report: Report) -> None:
    """Do away with program, drivers, world, sensor and daemon while the hand holds; look when both modules stand."""
    wanted, chance = options.kills(13, 130), random.Random(options.seed)
    found: dict[str, list[Rest]] = {what: [] for what in LIMITS}
    failed: Counter[str] = Counter()
    lame: Counter[str] = Counter()
    kinds, late = list[str](), 0
    while sum(map(len, found.values())) + failed.total() < wanted and lame.total() + late < wanted:
        try:
            with Daemon(toml_text(tables()), ready_s=READY_S) as daemon:
                _life(daemon, chance, kinds, wanted, found, failed, lame, report)
        except RuntimeError as error:  # a daemon that is not ready in time says nothing of those that were
            late += 1
            report.note(str(error).splitlines()[0])
    for what, samples in found.items():
        if samples:
            most_ms, notes = 1e3 * (LIMITS[what] + MARGIN_S), f"{len(samples)} rounds"
            told, moved = [one.told_ns for one in samples], [one.moved_ns for one in samples]
            report.samples(f"{what} to commands at rest", told, "ms", bars=[Bar("max", most_ms)], notes=notes)
            bar = Bar("max", most_ms + 1e3 * SETTLE_S)
            report.samples(f"{what} to the modules at rest", moved, "ms", bars=[bar], notes=notes)
    again = ", ".join(f"after {what}: {count}" for what, count in lame.items())
    bars = [Bar("value", 0.0)]
    report.value("rounds after which the hand did not hold again", lame.total(), "", bars=bars, notes=again)
    report.value(f"daemons that were not ready within {READY_S:g} s", late, "")
    notes = ", ".join(f"{what}: {count}" for what, count in failed.items())
    report.value("rounds in which a module moved on", failed.total(), "", bars=[Bar("value", 0.0)], notes=notes)


def _life(
    daemon: Daemon, chance: random.Random, kinds: list[str], wanted: int, found: dict[str, list[Rest]],
    failed: Counter[str], lame: Counter[str], report: Report,
) -> None:  # fmt: skip
    """Play rounds with one daemon until it dies itself, or there are enough."""
    last, home = "the start", list[float]()
    with daemon.cell() as cell:
        while sum(map(len, found.values())) + failed.total() < wanted:
            if not kinds:
                kinds += chance.sample(list(LIMITS), len(LIMITS))
            what = kinds.pop()
            report.progress(f"{what}: {sum(map(len, found.values()))} of {wanted}")
            try:
                rest = _round(daemon, cell, home, what, chance)
            except OSError as error:  # begin anew with another daemon
                lame[last] += 1
                report.note(f"after {last}, before {what}: {error}")
                kinds.append(what)
                return
            last = what
            if isinstance(rest, Rest):
                found[what].append(rest)
            else:
                failed[f"{what}: {rest}"] += 1
            if what.startswith("daemon"):
                return


def _round(daemon: Daemon, cell: Any, home: list[float], what: str, chance: random.Random) -> Rest | str:
    """Hold, do away with something; return when after that the modules stood, or what moved on."""
    _ready(cell, home)
    with ExitStack() as stack:
        nodes = {name: stack.enter_context(cell.open(f"{name}.readonly")) for name in MODULES}
        does = chance.choice((HOLDS, TOUCHES))
        program = _held(daemon, cell, home, nodes, SPEED * chance.choice((-1.0, 1.0)), does)
        stack.callback(_end, daemon, program)
        time.sleep(chance.uniform(0.0, 0.1))
        who, _, how = what.partition(" ")
        pid = {"program": program, "daemon": daemon.pid}.get(who) or _pid(cell, who)
        watched = [(node, node.read().number) for name, node in nodes.items() if name != who]
        begin_ns = time.monotonic_ns()
        if what == "emergency stop":
            cell.emergency_stop_workcell()
        else:
            os.kill(pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        try:
            rests = [_resting(node, after, begin_ns) for node, after in watched]
            before = {name: _place(node) for name, node in nodes.items()}
        except TimeoutError as error:
            return str(error)
        finally:
            if how == "stopped":
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL if who == "daemon" else signal.SIGCONT)
        moved = _moved(nodes, before) if how == "stopped" and who != "daemon" else ""
        return moved or Rest(max(rest.told_ns for rest in rests), max(rest.moved_ns for rest in rests))


def _held(
    daemon: Daemon, cell: Any, home: list[float], nodes: Mapping[str, Any], velocity: float, does: Does
) -> int:  # fmt: skip
    """Have a program hold and carry, or touch; return its pid. One that the machine kept from renewing its lease is
    replaced.
    """
    for _ in range(_TRIES):
        program = daemon.fork(does.program(daemon, velocity))
        if _begins(cell, nodes, program, does):
            return program
        _end(daemon, program)
        _ready(cell, home)
    raise TimeoutError(f"hold: {_TRIES} programs lost the hand or did not come to carry; want a quieter machine")


def _begins(cell: Any, nodes: Mapping[str, Any], program: int, does: Does) -> bool:
    """Wait until the hand does it; return False when it does not, or its program has ended."""
    with cell.open(does.node) as shown, contextlib.suppress(TimeoutError):
        wait_for(lambda: does.has_begun(shown, nodes) or not lives(program), 4.0 / PACE, f"the hand to {does.what}")
        return lives(program)
    return False


def _end(daemon: Daemon, program: int) -> None:
    daemon.kill(program)
    daemon.reap(program)


def _place(node: Any) -> list[float]:
    """Return the positions of a module's last snapshot."""
    return [float(at) for at in node.history(0, gone=True)[-1].position]


def _moved(nodes: Mapping[str, Any], before: Mapping[str, list[float]]) -> str:
    """Look for a while at the modules after what was stopped goes on; say what has moved, if anything has."""
    time.sleep(WAKE_S)
    for name, node in nodes.items():
        way = [abs(now - was) for now, was in zip(_place(node), before[name], strict=True)]
        if any(one > most for one, most in zip(way, _STAYED, strict=True)):
            return f"{name} moved by {max(way[:2]):.2g} m and {way[2]:.2g} rad when it went on"
    return ""


def _ready(cell: Any, home: list[float]) -> None:
    """Wait until all devices are up, take what was latched off, and go where the hand was at the first time."""
    why = [""]

    def up() -> bool:
        return all((one["state"], one["link"]) == ("up", "good") for one in cell.status()["devices"])

    def opened() -> bool:
        try:
            cell.reset()
            with cell.open("hand", "rw", 10.0) as hand:
                home[:] = home or list(hand.read().position)
                hand.write([command(axis, position=to, time=0.3 / PACE) for axis, to in enumerate(home)])
                hand.wait_until_idle(30.0)
        except OSError as error:  # something is latched still, or again
            why[0] = str(error)
            return False
        return True

    wait_for(up, 60.0, "all devices up")
    try:
        wait_for(opened, 30.0, "the hand to open")
    except TimeoutError as error:
        raise TimeoutError(f"{error}; the last try: {why[0]}") from None


def _pid(cell: Any, device: str) -> int:
    return int(next((one["pid"] for one in cell.status()["devices"] if one["name"] == device), 0))


def _carries(force: Any, nodes: Mapping[str, Any]) -> bool:
    """Return whether both modules go the same way at the speed at which the object is carried, and squeeze it."""
    rates = [float(node.read().commanded_velocity[0]) for node in nodes.values()]
    goes = all(abs(abs(rate) - SPEED) < 0.3 * SPEED for rate in rates) and rates[0] * rates[1] > 0.0
    return goes and abs(float(force.read().data[0]) - FORCE_N) < 0.3 * FORCE_N


def _touches(touch: Any, nodes: Mapping[str, Any]) -> bool:
    """Return whether the left finger touches the object and presses on."""
    rate = float(nodes["left"].read().commanded_velocity[0])
    return float(touch.read().data[0]) == 1.0 and rate > 0.25 * SPEED


class Does(NamedTuple):
    """What a hand does in a round: the program, the node that shows whether it does it, and how that is seen."""

    what: str
    program: Callable[[Daemon, float], Callable[[], None]]
    node: str
    has_begun: Callable[[Any, Mapping[str, Any]], bool]


HOLDS = Does("carry what it holds", holder, "hand.force", _carries)
TOUCHES = Does("touch with one finger", toucher, "hand.touch", _touches)


def _resting(node: Any, after: int, since_ns: int) -> Rest:
    """Return when a module was last commanded to move and when it moved last, once it has stood for some time.

    Raises:
        TimeoutError: it does not.
    """
    told_ns = moved_ns = seen_ns = since_ns
    while time.monotonic_ns() < since_ns + 4_000_000_000:
        for shot in node.history(after, gone=True):
            after, seen_ns = shot.number, max(int(shot.stamp_ns), seen_ns)
            if shot.stamp_ns >= since_ns:
                told_ns = told_ns if _slow(shot.commanded_velocity) else int(shot.stamp_ns)
                moved_ns = moved_ns if _slow(shot.velocity) else int(shot.stamp_ns)
        last_ns = max(told_ns, moved_ns)
        if time.monotonic_ns() - last_ns > 500_000_000 and seen_ns > last_ns:
            return Rest(told_ns - since_ns, moved_ns - since_ns)
        time.sleep(0.02)
    raise TimeoutError(f"{node.name} is still moving; its last reading is of {(seen_ns - since_ns) * 1e-9:.2f} s after")


def _slow(velocities: Any) -> bool:
    return all(abs(rate) < least for rate, least in zip(velocities, _SLOW, strict=True))
