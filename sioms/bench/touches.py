"""What the estimates of a finger in the driver are worth: frames of the simulated finger, whose mechanics are not the
estimator's.

Finite elements and contacts found point by point (`sioms.plant.finger`) press the demo's finger; its readings go
through `ShapeSensor` as they do in a driver. Asked are bias and coverage of what is stated, the state that is told, and
the time and processor time of a frame.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from sioms.plant.finger import FingerShape, TactileArray
from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.finger import Finger, from_toml
from sioms.tactile.quality import ShapeEstimate, State
from sioms.tactile.sensing import ShapeSensor

from .figures import Bar, Report
from .options import Options

Floats = NDArray[np.float64]

NOISE, STEP = 0.023, 0.01  # per cent of output: standard deviation, and step of the converter
RATE_HZ = 400
RADII = (1.59e-3, 3.9e-3, 6.01e-3, 12.3e-3, 25.25e-3, math.inf)
APART = math.radians(20.0)  # of two touches: nearer ones take means over many frames
REST, HELD = 60, 8  # frames between touches, and of each
NAMES = ("place", "load", "R")
EXPECTED = {
    "rest": State.UNTOUCHED,
    "touch": State.TOUCHED,
    "pull": State.DOUBTFUL,
    "two touches": State.DOUBTFUL,
    "hole": State.BLIND,
}
"""What is done to the finger, and the state that is true then."""


@dataclass(slots=True)
class Found:
    """What came out: errors and stated deviations of touches, loads, states told by what was done, times of frames
    [ns].

    Rows of ``touches`` are load [N/m], then the errors of place [deg], load [N/m] and R [mm], then their stated
    deviations.
    """

    touches: list[tuple[float, ...]] = field(default_factory=list)
    right: dict[str, list[bool]] = field(default_factory=dict)
    times: list[int] = field(default_factory=list)
    processor_ns: int = 0

    @property
    def rows(self) -> Floats:
        """Return ``touches`` as an array, shape (n, 7)."""
        return np.array(self.touches).reshape(-1, 7)


class _Bench:
    """One finger, one seed."""

    def __init__(self, finger: Finger, array: TactileArray, seed: int, found: Found) -> None:
        self.random = np.random.default_rng(seed)
        self.sensor, self.array, self.found = ShapeSensor(finger), array, found
        self.offset = self.random.uniform(-3.0, 3.0, len(finger.angles_rad))
        self.stamp_ns = 0
        for _ in range(REST):
            self.frame(np.zeros(self.offset.size))

    def frame(self, output: Floats, what: str = "") -> ShapeEstimate:
        """Sense a frame of these outputs [%]; note whether its state is that of what was done."""
        raw = self.offset + output + NOISE * self.random.normal(size=output.size)
        raw = np.round(raw / STEP) * STEP
        self.stamp_ns += 1_000_000_000 // RATE_HZ
        processor_ns, begin_ns = time.process_time_ns(), time.perf_counter_ns()
        shape = self.sensor.frame(raw, self.stamp_ns).shape
        self.found.times.append(time.perf_counter_ns() - begin_ns)
        self.found.processor_ns += time.process_time_ns() - processor_ns
        if what:
            self.found.right.setdefault(what, []).append(shape.state is EXPECTED[what])
        return shape

    def pressed(self, place: float, load: float, rc: float) -> Floats:
        """Return the outputs [%] under a touch."""
        return -100.0 / 3.0 * self.array.strain(load, place, rc)

    def touch(self) -> None:
        """Touch the finger somewhere, let go, and do one of the other things to it."""
        u = self.random.uniform
        low, high = min(self.sensor.finger.angles_rad) + 0.1, max(self.sensor.finger.angles_rad) - 0.1
        place, load, rc = float(u(low, high)), float(u(40.0, 500.0)), float(self.random.choice(RADII))
        output = self.pressed(place, load, rc)
        for _ in range(HELD):
            shape = self.frame(output, "touch")
        if shape.usable:
            radius = equivalent_radius(self.sensor.finger.cylinder, rc)
            off = (
                math.degrees(shape.angle_rad - place),
                shape.load_n_per_m - load,
                1e3 * (shape.equivalent_radius_m - radius),
            )
            sd = shape.deviations
            self.found.touches.append((load, *off, math.degrees(sd[0]), sd[1], 1e3 * sd[2]))
        self.rest()
        what = str(self.random.choice(["pull", "two touches", "hole"]))
        if what == "pull":
            output = -output
        elif what == "two touches":
            other = place + (APART if place < 0.5 * (low + high) else -APART)
            output = output + self.pressed(other, load, rc)
        else:
            nearest = int(np.argmin(np.abs(np.array(self.sensor.finger.angles_rad) - place)))
            first = min(max(nearest - 3, 0), output.size - 7)
            output = np.where((np.arange(output.size) - first) // 7 == 0, np.nan, 0.0)
        for _ in range(HELD):
            self.frame(output, what)
        self.rest()

    def rest(self) -> None:
        """Leave the finger alone; the first frame may be that of the release."""
        for number in range(REST):
            self.frame(np.zeros(self.offset.size), "rest" if number else "")


def bench_touches(options: Options, report: Report) -> None:
    """Measure, and draw where a picture is asked for."""
    finger = from_toml(files("sioms.tools.demo").joinpath("finger.toml").read_text(encoding="utf-8"))
    array, found = TactileArray(FingerShape(gain=3.0)), Found()
    for seed in range(options.count(3, 20)):
        bench = _Bench(finger, array, 1000 * options.seed + seed, found)
        for _ in range(15):
            bench.touch()
        report.progress(f"simulated finger: {len(found.touches)} touches")
    rows = found.rows
    for column, (name, unit) in enumerate(zip(NAMES, ("deg", "N/m", "mm"), strict=True), 1):
        z = rows[:, column] / rows[:, column + 3]
        report.value(
            f"simulated finger: mean error of {name} in its deviations",
            float(np.mean(z)),
            "",
            bars=[Bar("value", 1.0), Bar("value", -1.0, True)],
            notes=f"error {np.mean(rows[:, column]):+.3g} +- {np.std(rows[:, column]):.2g} {unit}",
        )
        report.value(
            f"simulated finger: {name} within two deviations",
            100.0 * float(np.mean(np.abs(z) < 2.0)),
            "%",
            bars=[Bar("value", 95.0, True)],
            notes=f"{100.0 * np.mean(np.abs(z) < 3.0):.1f} % within three",
        )
    for what, right in found.right.items():
        report.value(
            f"simulated finger: right state, {what}",
            100.0 * float(np.mean(right)),
            "%",
            bars=[Bar("value", 99.0, True)],
            notes=f"{len(right)} frames",
        )
    report.samples("simulated finger: raw frame to shape, rests and touches", found.times)
    report.value("simulated finger: processor time of a frame", 1e-3 * found.processor_ns / len(found.times), "us")
    if options.picture:
        draw(found, options.picture)
        report.note(f"drew {options.picture}")


def draw(found: Found, path: str) -> None:
    """Draw errors over the load, errors in their deviations, states and times."""
    from matplotlib.figure import Figure  # heavy, and for pictures only

    figure, rows = Figure(figsize=(13.0, 7.0), layout="constrained"), found.rows
    errors, (within, states, times) = figure.subplots(2, 3)
    for column, (axes, name) in enumerate(zip(errors, ("place [deg]", "load [N/m]", "R [mm]"), strict=True), 1):
        axes.errorbar(
            rows[:, 0],
            rows[:, column],
            2.0 * rows[:, column + 3],
            fmt=".",
            elinewidth=0.5,
            label="+- two stated deviations",
        )
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="load [N/m]", ylabel=f"error of {name}")
        size = np.sort(np.abs(rows[:, column] / rows[:, column + 3]))
        within.plot(size, (np.arange(size.size) + 1.0) / size.size, label=name.split()[0])
    errors[0].legend()
    x = np.linspace(0.0, 4.0, 100)
    within.plot(x, [math.erf(v / math.sqrt(2.0)) for v in x], "k--", label="as stated")
    within.set(xlabel="error in stated deviations", ylabel="share of touches below", xlim=(0.0, 4.0))
    within.legend()
    shares = [100.0 * float(np.mean(right)) for right in found.right.values()]
    states.barh(list(found.right), shares)
    for number, (share, right) in enumerate(zip(shares, found.right.values(), strict=True)):
        states.text(2.0, number, f"{share:.2f} % of {len(right)}", va="center", color="white")
    states.set(xlabel="frames in the right state [%]", xlim=(0.0, 100.0))
    ordered = 1e-3 * np.sort(found.times)
    times.plot(ordered, 1.0 - np.arange(ordered.size) / ordered.size)
    times.set(
        xlabel="raw frame to shape [us]",
        ylabel="share of frames that take longer",
        xscale="log",
        yscale="log",
    )
    figure.suptitle(f"{len(rows)} touches of the simulated finger, {len(ordered)} frames")
    figure.savefig(path, dpi=110)
