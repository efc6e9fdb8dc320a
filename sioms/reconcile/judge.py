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
from sioms.reconcile.thresholds import FREE_FLOORS, FREE_LEAST, FREE_NEAR, FREE_SHARE, GIVEN_POWER, STUCK
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


def judge(problem: Problem, model: AxisModel, free: Sequence[Freely], gaps: Sequence[Gap]) -> Judgement:
    """Judge a model.

    Args:
        problem: the samples that took no part.
        free: how it runs free over them.
        gaps: of the closed loop, where it can be simulated: then that is the free run that counts.
    """
    loop = next((g for g in gaps if g.channel == FORCE_LOOP), None)
    refusals = [*_impossible(problem, model, free)]
    if loop is not None:
        force = problem.join([r.force for r in problem.session.records])
        size = float(np.sqrt(np.mean((force - force.mean()) ** 2)))
        above = [("in closed loop", loop.after, loop.floor, size)]
    else:
        above = [(f"running free {f.over}", f.after, f.floor, f.moved) for f in free]
        if above and min(after / max(moved, 1e-300) for _, after, _, moved in above) > FREE_SHARE:
            where, after, _, moved = min(above, key=lambda a: a[1] / max(a[3], 1e-300))
            refusals.append(
                f"{where}, the corrected model is off by {100 * after / moved:.0f} % of the motion: short windows hide "
                "what it lacks"
            )
    far = [a for a in above if a[1] > FREE_FLOORS * a[2] and a[1] > FREE_LEAST * a[3]]
    if far and not refusals:
        where, after, floor, size = max(far, key=lambda a: a[1] / a[2])
        refusals.append(
            f"{where}, the corrected model stays {after / floor:.0f} times above what noise makes of it "
            f"({100 * after / size:.0f} % of the {'force' if loop is not None else 'motion'})"
        )
    near = [a for a in above if a[1] > FREE_NEAR * a[2] and a not in far]
    notes = [
        f"{where}, the corrected model stays {after / floor:.1f} times above the floor ({100 * after / size:.2g} % of "
        f"the {'force' if loop is not None else 'motion'})"
        for where, after, floor, size in sorted(near, key=lambda a: -a[1] / a[2])[:1]
    ]
    return Judgement(tuple(refusals), tuple(notes))


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
    return out


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
    still, level = np.zeros_like(x), np.zeros_like(x)
    force = -model.viscous * w
    for name, given in model.effects.items():
        effect = known()[name]
        if effect.slot is None or effect.slot is Slot.GAIN:
            continue
        row = effect.row(effect.values(given), model.pitch)
        if effect.slot is Slot.FORCE:
            force = force + effect.evaluate(x, w, still, still, row) - effect.evaluate(x, still, still, still, row)
        else:
            level = level + effect.evaluate(x, w, still, still, row)
    power = ((force - np.sign(w) * np.maximum(level, 0.0)) * w).reshape(PLACES, -1).mean(axis=0)
    power = power + power[::-1] if both else power
    return float(np.max(power) / (model.rated_force * np.max(np.abs(v))))
