"""The numbers of a model by steps half as long: what they change by is an error of the simulation, and no noise.

A resonator makes many periods in a record, and short windows tell its stiffness to a few parts in a hundred thousand. A
step of so much phase makes a spring stiffer by a twelfth of that phase squared, which is more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.engine.fit import get
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.simulate import pack

#: Steps of the fit, which begins where it is to end.
FEW = 4


def halved(problem: Problem, fit: Fit, frozen: Sequence[str]) -> tuple[Fit, dict[tuple[str, str], float]]:
    """Fit again with steps half as long, where the motion decides how long they are.

    Returns:
        The fit, and by how much each of its numbers has changed; the fit as it was, and nothing, where what the effects
        need decides.
    """
    own = fit.model.swings_hz
    finer = replace(fit.model, swings_hz=2.0 * own)
    if pack(finer).substeps <= pack(fit.model).substeps:
        return fit, {}
    new = refit(problem, finer, frozen, FEW)
    off = np.abs(get(new.model, fit.free) - get(fit.model, fit.free))
    changed = {(f.effect, f.symbol): float(d) for f, d in zip(fit.free, off, strict=True)}
    return replace(new, model=replace(new.model, swings_hz=own)), changed
