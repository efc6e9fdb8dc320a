"""Probe a tactile finger with axes, a force sensor and a client program: record touches as calibration wants them.

Four nodes make a prober: an axis round the finger [rad], an axis that presses towards its middle [m, larger is
deeper], the finger's readings, and one channel of a force sensor [N, larger when pressed]. The surface of the finger and the
depth that a load needs are found by feeling; the axes' own limits, their guard and the emergency stop hold as ever.
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
from sioms.tools.stopping import ExperimentStopped, check_running

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
POLL_S = 2e-3
MOVE_S = 10.0  # longest move
#: The surface is felt for at one speed [m/s], the way in at another; a force is that of so many samples.
FEEL_M_S, LEARN_M_S, NEAR = 5e-3, 1e-3, 8
FELT = 0.1  # of the largest load: the surface has been found
LEARNT, OVER = 1.08, 1.3  # of the largest load: the way in is known up to there; pressing is stopped


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
        self._columns: dict[str, list[Any]] = {
            name: [] for name in ("raw", "time", "touch", "phase", "force")
        }
        self.touches: list[Touch] = []

    def add(self, frames: Floats, time_s: Floats, force: Floats, touch: int, phase: int) -> None:
        """Append frames, shape (n, ns), with their time [s] and force [N/m]."""
        marks = np.ones(len(time_s), dtype=np.int64)
        for name, value in zip(
            self._columns, (frames, time_s, touch * marks, phase * marks, force), strict=True
        ):
            self._columns[name].append(value)

    def take_felt_loads(self) -> None:
        """Put the load that the force sensor felt in the place of the wanted one, where nothing else tells the load."""
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
        self._surface = self._tare = math.nan
        self._ways: dict[float, tuple[Floats, Floats]] = {}  # position and force on the way in, by indenter
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
        self._again(lambda: self._learn(radius_m, middle), lambda what: None)

    def run(self, plan: Sequence[Touch], tell: Say, what: str) -> Recorder:
        """Carry out a plan, touch by touch; an indenter is learnt when it is first used."""
        out = Recorder()
        for number, touch in enumerate(plan):
            if touch.radius_m not in self._ways:
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
        self._move(self._axis, self._depth(load))
        self._watch_for(60)

    def clear(self) -> None:
        """Take the indenter off the finger, whatever it feels."""
        if not math.isnan(self._surface):
            self._move(self._axis, self._surface - self._rig.clear_m, guarded=False)

    def go(self, place: float, radius_m: float) -> None:
        """Turn to a place [rad] with an indenter mounted, and take the force there for none."""
        if radius_m != self._mounted:
            self._mount(radius_m)
            self._mounted = radius_m
        self._move(self._place, place)
        number = self._force.read().number
        self._watch_for(50)
        self._tare = float(np.mean([s.data[0] for s in self._force.history(number)]))

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
        bottom, begin = self._depth(load), self._depth(0.0) - 0.1e-3
        self._move(self._axis, begin)
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
                wait_links(self._cell, *devices, meanwhile=self._keep_alive)
                self.clear()
        raise AssertionError("unreachable")

    # -- feeling

    def _learn(self, radius_m: float, middle: float) -> None:
        most = self._rig.most_load * self._rig.length_m
        self.go(middle, radius_m)
        way, _ = self._feel(FEEL_M_S, FELT * most)
        self._surface = float(way[-1])
        self.clear()
        way, force = self._feel(LEARN_M_S, LEARNT * most)
        self.clear()
        self._ways[radius_m] = _rising(way, force)
        self._surface = self._depth(0.0)
        # a force lags behind a motion: a press at rest sets the scale
        half = 0.5 * self._rig.most_load
        self.press(half)
        _, _, at_rest = self._frames(FRAMES)
        self.clear()
        position, force = self._ways[radius_m]
        self._ways[radius_m] = position, force * (float(at_rest.mean()) / half)

    def _feel(self, speed: float, until_n: float) -> tuple[Floats, Floats]:
        """Move towards the finger until a force is felt; return positions and forces on the way.

        Raises:
            ExperimentStopped: the axis came to its end before.
        """
        channel = self._axis.info.channels[0]
        end, limits = channel.maximum, channel.limits
        last, force_last = self._axis.read().number, self._force.read().number
        seen: list[Any] = []
        forces: list[Any] = []
        taken = self._axis.command(
            position=end, max_velocity=speed, max_acceleration=limits["acceleration"], replace=True
        )
        while True:
            time.sleep(POLL_S)
            seen += self._axis.history(seen[-1].number if seen else last)
            forces += self._force.history(forces[-1].number if forces else force_last)
            self._check()
            if len(forces) >= NEAR and self._net(forces[-NEAR:]) > until_n:
                break
            if seen and seen[-1].tick > taken and not seen[-1].in_motion[0]:
                raise ExperimentStopped(
                    f"feel for the finger with {self._rig.press}: no {until_n:.3g} N on {self._rig.force} up to {end:.4g} m; "
                    "see to the force sensor, the place and the finger"
                )
        self._axis.stop()
        stamps = [s.stamp_ns for s in forces]
        at = np.interp(stamps, [s.stamp_ns for s in seen], [s.position[0] for s in seen])
        return np.asarray(at), np.array([s.data[0] for s in forces]) - self._tare

    def _depth(self, load: float) -> float:
        """Return where the axis must go for a load [N/m].

        Raises:
            ValueError: it is more than the rig's largest.
        """
        if load > self._rig.most_load:
            raise ValueError(
                f"press with {load:g} N/m: the most for {self._rig.press} is {self._rig.most_load:g} N/m"
            )
        position, force = self._ways[self._mounted]
        return float(np.interp(load * self._rig.length_m, force, position))

    # -- motion, watched

    def _move(self, node: Any, position: float, guarded: bool = True) -> None:
        limits = node.info.channels[0].limits  # those of a command stay in force until others come
        speed, acceleration = limits["velocity"], limits["acceleration"]
        taken = node.command(
            position=position, max_velocity=speed, max_acceleration=acceleration, replace=True
        )
        deadline = time.monotonic() + MOVE_S
        while True:
            time.sleep(POLL_S)
            self._check(guarded)
            seen = node.read()
            if seen.tick > taken and not seen.in_motion[0] and not seen.buffered[0]:
                return
            if time.monotonic() > deadline:
                raise ExperimentStopped(f"move {node.name} to {position:.4g}: not there within {MOVE_S:g} s")

    def _watch_for(self, samples: int) -> None:
        """Wait for so many samples of the force, watching it."""
        wanted, deadline = self._force.read().number + samples, time.monotonic() + MOVE_S
        while self._force.read().number < wanted:
            if time.monotonic() > deadline:
                raise ExperimentStopped(f"read {self._rig.force}: no {samples} samples within {MOVE_S:g} s")
            time.sleep(POLL_S)
            self._check()

    def _keep_alive(self) -> None:
        for node in (self._axis, self._place):
            node.keepalive()

    def _check(self, guarded: bool = True) -> None:
        """Look whether the experiment may go on, and say that this program is alive.

        Raises:
            ExperimentStopped: an axis is stopped, or the force is too large.
        """
        self._keep_alive()
        for node in (self._axis, self._place):
            check_running(node.name, node.read())
        most = OVER * self._rig.most_load * self._rig.length_m
        if guarded and not math.isnan(self._tare):
            force = self._net(self._force.history(self._force.read().number - NEAR))
            if force > most:
                raise ExperimentStopped(f"press {self._rig.press}: {force:.3g} N, more than {most:.3g} N")

    def _net(self, forces: Sequence[Any]) -> float:
        """Return the mean force less the tare [N]."""
        return float(sum(s.data[0] for s in forces)) / max(len(forces), 1) - self._tare

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
            self._check()
        snaps = snaps[:count]
        stamps = np.array([s.stamp_ns for s in snaps])
        at = np.searchsorted([s.stamp_ns for s in forces], stamps, side="right") - 1
        tare = 0.0 if math.isnan(self._tare) else self._tare
        force = np.array([forces[max(int(i), 0)].data[0] for i in at]) - tare
        raw = np.array([s.data for s in snaps])
        return raw, (stamps - self._began_ns) * 1e-9, force / self._rig.length_m


def _rising(position: Floats, force: Floats, bins: int = 40) -> tuple[Floats, Floats]:
    """Return positions and the force that grows with them, from no force on; a line through what is pressed leads to none."""
    inside = slice(0, int(np.argmax(position)) + 1)
    position, force = position[inside], force[inside]
    edges = np.linspace(position[0], position[-1], bins * 4)
    which = np.clip(np.searchsorted(edges, position) - 1, 0, len(edges) - 2)
    count = np.bincount(which, minlength=len(edges) - 1)
    at, felt = (
        np.bincount(which, v, len(edges) - 1)[count > 0] / count[count > 0] for v in (position, force)
    )
    pressed = felt > 0.05 * felt.max()
    first = int(np.flatnonzero(~pressed)[-1]) + 1 if not pressed.all() else 0
    at, felt = at[first:], np.maximum.accumulate(felt[first:])
    slope = (felt[min(4, len(felt) - 1)] - felt[0]) / max(at[min(4, len(at) - 1)] - at[0], 1e-9)
    surface = at[0] - felt[0] / max(slope, 1e-9)
    return np.concatenate([[surface], at]), np.concatenate([[0.0], felt])


def write_nominal(path: Path, angles_rad: Floats) -> None:
    """Write the finger as built: what calibration begins with."""
    nominal = {
        "ra_mm": 9.6, "rb_mm": 12.7, "poisson": 0.46, "shear_modulus_pa": 8.3e4,
        "element_angle_deg": np.degrees(angles_rad).tolist(), "element_radius_mm": [10.3] * len(angles_rad),
        "gain_percent_strain_per_percent_output": [3.0] * len(angles_rad), "output_noise_percent": 0.05,
    }  # fmt: skip
    path.write_text(json.dumps(nominal, indent=1), encoding="utf-8")
