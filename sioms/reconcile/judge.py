"""The last word on a model: it runs free, on samples that took no part, and must come near what the machine did.

An observer pulls any model to the measurement, so what short windows leave may be small though the model, by itself,
does something else: it rings at another frequency, does not move at all, or runs away. Such a model is refused,
whatever its parts are called. What stays above the floor without being far is told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sioms.reconcile.effect import Slot
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Problem
from sioms.reconcile.free import Freely
from sioms.reconcile.model import AxisModel
from sioms.reconcile.resistance import resistance
from sioms.reconcile.thresholds import (
    CLIPPED,
    FREE_FLOORS,
    FREE_LEAST,
    FREE_NEAR,
    FREE_SHARE,
    GIVEN_POWER,
    STUCK,
    WORSE,
)
from sioms.reconcile.verdict import Gap

FORCE_LOOP = "force, closed loop"
#: Speeds and places at which the power of what opposes motion is looked at.
SPEEDS, PLACES = 40, 15
#: Less of the speed the other way is motion one way.
ONE_WAY = 0.1


@dataclass(frozen=True, slots=True)
class Judgement:
    """What the free run says: why a model is refused, and what is to be told though it is not."""

    refusals: tuple[str, ...]
    notes: tuple[str, ...]


def judge(problem: Problem, model: AxisModel, free: Sequence[Freely], gaps: Sequence[Gap], push: float) -> Judgement:
    """Judge a model.

    Args:
        problem: the samples that took no part.
        push: the force that is taken for noise, root mean square, [{F}].
        free: how it runs free over them.
        gaps: of the closed loop, where it can be simulated: then that is the free run that counts.
    """
    loop = next((g for g in gaps if g.channel == FORCE_LOOP), None)
    force = problem.join([r.force for r in problem.session.records])
    refusals = [*_impossible(problem, model, free), *_worse(free, loop)]
    if loop is not None:
        above = [Above("in closed loop", "force", loop.after, loop.floor, float(np.std(force)))]
    else:
        above = [Above(f"running free {f.over}", "motion", f.after, f.floor, f.moved) for f in free]
        # what is taken for noise may be what is missing
        refusals += _nowhere_near(free, above, push > FREE_LEAST * float(np.sqrt(np.mean(force**2))))
    far = [a for a in above if a.after > FREE_FLOORS * a.floor and a.after > FREE_LEAST * a.size]
    if far and not refusals:
        refusals.append(f"{_most(far)}: noise makes no such thing of it")
    near = [a for a in above if a.after > FREE_NEAR * a.floor and a not in far]
    return Judgement(tuple(refusals), (_most(near),) if near else ())


@dataclass(frozen=True, slots=True)
class Above:
    """How far a free run is from the measurement: what is left, its floor, and the size of what was measured."""

    where: str
    what: str
    after: float
    floor: float
    size: float

    @property
    def share(self) -> float:
        """What is left, of what was measured."""
        return self.after / max(self.size, 1e-300)


def _most(above: Sequence[Above]) -> str:
    a = max(above, key=lambda a: a.after / a.floor)
    return (
        f"{a.where}, the corrected model stays {a.after / a.floor:.2g} times above the floor ({100 * a.share:.2g} % of "
        f"the {a.what})"
    )


def _nowhere_near(free: Sequence[Freely], above: Sequence[Above], noisy: bool) -> list[str]:
    """Say that a model comes nowhere near the motion, unless so little moves that noise alone explains it.

    Over whole records there is one draw of noise, whose slowest part is not known: there it takes more.
    """
    if not above or min(a.share for a in above) <= FREE_SHARE:
        return []
    off = [f for f in free if f.after > (FREE_NEAR if np.isfinite(f.horizon_s) else FREE_FLOORS) * f.floor]
    if not (noisy or off):
        return []
    least = min(above, key=lambda a: a.share)
    return [
        f"{least.where}, the corrected model is off by {100 * least.share:.0f} % of the motion: short windows hide "
        "what it lacks"
    ]


def _worse(free: Sequence[Freely], loop: Gap | None) -> list[str]:
    """Say that the model was better as it was: over some length, what is corrected predicts worse."""
    runs = [(f"running free {f.over}", f.before, f.after, f.floor) for f in free]
    if loop is not None:
        runs = [("in closed loop", loop.before, loop.after, loop.floor)]
    worse = [(where, after / before) for where, before, after, floor in runs if after > WORSE * max(before, floor)]
    if not worse:
        return []
    where, times = max(worse, key=lambda w: w[1])
    return [f"{where}, the corrected model is off by {times:.2g} times as much as the nominal one: it is no correction"]


def _impossible(problem: Problem, model: AxisModel, free: Sequence[Freely]) -> list[str]:
    """Say why a model cannot have moved as the machine did."""
    out = []
    if (stuck := max((f.stuck for f in free), default=0.0)) > STUCK:
        out.append(
            f"driven by the recorded force, the corrected model is at rest during {100 * stuck:.0f} % of the way that "
            "the machine went: its friction is larger than the force that moved it"
        )
    if (given := power_given(problem, model)) > GIVEN_POWER:
        out.append(
            f"the corrected model gains energy from its own motion ({100 * given:.0f} % of what friction of the rated "
            "force would take): what opposes motion cannot drive it"
        )
    if (clipped := less_than_none(problem, model)) > CLIPPED:
        out.append(
            f"the dry friction of the corrected model would be less than none in {100 * clipped:.0f} % of the motion: "
            "what lowers it takes more than there is"
        )
    return out


def less_than_none(problem: Problem, model: AxisModel) -> float:
    """Return the share of the samples in motion in which the levels of dry friction add up to less than none."""
    laws = [(known()[n], given) for n, given in model.effects.items() if known()[n].slot is Slot.FRICTION]
    if not laws:
        return 0.0
    levels, speeds = [], []
    for r, run in zip(problem.session.records, problem.runs(model), strict=True):
        state = run.x, run.v, run.applied, run.temperature
        parts = (effect.evaluate(*state, effect.row(effect.values(given), model.pitch)) for effect, given in laws)
        levels.append(sum(parts, np.zeros(len(r))))
        speeds.append(np.abs(run.v))
    level, speed = problem.join(levels), problem.join(speeds)
    moving = speed > ONE_WAY * float(np.max(speed))
    return float(np.mean(level[moving] < 0.0)) if np.any(moving) else 0.0


def power_given(problem: Problem, model: AxisModel) -> float:
    """Return the largest power that what depends on speed gives the axis, at speeds that it had; of the rated force's
    at the largest of them.

    Where it moved both ways, both count together: what drives it one way and brakes it the other gives nothing.
    """
    dt = model.sample_time_s
    size = max(round(0.02 / dt), 1)
    speeds = [
        (r.position[size:] - r.position[:-size]) / (size * dt) for r in problem.session.records if len(r) > 2 * size
    ]
    if not speeds:
        return 0.0
    every = np.concatenate(speeds)
    low, high = np.quantile(every, (0.01, 0.99))
    both = min(-low, high) > ONE_WAY * max(-low, high)
    top = max(-low, high)
    v = np.linspace(-top, top, SPEEDS) if both else np.linspace(float(low), float(high), SPEEDS)
    v = v[np.abs(v) > 1e-3 * top]
    if not len(v):
        return 0.0
    places = np.quantile(np.concatenate([r.position for r in problem.session.records]), np.linspace(0.05, 0.95, PLACES))
    x, w = (a.ravel() for a in np.meshgrid(places, v, indexing="ij"))
    still = np.zeros_like(x)
    power = -(resistance(model, x, w, still, still) * np.abs(w)).reshape(PLACES, -1).mean(axis=0)
    power = power + power[::-1] if both else power
    return float(np.max(power) / (model.rated_force * np.max(np.abs(v))))
