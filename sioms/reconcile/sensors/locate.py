"""Where the disagreement of a sensor lives: its residual over the bins of what it may go with, with permutation
p-values.
"""

from __future__ import annotations

import numpy as np

from sioms.reconcile.engine.evidence import place
from sioms.reconcile.locate import bins_of
from sioms.reconcile.sensors.effect import Array, SensorModel
from sioms.reconcile.sensors.subject import Subject
from sioms.reconcile.verdict import Place


def locate(subject: Subject, model: SensorModel, rng: np.random.Generator, shifts: int = 99) -> list[Place]:
    """Rank the variables by how far they order the residual of the nominal model, with permutation p-values."""
    data = subject.whole
    e = -data.miss(data.predict(model))
    out = []
    told = subject.views()
    orders: dict[int, list[Array]] = {}  # of each view, in which all its variables are tried
    for name, unit, view, values, own in subject.variables(data):
        mine = np.flatnonzero(data.view == view)
        r = e[mine]
        if len(r) < 40 or np.ptp(values) == 0.0:
            continue
        if view not in orders:
            parts = np.split(r, np.flatnonzero(np.diff(data.block[mine])) + 1)
            orders[view] = [_shuffled(parts, rng) for _ in range(shifts)]
        shown = told[data.views[view]]
        bins = bins_of(values) if own is None else own
        out.append(place(f"{name} ({shown.title})", unit, r, values, bins, orders[view], shown.floor))
    # whatever else changed meanwhile goes with the time: it comes first only where nothing else explains a third as
    # much
    return sorted(out, key=lambda q: -q.explained / (3.0 if q.variable.startswith("time (") else 1.0))


def _shuffled(parts: list[Array], rng: np.random.Generator) -> Array:
    """Lay the blocks in another order, each turned within itself: neighbours stay neighbours, and nothing keeps its
    place.
    """
    pieces = []
    for i in rng.permutation(len(parts)):
        part = parts[i]
        cut = len(part) - int(rng.integers(len(part)))
        pieces += [part[cut:], part[:cut]]
    return np.concatenate(pieces)
