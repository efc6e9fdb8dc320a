"""Probe a tactile finger with axes, a force sensor and a client program: record touches as calibration wants them.

The workcell is that of etc/prober.toml: axes ``prober.place`` and ``prober.radial``, the finger ``tactile0``, the force sensor
``force0``. ``simulated`` starts one with a simulated finger behind a real framed stream; ``Prober`` works on any.
"""

from __future__ import annotations

import errno
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

import sioms

Floats = NDArray[np.float64]
Frames = tuple[Floats, Floats, Floats]  # raw (n, ns), time [s], force [N/m]
T = TypeVar("T")

SURFACE_M = 0.010  # depth of the finger's surface
CLEAR_M = 2e-3  # distance of the indenter between touches
LENGTH_M = 0.012  # of the indenters: N to N/m
FRAMES = 20  # averaged before and under each touch
RATE_HZ = 400.0
START_S = 180.0
ATTEMPTS = 5  # at a touch whose frames did not come
FINGER = (
    "length_m = 0.012; gain = 3.0; gain_scatter = 0.1; depth_scatter_m = 2e-4; angle_scatter_rad = 0.007; quadratic = 0.03; "
    "adhesion = 0.3; creep = 0.05; drift = 0.3; drift_s = 300.0; mains = 0.03; strip_gain = 0.02; seed = 1"
)
"""The finger that is probed if none is described: faults of the sizes that the dissertation reports."""


class Counterpart:
    """A simulated finger as a process; commands go to its standard input."""

    def __init__(self, words: Sequence[str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._wait("ready")

    def tell(self, line: str) -> None:
        """Send a command and wait for its answer.

        Raises:
            RuntimeError: it refused.
        """
        if self._process.stdin is not None:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
        self._wait("ok")

    def end(self) -> None:
        """End it."""
        self._process.terminate()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait(self, word: str) -> None:
        said: list[str] = []
        stream = self._process.stdout
        if stream is not None:
            reader = threading.Thread(target=lambda: said.append(stream.readline()), daemon=True)
            reader.start()
            reader.join(START_S)
        if not said or not said[0].startswith(word):
            raise RuntimeError(f"simulated finger: it said {said}; {word!r} was expected")


@contextmanager
def simulated(
    folder: Path, finger: str, radii_m: Sequence[float], text: str | None = None
) -> Iterator[Callable[[float], None]]:
    """Run the prober's workcell with a simulated finger; give a function that mounts an indenter [m].

    Args:
        folder: for sockets and configuration; a short path.
        finger: fields of the simulated finger.
        radii_m: of the indenters.
        text: of the configuration; None takes etc/prober.toml.
    """
    from sioms.tools.demo.rig import daemon  # its processes are those of any workcell

    port, socket = folder / "finger", folder / "prober.sock"
    with ExitStack() as stack:
        module = "sioms.tools.counterparts.finger"
        words = ["--link", str(port), "--socket", str(socket), "--finger", finger]
        device = Counterpart([module, *words, "--mount", *(str(radius) for radius in radii_m)])
        stack.callback(device.end)
        config = folder / "prober.toml"
        source = text or files("sioms.tools").joinpath("prober.toml").read_text(encoding="utf-8")
        config.write_text(source.replace("/dev/ttyACM0", str(port)), encoding="utf-8")
        before = os.environ.get("SIOMS_SOCKET")
        process = daemon(str(config), str(socket))
        stack.callback(process.end)
        try:
            wait_links()
            yield lambda radius_m: device.tell(f"indenter {radius_m}")
        finally:
            if before is None:
                del os.environ["SIOMS_SOCKET"]
            else:
                os.environ["SIOMS_SOCKET"] = before


def wait_links(meanwhile: Callable[[], None] = lambda: None) -> None:
    """Wait until all devices of the workcell answer; call `meanwhile` again and again.

    Raises:
        RuntimeError: one does not.
    """
    with sioms.Workcell(name="prober") as cell:
        deadline = time.monotonic() + START_S
        while any(device["link"] != "good" for device in cell.status()["devices"]):
            if time.monotonic() > deadline:
                raise RuntimeError(f"start prober: a link did not come up: {cell.status()['devices']}")
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
    """Moves the indenter and records.  One thread.

    Args:
        cell: the workcell.
        mount: changes the indenter.
    """

    def __init__(self, cell: sioms.Workcell, mount: Callable[[float], None]) -> None:
        self._mount = mount
        self._mounted = math.nan
        self._axis: Any = cell.open("prober.radial", "rw", lease=10.0)
        self._place: Any = cell.open("prober.place", "rw", lease=10.0)
        self._finger: Any = cell.open("tactile0")
        self._force: Any = cell.open("force0.fz")
        self._stiffness = 0.0
        self._tare = 0.0
        self._began_ns = time.monotonic_ns()

    def prepare(self, radius_m: float, middle: float) -> None:
        """Learn how deep the axis must go for a force: one press in the middle of the finger."""
        depth_m = 0.5e-3

        def press() -> float:
            self._go(middle, radius_m)
            self._press(depth_m)
            _, _, force = self._frames(FRAMES)
            self._clear()
            return float(np.mean(force))

        self._stiffness = self._again(press, lambda what: None) * LENGTH_M / depth_m
        if not self._stiffness > 0.0:
            raise RuntimeError(
                f"probe finger: pressing {1e3 * depth_m:g} mm deep gave no force; see to force0 and the prober"
            )

    def run(self, plan: Sequence[Touch], tell: Callable[[str], None], what: str) -> Recorder:
        """Carry out a plan, touch by touch."""
        out = Recorder()
        for number, touch in enumerate(plan):
            before, under = self._again(lambda: self._touch(touch), tell)  # noqa: B023 - called at once
            out.add(*before, number, 0)
            out.add(*under, number, 1)
            out.touches.append(touch)
            tell(f"{what}: touch {number + 1} of {len(plan)}")
        return out

    def _touch(self, touch: Touch) -> tuple[Frames, Frames]:
        self._go(touch.place, touch.radius_m)
        before = self._frames(FRAMES)
        self._press(touch.load * LENGTH_M / self._stiffness)
        under = self._frames(FRAMES)
        self._clear()
        return before, under

    def _again(self, work: Callable[[], T], tell: Callable[[str], None]) -> T:
        """Repeat what a break of the finger's link has spoilt."""
        for attempt in range(ATTEMPTS):
            try:
                return work()
            except OSError as error:
                if error.errno != errno.EIO or attempt == ATTEMPTS - 1:
                    raise
                tell(f"{error.strerror}: once more")
                wait_links(self._keep_alive)
                self._clear()
        raise AssertionError("unreachable")

    def _keep_alive(self) -> None:
        for node in (self._axis, self._place):
            node.keepalive()

    def ramps(
        self, places: Sequence[float], load: float, seconds: float, tell: Callable[[str], None]
    ) -> Recorder:
        """Press an edge over each element with a force that grows evenly."""
        out = Recorder()
        for number, place in enumerate(places):
            before, under = self._again(lambda: self._ramp(place, load, seconds), tell)  # noqa: B023 - called at once
            out.add(*before, number, 0)
            out.add(*under, number, 1)
            tell(f"ramp over element {number}")
        return out

    def _ramp(self, place: float, load: float, seconds: float) -> tuple[Frames, Frames]:
        self._go(place, 0.0)
        before = self._frames(FRAMES)
        depth_m = load * LENGTH_M / self._stiffness
        self._move(SURFACE_M - 0.1e-3)
        self._axis.command(velocity=depth_m / seconds, replace=True)
        frames, stamps, force = self._frames(round(RATE_HZ * seconds))
        self._clear()
        pressed = np.flatnonzero(force > 0.05 * force.max())
        rise = slice(int(pressed[0]), int(np.argmax(force)) + 1)
        return before, (frames[rise], stamps[rise], force[rise])

    def quiet(self, frames: int) -> Recorder:
        """Record the untouched finger."""
        out = Recorder()
        for _ in range(math.ceil(frames / 200)):  # the page holds 512
            out.add(*self._again(lambda: self._frames(200), lambda what: None), -1, 2)
        return out

    def close(self) -> None:
        """Go clear and let the nodes go."""
        self._clear()
        for node in (self._axis, self._place, self._finger, self._force):
            node.close()

    def _go(self, place: float, radius_m: float) -> None:
        if radius_m != self._mounted:
            self._mount(radius_m)
            self._mounted = radius_m
        self._keep_alive()
        self._place.command(position=place, replace=True)
        self._place.wait_until_idle(5.0)
        number = self._force.read().number
        self._force.wait_new(number + 50, 2.0)
        self._tare = float(np.mean([s.data[0] for s in self._force.history(number)]))

    def _press(self, depth_m: float) -> None:
        self._move(SURFACE_M + depth_m)
        self._force.wait_new(self._force.read().number + 60, 2.0)

    def _clear(self) -> None:
        self._move(SURFACE_M - CLEAR_M)

    def _move(self, position: float) -> None:
        self._axis.command(position=position, replace=True)
        self._axis.wait_until_idle(5.0)

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
            last, force_last = news[-1].number, forces[-1].number
            self._keep_alive()
        snaps = snaps[:count]
        stamps = np.array([s.stamp_ns for s in snaps])
        at = np.searchsorted([s.stamp_ns for s in forces], stamps, side="right") - 1
        force = np.array([forces[max(int(i), 0)].data[0] for i in at]) - self._tare
        raw = np.array([s.data for s in snaps])
        return raw, (stamps - self._began_ns) * 1e-9, force / LENGTH_M


def write_nominal(path: Path, angles_rad: Floats) -> None:
    """Write the finger as built: what calibration begins with."""
    nominal = {
        "ra_mm": 9.6, "rb_mm": 12.7, "poisson": 0.46, "shear_modulus_pa": 8.3e4,
        "element_angle_deg": np.degrees(angles_rad).tolist(), "element_radius_mm": [10.3] * len(angles_rad),
        "gain_percent_strain_per_percent_output": [3.0] * len(angles_rad), "output_noise_percent": 0.05,
    }  # fmt: skip
    path.write_text(json.dumps(nominal, indent=1), encoding="utf-8")
