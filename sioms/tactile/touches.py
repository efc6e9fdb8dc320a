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
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from sioms.tactile import closedform
from sioms.tactile.contact import frictionless, width_for_load
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import Wedge
from sioms.tactile.model import pressed, stuck
from sioms.tactile.width import WidthTable

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BASELINE, LOADED = 0, 1
_ALIKE_FRAMES = 3  # under load, that must read the same
_FULL = 10  # touches under which an element reads the same: saturated


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
                raise ValueError(f"read recording: {name} has shape {getattr(self, name).shape}; need ({frames},)")


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
        averaged: frames of white noise whose mean is as noisy as an output; 10 if it is 20 frames under load less 20 of
            baseline, more with a mains line, which a mean leaves out.
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
        ValueError: a touch lacks frames or holds values that are not finite, or an element was at the end of its range.
    """
    count = angle_rad.size
    output, force = np.empty((count, recording.raw.shape[1])), np.empty(count)
    spread: list[Floats] = []
    slow: list[Floats] = []
    shares, living = np.empty(count), np.isfinite(recording.raw).any(axis=0)
    stuck_at = np.full(output.shape, np.nan)
    for number in range(count):
        mine = recording.touch == number
        before, under = mine & (recording.phase == BASELINE), mine & (recording.phase == LOADED)
        if not (before.any() and under.any()):
            raise ValueError(
                f"average touch {number} of {count}: {int(before.sum())} baseline and {int(under.sum())} loaded "
                "frames; need at least one of each"
            )
        shares[number] = 1.0 / before.sum() + 1.0 / under.sum()
        output[number] = _mean(recording.raw[under]) - _mean(recording.raw[before])
        if under.sum() >= _ALIKE_FRAMES:
            stuck_at[number] = np.where(np.ptp(recording.raw[under], axis=0) == 0.0, recording.raw[under][0], np.nan)
        force[number] = recording.force[under].mean() - recording.force[before].mean()
        if before.sum() > 2 and np.isfinite(recording.raw[before][:, living]).all():
            spread.append(recording.raw[before].var(0, ddof=1))
            slow.append(_slow(recording.raw[before]))
    _check_range(recording.raw, stuck_at)
    output[:, ~np.isfinite(output).any(axis=0)] = 0.0  # an element that is not there is silent
    if not np.isfinite(output).all():
        touch, element = np.argwhere(~np.isfinite(output))[0]
        raise ValueError(
            f"average touch {touch}: element {element} holds a reading that is not finite; leave the touch out"
        )
    noise = np.sqrt(np.mean(spread, axis=0)) if spread else np.full(output.shape[1], np.nan)
    averaged = 1.0 / float(shares.mean()) if count else 1.0
    if spread:
        alive = np.isfinite(noise)
        felt = float(np.mean(slow, axis=0)[alive].sum())
        averaged *= float(np.sum(noise[alive] ** 2)) / felt if felt > 0.0 else 1.0
    return Touches(output * scale, angle_rad, load, radius_m, force, noise * scale, averaged)


def _check_range(raw: Floats, stuck_at: Floats) -> None:
    """Refuse elements that read the same largest value, without any noise, under many touches."""
    for element in np.flatnonzero(np.isfinite(raw).any(axis=0)):
        top = np.nanmax(raw[:, element])
        full = int(np.count_nonzero(stuck_at[:, element] == top))
        if full >= _FULL and top > np.nanmin(raw[:, element]):
            raise ValueError(
                f"average touches: element {element} reads exactly {top:g} in all frames of {full} touches, and never "
                "more: it is at the end of its range; press less hard, or lower the gain of the electronics"
            )


def _mean(frames: Floats) -> Floats:
    """Return the mean of the readings that are finite, nan where there is none, shape (ns,)."""
    finite = np.isfinite(frames)
    count = finite.sum(axis=0)
    total = np.where(finite, frames, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _slow(frames: Floats) -> Floats:
    """Return the variance per frame of what a mean of such frames feels: that of the slowest waves, shape (ns,)."""
    waves = np.fft.rfft(frames - frames.mean(0), axis=0)[1 : 1 + max(1, min(3, (len(frames) - 1) // 2))]
    return np.asarray(np.mean(np.abs(waves) ** 2, axis=0) / len(frames))


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
        load = np.polyval(np.polyfit(clock, recording.force[under] - recording.force[before].mean(), 1), clock)
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

    @property
    def highest(self) -> int:
        """Return nc."""
        return int(self.normal.shape[1]) - 1


def touch_loads(
    cylinder: Cylinder, widths: WidthTable, touches: Touches, highest: int, edge_half_angle: float = np.pi / 4,
    wider: Floats | float = 1.0,
) -> TouchLoads:  # fmt: skip
    """Return the tractions of the touches: an edge as a wedge with the rigid core, the others with the table's width,
    times `wider` of each touch, with the tangential traction of full adhesion beside them (scale it by the share of
    adhesion). Hertz's table brings elliptic pressures, another the exact ones.
    """
    k, line = np.arange(highest + 1), 1.0 / (np.pi * cylinder.outer_m)
    shape = None if widths.is_hertz else pressed(cylinder, highest)
    normal, shear = np.empty((len(touches), highest + 1)), np.empty((len(touches), highest + 1))
    sticking, factor = stuck(cylinder, highest), np.broadcast_to(wider, len(touches))
    for number in range(len(touches)):
        load, radius = float(touches.load[number]), float(touches.radius_m[number])
        if radius == 0.0:
            # the shape of an edge's narrow pressure hardly matters: one for each per cent of load
            alike = float(np.exp(0.01 * np.round(100.0 * np.log(load))))
            p, half = _edge(cylinder, highest, edge_half_angle, alike)
            p = p * (load / alike)
        else:
            half = widths.half_width(load * closedform.equivalent_radius(cylinder, radius))
            half *= float(factor[number])
            p = -load * line * (closedform.ellipse_spectrum(k * half) if shape is None else shape(half))
            p[0] *= 0.5
        normal[number], shear[number] = p, load * line * sticking(half)
    return TouchLoads(normal, shear)


class _Edges:
    """Solve edges on a few half widths; in between load over width and the pressure's shape go as cubics."""

    _WIDTHS = (0.08, 0.2, 0.35, 0.55, 0.75, 1.0)
    _HEAVY = 1000.0  # N/m

    def __init__(self, cylinder: Cylinder, highest: int, half_angle: float) -> None:
        self._highest, self._edge = highest, Wedge(half_angle)
        # the core narrows the contact, so that the table goes beyond the heavy load
        top = min(0.5 * closedform.wedge_width(cylinder, self._HEAVY, half_angle), 0.5)
        solved = [frictionless(cylinder, self._edge, top * share) for share in self._WIDTHS]
        half = np.array([one.half_width for one in solved])
        # without width a half plane's
        first = 2.0 / closedform.wedge_width(cylinder, 1.0, half_angle)
        self._load = CubicSpline(np.concatenate([[0.0], half]), [first, *(one.load / one.half_width for one in solved)])
        self._shape = CubicSpline(half, [one.normal * one.half_width / one.load for one in solved])
        self._widest = solved[-1]

    def at(self, load: float) -> tuple[Floats, float]:
        """Return the cosine coefficients of p about the middle [Pa], and the half width [rad]."""
        widest = self._widest
        if load > widest.load:
            solved = width_for_load(widest.cylinder, self._edge, load)
        else:
            half = float(brentq(lambda a: a * float(self._load(a)) - load, 0.0, widest.half_width))
            solved = replace(widest, half_width=half, load=load, normal=self._shape(half) * load / half)
        return solved.series(0.0, self._highest)[: 2 * self._highest + 1 : 2], solved.half_width


@lru_cache(maxsize=8)
def _edges(cylinder: Cylinder, highest: int, half_angle: float) -> _Edges:
    return _Edges(cylinder, highest, half_angle)


@lru_cache(maxsize=1000)
def _edge(cylinder: Cylinder, highest: int, half_angle: float, load: float) -> tuple[Floats, float]:
    return _edges(cylinder, highest, half_angle).at(load)
