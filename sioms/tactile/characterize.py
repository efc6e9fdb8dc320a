"""Characterise a finger's outputs beside the touch itself: noise, mains lines, temperature, creep, proximity (dissertation 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import welch

from sioms.tactile.touches import LOADED, Recording

Floats = NDArray[np.float64]


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
    return Noise(
        raw.std(0, ddof=1), float(gaps.min()) if gaps.size else 0.0, frequency, density, tuple(lines)
    )


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


@dataclass(frozen=True, slots=True)
class Creep:
    """Hold the rise of the output under a constant load, out = 1 + share (1 - exp(-t/time)) from its first value.

    Args:
        share: relative rise; deviation beside it.
        deviation: of the share.
        time_s: time constant; nan if the share is within two deviations of zero.
    """

    share: float
    deviation: float
    time_s: float


def creep_of(recording: Recording) -> Creep | None:
    """Fit the mean course of touches held at constant load; None without at least five loaded frames in a touch."""
    courses, clocks = [], []
    for number in np.unique(recording.touch[recording.touch >= 0]):
        mine = (recording.touch == number) & (recording.phase == LOADED)
        before = (recording.touch == number) & (recording.phase != LOADED)
        if mine.sum() < 5 or not before.any():
            continue
        rise = recording.raw[mine] - recording.raw[before].mean(0)
        loudest = int(rise.mean(0).argmax())
        if rise[:, loudest].mean() > 0.0:
            courses.append(rise[:, loudest] / rise[:, loudest].mean())
            clocks.append(recording.time_s[mine] - recording.time_s[mine][0])
    if not courses:
        return None
    shortest = min(course.size for course in courses)
    mean = np.mean([course[:shortest] for course in courses], axis=0)
    clock = np.mean([time[:shortest] for time in clocks], axis=0)

    def miss(v: Floats) -> Floats:
        out: Floats = v[0] * (1.0 + v[1] * -np.expm1(-clock / np.exp(v[2]))) - mean
        return out

    found = least_squares(
        miss, [mean[0], 0.05, np.log(0.3 * clock[-1] + 1e-9)], bounds=([0, -1, -7], [2, 5, 3])
    )
    jacobian = np.asarray(found.jac, dtype=np.float64)
    variance = 2.0 * found.cost / max(shortest - 3, 1)
    deviation = float(np.sqrt(np.linalg.pinv(jacobian.T @ jacobian)[1, 1] * variance))
    share = float(found.x[1])
    return Creep(share, deviation, float(np.exp(found.x[2])) if abs(share) > 2.0 * deviation else np.nan)


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
