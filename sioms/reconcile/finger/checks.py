"""Refuse touches that cannot be used, before anything is fitted, and say why."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.finger.belief import Belief, outputs, scene_of
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.finger.records import Touched

LEAST_LIKE = 0.35  # correlation of measured and simulated touches below which it is another finger
FACTOR = 8.0  # outputs, loads or radii off by more are in another unit
SATURATED = 0.25  # share of the frames in which an element is at an end of its range from which on little is learnt
PILE, FEW = (
    5.0,
    20,
)  # readings at the end, times those just below, and least number of them, that make it the end of the range
DEAD_SHARE = 0.05  # an element that answers with less of what is expected is dead


def check_raw(raw: Floats, elements: int, name: str) -> None:
    """Check one recording's readings.

    Raises:
        BadInputError: the number of columns is wrong, nothing in them moves, or they are saturated.
    """
    if raw.ndim != 2 or raw.shape[1] != elements:
        width = raw.shape[1] if raw.ndim == 2 else 0
        raise BadInputError(f"read {name}: raw has {width} columns; the finger has {elements} elements")
    if not np.isfinite(raw).any():
        raise BadInputError(f"read {name}: raw holds no number; needs readings of {elements} elements")
    finite = np.where(np.isfinite(raw), raw, 0.0)
    if np.all(np.ptp(finite, axis=0) == 0.0):
        raise BadInputError(f"read {name}: all {elements} elements are constant; needs frames of a living finger")
    ended = np.any([_at_the_end(column) for column in finite.T], axis=0)
    if ended.mean() > SATURATED:
        raise BadInputError(
            f"read {name}: an element is at an end of its range ({float(np.abs(finite[ended]).max()):.4g} %) in "
            f"{100 * float(ended.mean()):.0f} % of the frames: the electronics is saturated; press more gently, or "
            "widen the range"
        )


def _at_the_end(values: Floats) -> NDArray[np.bool_]:
    """Say which readings of one element pile up at its largest or smallest, shape (frames,)."""
    levels, times = np.unique(values, return_counts=True)
    out = np.zeros(len(values), dtype=bool)
    for end, near in ((-1, times[-4:-1]), (0, times[1:4])):
        if len(levels) > 4 and times[end] > max(PILE * float(near.mean()), FEW):
            out |= values == levels[end]
    return out


def check_commands(place: Floats, load: Floats, radius: Floats, name: str) -> None:
    """Check commanded places [rad], loads [N/m] and radii [m].

    Raises:
        BadInputError: with the column, its value, and the unit that it looks like.
    """
    for what, values in (("cmd_theta", place), ("cmd_P", load)):
        if not np.isfinite(values).all():
            raise BadInputError(
                f"read {name}: {what} has {int(np.sum(~np.isfinite(values)))} values that are no numbers"
            )
    if not np.all(load > 0.0):
        raise BadInputError(f"read {name}: cmd_P is {float(load.min()):g} N/m; pressing loads are positive")
    if np.isnan(radius).any() or np.any(radius < 0.0):
        raise BadInputError(
            f"read {name}: cmd_rc holds negative values or no numbers; needs mm, 0 for an edge, inf for a flat"
        )
    round_ = radius[(radius > 0.0) & np.isfinite(radius)]
    if len(round_) and (np.median(round_) > 1.0 or np.median(round_) < 2e-5):
        factor = 1000.0 if np.median(round_) > 1.0 else 0.001
        raise BadInputError(
            f"read {name}: cmd_rc is about {1e3 * float(np.median(round_)):g} mm; a factor of {factor:g} too "
            "much: needs mm"
        )
    if np.ptp(place) > 4.0 * np.pi:
        raise BadInputError(
            f"read {name}: cmd_theta spans {np.degrees(np.ptp(place)):.0f} deg, about {np.degrees(1.0):.1f} times a "
            "finger's arc; needs degrees"
        )


def check_match(t: Touched, b: Belief, alive: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Compare the touches with the nominal finger as a whole.

    Returns:
        Elements that answer, shape (ns,).

    Raises:
        BadInputError: units, a sign, or a finger that does not match at all.
    """
    expected = outputs(b, scene_of(t.place, t.load, t.radius))
    own = t.output - _common(t.output, expected)
    like = _like(own[:, alive], expected[:, alive])
    if abs(like) < LEAST_LIKE:
        _raise_turned(t, b, own, alive, like)
        raise BadInputError(
            f"compare touches with the finger: they agree to {100 * like:.0f} % (correlation) with what the nominal "
            "finger should feel; it is another finger, or places, loads and readings do not belong together"
        )
    if like < 0.0:
        raise BadInputError(
            "compare touches with the finger: pressing lowers the outputs; compression must be positive: change "
            "the sign of raw"
        )
    e, m = expected[:, alive], own[:, alive]
    scale = float(np.sum(e * m) / np.sum(e * e))
    if scale > FACTOR or scale < 1.0 / FACTOR:
        near = 10.0 ** round(np.log10(scale))
        raise BadInputError(
            f"compare touches with the finger: outputs are {scale:.4g} times what the nominal finger gives (about "
            f"{near:g}); check the units of raw (per cent), cmd_P (N/m) and the gains (a factor of 1000: N/mm, "
            "a factor of 100: fractions)"
        )
    if np.isfinite(t.cell).all():
        ratio = float(np.median(t.cell / t.load))
        if not 1.0 / FACTOR < ratio < FACTOR and np.ptp(t.cell) > 0.0:
            raise BadInputError(
                f"compare load cell with command: force is {ratio:.4g} times cmd_P (about "
                f"{10.0 ** round(np.log10(abs(ratio) + 1e-12)):g}); needs both in N/m"
            )
    size = np.sum(expected**2, axis=0)
    answer = np.sum(expected * t.output, axis=0) / np.maximum(size, 1e-300)
    heard = size > 0.05 * np.median(size)
    living: NDArray[np.bool_] = alive & ~(heard & (np.abs(answer) < DEAD_SHARE * scale))
    return living


def _common(output: Floats, expected: Floats) -> Floats:
    """Return what lowers the outputs where little strain is expected: the pull of a conductor, a drift."""
    far = np.abs(expected) < 0.1 * np.abs(expected).max(1, keepdims=True)
    count = np.maximum(far.sum(1), 1)
    out: Floats = (np.where(far, output, 0.0).sum(1) / count)[:, None]
    return out


def _like(a: Floats, b: Floats) -> float:
    return float(np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b) + 1e-300))


def _raise_turned(t: Touched, b: Belief, own: Floats, alive: NDArray[np.bool_], like: float) -> None:
    """Try what people mix up with the places."""
    for factor, said in (
        (180.0 / np.pi, "cmd_theta looks like radians; needs degrees"),
        (1000.0, "cmd_theta looks a factor of 1000 too small; needs degrees"),
        (-1.0, "cmd_theta runs the other way round; change its sign"),
    ):
        if np.ptp(t.place * factor) > 4.0 * np.pi:
            continue
        again = outputs(b, scene_of(t.place * factor, t.load, t.radius))
        if _like(own[:, alive], again[:, alive]) > max(2.0 * LEAST_LIKE, 2.0 * abs(like)):
            raise BadInputError(f"compare touches with the finger: {said}")
