"""The gate before any fit: which effects would these records show, and which pairs look the same in them?

Every effect is given its typical size and passed through the observer; the size of its trace in units of the
floor says whether it was excited, the correlation of two traces whether they can be told apart at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sioms.reconcile.effect import Array, Effect
from sioms.reconcile.effects import library
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.screen import (
    dead_band,
    range_of,
    shapes,
    smoothed_motion,
    state_columns,
    trial_values,
)
from sioms.reconcile.thresholds import AXIS, LARGEST, SAME
from sioms.reconcile.variation import accompanied


@dataclass(frozen=True, slots=True)
class Gate:
    """What the records can show.

    Attributes:
        traces: root mean square trace of each effect at its typical size, in units of the floor.
        pairs: effects that these records cannot tell apart, with the share of energy they have in common.
        missing: effects not excited, with the record that would excite them.
        faint: of these the ones that would show if they were as large as they can be.
    """

    traces: dict[str, float]
    pairs: tuple[tuple[str, str, float], ...]
    missing: dict[str, str]
    faint: tuple[str, ...]


def gate(problem: Problem, model: AxisModel, names: tuple[str, ...]) -> Gate:
    """Score the records before fitting."""
    lib = library()
    columns = {n: c for n in names if (c := _trace(problem, model, lib[n])) is not None}
    traces = {n: float(np.sqrt(np.mean(np.sum(c, axis=1) ** 2))) for n, c in columns.items()}
    missing = {n: lib[n].separate for n, t in traces.items() if t < AXIS.trace}
    faint = tuple(n for n in missing if traces[n] * _largest(lib[n]) >= AXIS.trace)
    pairs = []
    shown = [n for n in columns if n not in missing]
    for i, a in enumerate(shown):
        for b in shown[i + 1 :]:
            alike = b in lib[a].confounders or a in lib[b].confounders
            contained = b in lib[a].replaces or a in lib[b].replaces
            if alike and not contained and (same := common(columns[a], columns[b])) > SAME:
                pairs.append((a, b, same))
    return Gate(traces, tuple(sorted(pairs, key=lambda p: -p[2])), missing, faint)


def _largest(effect: Effect) -> float:
    """How many times its typical size an effect may have."""
    p = effect.primary
    typical = abs(p.start - effect.neutral)
    most = max(p.upper - effect.neutral, effect.neutral - p.lower)
    return float(min(most / typical, LARGEST)) if typical > 0.0 else 1.0


def common(a: Array, b: Array) -> float:
    """Largest share of energy that a combination of a's columns has in common with b's (first principal angle)."""
    qa, qb = np.linalg.qr(a)[0], np.linalg.qr(b)[0]
    return float(np.linalg.svd(qa.T @ qb, compute_uv=False)[0] ** 2)


def _trace(problem: Problem, model: AxisModel, effect: Effect) -> Array | None:
    """Trace of the effect at its typical size, one column per amplitude and phase; None where it leaves none."""
    if not accompanied(model, effect.name):
        return None
    size = effect.primary.start * model.scale(effect.primary)
    if effect.trials is None:
        motions, dead = smoothed_motion(problem, model), dead_band(problem, model)
        shape = next(shapes(effect, model, range_of(motions)), None)
        if shape is None:  # the range holds no period of any order
            return None
        forces = [state_columns(effect, model, m, shape, dead) for m in motions]
        if effect.by_reach:
            largest = max(float(np.max(np.abs(f))) for f in forces)
            size = effect.primary.start * model.rated_force / max(largest, 1e-300)
        parts = [problem.answer(model, size * f) for f in forces]
        trace = problem.join(parts) / problem.noise.innovation
    else:
        values = next(iter(trial_values(effect, model, problem)))
        moved = problem.residual(model.with_effect(effect.name, values)) - problem.residual(model)
        trace = moved[:, None]
    return trace[:, np.linalg.norm(trace, axis=0) > 1e-9] if np.any(trace) else None
