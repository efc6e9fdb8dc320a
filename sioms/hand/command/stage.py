"""The cell of a demonstration: etc/hand.toml about an object that no program knows, with a prober that pushes it.

The daemon, its drivers and the client are those of any cell. It runs in slow motion where the machine is busy, and then
waits longer for what is late: nothing real moves in it.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

from sioms.children import PATIENCE_S, daemon
from sioms.client.workcell import Workcell
from sioms.documents import toml_of, toml_text
from sioms.hand.slow import slowed
from sioms.hand.trials import Subject

RATES = {"world": 500.0, "left": 500.0, "right": 500.0, "hand": 200.0, "touch": 200.0, "wrist": 200.0}
"""Of the devices [Hz], in the hand's own time: half of what etc/hand.toml has."""
LATE_S = 0.25
"""How old what devices tell each other may be, in the hand's own time."""
TOGETHER = {"world": "plane", "left": "plane", "right": "plane", "prober": "plane", "touch1": "finger1",
            "wrist1": "finger1", "touch2": "finger2", "wrist2": "finger2"}  # fmt: skip
"""Process of each device: finger 2 can be killed alone."""
PRIORITY = 5
"""Of the drivers, where the user may ask for real time: so they work beside other programs, at half a processor."""
PROBER_N_PER_M = 200.0
OPEN_M = 0.14
AWAY_M = (0.0, 0.14)
"""Where the prober waits."""
_LOOK_S = 0.5
_PACES = ((0.7, 1.0), (0.0, 0.5))
"""Least share of a processor that a process gets, and the pace that goes with it."""


def tables(subject: Subject, pace: float) -> dict[str, Any]:
    """Return the configuration of the cell.

    Args:
        subject: the object on the platen.
        pace: of its time.
    """
    folder = Path(str(files("sioms.hand.command")))
    found = toml_of((folder / "hand.toml").read_bytes())
    devices: dict[str, Any] = found["device"]
    world, points = devices["world"], [[float(x), float(y)] for x, y in subject.outline.points]
    world["object"] = {"shape": "polygon", "points_m": points, "pose": list(subject.pose)}
    for finger in world["finger"]:
        finger["mount"]["friction"] = subject.friction
    soft = {**world["finger"][0]["mount"], "link_m": 0.0, "stiffness": PROBER_N_PER_M, "friction": 0.2}
    axes = [f"prober.plant.{joint}_position" for joint in "xy"]
    world["finger"].append({"name": "prober", "axes": [*axes, ""], "mount": soft})
    carried = [{**axis, "motor": dict(axis["motor"])} for axis in devices["left"]["axis"][:2]]
    for axis, start in zip(carried, AWAY_M, strict=True):
        axis["motor"]["start"] = start
    devices["prober"] = {"driver": "sim-axes", "axis": carried, "tick_hz": RATES["left"]}
    for name, device in devices.items():
        device["tick_hz"] = RATES.get(name.rstrip("12"), RATES["left"])
    for name, sign in (("left", -1.0), ("right", 1.0)):
        devices[name]["world_age_max_s"] = LATE_S
        devices[name]["axis"][0]["motor"]["start"] = sign * 0.5 * OPEN_M
    for table in ("squeeze", "touch"):
        devices["hand"][table]["age_max_s"] = LATE_S
    slow = slowed(found, pace, folder)
    for name, device in slow["device"].items():
        device["realtime_priority"] = PRIORITY
        device["process"] = TOGETHER.get(name, name)
    return slow


def pace_here() -> float:
    """Return the pace that this machine carries, with all else that it has to do."""
    began_s, used_s = time.perf_counter(), time.process_time()
    while (wall_s := time.perf_counter() - began_s) < _LOOK_S:
        pass
    share = (time.process_time() - used_s) / wall_s
    return next(pace for least, pace in _PACES if share >= least)


@contextmanager
def staged(subject: Subject, pace: float) -> Iterator[Workcell]:
    """Start the cell, give a session with it, and end it.

    Raises:
        RuntimeError: it does not start, with what the daemon said.
    """
    with tempfile.TemporaryDirectory(prefix="sioms-hand-") as folder:
        config = Path(folder, "cell.toml")
        config.write_text(toml_text(tables(subject, pace)), encoding="utf-8")
        before = os.environ.get("SIOMS_SOCKET")
        process = daemon(str(config), f"{folder}/siomsd.sock")
        try:
            with Workcell(name="demonstration") as cell:
                _wait_up(cell)
                yield cell
        finally:
            process.end()
            os.environ.pop("SIOMS_SOCKET")
            if before is not None:
                os.environ["SIOMS_SOCKET"] = before


def _wait_up(cell: Workcell) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while down := [one["name"] for one in cell.status()["devices"] if one["state"] != "up"]:
        if time.monotonic() > deadline_s:
            raise RuntimeError(f"start the cell: {', '.join(down)} not up after {PATIENCE_S:g} s; want all devices up")
        time.sleep(0.1)


@contextmanager
def in_time() -> Iterator[None]:
    """Let this thread be kept waiting by nothing but the drivers, where the user may ask for real time."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY - 1))
    except OSError:
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def pid_of(cell: Workcell, device: str) -> int:
    """Return the process of a device's driver."""
    return next(int(one["pid"]) for one in cell.status()["devices"] if one["name"] == device)
