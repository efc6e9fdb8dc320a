"""What opposes the motion, all told, at the speeds that the records dwell at.

Where friction has laws without a name, or several with one, how it is shared out between them is a convention: a smooth
law of the speed is zero at rest, and what it does up to its first place may be Coulomb friction's as well. What they
add up to is told by the records, whatever the convention, and so is how it differs from one direction to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.blocks import combined
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import LAWS
from sioms.reconcile.engine.fit import Free, get, put
from sioms.reconcile.fit import Fit, Problem, block_ids
from sioms.reconcile.model import AxisModel
from sioms.reconcile.plausible import physical
from sioms.reconcile.resistance import resistance
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.simulate import Run

#: Ranges of speed up to the largest, those that are told, and the least share of the motion in one.
RANGES, MOST, LEAST = 24, 3, 0.04
#: Effects that are tried in the place of a law, the share of it that is most of it, and what does about as well.
LIKENED, LARGELY, ABOUT_AS = 3, 0.5, 0.9
#: Speeds either way that differ by less than this share are one.
ONE_SPEED = 0.1
#: A small step of a number, of its size.
STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Sample:
    """States of an axis at about one speed, one way; shape (n,) each."""

    x: Array
    v: Array
    u: Array
    temperature: Array

    @property
    def speed(self) -> float:
        """Mean speed, [{x}/s]."""
        return float(np.mean(self.v))


def friction_told(problem: Problem, fit: Fit) -> str:
    """Say what opposes the motion at the speeds of the records, with 95 % intervals; empty: no speed is held.

    Args:
        problem: the records that were fitted.
        fit: to all of them.
    """
    model = fit.model
    samples, values, slopes = _summed(problem, fit)
    if not samples:
        return ""
    ids, force, speed = block_ids(problem, model.sample_time_s), model.force_unit, f"{model.position_unit}/s"
    half = combined(fit, ids, slopes)
    told = [
        f"{value:.4g} {force} [{value - h:.4g}, {value + h:.4g}] at {s.speed:+.3g} {speed}"
        for s, value, h in zip(samples, values, half, strict=True)
    ]
    text = f"what opposes the motion adds up to {', '.join(told)}, however its parts share it"
    if not (pairs := _pairs(samples)):
        return text
    ahead, back = pairs[0], pairs[0] + 1
    more, h = values[back] - values[ahead], float(combined(fit, ids, (slopes[back] - slopes[ahead])[None])[0])
    if abs(more) <= h:
        return text
    at = f"{samples[ahead].speed:.3g} {speed}"
    return f"{text}; backward it is {more:.3g} {force} [{more - h:.3g}, {more + h:.3g}] more than forward at {at}"


def at_rest(problem: Problem, fit: Fit) -> tuple[float, float] | None:
    """Return what opposes the motion, extrapolated to rest from the two slowest speeds that are held both ways, and the
    half-width of its interval, [{F}]; None where there are no two.
    """
    samples, values, slopes = _summed(problem, fit)
    pairs = _pairs(samples)
    if len(pairs) < 2:
        return None
    fast, slow = pairs[-2:]
    v = [0.5 * (samples[i].speed - samples[i + 1].speed) for i in (slow, fast)]
    weight = np.array([v[1], -v[0]]) / (v[1] - v[0])
    sums = np.zeros(len(samples))
    for i, w in zip((slow, fast), weight, strict=True):
        sums[[i, i + 1]] += 0.5 * w
    half = combined(fit, block_ids(problem, fit.model.sample_time_s), (sums @ slopes)[None])[0]
    return float(sums @ values), float(half)


def _summed(problem: Problem, fit: Fit) -> tuple[list[Sample], Array, Array]:
    """Return the states that are told, what opposes them, shape (m,), and how that goes with the numbers, (m, k)."""
    samples = dwelt(problem.runs(fit.model), [problem.span(r) for r in problem.session.records])
    values = np.array([opposing(fit.model, s) for s in samples])
    return samples, values, np.array([_slopes(fit.model, fit.free, s) for s in samples])


def _pairs(samples: Sequence[Sample]) -> list[int]:
    """Return where a speed forward is followed by the same backward, the fastest first."""
    speeds = [s.speed for s in samples]
    return [i for i in range(len(speeds) - 1) if abs(speeds[i] + speeds[i + 1]) < ONE_SPEED * speeds[i]]


def likened(searcher: Searcher, found: Found) -> list[str]:
    """Say of each smooth law of a model which effects with a name make most of what it explains; several that do about
    as well are not told apart.
    """
    fit = found.fit
    said = []
    for law in (law for law in LAWS if law.name in fit.model.effects):
        bare = searcher.fit(fit.model.without_effect(law.name), 5)
        names = [n for n in law.replaces if n in searcher.names and n not in fit.model.effects]
        fits = [
            (s.effect, searcher.fit(searcher.switched_on(bare, s), 6)) for s in searcher.screen(bare, names)[:LIKENED]
        ]
        shares = {n: (bare.cost - f.cost) / max(bare.cost - fit.cost, 1e-300) for n, f in fits if physical(f, n)}
        most = max(shares.values(), default=0.0)
        near = sorted((n for n in shares if shares[n] > ABOUT_AS * most), key=lambda n: -shares[n])
        if most < LARGELY:
            continue
        parts = " or ".join(f"{known()[n].title} ({100 * shares[n]:.0f} %)" for n in near)
        open_ = "; these records do not tell which" if len(near) > 1 else ""
        said.append(f"of what the {law.title} explains, most is what {parts} would make{open_}; the rest has no name")
    return said


def dwelt(runs: Sequence[Run], spans: Sequence[slice]) -> list[Sample]:
    """Return the states at the speeds at which most of the motion is, the fastest first, forward before backward."""
    x, v, u, t = (
        np.concatenate([getattr(r, name)[span] for r, span in zip(runs, spans, strict=True)])
        for name in ("x", "v", "applied", "temperature")
    )
    size = np.abs(v)
    top = float(np.quantile(size, 0.999))
    if top <= 0.0:
        return []
    at = np.minimum((size / top * RANGES).astype(np.int64), RANGES - 1)
    count = np.bincount(at, minlength=RANGES)
    count[0] = 0
    peaks = [i for i in range(1, RANGES) if count[i] >= max(count[max(i - 1, 0) : i + 2].max(), LEAST * count.sum())]
    chosen = sorted(sorted(peaks, key=lambda i: -count[i])[:MOST], reverse=True)
    parts = [(at == i) & (np.sign(v) == way) for i in chosen for way in (1.0, -1.0)]
    return [Sample(x[p], v[p], u[p], t[p]) for p in parts if np.sum(p) >= 0.25 * LEAST * count.sum()]


def opposing(model: AxisModel, s: Sample) -> float:
    """Return the mean force against the motion of a model in those states, [{F}]: all that leaves with the motion."""
    return float(np.mean(resistance(model, s.x, s.v, s.u, s.temperature)))


def _slopes(model: AxisModel, free: Sequence[Free], s: Sample) -> NDArray[np.float64]:
    """How that force goes with the free numbers, in units of their sizes, shape (k,)."""
    at, base = get(model, free), opposing(model, s)
    out = np.zeros(len(free))
    for i, f in enumerate(free):
        step = STEP if at[i] + STEP * f.scale <= f.upper else -STEP
        moved = at.copy()
        moved[i] += step * f.scale
        out[i] = (opposing(put(model, free, moved), s) - base) / step
    return out
