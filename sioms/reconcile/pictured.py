"""What the pictures of a verdict show: where the disagreement lies, its spectra, and curves before and after."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.axis_verdict import Trace
from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.locate import Spectrum, locate, spectra
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options, Prepared
from sioms.reconcile.simulate import replay
from sioms.reconcile.timed import as_recorded
from sioms.reconcile.verdict import Place


def pictures(
    ready: Prepared, nominal: AxisModel, model: AxisModel, o: Options, rng: np.random.Generator
) -> tuple[tuple[Place, ...], tuple[Spectrum, Spectrum] | None, tuple[Trace, ...]]:
    """Localise the disagreement, and keep curves, if pictures are wanted.

    The places are of the samples on which the search was made; the curves show the records on which the gap is
    measured, by the
    models that it is measured of: those to which the untouched samples have contributed nothing.
    """
    if not o.pictures:
        return (), None, ()
    o.progress("locating the disagreement")
    plain = as_recorded(ready.problem, ready.timed)
    places = tuple(locate(plain, nominal, rng))
    before = ready.final if ready.apart else as_recorded(ready.final, ready.timed)
    return places, spectra(plain, nominal), _traces((before, ready.final), (nominal, model))


def _traces(problems: tuple[Problem, Problem], models: tuple[AxisModel, AxisModel]) -> tuple[Trace, ...]:
    """Keep force curves for the pictures, before and after: in closed loop where it can be, else what short windows
    leave.
    """
    curves: list[list[Array]] = []
    for problem, model in zip(problems, models, strict=True):
        unit, heat = problem.noise.drive / problem.noise.innovation, 0.0
        own: list[Array] = []
        for r, tracked in zip(problem.session.records, problem.runs(model), strict=True):
            if model.controller is None or r.command is None:
                left = r.force + tracked.innovation * unit
                left[: problem.skip] = np.nan  # in which the observer finds the state
                own.append(left)
                continue
            run = replay(model, r, heat)
            heat = run.end_temperature
            own.append(run.force)
        curves.append(own)
    dt = models[0].sample_time_s
    return tuple(
        Trace(
            r.name,
            np.arange(len(r), dtype=np.float64) * dt,
            r.force,
            before,
            after,
            int(problems[0].begin * len(r)) * dt,
        )
        for r, before, after in zip(problems[0].session.records, *curves, strict=True)
    )
