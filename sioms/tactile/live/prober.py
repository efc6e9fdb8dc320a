"""Probe a tactile finger with axes, a force sensor and a client program: record touches as calibration wants them.

Four nodes make a prober: an axis round the finger [rad], an axis that presses towards its middle [m, larger is
deeper], the finger's readings, and one channel of a force sensor [N, larger when pressed]. The surface of the finger
and the depth that a load needs are found by feeling; the axes' own limits, their guard and the emergency stop hold as
ever.
"""

from __future__ import annotations

import errno
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

import sioms
from sioms.lab.loading_axis import LoadingAxis
from sioms.lab.stopping import ExperimentStopped
from sioms.whole_file import write_whole

Floats = NDArray[np.float64]
Frames = tuple[Floats, Floats, Floats]  # raw (n, ns), time [s], force [N/m]
Say = Callable[[str], None]
T = TypeVar("T")

CLEAR_M = 2e-3  # distance of the indenter between touches
LENGTH_M = 0.012  # of the prober's indenters: N to N/m
FRAMES = 20  # averaged before and under each touch
RATE_HZ = 400.0
START_S = 180.0
ATTEMPTS = 5  # at a touch whose frames did not come


@dataclass(frozen=True, slots=True)
class Rig:
    """A prober: its nodes, and what its indenters bear.

    Attributes:
        place, press, finger, force: names of the nodes.
        length_m: length of contact: N to N/m.
        most_load: [N/m]; nothing is pressed harder than this, and a third above it the experiment is stopped.
        clear_m: distance of the indenter between touches.
        lease_s: the axes halt when this program has been silent for so long.
    """

    place: str = "prober.place"
    press: str = "prober.radial"
    finger: str = "tactile0"
    force: str = "force0.fz"
    length_m: float = LENGTH_M
    most_load: float = 260.0
    clear_m: float = CLEAR_M
    lease_s: float = 1.0


def wait_links(cell: sioms.Workcell, *devices: str, meanwhile: Callable[[], None] = lambda: None) -> None:
    """Wait until devices of the workcell answer, all of them where none is named; call `meanwhile` again and again.

    Raises:
        RuntimeError: one does not.
    """
    deadline = time.monotonic() + START_S
    while True:
        waited = [d for d in cell.status()["devices"] if d["name"] in devices or not devices]
        if all(d["link"] == "good" for d in waited):
            return
        if time.monotonic() > deadline:
            raise RuntimeError(f"start prober: a link did not come up: {waited}")
        meanwhile()
        time.sleep(0.05)


@dataclass(frozen=True, slots=True)
class Touch:
    """One touch of a plan: place [rad], load [N/m], indenter radius [m] (0 an edge, inf a flat)."""

    place: float
    load: float
    radius_m: float


class Recorder:
    """Collects frames with their marks in the form that `sioms tactile calibrate` reads."""

    def __init__(self) -> None:
        self._columns: dict[str, list[Any]] = {name: [] for name in ("raw", "time", "touch", "phase", "force")}
        self.touches: list[Touch] = []

    def add(self, frames: Floats, time_s: Floats, force: Floats, touch: int, phase: int) -> None:
        """Append frames, shape (n, ns), with their time [s] and force [N/m]."""
        marks = np.ones(len(time_s), dtype=np.int64)
        for name, value in zip(self._columns, (frames, time_s, touch * marks, phase * marks, force), strict=True):
            self._columns[name].append(value)

    def take_felt_loads(self) -> None:
        """Replace the commanded load by the measured one where no load cell gives it."""
        force, touch, phase = (np.concatenate(self._columns[n]) for n in ("force", "touch", "phase"))
        for i, t in enumerate(self.touches):
            before, under = (force[(touch == i) & (phase == p)].mean() for p in (0, 1))
            self.touches[i] = replace(t, load=float(under - before))

    def save(self, path: Path) -> None:
        """Write the npz."""
        columns: dict[str, Any] = {name: np.concatenate(parts) for name, parts in self._columns.items()}
        plan: dict[str, Any] = {}
        if self.touches:
            plan = {
                "cmd_theta": np.degrees([t.place for t in self.touches]),
                "cmd_P": np.array([t.load for t in self.touches]),
                "cmd_rc": 1e3 * np.array([t.radius_m for t in self.touches]),
            }
        np.savez(path, fs=RATE_HZ, **columns, **plan)


class Prober:
    """Moves the indenter and records; use it in a ``with`` block, which leaves it clear of the finger.  One thread.

    Args:
        cell: the workcell.
        mount: changes the indenter.
        rig: nodes and sizes.
    """

    def __init__(self, cell: sioms.Workcell, mount: Callable[[float], None], rig: Rig | None = None) -> None:
        self._cell, self._mount, self._rig = cell, mount, rig or Rig()
        self._mounted = math.nan
        self._axis: Any = cell.open(self._rig.press, "rw", lease=self._rig.lease_s)
        self._place: Any = cell.open(self._rig.place, "rw", lease=self._rig.lease_s)
        self._finger: Any = cell.open(self._rig.finger)
        self._force: Any = cell.open(self._rig.force)
        most_n = self._rig.most_load * self._rig.length_m
        self._loading = LoadingAxis(self._axis, self._force, most_n, self._rig.clear_m, (self._place,))
        self._began_ns = time.monotonic_ns()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def prepare(self, radius_m: float, middle: float) -> None:
        """Feel for the finger and learn how deep the axis must go for a force, at a place [rad] in its middle.

        The indenter must be clear of the finger.

        Raises:
            ExperimentStopped: there is no finger, or the axis is stopped.
        """

        def learn() -> None:
            self.go(middle, radius_m)
            self._loading.learn()

        self._again(learn, lambda what: None)

    def run(self, plan: Sequence[Touch], tell: Say, what: str) -> Recorder:
        """Carry out a plan, touch by touch; an indenter is learnt when it is first used."""
        out = Recorder()
        for number, touch in enumerate(plan):
            if not self._loading.take(touch.radius_m):
                self.prepare(touch.radius_m, touch.place)
            before, under = self._again(lambda: self._touch(touch), tell)  # noqa: B023 - called at once
            out.add(*before, number, 0)
            out.add(*under, number, 1)
            out.touches.append(touch)
            tell(f"{what}: touch {number + 1} of {len(plan)}")
        return out

    def ramps(self, places: Sequence[float], load: float, seconds: float, tell: Say) -> Recorder:
        """Press an edge over each element with a force that grows evenly."""
        out = Recorder()
        for number, place in enumerate(places):
            before, under = self._again(lambda: self._ramp(place, load, seconds), tell)  # noqa: B023 - called at once
            out.add(*before, number, 0)
            out.add(*under, number, 1)
            tell(f"ramp over element {number}")
        return out

    def quiet(self, frames: int) -> Recorder:
        """Record the untouched finger."""
        out = Recorder()
        out.add(*self._again(lambda: self._frames(frames), lambda what: None), -1, 2)
        return out

    def press(self, load: float) -> None:
        """Press with a load [N/m], at most the rig's largest, and let the force settle."""
        self._loading.press(load * self._rig.length_m)

    def clear(self) -> None:
        """Take the indenter off the finger, whatever it feels."""
        self._loading.clear()

    def go(self, place: float, radius_m: float) -> None:
        """Turn to a place [rad] with an indenter mounted, and take the force there for none."""
        if radius_m != self._mounted:
            self._mount(radius_m)
            self._mounted = radius_m
        self._loading.take(radius_m)
        self._loading.move(self._place, place)
        self._loading.tare()

    def close(self) -> None:
        """Go clear, if that can be, and let the nodes go; their axes halt."""
        try:
            self.clear()
        except (OSError, ExperimentStopped):
            pass  # stopped: it stays where it is
        finally:
            for node in (self._axis, self._place, self._finger, self._force):
                node.close()

    # -- touches

    def _touch(self, touch: Touch) -> tuple[Frames, Frames]:
        self.go(touch.place, touch.radius_m)
        before = self._frames(FRAMES)
        self.press(touch.load)
        under = self._frames(FRAMES)
        self.clear()
        return before, under

    def _ramp(self, place: float, load: float, seconds: float) -> tuple[Frames, Frames]:
        self.go(place, 0.0)
        before = self._frames(FRAMES)
        bottom = self._loading.depth(load * self._rig.length_m)
        begin = self._loading.depth(0.0) - 0.1e-3
        self._loading.move(self._axis, begin)
        self._axis.command(velocity=(bottom - begin) / seconds, replace=True)
        frames, stamps, force = self._frames(round(RATE_HZ * seconds))
        self.clear()
        pressed = np.flatnonzero(force > 0.05 * force.max())
        rise = slice(int(pressed[0]), int(np.argmax(force)) + 1)
        return before, (frames[rise], stamps[rise], force[rise])

    def _again(self, work: Callable[[], T], tell: Say) -> T:
        """Repeat what a break of the finger's link has spoilt."""
        for attempt in range(ATTEMPTS):
            try:
                return work()
            except OSError as error:
                if error.errno != errno.EIO or attempt == ATTEMPTS - 1:
                    raise
                tell(f"{error.strerror}: once more")
                devices = (n.split(".")[0] for n in (self._rig.finger, self._rig.force))
                wait_links(self._cell, *devices, meanwhile=self._loading.keep_alive)
                self.clear()
        raise AssertionError("unreachable")

    def _frames(self, count: int) -> Frames:
        """Return frames of now on, shape (count, ns), their times [s] and the forces at them [N/m]."""
        begin_ns = time.monotonic_ns()
        last, force_last = self._finger.read().number, self._force.read().number
        snaps: list[Any] = []
        forces: list[Any] = []
        while len(snaps) < count:
            self._finger.wait_new(last + min(count - len(snaps), 100) - 1, 2.0)  # the pages hold 512
            news = self._finger.history(last)
            # what comes late from a busy device or line was felt before the press that led here
            snaps += [snap for snap in news if snap.stamp_ns >= begin_ns]
            forces += self._force.history(force_last)
            last, force_last = news[-1].number, forces[-1].number if forces else force_last
            self._loading.check()
        snaps = snaps[:count]
        stamps = np.array([s.stamp_ns for s in snaps])
        at = np.searchsorted([s.stamp_ns for s in forces], stamps, side="right") - 1
        tare = 0.0 if math.isnan(self._loading.tare_n) else self._loading.tare_n
        force = np.array([forces[max(int(i), 0)].data[0] for i in at]) - tare
        raw = np.array([s.data for s in snaps])
        return raw, (stamps - self._began_ns) * 1e-9, force / self._rig.length_m


def write_nominal(path: Path, angles_rad: Floats) -> None:
    """Write the finger as built: what calibration begins with."""
    nominal = {
        "ra_mm": 9.6, "rb_mm": 12.7, "poisson": 0.46, "shear_modulus_pa": 8.3e4,
        "element_angle_deg": np.degrees(angles_rad).tolist(), "element_radius_mm": [10.3] * len(angles_rad),
        "gain_percent_strain_per_percent_output": [3.0] * len(angles_rad), "output_noise_percent": 0.05,
    }  # fmt: skip
    write_whole(path, json.dumps(nominal, indent=1))
