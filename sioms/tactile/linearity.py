"""Find and undo the quadratic in an element's output: d = l + q l^2, l the linear output.

The electronics' quadratic must be kept apart from the growth of the contact with load (strain per N/m of an
edge falls) and from creep.  So touches of the same indenter at the same place are compared over their loads
only: each such group has its own free scale, the model gives the growth, every touch is as old as the others,
    and what is left is q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from sioms.tactile.touches import Touches

Floats = NDArray[np.float64]

Pair = tuple[Floats, Floats]

_FEWEST = 4  # groups for an element's own value
_MOST = 20.0  # |q| up to 0.2 per per cent
_STRONG = 0.3  # an element takes part in a group if it sees this share of the group's largest strain


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """Hold q [1/output] of each element, its standard deviation, and how many groups spoke for it; immutable."""

    value: Floats
    deviation: Floats
    groups: NDArray[np.int64]
    common: float


def linearise(output: ArrayLike, quadratic: ArrayLike) -> Floats:
    """Return l from d = l + q l^2, the root that goes with l = d at q = 0.

    Where d is beyond the vertex of the parabola (q d < -1/4) the vertex's l = -1/(2q) is returned: saturated.
    """
    d, q = np.asarray(output, dtype=np.float64), np.asarray(quadratic, dtype=np.float64)
    root = np.sqrt(np.maximum(1.0 + 4.0 * q * d, 0.0))
    linear: Floats = 2.0 * d / (1.0 + root)
    return np.where(1.0 + 4.0 * q * d < 0.0, -0.5 / np.where(q == 0.0, 1.0, q), linear)


def find_quadratic(touches: Touches, model: Floats, drawn: bool = False) -> Quadratic | None:
    """Fit q to groups of touches that differ in load only.

    Args:
        touches: outputs as recorded.
        model: strain of every touch and element by the model [1], shape (nt, ns); only ratios within a group
            matter.
        drawn: the outputs hold the pull of a conductor, which is the same for all loads at one place: an offset
            of its own for each group takes it up; groups then need four loads.

    Returns:
        None if no group spans a factor of two in load with three loads or more.
    """
    groups = _groups(touches)
    if not groups:
        return None
    count = touches.output.shape[1]
    pairs = [_pairs(touches, model, groups, element) for element in range(count)]
    if drawn:
        pairs = [[_without_offset(*pair) for pair in own if pair[0].size >= 4] for own in pairs]
    everyone = [pair for own in pairs for pair in own]
    if not everyone:
        return None
    common = _fit(everyone)
    value, deviation, seen = np.full(count, common), np.full(count, np.inf), np.zeros(count, dtype=np.int64)
    for element, own in enumerate(pairs):
        seen[element] = len(own)
        if len(own) >= _FEWEST:
            value[element] = _fit(own)
            deviation[element] = _jackknife(own)
    return Quadratic(_shrink(value, deviation, common), deviation, seen, common)


def _shrink(value: Floats, deviation: Floats, common: float) -> Floats:
    """Draw each element towards the common value, unless the elements differ by more than they are uncertain."""
    known = np.isfinite(deviation)
    if np.count_nonzero(known) < 2:
        return np.full(value.size, common)
    between = max(float(np.mean((value[known] - common) ** 2 - deviation[known] ** 2)), 0.0)
    trust = between / (between + np.where(known, deviation, np.inf) ** 2) if between > 0.0 else np.zeros(value.size)
    drawn: Floats = trust * value + (1.0 - trust) * common
    return drawn


def _jackknife(pairs: list[Pair]) -> float:
    """Return the standard deviation of q from leaving out each group in turn (groups err together, touches do not)."""
    without = np.array([_fit(pairs[:n] + pairs[n + 1 :]) for n in range(len(pairs))])
    return float(np.sqrt((len(pairs) - 1) * np.mean((without - without.mean()) ** 2)))


def _without_offset(output: Floats, model: Floats) -> Pair:
    """Take off what a group's outputs have in common, by output = s m + c m^2 + offset."""
    base = np.stack([model, model**2 / model.max(), np.full(model.size, model.max())], axis=1)
    answer = np.linalg.lstsq(base, output, rcond=None)[0]
    return output - answer[2] * model.max(), model


def ramp_quadratic(output: Floats, model: Floats, drawn: bool = False) -> float:
    """Return q of one element from a load ramp over it, creep included.

    Args:
        output: of the element, shape (frames,).
        model: its strain by the model at the same frames, negative; only the shape matters.
        drawn: as in `find_quadratic`.
    """
    return _fit([_without_offset(output, -model) if drawn else (output, -model)])


def with_ramps(ramps: Floats, series: Quadratic | None) -> Quadratic:
    """Join ramps (nan where an element has none) and load series.

    Elements that have both give the level; without any, the ramps' own level stands, with creep's bias in it.
    """
    if series is None:
        common = float(np.nanmedian(ramps))
        nothing = np.zeros(ramps.size, dtype=np.int64)
        return Quadratic(np.where(np.isfinite(ramps), ramps, common), np.full(ramps.size, np.inf), nothing, common)
    both = np.isfinite(ramps) & (series.groups > 0)
    if not both.any():
        return series
    weight = series.groups[both].astype(np.float64)
    level = series.common - float(weight @ ramps[both] / weight.sum())
    value = np.where(np.isfinite(ramps), ramps + level, series.value)
    return Quadratic(value, series.deviation, series.groups, series.common)


def _groups(touches: Touches) -> list[NDArray[np.intp]]:
    keys = np.stack(
        [np.round(touches.angle_rad, 5), np.where(np.isinf(touches.radius_m), 1e9, touches.radius_m)], axis=1
    )
    _, label = np.unique(keys, axis=0, return_inverse=True)
    found = [np.flatnonzero(label.ravel() == number) for number in range(int(label.max()) + 1)]
    wide = [g for g in found if g.size >= 3 and touches.load[g].max() >= 2.0 * touches.load[g].min()]
    return wide


def _pairs(touches: Touches, model: Floats, groups: list[NDArray[np.intp]], element: int) -> list[Pair]:
    """Return (output, model) of the groups in which the element speaks loudly."""
    out = []
    for group in groups:
        strain = -model[group, element]
        if strain.max() > _STRONG * -model[group].min() > 0.0:
            out.append((touches.output[group, element], strain))
    return out


def _fit(pairs: list[Pair]) -> float:
    """Return the q that leaves the least squares, each group with its own scale."""

    def cost(q: float) -> float:
        total = 0.0
        for d, m in pairs:
            linear = linearise(d, q)
            part = float(linear @ m) / float(m @ m) * m
            total += float(np.sum((d - part - q * part**2) ** 2))
        return total

    return float(minimize_scalar(cost, bounds=(-_MOST, _MOST), method="bounded", options={"xatol": 1e-4}).x)
