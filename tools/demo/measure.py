"""Latencies that the demo measures, each beside what it would cost without SIOMS."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import sioms

from .rig import PATIENCE_S, Process


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table; times in us."""

    what: str
    median_us: float
    worst_us: float
    trials: int


def row(what: str, times_us: Sequence[float]) -> Row:
    """Summarise trials."""
    ordered = sorted(times_us)
    return Row(what, ordered[len(ordered) // 2], ordered[-1], len(ordered))


def socket_round_trip(trials: int) -> Row:
    """A bare round trip between two Python processes over a Unix socket: the yardstick."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = os.fork()
    if pid == 0:
        try:
            ours.close()
            while data := theirs.recv(256):
                theirs.send(data)
        finally:
            os._exit(0)
    theirs.close()
    try:
        return row(
            "bare socket round trip (yardstick)",
            _timed(lambda: (ours.send(b"x" * 64), ours.recv(256)), trials),
        )
    finally:
        ours.close()
        os.waitpid(pid, 0)


def reading(cell: sioms.Workcell, trials: int) -> Row:
    """Read a node of four axes."""
    with cell.open("mod0.readonly") as node:
        return row("read of four axes", _timed(node.read, trials))


def writing(cell: sioms.Workcell, trials: int) -> Row:
    """Write a command and have it acknowledged."""
    with cell.open("mod0.taxis", "rw", timeout=PATIENCE_S) as node:
        record = sioms.command(velocity=0.01)
        return row(
            "write, acknowledged by the driver", _timed(lambda: node.write(record, replace=True), trials)
        )


def edge_to_client(cell: sioms.Workcell, trials: int) -> Row:
    """From an edge of a light beam, by its stamp, to the waiting client awake."""
    times = []
    with cell.open("mod0.xaxis", "rw", timeout=PATIENCE_S) as axis, cell.open("beam0") as beam:
        for _ in range(trials):
            axis.move(0.12 if axis.read().position[0] < 0.09 else 0.08)
            event = beam.wait_event(timeout=PATIENCE_S)
            times.append((time.monotonic_ns() - event.stamp_ns) / 1e3)
            axis.wait_until_idle(PATIENCE_S)
    return row("light beam edge to client awake", times)


def kill_to_halt(cell: sioms.Workcell, trials: int) -> Row:
    """From SIGKILL of a client to its axis braking."""
    times = []
    with cell.open("mod0.xaxis.readonly") as watch:
        for trial in range(trials):
            victim = Process(
                ["sioms.tools.demo.victim", "mod0.xaxis", "0.1" if trial % 2 == 0 else "-0.1"], "moving"
            )
            _wait(lambda: abs(watch.read().commanded_velocity[0]) > 0.099)
            killed_ns = victim.kill()
            times.append((_first_slower(watch, 0.0999, killed_ns) - killed_ns) / 1e3)
            _wait(lambda: not watch.read().in_motion[0])
    return row("client killed to its axis braking", times)


def stop_to_halt(cell: sioms.Workcell, trials: int) -> Row:
    """From the call of the emergency stop to the last of eight axes braking."""
    times = []
    with cell.open("mod0", "rw", PATIENCE_S) as first, cell.open("mod1", "rw", PATIENCE_S) as second:
        for trial in range(trials):
            velocity = 0.05 if trial % 2 == 0 else -0.05
            for node in (first, second):
                node.write([sioms.command(axis, velocity=velocity) for axis in range(2)])
            _wait(
                lambda: all(abs(v) > 0.0499 for n in (first, second) for v in n.read().commanded_velocity[:2])
            )
            called_ns = time.monotonic_ns()
            cell.emergency_stop(why="measurement")
            slower_ns = max(_first_slower(node, 0.0499, called_ns) for node in (first, second))
            times.append((slower_ns - called_ns) / 1e3)
            _wait(lambda: not any(first.read().in_motion) and not any(second.read().in_motion))
            cell.reset()
            time.sleep(0.01)
    return row("emergency stop to all axes braking", times)


def _first_slower(node: Any, velocity: float, after_ns: int) -> int:
    """Return the stamp of the first snapshot after a time in which an axis is slower than commanded."""
    number = 0
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for snapshot in node.history(number):
            number = snapshot.number
            if snapshot.stamp_ns > after_ns and abs(snapshot.commanded_velocity[0]) < velocity:
                return int(snapshot.stamp_ns)
        time.sleep(0.0005)
    raise RuntimeError(f"{node.name} did not slow down in time")


def _wait(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError("the axis did not do what it was told to do")
        time.sleep(0.001)


def _timed(action: Callable[[], object], trials: int) -> list[float]:
    times = []
    for _ in range(trials):
        before = time.perf_counter()
        action()
        times.append((time.perf_counter() - before) * 1e6)
    return times
