"""The causes that drifts have, which of them separates from all others, and what is said where none does.

A cause is a direction, or a few, in which the numbers of an axis change together. It is named where a change along it
leaves nothing else to explain, and where every other cause leaves far more. Confounders that the records do not
separate are told together, as an open question, with the variable that orders the change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sioms.reconcile.thresholds import (
    BEHIND_PLAY,
    BENT,
    CHANGED,
    LEAVES,
    NEEDED,
    ONE_FLANK_STAYS,
    PUSHED_APART,
    RIVAL,
    SMALLEST,
    TOLD_PLAY,
    YIELDS,
)

from .moves import Array
from .normal import ALL_NAMES, LATE, PLACE, PLAY, SCALE, TOTAL, UNKNOWN, Estimate, Normal
from .rows import CONSTANT, DRY, GAP, GIVE, LAG, MASS, PLAYS, SIZE, VISCOUS

#: What orders an unexplained change.
ORDERED = {
    "mass": "acceleration", "viscous": "speed", "dry": "direction of motion", "constant": "nothing: it is constant",
    "lag": "change of the acceleration", "give": "second change of the acceleration", "gap0": "reversal of force",
    "gap1": "reversal of force", "gap2": "reversal of force", "place": "place of the reference",
    "scale": "distance along the axis", "play": "direction of approach", "late": "speed at the reference",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cause:
    """One cause.

    Attributes:
        text: as a technician says it.
        unit: of its size, with {x} and {F}; "1": a share.
        ways: (normal numbers) -> directions, shape (TOTAL, k), the first of which carries its size.
        signs: that the first coefficient may have: 1, -1 or 0 for both.
        part_of: a richer cause that contains this one.
    """

    name: str
    text: str
    unit: str
    ways: Callable[[Array], Array]
    signs: int = 0
    part_of: str = ""


def _axis(*numbers: int) -> Callable[[Array], Array]:
    def ways(theta: Array) -> Array:
        return np.eye(TOTAL)[:, list(numbers)]

    return ways


def _weaker(theta: Array) -> Array:
    way = np.zeros((TOTAL, 1))
    way[:SIZE, 0] = theta[:SIZE]
    return way


def _stretched(theta: Array) -> Array:
    way = np.zeros((TOTAL, 1))
    way[[MASS, VISCOUS, LAG, GIVE], 0] = -theta[[MASS, VISCOUS, LAG, GIVE]]
    way[SCALE, 0] = 1.0
    return way


CAUSES = (
    Cause("dry friction", "dry friction has grown: wear, or no lubricant", "{F}", _axis(DRY), 1, "friction"),
    Cause("less dry friction", "dry friction has fallen: preload is lost", "{F}", _axis(DRY), -1),
    Cause("viscous friction", "viscous friction has changed: the lubricant ages", "{F} s/{x}",
          _axis(VISCOUS), 0, "friction"),
    Cause("friction", "dry and viscous friction have changed", "{F}", _axis(DRY, VISCOUS)),
    Cause("mass", "the moved mass has changed", "{m}", _axis(MASS)),
    Cause("lower force", "the drive gives less force than commanded", "1", _weaker, 1),
    Cause("more force", "the drive gives more force than commanded", "1", _weaker, -1),
    Cause("backlash", "there is more play", "{x}", _axis(GAP, GAP + 1, GAP + 2, PLAY, LAG, GIVE), 0),
    Cause("scale", "the position is scaled: pulley, coupling or encoder", "1", _stretched),
    Cause("place", "the place is shifted: a belt has slipped, or a screw is loose", "{x}", _axis(PLACE)),
    Cause("constant force", "a constant force has changed, or friction differs by direction", "{F}", _axis(CONSTANT)),
    Cause("elasticity", "the transmission yields more", "{m} s^2", _axis(GIVE), 0, "backlash"),
    Cause("drive lag", "the drive is later", "{m} s", _axis(LAG), 0, "backlash"),
    Cause("late reference", "the reference is told later", "s", _axis(LATE)),
    Cause("reference hysteresis", "the reference switches later either way: sensor or its target", "{x}", _axis(PLAY)),
)  # fmt: skip
BY_NAME = {cause.name: cause for cause in CAUSES}
#: What a reference may have done where its edges move apart by the way of the motion.
OF_REFERENCE = ("late reference", "reference hysteresis")
#: Where a constant force holds the load at one flank, play shifts the reference, too.
ONE_FLANK = Cause("backlash", BY_NAME["backlash"].text, "{x}", _axis(GAP, GAP + 1, GAP + 2, PLAY, LAG, GIVE, PLACE))


@dataclass(frozen=True, slots=True)
class Finding:
    """What some blocks say against what is normal.

    Attributes:
        gain: energy of the change along the best cause, in units of its variance; above CHANGED there is one.
        names: of causes that explain it: one is a name, several are an open question, none: no known cause.
        size, low, high: of the first one.
        change: of all numbers, shape (TOTAL,).
        ordered: the variable that orders it.
        share: of the usual force that the change makes.
    """

    gain: float
    names: tuple[str, ...]
    size: float
    low: float
    high: float
    change: Array
    ordered: str
    share: float

    @property
    def is_drift(self) -> bool:
        """Whether something has changed."""
        return self.gain > CHANGED


def judge(normal: Normal, now: Estimate, travel: float) -> Finding:
    """Say what some blocks say against what is normal."""
    change = now.theta - normal.theta
    cover = now.noise + normal.own
    change, cover = _without_loads(normal, change, cover)
    energy = float(change[:SIZE] @ now.gram[:SIZE, :SIZE] @ change[:SIZE])
    bent = float(np.sqrt(max(energy, 0.0) / now.rows))
    fits = {cause.name: _fit(cause, normal.theta, change, cover) for cause in CAUSES}
    nothing = float(change @ np.linalg.solve(cover, change))
    best = max((nothing - left for left, *_ in fits.values()), default=0.0)
    slack = cover.copy()
    at = np.arange(SIZE)
    slack[at, at] += (BENT * bent / np.maximum(normal.per, 1e-300)) ** 2
    pace = now.pace if now.pace > 0.0 else 0.0
    places = max(float(np.abs(change[[PLACE, PLAY]]).max()), pace * abs(float(change[LATE])))
    slack[[PLACE, PLAY], [PLACE, PLAY]] += (BENT * places) ** 2
    slack[SCALE, SCALE] += (BENT * places / travel) ** 2
    slack[LATE, LATE] += (BENT * places / pace) ** 2 if pace else 0.0
    loose = {cause.name: _fit(cause, normal.theta, change, slack) for cause in CAUSES}
    lefts = {name: left for name, (left, *_) in loose.items()}
    names = _names(lefts)
    one = _fit(ONE_FLANK, normal.theta, change, slack)
    others = [left for name, left in lefts.items() if name != ONE_FLANK.name]
    shift = 2.0 * abs(float(change[PLACE]))
    if one[0] < LEAVES and min(others) > one[0] + RIVAL and _behind(normal, now, change, travel, shift)[0]:
        names, loose[ONE_FLANK.name] = (ONE_FLANK.name,), one
    if "backlash" in names:
        names = _play_or_reference(names, normal, now, change, travel)
    if "place" in names or not names:
        names = _by_turns(names, normal, now, float(change[PLACE]))
    if names == ("place",) and not (_never_turned(normal, now, change) or _without_play(normal, now, change, travel)):
        names = (*names, "backlash")
    scores = change**2 / np.diag(cover)
    ordered = ORDERED[ALL_NAMES[int(np.argmax(scores))]]
    size, wide = _size(BY_NAME[names[0]], normal, now, loose[names[0]], travel) if names else (np.nan, np.nan)
    return Finding(best, names, size, size - wide, size + wide, change, ordered, bent / normal.force)


def _without_loads(normal: Normal, change: Array, cover: Array) -> tuple[Array, Array]:
    """Forget the mass where it is within those of the loads that are carried."""
    lightest = normal.theta[MASS] + change[MASS]
    if not normal.loads or not 0.97 * normal.least < lightest < 1.03 * normal.most:
        return change, cover
    cover = cover.copy()
    cover[MASS, :] = cover[:, MASS] = 0.0
    cover[MASS, MASS] = UNKNOWN
    return change, cover


def _by_turns(names: tuple[str, ...], normal: Normal, now: Estimate, place: float) -> tuple[str, ...]:
    """Name a shift of the reference backlash where edges moved apart by twice of it between one push and the other.

    A play of which one flank bears at steady speed shifts the edges there by half of it; inertia brings the other flank
    to bear, while with the other push the edge stays where steady speed leaves it. A transmission that yields more
    moves it as far one way as the other. A play with a constant force on the load does not bounce as its columns do:
    the edges tell it also where no cause explains the force.
    """
    back, forth, error = now.turned
    play, twice = forth - back - normal.turned, 2.0 * abs(place)
    nearer = min(abs(back - place), abs(forth - place))
    apart = np.isfinite(play) and PUSHED_APART[1] * error < play and nearer < ONE_FLANK_STAYS * play
    return ("backlash",) if apart and abs(play - twice) < PUSHED_APART[0] * twice + 2.0 * error else names


def _play_or_reference(
    names: tuple[str, ...], normal: Normal, now: Estimate, change: Array, travel: float
) -> tuple[str, ...]:
    """Drop backlash, or what a reference may have done instead, where edges or reversals of force exclude it.

    A reference that tells its edges late, or with a hysteresis, sets them apart by the way of the motion as a play
    does, but not by the push, and nothing goes on by itself when the force turns. What separates neither leaves all.
    """
    play, variance = _play(normal, now, change)
    if variance > (TOLD_PLAY * play) ** 2:
        return names
    back, forth, error = now.turned
    by_push = forth - back - normal.turned
    # how far each would set edges apart by the push
    made = {"backlash": play, "reference hysteresis": now.by_way * play}
    if now.pace > 0.0:
        made["late reference"] = now.by_speed * play / (2.0 * now.pace)
    off = {name for name, apart in made.items() if abs(by_push - apart) > PUSHED_APART[0] * abs(play) + 2.0 * error}
    proved, excluded = _behind(normal, now, change, travel, abs(play))
    if _outweighs(normal, DRY):
        off |= {"backlash"} if excluded else set()
    else:
        off -= {"backlash"}  # its friction may hold the load at one flank, whatever the push
    shown = proved or ("backlash" not in off and {"reference hysteresis"} <= off)
    if not shown and abs(play) < _wound(normal, now, change):
        names = (*names, "elasticity") if "elasticity" not in names else names
    return tuple(name for name in names if name not in off)


def _outweighs(normal: Normal, *beside: int) -> bool:
    """Say whether the inertia of what may be behind a play outweighs the constant force on the axis, and more forces
    beside it: else it may never leave its flank.
    """
    holds = sum(abs(float(normal.theta[number])) for number in (CONSTANT, *beside))
    return BEHIND_PLAY * abs(float(normal.theta[MASS])) * float(normal.per[MASS]) > holds


def _wound(normal: Normal, now: Estimate, change: Array) -> float:
    """Return how far a transmission that yields more may set edges apart: dry friction of the load winds it up.

    What it yields shows in GIVE as well: there by both masses, of which each is BEHIND_PLAY of the whole or more.
    """
    error = 2.0 * float(np.sqrt(now.noise[GIVE, GIVE] + normal.own[GIVE, GIVE]))
    masses = BEHIND_PLAY * (1.0 - BEHIND_PLAY) * float(normal.theta[MASS]) ** 2
    return 2.0 * abs(float(now.theta[DRY])) * max(float(change[GIVE]) + error, 0.0) / max(masses, 1e-300)


def _play(normal: Normal, now: Estimate, change: Array) -> tuple[float, float]:
    """Return how far the reference's edges have moved apart by the way, all of it taken for play, and its variance: how
    late they are told is what it was.
    """
    cover = now.noise + normal.own
    tied = cover[PLAY, LATE] / cover[LATE, LATE]
    return float(change[PLAY] - tied * change[LATE]), float(cover[PLAY, PLAY] - tied * cover[PLAY, LATE])


def _never_turned(normal: Normal, now: Estimate, change: Array) -> bool:
    """Say whether edges are passed at the same place whichever way inertia pushes the load, where a play that makes the
    shift would have moved them apart by twice of it.

    Only where inertia outweighs the constant force on the axis: else the load may never leave its flank.
    """
    back, forth, error = now.turned
    play = abs(forth - back - normal.turned)
    return bool(_outweighs(normal) and play + 2.0 * error < PUSHED_APART[0] * 2.0 * abs(float(change[PLACE])))


def _without_play(normal: Normal, now: Estimate, change: Array, travel: float) -> bool:
    """Say whether a shift of the reference's edges cannot be play, which shifts them by the flank that bears.

    At a steady speed it shifts them all alike, or by the way in which they are passed, so it is no scale. A play that
    makes a shift is at least twice as large, and the mass behind it would show at reversals of force. Every size from
    there on is tried by itself: of all sizes at once only their sum shows, and what is too small to show in it hides
    the rest. What is too small for any column is not told apart.
    """
    return _behind(normal, now, change, travel, 2.0 * abs(float(change[PLACE])))[1]


def _behind(normal: Normal, now: Estimate, change: Array, travel: float, play: float) -> tuple[bool, bool]:
    """Say whether reversals of force prove a mass behind a play, and whether they exclude one behind any play from
    there on.
    """
    gap = play / travel
    if gap <= SMALLEST * PLAYS[0]:
        return False, False
    plays = slice(GAP, GAP + len(PLAYS))
    information = np.linalg.inv((now.noise + normal.own)[plays, plays])
    least = BEHIND_PLAY * abs(float(normal.theta[MASS]))
    spans = []
    for way in _sizes(gap):
        known = float(way @ information @ way)
        behind, error = float(way @ information @ change[plays]) / known, 2.0 / np.sqrt(known)
        spans.append((behind - error, behind + error))
    return spans[0][0] > least, all(high < least for _, high in spans)


def _sizes(gap: float) -> list[Array]:
    """Return how a mass behind a play shows in the columns of play: of that size [of the travel], and of each above."""
    at = float(np.interp(np.log(gap), np.log(PLAYS), np.arange(len(PLAYS))))
    places = [at, *range(int(at) + 1, len(PLAYS))]
    return [np.interp(np.arange(len(PLAYS)), [p - 1.0, p, p + 1.0], [0.0, 1.0, 0.0]) for p in places]


def _fit(cause: Cause, theta: Array, change: Array, cover: Array) -> tuple[float, Array, Array]:
    """Return what a cause leaves of a change, its coefficients and their covariance."""
    ways = cause.ways(theta)
    weighed = np.linalg.solve(cover, ways)
    information = ways.T @ weighed
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    along = inverse @ (weighed.T @ change)
    if cause.signs and along[0] * cause.signs < 0.0:
        along = np.zeros_like(along)
    rest = change - ways @ along
    return float(rest @ np.linalg.solve(cover, rest)), along, inverse


def _names(left: dict[str, float]) -> tuple[str, ...]:
    """Return the causes that explain a change, the best first; a richer one only where it is needed."""
    kept = dict(left)
    for cause in CAUSES:
        richer = cause.part_of
        if (
            richer
            and richer in kept
            and kept.get(cause.name, np.inf) - kept[richer] < NEEDED
            and kept[cause.name] < LEAVES
        ):
            del kept[richer]
    order = sorted(kept, key=lambda name: kept[name])
    if not order or kept[order[0]] > LEAVES:
        return ()
    most = kept[order[0]] + RIVAL
    names = [name for name in order if kept[name] < most]
    # the simpler one for which a richer one was dropped may itself be no rival of what is best now
    spoken = {cause.part_of for cause in CAUSES if cause.name in names}
    return (*names, *(n for n in left if n not in kept and n not in spoken and left[n] < most))


def _size(
    cause: Cause, normal: Normal, now: Estimate, fit: tuple[float, Array, Array], travel: float
) -> tuple[float, float]:
    """Return the size of a cause and half the width of its interval of 95 %."""
    _, along, inverse = fit
    half = 1.96 * float(np.sqrt(max(inverse[0, 0], 0.0)))
    if cause.name in ("lower force", "more force"):
        return 1.0 / (1.0 + float(along[0])), half / (1.0 + float(along[0])) ** 2
    if cause.name != "backlash":
        return float(along[0]), half
    play, variance = _play(normal, now, now.theta - normal.theta)
    shift, unsure = 2.0 * abs(float(now.theta[PLACE] - normal.theta[PLACE])), now.noise[PLACE, PLACE]
    unsure = 2.0 * float(np.sqrt(unsure + normal.own[PLACE, PLACE]))
    loose = now.loose - (normal.loose if np.isfinite(normal.loose) else 0.0)
    if loose > max(abs(play), shift) + 4.0 * normal.scatter:  # at either flank, whichever way the axis goes
        return loose, 1.96 * normal.scatter + YIELDS * loose
    if shift > abs(play) and unsure < TOLD_PLAY * shift:  # one flank bears: hardly ever the other does at steady speed
        return shift, 1.96 * unsure + YIELDS * shift
    known = float(np.sqrt(variance))
    if known < TOLD_PLAY * abs(play):
        return float(play), 1.96 * known
    weight = np.maximum(along[:3], 0.0) * PLAYS
    gap = travel * float(weight @ PLAYS / max(weight.sum(), 1e-300))
    return gap, 0.7 * gap
