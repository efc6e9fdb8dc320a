"""Does the force belong to the motion, by what the nominal inertia needs, before anything is searched?

A regression of force on acceleration, speed, direction and place, all passed through the same filter, which then drops
out of the equation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.fit import Problem
from sioms.reconcile.mistakes import in_another_unit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record
from sioms.reconcile.screen import Motion, bandwidth, dead_band, direction, low_passed, smoothed_motion
from sioms.reconcile.thresholds import FORETOLD, INERTIAS, UNLIKE, UNRELATED

#: Beyond these multiples of the nominal inertia it is said.
UNLIKELY = 0.5, 4.0
#: The inertia shows where it makes this share of the force, and all together this one; in one record, and of two that
#: are compared, these.
SHOWN, FITS = 0.02, 0.2
SHOWN_ALONE, FITS_ALONE = 0.3, 0.8
#: Rows of the past that foretell, strides at which they are read, and rows at least.
PAST, STRIDES, LEAST_ROWS = 12, (1, 2, 4, 8), 200


@dataclass(frozen=True, slots=True)
class Seen:
    """What force and motion show.

    Attributes:
        inertia: as a multiple of the nominal one; None where too little tells.
        explained: share of the force that inertia, friction and place explain, at best.
    """

    inertia: float | None
    explained: float


def check_scale(problem: Problem, model: AxisModel) -> list[str]:
    """Compare the force with what the nominal inertia needs, whatever friction and position forces there are.

    Returns:
        What is to be said of a factor that a payload may make, but a unit more likely.

    Raises:
        BadInputError: they differ by a factor that no payload makes (units, or another axis), have nothing to do with
            each other, or differ from record to record.
    """
    columns, forces = _columns(problem, model)
    whole = _seen(problem.join(columns), problem.join(forces), SHOWN, FITS)
    if whole.explained < UNRELATED and follows(problem.session.records) < FORETOLD:
        raise BadInputError(
            f"compare force with motion: inertia, friction and forces of place explain {100 * whole.explained:.0f} % "
            "of the force: force and position are not of the same run, or not of the same rows"
        )
    _check_alike(problem, columns, forces)
    if whole.explained < UNRELATED:
        return [
            f"inertia, friction and forces of place explain {100 * whole.explained:.0f} % of the force, and yet the "
            "motion follows from it: something swings between them (an elastic transmission, a hanging load, a filter)"
        ]
    return _check_ratio(whole.inertia, model)


def follows(records: Sequence[Record]) -> float:
    """Return the share of what is new in the acceleration that the force foretells, as in any linear machine.

    The acceleration is predicted from its own past, and from that and the past force, by least squares on the first
    half of each record; the shares are of the second half, the largest of the strides at which the rows are read, as a
    fine sampling buries the motion in noise. Source: C. W. J. Granger, Econometrica 37 (1969) 424.
    """
    return max(_foretold(records, stride) for stride in STRIDES)


def _foretold(records: Sequence[Record], stride: int) -> float:
    own, both = 0.0, 0.0
    for r in records:
        x, u = r.position[::stride], r.force[::stride][1:-1]
        a = np.diff(x, 2)
        if len(a) < LEAST_ROWS or np.ptp(a) == 0.0:
            continue
        a, u = a / np.std(a), u / max(float(np.std(u)), 1e-300)
        past = sliding_window_view(a[:-1], PAST)
        forces = sliding_window_view(u, PAST + 1)
        for i, columns in enumerate((past, np.hstack([past, forces]))):
            left = _left(columns, a[PAST:])
            own, both = (own + left, both) if i == 0 else (own, both + left)
    return 1.0 - both / own if own > 0.0 else 0.0


def _left(columns: Array, of: Array) -> float:
    """Return the energy that a regression on the first half leaves of the second."""
    half = len(of) // 2
    c = np.linalg.lstsq(columns[:half], of[:half], rcond=1e-10)[0]
    return float(np.sum((of[half:] - columns[half:] @ c) ** 2))


def _check_ratio(ratio: float | None, model: AxisModel) -> list[str]:
    if ratio is None:
        return []
    if ratio < -0.05:
        raise BadInputError(
            f"compare force with motion: force is {ratio:.3g} times what the nominal inertia needs; the sign "
            "of force or position is turned round"
        )
    uncertain = "inertia" in model.refine
    if not INERTIAS[0] < ratio < INERTIAS[1] and not uncertain:
        raise BadInputError(
            f"compare force with motion: force is {ratio:.4g} times what the nominal inertia of {model.inertia:.4g} "
            f"needs; {in_another_unit(ratio)} check the units of force, position and inertia, the sample time, and "
            'whether the model is of this axis; where only the inertia is not known, give refine = ["inertia"]'
        )
    if UNLIKELY[0] < ratio < UNLIKELY[1] or uncertain:
        return []
    return [
        f"force is {ratio:.3g} times what the nominal inertia of {model.inertia:.4g} needs: a heavy payload, or a "
        "wrong unit (turns for radians make 6.3) or sample time (twice the time makes 4)"
    ]


def _check_alike(problem: Problem, columns: Sequence[Array], forces: Sequence[Array]) -> None:
    """Compare the records with each other.

    Raises:
        BadInputError: one shows another inertia than the others.
    """
    records = problem.session.records
    each = [
        _seen(c[problem.span(r)], f[problem.span(r)], SHOWN_ALONE, FITS_ALONE)
        for r, c, f in zip(records, columns, forces, strict=True)
    ]
    found = [(r.name, s.inertia) for r, s in zip(records, each, strict=True) if s.inertia is not None]
    if len(found) < 2:
        return
    (low, least), (high, most) = min(found, key=lambda f: f[1]), max(found, key=lambda f: f[1])
    if not most < UNLIKE * least:
        raise BadInputError(
            f"compare records: {high} shows {most:.3g} times the nominal inertia, {low} {least:.3g} times; needs "
            "records of one axis with one load, in the same units and at the same sample time"
        )


def _columns(problem: Problem, model: AxisModel) -> tuple[list[Array], list[Array]]:
    """Return what the force may go with, and the force, of every record."""
    motions = smoothed_motion(problem, model)
    dead, hz = dead_band(problem, model), bandwidth(problem, model)
    forces = [low_passed(m.u + m.outer, hz, model.sample_time_s) for m in motions]
    return [_of(m, model, dead) for m in motions], forces


def _of(m: Motion, model: AxisModel, dead: float) -> Array:
    turn = 1.0 if model.rotary else 2.0 * np.pi / model.pitch  # gravity, or cogging
    way, one = direction(m.v, dead), np.ones_like(m.x)
    columns = [model.inertia * m.a, m.v, way, m.x, one, np.sin(turn * m.x), np.cos(turn * m.x)]
    return np.stack(columns, axis=1)


def _seen(a: Array, u: Array, shown: float, fits: float) -> Seen:
    size = np.linalg.norm(a, axis=0)
    size[size == 0.0] = 1.0
    c = np.linalg.lstsq(a / size, u, rcond=1e-10)[0] / size
    explained = 1.0 - float(np.sum((u - a @ c) ** 2) / max(float(np.sum(u**2)), 1e-300))
    inertial = float(np.linalg.norm(a[:, 0] * c[0]) / max(float(np.linalg.norm(u)), 1e-300))
    return Seen(None if inertial < shown or explained < fits else float(c[0]), explained)
