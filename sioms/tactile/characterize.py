"""Characterise a finger's outputs beside the touch itself: noise, mains lines, temperature, creep, relaxation,
proximity.

As section 3.3 of the dissertation does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import welch

from sioms.tactile.touches import BASELINE, LOADED, Recording

Floats = NDArray[np.float64]

_SLOPE_SIGMA = 20.0  # of an element's slope, for its share to be better known than that all are alike


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Hold the noise of an untouched finger.

    Args:
        deviation: per element [raw], shape (ns,).
        step: smallest difference between readings [raw], 0 if none repeats: the converter's step.
        frequency_hz: of the spectrum, shape (nf,).
        density: mean power density over elements [raw^2/Hz], shape (nf,).
        lines: frequency [Hz] and amplitude [raw] of lines that stand out of the spectrum.
    """

    deviation: Floats
    step: float
    frequency_hz: Floats
    density: Floats
    lines: tuple[tuple[float, float], ...]


def noise_of(recording: Recording, outstanding: float = 8.0) -> Noise:
    """Return deviation, spectrum and lines of an untouched recording.

    Args:
        recording: at least 64 frames.
        outstanding: how far a line stands above the median density.
    """
    frames = recording.raw.shape[0]
    if frames < 64:
        raise ValueError(f"characterise noise: {frames} frames; need at least 64")
    raw = recording.raw - recording.raw.mean(0)
    length = min(1024, frames)
    frequency, power = welch(raw, fs=recording.rate_hz, axis=0, nperseg=length, window="hann")
    density = power.mean(1)
    floor = float(np.median(density[1:]))
    lines = []
    width = 1.5 * recording.rate_hz / length  # equivalent noise bandwidth of the window
    for place in range(2, frequency.size - 1):
        here = density[place]
        if here > outstanding * floor and here >= density[place - 1] and here > density[place + 1]:
            lines.append((float(frequency[place]), float(np.sqrt(2.0 * (here - floor) * width))))
    gaps = np.diff(np.unique(np.round(recording.raw[:, 0], 9)))
    return Noise(raw.std(0, ddof=1), float(gaps.min()) if gaps.size else 0.0, frequency, density, tuple(lines))


@dataclass(frozen=True, slots=True, eq=False)
class Thermal:
    """Hold output against temperature: slope [raw/K] and its deviation per element."""

    slope: Floats
    deviation: Floats


def thermal_of(recording: Recording) -> Thermal | None:
    """Regress an untouched recording on temperature; None if it spans less than half a degree."""
    warm = recording.temperature_c - recording.temperature_c.mean()
    if not np.isfinite(warm).all() or np.ptp(warm) < 0.5:
        return None
    raw = recording.raw - recording.raw.mean(0)
    square = float(warm @ warm)
    slope = warm @ raw / square
    rest = raw - warm[:, None] * slope
    return Thermal(slope, np.sqrt((rest**2).sum(0) / max(warm.size - 2, 1) / square))


def shares_of(thermal: Thermal) -> tuple[float, ...]:
    """Return each element's slope over their median; nothing where the slopes are not known well enough to help."""
    middle = float(np.median(thermal.slope))
    if not np.isfinite(thermal.slope).all() or abs(middle) < _SLOPE_SIGMA * float(np.max(thermal.deviation)):
        return ()
    return tuple(round(float(share), 5) for share in thermal.slope / middle)


@dataclass(frozen=True, slots=True)
class Creep:
    """Hold what comes or goes late, as a share of the output under load.

    Args:
        share: that comes late under a constant load (creep: out = 1 + share (1 - exp(-t/time)) from its first value),
            or is left at the first frame after a release (relaxation: out = share exp(-t/time)).
        deviation: of the share.
        time_s: time constant; nan if the share is within two deviations of zero.
    """

    share: float
    deviation: float
    time_s: float


def creep_of(recording: Recording) -> Creep | None:
    """Fit the mean course of touches held at constant load; None without at least five loaded frames in a touch."""
    fitted = _fit_course(_courses(recording, released=False))
    if fitted is None:
        return None
    _, share, _, deviation, time_s = fitted
    return _creep(share, deviation, time_s)


def relaxation_of(recording: Recording) -> Creep | None:
    """Fit the mean course after release; None without at least five frames of phase 2 after the loaded ones of a
    touch.
    """
    fitted = _fit_course(_courses(recording, released=True))
    if fitted is None:
        return None
    first, share, first_deviation, _, time_s = fitted
    # what has come at last is off by the drift since the baseline and no relaxation
    return _creep(-first * share, first_deviation, time_s)


def _creep(share: float, deviation: float, time_s: float) -> Creep:
    return Creep(share, deviation, time_s if abs(share) > 2.0 * deviation else np.nan)


def _courses(recording: Recording, released: bool) -> list[tuple[Floats, Floats, float]]:
    """Return of the loudest element of each touch the time from the first frame, its output over its mean under load,
    and that mean [raw].
    """
    out = []
    for number in np.unique(recording.touch[recording.touch >= 0]):
        mine = recording.touch == number
        before, under = mine & (recording.phase == BASELINE), mine & (recording.phase == LOADED)
        if not (before.any() and under.any()):
            continue
        rise = recording.raw[under].mean(0) - recording.raw[before].mean(0)
        loudest = int(rise.argmax())
        after = mine & ~before & ~under & (recording.time_s > recording.time_s[under].max())
        chosen = after if released else under
        if chosen.sum() >= 5 and rise[loudest] > 0.0:
            course = (recording.raw[chosen, loudest] - recording.raw[before, loudest].mean()) / rise[loudest]
            out.append((recording.time_s[chosen] - recording.time_s[chosen][0], course, float(rise[loudest])))
    return out


def _fit_course(
    courses: list[tuple[Floats, Floats, float]],
) -> tuple[float, float, float, float, float] | None:
    """Fit first (1 + share (1 - exp(-t/time))) to the mean; return first, share, their deviations, time [s].

    Touches count by the square of their output: one beside the array is mostly noise.
    """
    if not courses:
        return None
    shortest = min(course.size for _, course, _ in courses)
    weights = np.square([rise for _, _, rise in courses])
    mean = np.average([course[:shortest] for _, course, _ in courses], axis=0, weights=weights)
    clock = np.mean([time[:shortest] for time, _, _ in courses], axis=0)

    def miss(v: Floats) -> Floats:
        out: Floats = v[0] + v[1] * -np.expm1(-clock / np.exp(v[2])) - mean
        return out

    low, high = np.array([-1.0, -5.0, -7.0]), np.array([2.0, 5.0, 3.0])
    begin = [mean[0], mean[-1] - mean[0], np.log(0.3 * clock[-1] + 1e-9)]
    found = least_squares(miss, np.clip(begin, low + 1e-3, high - 1e-3), bounds=(low, high))
    jacobian = np.asarray(found.jac, dtype=np.float64)
    variance = 2.0 * found.cost / max(shortest - 3, 1)
    deviation = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian)) * variance)
    first = float(found.x[0]) if abs(found.x[0]) > 1e-9 else 1e-9
    return (
        first,
        float(found.x[1]) / first,
        float(deviation[0]),
        float(deviation[1]) / abs(first),
        float(np.exp(found.x[2])),
    )


def proximity_of(recording: Recording) -> Floats:
    """Return the mean change of far elements in touches [raw], shape (ns,): a field effect, no strain reaches so far.

    The four elements with the largest output in each touch and their neighbours are left out.
    """
    total, seen = np.zeros(recording.raw.shape[1]), np.zeros(recording.raw.shape[1])
    for number in np.unique(recording.touch[recording.touch >= 0]):
        mine = recording.touch == number
        under, before = mine & (recording.phase == LOADED), mine & (recording.phase != LOADED)
        if not (under.any() and before.any()):
            continue
        change = recording.raw[under].mean(0) - recording.raw[before].mean(0)
        far = np.abs(np.arange(change.size) - int(np.abs(change).argmax())) >= 6
        total[far] += change[far]
        seen[far] += 1
    return np.where(seen > 0, total / np.maximum(seen, 1), np.nan)
