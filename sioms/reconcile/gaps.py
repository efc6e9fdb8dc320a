"""How far measurement and model disagree on samples that took no part in any choice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem, closed_errors
from sioms.reconcile.floor import OF_WINDOWS, ON_MODEL, Floor
from sioms.reconcile.free import Freely
from sioms.reconcile.model import AxisModel
from sioms.reconcile.session import State, applied, estimate, half, heats
from sioms.reconcile.simulate import replay, track
from sioms.reconcile.verdict import Gap


def measure(
    problem: Problem, nominal: AxisModel, model: AxisModel, floor: Floor, states: Sequence[State] = ()
) -> tuple[Gap, ...]:
    """Compare before and after on the samples of ``problem`` (the untouched ones).

    Args:
        floor: of the closed loop.
        states: session parameters of each record, estimated on the first halves; the scores that use them, and
            those of the frozen model to set beside them, are of the second halves.
    """
    unit, k = nominal.force_unit, problem.noise.drive  # an expected innovation answers to one drive noise
    before, after = _rms(problem.residual(nominal)) * k, _rms(problem.residual(model)) * k
    late = [_late_errors(problem, model, s) for s in ([], states)] if states else [(None,) * 3] * 2
    frozen, session = late
    out = [Gap("force, short windows", unit, before, after, k, frozen[0], session[0], OF_WINDOWS)]
    if nominal.controller is None or any(r.command is None for r in problem.session.records):
        return tuple(out)
    errors = np.transpose([closed_errors(problem, m) for m in (nominal, model)])
    units, floors = (unit, nominal.position_unit), (floor.force, floor.place)
    for i, name in enumerate(("force", "position")):
        before, after = (float(e) for e in errors[i])
        later = frozen[i + 1], session[i + 1]
        out.append(Gap(f"{name}, closed loop", units[i], before, after, floors[i], *later, floor.how))
    return tuple(out)


def free_gaps(free: Sequence[Freely], unit: str) -> tuple[Gap, ...]:
    """Return what models that run free leave, as gaps."""
    return tuple(
        Gap(f"position, running free, {f.over}", unit, f.before, f.after, f.floor, floor_from=ON_MODEL) for f in free
    )


def session_states(problem: Problem, model: AxisModel) -> tuple[State, ...]:
    """Estimate the session parameters of every record on the first half of its samples in ``problem``."""
    return tuple(
        estimate(problem, model, r, half(problem, r), heat)
        for r, heat in zip(problem.session.records, heats(problem, model), strict=True)
    )


def _late_errors(problem: Problem, model: AxisModel, states: Sequence[State]) -> tuple[float | None, ...]:
    """Errors over the second halves: of short windows [{F}], and in closed loop of force and position."""
    windows, force, place = [], [], []
    unit = problem.noise.drive / problem.noise.innovation
    for i, (r, heat) in enumerate(zip(problem.session.records, heats(problem, model), strict=True)):
        m, seen = applied(model, r, states[i]) if states else (model, r)
        start = states[i].heat if states else heat
        part = slice(half(problem, r), problem.span(r).stop)
        run = track(m, seen.position, seen.force, problem.noise, start, external=seen.external, bends=seen.bends)
        windows.append(run.innovation[part] * unit)
        if model.controller is not None and seen.command is not None:
            run = replay(m, seen, start)
            force.append(np.nan_to_num(run.force - seen.force, nan=1e9)[part])
            place.append(np.nan_to_num(run.position - seen.position, nan=1e9)[part])
    return tuple(_rms(np.concatenate(e)) if e else None for e in (windows, force, place))


def rungs(problem: Problem, models: Sequence[AxisModel]) -> tuple[float, ...]:
    """Force error of each model on the samples of ``problem``: in closed loop where it can be, [{F}]."""
    closed = all(r.command is not None for r in problem.session.records)
    return tuple(
        closed_errors(problem, m)[0]
        if closed and m.controller is not None
        else _rms(problem.residual(m)) * problem.noise.drive
        for m in models
    )


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))
