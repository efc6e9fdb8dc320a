"""Latencies that the demo measures, each beside what it would cost without SIOMS."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import sioms
from sioms.children import PATIENCE_S, Process
from sioms.protocol.flags import AxisStatus

MIDDLE = 0.24
"""Of the range of each axis that is moved [m]: from here the way to either limit is the same."""


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
        return row("write, acknowledged by the driver", _timed(lambda: node.write(record, replace=True), trials))


def edge_to_client(cell: sioms.Workcell, trials: int) -> Row:
    """From an edge of a light beam, by its stamp, to the waiting client awake."""
    times = []
    with cell.open("mod0.xaxis", "rw", timeout=PATIENCE_S) as axis, cell.open("beam0") as beam:
        for _ in range(trials):
            before = beam.read()  # a busy machine may let the edge pass before the wait begins
            axis.move(0.12 if axis.read().position[0] < 0.09 else 0.08)
            event = beam.wait_event(last=before, timeout=PATIENCE_S)
            times.append((time.monotonic_ns() - event.stamp_ns) / 1e3)
            axis.wait_until_idle(PATIENCE_S)
    return row("light beam edge to client awake", times)


def kill_to_halt(cell: sioms.Workcell, trials: int) -> Row:
    """From SIGKILL of a client to its axis braking."""
    times = []
    with cell.open("mod0.xaxis.readonly") as watch:
        for _ in range(trials):
            victim = _running_victim(watch)
            killed_ns = victim.kill()
            times.append((_first_slower(watch, 0.0999, killed_ns) - killed_ns) / 1e3)
            wait_for_rest(watch)
    return row("client killed to its axis braking", times)


def stop_to_halt(cell: sioms.Workcell, trials: int) -> Row:
    """From the call of the emergency stop to the last of eight axes braking."""
    times = []
    with cell.open("mod0", "rw", PATIENCE_S) as first, cell.open("mod1", "rw", PATIENCE_S) as second:
        for _ in range(trials):
            _run_together(first, second)
            called_ns = time.monotonic_ns()
            cell.emergency_stop(why="measurement")
            slower_ns = max(_first_slower(node, 0.0499, called_ns) for node in (first, second))
            times.append((slower_ns - called_ns) / 1e3)
            wait_for_rest(first, second)
            cell.reset()
            time.sleep(0.01)
    return row("emergency stop to all axes braking", times)


def _running_victim(watch: Any) -> Process:
    """Start a client that moves its axis, and see it move; a busy machine may let it come to its limit before."""
    while True:
        velocity = 0.1 if watch.read().position[0] < MIDDLE else -0.1
        victim = Process(["sioms.tools.demo.victim", "mod0.xaxis", str(velocity)], "moving")
        if _seen_running([watch], [[velocity]]):
            return victim
        victim.kill()
        wait_for_rest(watch)


def _run_together(*nodes: Any) -> None:
    """Run two axes of each node, and see them run together."""
    while True:
        velocities = [[0.05 if place < MIDDLE else -0.05 for place in node.read().position[:2]] for node in nodes]
        for node, chosen in zip(nodes, velocities, strict=True):
            node.write([sioms.command(axis, velocity=v) for axis, v in enumerate(chosen)])
        if _seen_running(nodes, velocities):
            return
        for node in nodes:
            node.stop()
        wait_for_rest(*nodes)


def _seen_running(nodes: Sequence[Any], velocities: Sequence[Any]) -> bool:
    """Wait until axes run as commanded; False when one has come to its limit before that was seen."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        running = True
        for node, wanted in zip(nodes, velocities, strict=True):
            reading = node.read()
            for axis, v in enumerate(wanted):
                running &= abs(reading.commanded_velocity[axis] - v) < 1e-3 * abs(v)
                ahead = AxisStatus.LIMIT_PLUS if v > 0 else AxisStatus.LIMIT_MINUS
                if reading.status[axis] & ahead:
                    return False
        if running:
            return True
        time.sleep(0.001)
    raise RuntimeError(f"{', '.join(node.name for node in nodes)} did not run as commanded in {PATIENCE_S:g} s")


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
    raise RuntimeError(f"{node.name} did not slow down in {PATIENCE_S:g} s")


def wait_for_rest(*nodes: Any, slower_than: float = math.inf) -> None:
    """Wait until no axis of some nodes is in motion any more.

    Args:
        nodes: open axis nodes.
        slower_than: measured velocity below which an axis that has arrived counts as resting [unit/s].

    Raises:
        RuntimeError: some are still, after ``PATIENCE_S``.
    """
    deadline = time.monotonic() + PATIENCE_S
    while moving := [node.name for node in nodes if _moves(node.read(), slower_than)]:
        if time.monotonic() > deadline:
            raise RuntimeError(f"{', '.join(moving)} did not come to rest in {PATIENCE_S:g} s")
        time.sleep(0.001)


def _moves(reading: Any, slower_than: float) -> bool:
    return any(reading.in_motion) or any(abs(v) >= slower_than for v in reading.velocity)


def _timed(action: Callable[[], object], trials: int) -> list[float]:
    times = []
    for _ in range(trials):
        before = time.perf_counter()
        action()
        times.append((time.perf_counter() - before) * 1e6)
    return times
