"""What records of a sensor can show: the trace of every effect of natural size, and which pairs leave the same one."""

from __future__ import annotations

import numpy as np

from sioms.reconcile.sensors.effect import Array, SensorEffect
from sioms.reconcile.sensors.fit import Data
from sioms.reconcile.sensors.screen import screening_columns
from sioms.reconcile.sensors.subject import Subject
from sioms.reconcile.thresholds import FELT, LARGEST, SAME, SENSOR


def gate(subject: Subject) -> tuple[dict[str, str], tuple[tuple[str, str, float], ...], tuple[str, ...]]:
    """Score the records before fitting.

    Returns:
        Effects that are not excited, pairs that these records cannot tell apart, and what is worth a try: an effect
        that would not show at its natural size may be larger.
    """
    model, data = subject.model, subject.training
    columns = {n: screening_columns(data, model, model.library[n]) for n in subject.names}
    trace = {n: float(np.linalg.norm(c)) for n, c in columns.items()}
    missing = {n: model.library[n].separate for n in columns if trace[n] < SENSOR.trace}
    names = tuple(n for n in columns if trace[n] * _largest(model.library[n]) > SENSOR.trace)
    pairs = []
    shown = [n for n in columns if n not in missing]
    for i, a in enumerate(shown):
        for b in shown[i + 1 :]:
            own, other = model.library[a], model.library[b]
            alike = (
                (b in own.confounders or a in other.confounders) and b not in own.replaces and a not in other.replaces
            )
            if alike and columns[a].shape[1] == columns[b].shape[1]:
                each = own.primary.each and other.primary.each
                same = _common(data, columns[a], columns[b], model.count if each else 0)
                if same > SAME:
                    pairs.append((a, b, same))
    return missing, tuple(sorted(pairs, key=lambda p: -p[2])), names


def _largest(effect: SensorEffect) -> float:
    """How many times its natural size an effect may have."""
    q = effect.primary
    return min(max(q.upper - effect.neutral, effect.neutral - q.lower) / q.size, LARGEST)


def _common(data: Data, a: Array, b: Array, elements: int) -> float:
    """Share that two traces have in common; of numbers of the elements' own that of the middle one of the elements that
    feel both.

    What tells the kind of one element does not tell that of the others.

    Args:
        elements: how many there are where the columns are of their own numbers, else 0.
    """
    if not elements:
        return min(_shared(a, b), _shared(b, a))
    found = []
    for i, (x, y) in enumerate(zip(a.T, b.T, strict=True)):
        mine = data.element == i % elements
        x, y = x[mine], y[mine]
        if min(np.linalg.norm(x), np.linalg.norm(y)) > FELT:
            found.append(float((x @ y) ** 2 / ((x @ x) * (y @ y))))
    return float(np.median(found)) if found else 0.0


def _shared(a: Array, b: Array) -> float:
    """Share of the energy of a's columns that lies in the span of b's; of elements that hardly feel either, hardly
    any.
    """
    q = np.linalg.qr(b[:, np.linalg.norm(b, axis=0) > 0.0])[0]
    return float(np.sum((q.T @ a) ** 2) / np.sum(a**2))
