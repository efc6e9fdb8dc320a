"""Recorded grasps that cannot be used are refused before anything is fitted; what they cannot show is noted."""

from __future__ import annotations

import numpy as np

from sioms.hand.survey import LEAST_GRASPS, LEAST_ROWS, missing
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.hand.belief import HandBelief, gaps
from sioms.reconcile.hand.grasps import BAR, DISK, OTHER, Floats, Grasps

MOST_SIZE_M, MOST_LOAD_N, MOST_PLACE_M = 0.5, 100.0, 10.0
FAR_M = 0.03
"""By how much contacts may miss their object in the middle of all grasps: more is another unit, sign or finger."""
TURNED = 7.0  # rad; angles beyond are degrees


def check(g: Grasps, b: HandBelief) -> list[str]:
    """Check grasps by themselves and against the nominal hand; return notes.

    Raises:
        BadInputError: with what is wrong and what would be right.
    """
    grasps = len(np.unique(g.grasp))
    if more := missing(len(g), grasps):
        raise BadInputError(
            f"read grasps: {len(g)} rows of {grasps} grasps are too few; want {LEAST_ROWS} rows of {LEAST_GRASPS} "
            f"grasps or more: record {more} (sioms hand record --append, or another file)"
        )
    for name, values, most, unit in (
        ("time", g.time, np.inf, "s"), ("joints", g.joints[:, [0, 1, 3, 4]], MOST_PLACE_M, "m"),
        ("joints", g.joints[:, [2, 5]], TURNED, "rad"), ("place", g.place, TURNED, "rad"),
        ("load", g.load, MOST_LOAD_N, "N"),
    ):  # fmt: skip
        _within(name, values, most, unit)
    _ordered(g)
    _objects(g)
    if np.median(g.load) <= 0.0:
        raise BadInputError("read grasps: most loads are not above 0 N; a load presses the finger and is positive")
    _meets(g, b)
    return _notes(g)


def _within(name: str, values: Floats, most: float, unit: str) -> None:
    if not np.isfinite(values).all():
        raise BadInputError(f"read grasps: {name} holds values that are no numbers; needs numbers in every row")
    if np.max(np.abs(values)) > most:
        raise BadInputError(
            f"read grasps: {name} goes up to {np.max(np.abs(values)):.4g} {unit}; needs at most {most:g} {unit}"
        )


def _ordered(g: Grasps) -> None:
    same = np.diff(g.record) == 0
    if np.any(np.diff(g.time)[same] < 0.0):
        raise BadInputError("read grasps: time does not rise; needs seconds in the order of recording")
    if np.any(np.diff(g.grasp)[same] < 0):
        raise BadInputError(
            "read grasps: the number of the grasp does not rise; needs one number for each grasp, in order"
        )


def _objects(g: Grasps) -> None:
    odd = set(g.kind.tolist()) - {OTHER, DISK, BAR}
    if odd:
        raise BadInputError(f"read grasps: kind is {min(odd)}; needs 1 for a disk, 2 for a bar, 0 for another object")
    for thing in np.unique(g.thing):
        mine = g.thing == thing
        sizes = g.size[mine & g.known]
        if len(np.unique(g.kind[mine])) > 1 or (len(sizes) and (np.ptp(sizes) > 0.0 or len(sizes) < mine.sum())):
            raise BadInputError(
                f"read grasps: object {thing} has several kinds or sizes; needs a number for each object"
            )
        if len(sizes) and not 0.0 < sizes[0] < MOST_SIZE_M:
            raise BadInputError(f"read grasps: object {thing} has size {sizes[0]:g} m; needs 0 to {MOST_SIZE_M:g} m")
    odd = set(g.slip.tolist()) - {0, 1, 2}
    if odd:
        raise BadInputError(f"read grasps: slip is {min(odd)}; needs the finger that slides, 1 or 2, and 0 for none")


def _meets(g: Grasps, b: HandBelief) -> None:
    """Refuse grasps that the nominal hand misses by centimetres."""
    along = gaps(b, g).along
    off = along[np.isfinite(along)]
    if len(off) and np.median(np.abs(off)) > FAR_M:
        raise BadInputError(
            f"compare contacts with their objects: they miss by {1e3 * np.median(np.abs(off)):.0f} mm in the middle; "
            "check units (m, rad), which finger is 1, and the frame of the places (pi/2 is across the link)"
        )


def _notes(g: Grasps) -> list[str]:
    notes = []
    if not g.weighed.any():
        notes.append(
            "no forces of the wrists were recorded: a stiffness is known only as far as the fingers' loads are right"
        )
    if not g.told.any():
        notes.append("no commands were recorded: the stiffness of the drives is not judged")
    if not (g.slip > 0).any():
        notes.append("no slip was recorded: friction is not judged")
    if not (g.known & (g.kind != OTHER)).any():
        notes.append("no object is of known size: sizes are fitted along")
    if (g.kind == OTHER).any():
        notes.append(
            f"{int(np.sum(g.kind == OTHER))} rows are of objects that are neither disk nor bar: they tell drives, "
            "loads and slips only"
        )
    return notes
