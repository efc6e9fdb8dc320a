"""Hold recorded touches and what the contact model says about each of them.

A recording is a table of frames with marks: which touch, and whether the frame is its baseline or under load.
 `average` turns it into one output for each touch and element; `touch_loads` gives the traction of each touch
 as a spectrum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sioms.tactile import closedform
from sioms.tactile.contact import adhere, width_for_load
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import FLAT, Wedge
from sioms.tactile.width import WidthTable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BASELINE, LOADED = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Hold frames as recorded; immutable.

    Args:
        raw: readings, shape (frames, ns).
        time_s: shape (frames,), rising.
        touch: touch number of each frame, -1 without.
        phase: 0 baseline just before the touch, 1 under load, 2 neither.
        force: load cell [N/m].
        temperature_c: of the air, or nan.
        rate_hz: frames per second.
    """

    raw: Floats
    time_s: Floats
    touch: Ints
    phase: Ints
    force: Floats
    temperature_c: Floats
    rate_hz: float

    def __post_init__(self) -> None:
        frames = self.raw.shape[0] if self.raw.ndim == 2 else -1
        for name in ("time_s", "touch", "phase", "force", "temperature_c"):
            if getattr(self, name).shape != (frames,):
                raise ValueError(
                    f"read recording: {name} has shape {getattr(self, name).shape}; need ({frames},)"
                )


@dataclass(frozen=True, slots=True, eq=False)
class Touches:
    """Hold averaged touches; immutable.

    Args:
        output: linear fraction of the untouched output, compression positive, shape (nt, ns).
        angle_rad: commanded place, shape (nt,).
        load: commanded load [N/m], shape (nt,).
        radius_m: indenter radius, 0 for an edge, infinite for a flat, shape (nt,).
        force: measured load [N/m], shape (nt,); nan without a load cell.
        noise: standard deviation of one frame's output, shape (ns,).
        averaged: frames whose mean is as noisy as an output; 10 if it is 20 frames under load less 20 of baseline.
    """

    output: Floats
    angle_rad: Floats
    load: Floats
    radius_m: Floats
    force: Floats
    noise: Floats
    averaged: float = 10.0

    def __len__(self) -> int:
        return int(self.angle_rad.size)

    def pick(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Touches:
        """Return some of the touches."""
        return Touches(
            self.output[which], self.angle_rad[which], self.load[which], self.radius_m[which], self.force[which],
            self.noise, self.averaged,
        )  # fmt: skip

    def with_output(self, output: Floats) -> Touches:
        """Return the same touches with other outputs (linearised, say)."""
        return replace(self, output=output)


def join(parts: list[Touches]) -> Touches:
    """Return all touches of several experiments; the noise is that of all."""
    if not parts:
        raise ValueError("join touches: no experiment holds touches")
    names = ("output", "angle_rad", "load", "radius_m", "force")
    output, angle, load, radius, force = (np.concatenate([getattr(p, name) for p in parts]) for name in names)
    count = np.array([len(part) for part in parts], dtype=np.float64)
    noise = np.sqrt(count @ np.array([part.noise**2 for part in parts]) / count.sum())
    return Touches(output, angle, load, radius, force, noise, min(part.averaged for part in parts))


def average(recording: Recording, angle_rad: Floats, load: Floats, radius_m: Floats, scale: float) -> Touches:
    """Average each touch's loaded frames less its baseline frames.

    Args:
        recording: frames.
        angle_rad: commanded place of each touch, shape (nt,).
        load: commanded load [N/m].
        radius_m: indenter radius.
        scale: output per raw unit.

    Raises:
        ValueError: a touch lacks frames or holds values that are not finite.
    """
    count = angle_rad.size
    output, force = np.empty((count, recording.raw.shape[1])), np.empty(count)
    spread: list[Floats] = []
    shares = np.empty(count)
    for number in range(count):
        mine = recording.touch == number
        before, under = mine & (recording.phase == BASELINE), mine & (recording.phase == LOADED)
        if not (before.any() and under.any()):
            raise ValueError(
                f"average touch {number} of {count}: {int(before.sum())} baseline and {int(under.sum())} loaded frames; "
                "need at least one of each"
            )
        shares[number] = 1.0 / before.sum() + 1.0 / under.sum()
        output[number] = recording.raw[under].mean(0) - recording.raw[before].mean(0)
        force[number] = recording.force[under].mean() - recording.force[before].mean()
        if before.sum() > 2:
            spread.append(recording.raw[before].var(0, ddof=1))
    output[:, ~np.isfinite(output).any(axis=0)] = 0.0  # an element that is not there is silent
    if not np.isfinite(output).all():
        touch, element = np.argwhere(~np.isfinite(output))[0]
        raise ValueError(
            f"average touch {touch}: element {element} holds a reading that is not finite; leave the touch out"
        )
    noise = np.sqrt(np.mean(spread, axis=0)) if spread else np.full(output.shape[1], np.nan)
    averaged = 1.0 / float(shares.mean()) if count else 1.0
    return Touches(output * scale, angle_rad, load, radius_m, force, noise * scale, averaged)


@dataclass(frozen=True, slots=True, eq=False)
class Ramp:
    """Hold a load ramp of an edge over one element; immutable.

    Args:
        element: number of the element.
        output: of that element, shape (frames,).
        load: smoothed [N/m], > 0, shape (frames,).
    """

    element: int
    output: Floats
    load: Floats


def ramps_of(recording: Recording, scale: float) -> list[Ramp]:
    """Read load ramps: touch n lies over element n; the load is the straight line through the load cell's readings."""
    out = []
    for number in np.unique(recording.touch[recording.touch >= 0]):
        mine = recording.touch == number
        before, under = mine & (recording.phase == BASELINE), mine & (recording.phase == LOADED)
        if under.sum() < 20 or not before.any() or number >= recording.raw.shape[1]:
            continue
        clock = recording.time_s[under] - recording.time_s[under][0]
        load = np.polyval(
            np.polyfit(clock, recording.force[under] - recording.force[before].mean(), 1), clock
        )
        output = scale * (recording.raw[under, number] - recording.raw[before, number].mean())
        pressed = load > 0.02 * load.max()
        if np.isfinite(output).all() and np.isfinite(load).all() and load.max() > 0.0:
            out.append(Ramp(int(number), output[pressed], load[pressed]))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class TouchLoads:
    """Hold cosine coefficients of p and sine coefficients of q [Pa] about each touch, shape (nt, nc + 1)."""

    normal: Floats
    shear: Floats


def touch_loads(
    cylinder: Cylinder, widths: WidthTable, touches: Touches, highest: int, edge_half_angle: float = np.pi / 4,
    wider: Floats | float = 1.0,
) -> TouchLoads:  # fmt: skip
    """Return the tractions of the touches: an edge as a wedge with the rigid core, the others as ellipses of the table's
    width, times `wider` of each touch, with the tangential traction of full adhesion beside them (scale it by the share
    of adhesion).
    """
    k = np.arange(highest + 1)
    normal, shear = np.empty((len(touches), highest + 1)), np.empty((len(touches), highest + 1))
    stuck, factor = _adhesion_by_width(cylinder, highest), np.broadcast_to(wider, len(touches))
    for number in range(len(touches)):
        load, radius = float(touches.load[number]), float(touches.radius_m[number])
        if radius == 0.0:
            # an edge's narrow width hardly matters: one solution for each four per cent of load, scaled
            step = round(float(np.log(load)) / 0.04)
            spectrum, half = _edge(cylinder, highest, edge_half_angle, step)
            p = load * spectrum
        else:
            half = widths.half_width(load * closedform.equivalent_radius(cylinder, radius)) * float(
                factor[number]
            )
            p = -load / (np.pi * cylinder.outer_m) * closedform.ellipse_spectrum(k * half)
            p[0] *= 0.5
        normal[number], shear[number] = p, load * stuck.at(half)
    return TouchLoads(normal, shear)


@lru_cache(maxsize=1000)
def _edge(cylinder: Cylinder, highest: int, half_angle: float, step: int) -> tuple[Floats, float]:
    """Return the cosine coefficients of p under an edge per unit load, and its half width, at the load exp(0.04 step)."""
    solved = width_for_load(cylinder, Wedge(half_angle), float(np.exp(0.04 * step)))
    return solved.series(0.0, highest)[: 2 * highest + 1 : 2] / solved.load, solved.half_width


class _AdhesionByWidth:
    """Interpolate q's coefficients per unit load over the half width."""

    def __init__(self, cylinder: Cylinder, highest: int) -> None:
        self._nodes = np.array([0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.27, 0.35, 0.5])
        rows = [np.zeros(highest + 1)]
        for half in self._nodes[1:]:
            solved = adhere(cylinder, FLAT, float(half))
            q = np.zeros(highest + 1)
            q[1:] = solved.series(0.0, highest)[2 * highest + 2 :: 2] / solved.load
            rows.append(q)
        self._rows = np.array(rows)

    def at(self, half_width: float) -> Floats:
        place = int(np.clip(np.searchsorted(self._nodes, half_width) - 1, 0, self._nodes.size - 2))
        part = (half_width - self._nodes[place]) / (self._nodes[place + 1] - self._nodes[place])
        blend: Floats = (1.0 - part) * self._rows[place] + part * self._rows[place + 1]
        return blend


@lru_cache(maxsize=8)
def _adhesion_by_width(cylinder: Cylinder, highest: int) -> _AdhesionByWidth:
    return _AdhesionByWidth(cylinder, highest)
