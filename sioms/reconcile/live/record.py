"""Run a position command on an axis node and record it, tick by tick, through the daemon.

The axis is moved by its own commands (timed passes through knots), so that its limits, its guard and the
emergency stop hold as ever. Whatever ends an experiment early, the node is closed, and its driver halts the axis.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

import sioms
from sioms.client.node import AxisNode
from sioms.client.snapshot import AxisSnapshot
from sioms.lab.stopping import ExperimentStopped as ExperimentStopped
from sioms.lab.stopping import check_running
from sioms.reconcile.effect import Array
from sioms.reconcile.experiment import Envelope, Experiment
from sioms.reconcile.records import Record
from sioms.reconcile.timing import LEAST_SAMPLES

#: Samples from knot to knot.
KNOT = 10
LEASE_S = 1.0
POLL_S = 0.02
#: The axis rests this long before a record, and the record begins this long before the motion.
SETTLE_S, LEAD_S = 0.4, 0.1
#: Commands written ahead of the motion.
AHEAD = 400
#: So many periods without a tick are filled in; where more were lost, one record ends and another begins. The run is
#: made again, so many times, unless this share of it is left in records that are long enough.
MOST_FILLED = 4
ENOUGH, TRIES = 0.6, 6


def perform(
    cell: sioms.Workcell,
    node: str,
    experiments: Sequence[Experiment],
    envelope: Envelope,
    say: Callable[[str], None],
) -> list[Record]:
    """Run experiments one after the other on a node, which is held for as long only.

    Raises:
        ExperimentStopped: one did not come to its end.
        OSError: the node cannot be had.
    """
    with cell.open(node, "rw", lease=LEASE_S) as axis:
        recorder, out = Recorder(axis, envelope), []
        for e in experiments:
            say(f"running {e.name} ({len(e.command) / axis.info.tick_hz:.0f} s)")
            out += recorder.run(e)
        return out


@dataclass(slots=True)
class Recorder:
    """Runs experiments on one axis. Use from one thread.

    Attributes:
        node: open for reading and writing, of one axis.
        envelope: what the axis may be asked; moves between experiments keep it, too.
    """

    node: AxisNode
    envelope: Envelope

    def run(self, experiment: Experiment) -> list[Record]:
        """Run one experiment from rest at its first position.

        Returns:
            Position, force and command at the rate of the axis, without a gap; several records where the machine lost
            ticks.

        Raises:
            ExperimentStopped: by a stop, a fault, a refusal, or because the machine loses ticks.
        """
        lost = 0
        for _ in range(TRIES):
            try:
                self._go(float(experiment.command[0]))
                seen = self._play(experiment.command)
            except OSError as error:
                raise ExperimentStopped(
                    f"run {experiment.name} on {self.node.name}: {error.strerror or error}"
                ) from error
            records = uniform(experiment.name, seen, 1.0 / self.node.info.tick_hz)
            if sum(map(len, records)) >= ENOUGH * len(experiment.command):
                return records
            lost += 1
        raise ExperimentStopped(
            f"record {experiment.name} on {self.node.name}: ticks were missing in {lost} runs; the machine is too busy "
            "to record at the rate of the axis"
        )

    def _go(self, position: float) -> None:
        """Move to a position and let the axis come to rest."""
        e, here = self.envelope, self.node.read()
        check_running(self.node.name, here)
        self.node.move(position, max_velocity=0.5 * e.speed, max_acceleration=0.5 * e.acceleration)
        self.node.wait_until_idle(timeout=5.0 + 4.0 * abs(position - here.position[0]) / e.speed)
        end = time.monotonic() + SETTLE_S
        while time.monotonic() < end:
            time.sleep(POLL_S)
            self.node.keepalive()
            check_running(self.node.name, self.node.read())

    def _play(self, command: Array) -> list[AxisSnapshot]:
        """Write the knots ahead of the motion and collect every snapshot until the axis rests again."""
        limits = self.node.info.channels[0].limits
        records = knots(command, 1.0 / self.node.info.tick_hz, limits["velocity"], limits["acceleration"])
        last = self.node.read().number
        deadline = time.monotonic() + 2.0 * len(command) / self.node.info.tick_hz + 5.0
        seen: list[AxisSnapshot] = []
        lead, taken = time.monotonic() + LEAD_S, 0
        while True:
            new = self.node.history(last)
            for snapshot in new:
                check_running(self.node.name, snapshot)
            seen += new
            last = new[-1].number if new else last
            self.node.keepalive()
            room = min(AHEAD, self.node.info.buffer_capacity) - self.node.read().buffered[0]
            if time.monotonic() < lead:
                time.sleep(POLL_S / 4)
                continue
            if records and room > 0:
                taken = self.node.write(records[:room])
                records = records[room:]
                continue
            if not records and new and new[-1].tick > taken and not new[-1].in_motion[0] and not new[-1].buffered[0]:
                return seen
            if time.monotonic() > deadline:
                raise ExperimentStopped(f"run an experiment on {self.node.name}: it did not end in time")
            time.sleep(POLL_S / 2)


def knots(command: Array, dt: float, max_velocity: float, max_acceleration: float) -> list[bytes]:
    """Turn a sampled command into timed passes through knots; the first and the last are at rest.

    Args:
        max_velocity, max_acceleration: the axis's own limits, in force from the first knot on.
    """
    v = np.gradient(command, dt)
    a = np.gradient(v, dt)
    v[[0, -1]] = a[[0, -1]] = 0.0
    at = [*range(KNOT, len(command) - KNOT, KNOT), len(command) - 1]
    words = [
        {"position": command[i], "velocity": v[i], "acceleration": a[i], "time": n * dt}
        for i, n in zip(at, np.diff([0, *at]).tolist(), strict=True)
    ]
    words[0] |= {"max_velocity": max_velocity, "max_acceleration": max_acceleration}
    return [sioms.command(**w) for w in words]


def uniform(name: str, seen: Sequence[AxisSnapshot], dt: float) -> list[Record]:
    """Lay snapshots on the grid of the axis's rate, by their time stamps, from one long hole to the next.

    On a busy machine a tick comes late and the next one early. Of two in one period the later counts, and a period
    without one
    is filled in: its force is the one that was held, its position lies on a cubic spline, since a straight line would
    end in jumps of the speed that no force has made.
    """
    periods = np.rint(np.diff([s.stamp_ns for s in seen]) * 1e-9 / dt).astype(np.int64)
    edges = [0, *(np.flatnonzero(periods > MOST_FILLED) + 1).tolist(), len(seen)]
    parts = [(a, b) for a, b in pairwise(edges) if np.sum(periods[a : b - 1]) >= LEAST_SAMPLES]
    names = [name] if len(parts) == 1 else [f"{name}_{i + 1}" for i in range(len(parts))]
    return [_even(n, seen[a:b], periods[a : b - 1], dt) for n, (a, b) in zip(names, parts, strict=True)]


def _even(name: str, seen: Sequence[AxisSnapshot], periods: NDArray[np.int64], dt: float) -> Record:
    at = np.concatenate([[0], np.cumsum(periods)])
    last = np.flatnonzero(np.diff(at, append=at[-1] + 1) > 0)
    at, kept = at[last], [seen[i] for i in last.tolist()]
    grid = np.arange(at[-1] + 1)
    position, force, command = (
        np.array([getattr(s, field)[0] for s in kept], dtype=np.float64)
        for field in ("position", "force", "commanded_position")
    )
    held = force[np.searchsorted(at, grid, side="right") - 1]
    return Record(
        name,
        CubicSpline(at, position)(grid),
        held,
        np.interp(grid, at, command),
        time_s=grid.astype(np.float64) * dt,
        filled=~np.isin(grid, at),
    )
