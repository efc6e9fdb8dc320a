"""Reduce recorded frames to what is fitted: touches with their course in time, untouched frames, load ramps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.finger.pressures import Floats
from sioms.tactile.touches import BASELINE, LOADED, Recording

PARTS = 4  # of the course of a touch under load
LEAST_TOUCHES = 24
RAMP_BINS = 16
NEIGHBOURS = 9  # touches over which the temperature is taken for a straight line
TOLD = 0.15  # root mean square of a unit sine over a run of frames from which on it is no constant


@dataclass(frozen=True, slots=True, eq=False)
class Touched:
    """Touches of all experiments, averaged; outputs as fractions, shape (nt, ns) where not said.

    Attributes:
        name: experiment of each touch.
        place, load, radius: as commanded [rad, N/m, m], shape (nt,).
        cell: load cell, loaded less baseline [N/m], nan without; cell_noise: its standard deviation.
        output: mean under load less baseline; part: the same for ``PARTS`` parts, shape (nt, PARTS, ns).
        since: middle of each part after the load came on [s], shape (nt, PARTS).
        level: baseline; temperature, temperature_noise: [deg C] of the baseline, nan without; time: [s] of the
            baseline.
        warmed: temperature of each part less that of the baseline [K], 0 without, shape (nt, PARTS).
        unseen: time before the first frame under load of which nothing was recorded [s], shape (nt,).
        share: 1/frames under load + 1/frames of baseline, shape (nt,): variance of a touch's output over that of a
            frame.
        noise: standard deviation of one frame, shape (ns,).
    """

    name: tuple[str, ...]
    place: Floats
    load: Floats
    radius: Floats
    cell: Floats
    cell_noise: Floats
    output: Floats
    part: Floats
    since: Floats
    level: Floats
    temperature: Floats
    temperature_noise: Floats
    time: Floats
    warmed: Floats
    unseen: Floats
    share: Floats
    noise: Floats

    def __len__(self) -> int:
        return len(self.place)

    def pick(self, which: NDArray[np.bool_]) -> Touched:
        """Return some of the touches."""
        own = {n: getattr(self, n)[which] for n in _columns()}
        return replace(self, name=tuple(n for n, w in zip(self.name, which, strict=True) if w), **own)


def _columns() -> tuple[str, ...]:
    """Names of the arrays with a row for each touch, in the order of ``Touched``."""
    return tuple(f.name for f in fields(Touched) if f.name not in ("name", "noise"))


@dataclass(frozen=True, slots=True, eq=False)
class Untouched:
    """Frames without contact: outputs (n, ns) as fractions, temperature [deg C] (n,), noise of a row (ns,)."""

    output: Floats
    temperature: Floats
    noise: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Ramped:
    """One load ramp of an edge over one element, in bins: output (n,), load [N/m] (n,), time since its start [s]
    (n,).
    """

    element: int
    output: Floats
    load: Floats
    since: Floats
    noise: float


@dataclass(frozen=True, slots=True)
class Line:
    """A line in the spectrum of untouched frames: frequency [Hz], amplitude [output], and the deviations of both."""

    frequency: float
    amplitude: float
    deviation: float
    frequency_deviation: float = 0.0


def reduce_touches(
    experiments: Sequence[tuple[str, Recording, Floats, Floats, Floats]],
    scale: float,
    dead: NDArray[np.bool_],
    lines: Sequence[Line] = (),
) -> tuple[Touched, list[str]]:
    """Average the touches of all experiments.

    Args:
        experiments: name, recording, and per touch place [rad], load [N/m], indenter radius [m].
        scale: output per raw unit.
        dead: elements whose readings are not looked at.
        lines: taken off within every phase of every touch.

    Returns:
        The touches, and notes on those left out.
    """
    rows: dict[str, list[object]] = {k: [] for k in ("name", *_columns())}
    variances: list[Floats] = []
    notes: list[str] = []
    for name, r, place, load, radius in experiments:
        left, rate = 0, _warming(r, len(place))
        for number in range(len(place)):
            mine = np.flatnonzero(r.touch == number)
            before, under = mine[r.phase[mine] == BASELINE], mine[r.phase[mine] == LOADED]
            readings = r.raw[np.concatenate([before, under])][:, ~dead]
            if len(before) < 2 or len(under) < PARTS or not np.isfinite(readings).all():
                left += 1
                continue
            quiet, spent, more = without_lines(r.raw[before] * scale, r.time_s[before], lines)
            loud, _, further = without_lines(r.raw[under] * scale, r.time_s[under], lines)
            onset = _onset(r, mine, before, under)
            parts = np.array_split(np.arange(len(under)), PARTS)
            level = quiet.mean(0)
            variances.append(quiet.var(0, ddof=1 + spent))
            cell = r.force[under].mean() - r.force[before].mean()
            spread = np.sqrt(
                np.var(r.force[under], ddof=1) / len(under) + np.var(r.force[before], ddof=1) / len(before)
            )
            values = (
                name,
                place[number],
                load[number],
                radius[number],
                cell,
                spread,
                loud.mean(0) - level,
                np.array([loud[p].mean(0) - level for p in parts]),
                np.array([r.time_s[under[p]].mean() - onset for p in parts]),
                level,
                r.temperature_c[before].mean(),
                np.std(r.temperature_c[before], ddof=1) / np.sqrt(len(before)),
                r.time_s[before].mean(),
                [rate[number] * (r.time_s[under[p]].mean() - r.time_s[before].mean()) for p in parts],
                r.time_s[under[0]] - r.time_s[mine[mine < under[0]][-1]],
                1.0 / len(under) + 1.0 / len(before) + more + further,
            )
            for key, value in zip(rows, values, strict=True):
                rows[key].append(value)
        if left:
            notes.append(f"{name}: {left} of {len(place)} touches left out, frames are missing or no numbers")
    count = len(rows["place"])
    if count < LEAST_TOUCHES:
        raise BadInputError(
            f"read touches: {count} complete touches are too few; record {LEAST_TOUCHES} or more over the arc"
        )
    arrays = {k: np.array(v, dtype=np.float64) for k, v in rows.items() if k != "name"}
    noise = np.sqrt(np.mean(variances, axis=0))
    return Touched(name=tuple(str(n) for n in rows["name"]), noise=noise, **arrays), notes


def _warming(r: Recording, count: int) -> Floats:
    """Return how fast the temperature rises at each touch [K/s], of its neighbours as well: one touch tells little; 0
    without.
    """
    out = np.zeros(count)
    told = np.isfinite(r.temperature_c) & (r.touch >= 0)
    for number in range(count):
        mine = told & (np.abs(r.touch - number) <= NEIGHBOURS // 2)
        if np.any(mine):
            since = r.time_s[mine] - r.time_s[mine].mean()
            out[number] = since @ r.temperature_c[mine] / max(float(since @ since), 1e-12)
    return out


def _onset(r: Recording, mine: NDArray[np.intp], before: NDArray[np.intp], under: NDArray[np.intp]) -> float:
    """Return when the load came on: at half its height where that was recorded, else right after the baseline."""
    between = mine[(mine > before[-1]) & (mine < under[0])]
    if len(between) and np.isfinite(r.force[between]).all():
        half = 0.5 * (r.force[before].mean() + r.force[under].mean())
        above = between[r.force[between] >= half]
        return float(r.time_s[above[0]] if len(above) else r.time_s[under[0]])
    return float(r.time_s[before[-1]])


def without_lines(frames: Floats, time: Floats, lines: Sequence[Line], order: int = 0) -> tuple[Floats, int, float]:
    """Take sines of known frequencies off a run of frames; amplitudes and phases are free.

    What these frames cannot tell from their course (a line that their rate folds to nothing) is left in.

    Args:
        order: of the polynomial that the course of the frames may follow.

    Returns:
        The frames without lines, how many of their degrees of freedom that took, and what it adds to the variance of
        their mean, in variances of one frame.
    """
    if not lines or len(frames) < 2 * len(lines) + order + 4:
        return frames, 0, 0.0
    since = time - time[0]
    angle = 2.0 * np.pi * np.array([line.frequency for line in lines]) * since[:, None]
    waves = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    course = np.linalg.qr(np.vander(since / max(since[-1], 1e-9), order + 1))[0]
    u, s, v = np.linalg.svd(waves - course @ (course.T @ waves), full_matrices=False)
    told = s > TOLD * np.sqrt(len(time))
    back = v[told].T / s[told]
    mean = waves.mean(0) @ back
    return frames - waves @ back @ (u[:, told].T @ frames), int(told.sum()), float(mean @ mean)


def reduce_untouched(
    r: Recording, scale: float, lines: Sequence[Line] = (), skip_s: float = 10.0, after_s: float = -np.inf
) -> Untouched | None:
    """Return untouched frames with their temperature, without lines; those whose time reaches back to a touch are left
    out.
    """
    step = float(np.median(np.diff(r.time_s))) if len(r.time_s) > 1 else 0.0
    good = np.isfinite(r.temperature_c) & np.isfinite(r.raw).all(axis=1) & (r.time_s - step > after_s + skip_s)
    if np.count_nonzero(good) < 8:
        return None
    output = r.raw[good] * scale
    # what goes with the temperature is no noise, and does not pass for it where it swings fast
    warm = r.temperature_c[good] - r.temperature_c[good].mean()
    own = np.linalg.qr(np.stack([np.ones_like(warm), warm, warm**2], axis=1))[0]
    for line in lines:
        output = output - _folded(output, r.time_s[good], own, line)
    second = np.diff(output - own @ (own.T @ output), 2, axis=0)
    noise = np.sqrt(np.mean(second**2, axis=0) / 6.0)
    return Untouched(output, r.temperature_c[good], np.maximum(noise, 1e-9))


def _folded(output: Floats, time: Floats, own: Floats, line: Line) -> Floats:
    """Return what a line leaves in slow frames beside what is their own, at the likeliest frequency of those that it
    may have.

    Args:
        own: orthonormal columns that are no line, shape (n, k).
    """
    since = time - time[0]
    middle, reach, most, found = line.frequency, 3.0 * line.frequency_deviation, 0.0, np.zeros_like(output)
    count = int(min(np.ceil(4.0 * reach * since[-1]), 100.0))
    for _ in range(3):  # finer and finer about the best
        for frequency in middle + reach * np.linspace(-1.0, 1.0, 2 * count + 1):
            waves = np.stack([f(2.0 * np.pi * frequency * since) for f in (np.sin, np.cos)], axis=1)
            u, s, v = np.linalg.svd(waves - own @ (own.T @ waves), full_matrices=False)
            told = u.T @ output
            saved = float(np.sum(told**2)) if s.min() > TOLD * np.sqrt(len(time)) else 0.0
            if saved > most:
                most, middle, found = saved, float(frequency), waves @ (v.T / s) @ told
        reach, count = reach / max(count, 1), 4
    return found


def reduce_ramps(r: Recording, scale: float, dead: NDArray[np.bool_], lines: Sequence[Line] = ()) -> list[Ramped]:
    """Return load ramps in bins; touch n lies over element n; the load is the line through the load cell's readings."""
    out = []
    for number in np.unique(r.touch[r.touch >= 0]):
        n = int(number)
        mine = r.touch == number
        before, under = (
            np.flatnonzero(mine & (r.phase == BASELINE)),
            np.flatnonzero(mine & (r.phase == LOADED)),
        )
        if len(under) < 2 * RAMP_BINS or len(before) < 2 or n >= r.raw.shape[1] or dead[n]:
            continue
        clock = r.time_s[under] - r.time_s[before[-1]]
        if not (np.isfinite(r.raw[under, n]).all() and np.isfinite(r.force[under]).all()):
            continue
        load = np.polyval(np.polyfit(clock, r.force[under] - r.force[before].mean(), 1), clock)
        output = scale * (r.raw[under, n] - r.raw[before, n].mean())
        output = without_lines(output[:, None], clock, lines, order=4)[0][:, 0]
        bins = np.array_split(np.arange(len(under)), RAMP_BINS)
        keep = [p for p in bins if load[p].min() > 0.02 * load.max()]
        if len(keep) < 4:
            continue
        noise = float(np.sqrt(np.mean(np.diff(output, 2) ** 2) / 6.0 / len(keep[0])))
        out.append(
            Ramped(
                n,
                np.array([output[p].mean() for p in keep]),
                np.array([load[p].mean() for p in keep]),
                np.array([clock[p].mean() for p in keep]),
                noise,
            )
        )
    return out


def find_lines(r: Recording, scale: float, outstanding: float = 60.0) -> list[Line]:
    """Return lines that stand out of the spectrum of untouched frames, the loudest first.

    Power is averaged over elements; noise of any colour has no single bin that many times above its neighbours.
    """
    good = np.isfinite(r.raw).all(axis=1)
    raw = (r.raw[good] - r.raw[good].mean(0)) * scale
    frames = len(raw)
    if frames < 1024 or not np.any(raw):
        return []
    window = np.hanning(frames)
    spectrum = np.abs(np.fft.rfft(raw * window[:, None], axis=0)) ** 2
    power = spectrum.mean(1)
    reach = max(frames // 64, 16)
    padded = np.pad(power, reach, mode="reflect")
    floor = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=1)
    out: list[Line] = []
    taken = np.zeros(len(power), dtype=bool)
    taken[:8] = True
    for place in np.argsort(-power)[:64]:
        if taken[place] or power[place] < outstanding * floor[place]:
            continue
        taken[max(place - 6, 0) : place + 7] = True
        fine = _peak(raw, float(place))
        amplitude = _amplitudes(raw, fine)
        size = float(np.sqrt(np.mean(amplitude**2)))
        # the least that noise of one bin's power, ``floor``, allows: Rife & Boorstyn 1974, IEEE Trans. Inf. Theory 20,
        # eq. 12
        noise = floor[place] / (window @ window)
        unsure = np.sqrt(24.0 * noise / raw.size) / (2.0 * np.pi * size * frames / r.rate_hz)
        own = float(np.std(amplitude, ddof=1) / np.sqrt(raw.shape[1]))
        out.append(Line(fine * r.rate_hz / frames, size, own, float(unsure)))
    return out[:4]


def _peak(raw: Floats, place: float) -> float:
    """Return where between bins the spectrum of all columns has its top, beginning at one: parabolas through three
    places.
    """
    for step in (0.5, 0.2, 0.1):
        low, mid, high = (float(np.sum(_amplitudes(raw, place + k * step) ** 2)) for k in (-1, 0, 1))
        bend = min(low - 2.0 * mid + high, -1e-300)
        place += float(np.clip(0.5 * (low - high) / bend, -1.0, 1.0)) * step
    return place


def _amplitudes(raw: Floats, place: float) -> Floats:
    """Return the amplitude of every column at a place of the spectrum, in bins."""
    turn = np.exp(-2j * np.pi * place / len(raw) * np.arange(len(raw)))
    return np.asarray(2.0 * np.abs(turn @ raw) / len(raw))
