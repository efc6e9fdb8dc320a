"""A second mass that swings far slower than the force is made of: short windows do not show it, free runs do.

Above the frequencies at which two masses swing, the motor moves as if it were alone, and what the load does shows only
in how the motion goes on. So an elastic transmission is sought once more where a model without a closed loop runs free
far from the machine: from many starts, by free runs over short segments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.fit import Fit, Problem, free_parameters, refit
from sioms.reconcile.free import HORIZONS_S, errors, moved
from sioms.reconcile.model import AxisModel
from sioms.reconcile.refine import flown
from sioms.reconcile.thresholds import FREE_SHARE, SPECIFIC, WORSE

#: What is sought, and its starts: resonances [Hz], shares of the inertia behind the spring, damping.
TWO_MASSES = "elastic"
GRID_HZ = (2.5, 4.0, 6.5, 10.0, 16.0, 25.0, 40.0)
GRID_SHARE = (0.3, 0.6, 0.9)
ZETA = 0.05
#: Of the starts so many are followed.
FOLLOWED = 2


def off(problem: Problem, model: AxisModel, horizon_s: float = HORIZONS_S[0]) -> float:
    """Return the error of free runs over segments of a length, by default the shortest, root mean square, [{x}];
    infinite where no record holds one.
    """
    e = errors(problem, model, horizon_s)
    return float(np.sqrt(np.mean(e**2))) if len(e) else np.inf


def second(problem: Problem, fit: Fit, start: AxisModel, frozen: Sequence[str]) -> Fit | None:
    """Fit an elastic transmission in the place of what was found, where that runs free far from the machine.

    Args:
        fit: what was found; start: the model that the search began with.
        frozen: effects that keep their values.

    Returns:
        None where it runs free near enough, or no second mass comes far nearer over short segments and as near over
        longer ones.
    """
    spans = (*HORIZONS_S, np.inf)
    motion = [_moved(problem, fit.model, h) for h in spans]
    was = [off(problem, fit.model, h) for h in spans]
    if was[0] <= FREE_SHARE * motion[0]:
        return None
    other = refit(problem, second_mass(problem, replace(start, within={})), frozen)
    return other if nearer(was, [off(problem, other.model, h) for h in spans], motion) else None


def nearer(was: Sequence[float], now: Sequence[float], motion: Sequence[float]) -> bool:
    """Say whether a model runs free far nearer than another one over short segments, and no farther off over those
    longer ones over which that comes any nearer than a constant speed.

    Args:
        was, now: errors of the other one and of the model, the shortest segments first.
        motion: size of the motion about a constant speed.
    """
    longer = zip(was[1:], now[1:], motion[1:], strict=True)
    return now[0] < (1.0 - SPECIFIC) * was[0] and all(n <= WORSE * w for w, n, m in longer if w < m)


def _moved(problem: Problem, model: AxisModel, horizon: float) -> float:
    """Return the size of the measured motion about a constant speed, root mean square, [{x}]; zero where no record is
    so long.
    """
    motion = moved(problem, model, horizon)
    return float(np.sqrt(np.mean(motion**2))) if len(motion) else 0.0


def second_mass(problem: Problem, model: AxisModel) -> AxisModel:
    """Return a model with the elastic transmission beside which free runs leave least."""
    starts = sorted(_starts(model), key=lambda m: off(problem, m))[:FOLLOWED]
    ends = [flown(problem, m, free_parameters(m), HORIZONS_S[0]) for m in starts]
    return min(ends, key=lambda m: off(problem, m))


def _starts(model: AxisModel) -> Iterator[AxisModel]:
    """Yield starts; an inertia that is uncertain may be the motor's alone."""
    for hz in GRID_HZ:
        for share in GRID_SHARE:
            values = {"f_res": hz, "load_fraction": share, "zeta": ZETA}
            yield model.with_effect(TWO_MASSES, values)
            if "inertia" in model.refine:
                whole = replace(model, inertia=model.inertia / (1.0 - share), within={})
                yield whole.with_effect(TWO_MASSES, values)
