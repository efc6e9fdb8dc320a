"""What the controller of a model would have made of command and position, against the force that was recorded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sioms.reconcile.kernel import (
    CTL_ALPHA,
    CTL_K,
    CTL_KB,
    CTL_KP,
    CTL_KZ,
    CTL_MAX,
    CTL_MEAN,
    CTL_OFFSET,
)
from sioms.reconcile.model import AxisModel, controller_row
from sioms.reconcile.records import Record, Session
from sioms.reconcile.timing import LEAST_SAMPLES

#: Share of the force above which what feedback does not explain is told, and samples until a filter of speed has
#: settled.
FOREIGN, SETTLED = 0.05, 100
#: So many rows after one that was interpolated the force is made of it.
REACH = 2


def runs_the_loop(session: Session, model: AxisModel) -> bool:
    """Say whether the controller of the model makes the recorded forces: then the rows are those of the loop."""
    return (
        model.controller is not None
        and all(r.command is not None for r in session.records)
        and all(beyond_feedback(r, model) <= FOREIGN for r in session.records)
    )


def foreign(session: Session, model: AxisModel) -> bool:
    """Say whether the controller of a model leaves more of some recorded force than it can: then the model is not that
    of what was recorded, whatever its mechanics are.
    """
    return model.controller is not None and any(beyond_feedback(r, model) > FOREIGN for r in session.records)


def beyond_feedback(r: Record, model: AxisModel) -> float:
    """Size of the recorded force that the controller does not explain, over the size of the force; 0 without a command.

    Rows that were interpolated, or follow one, do not count: on a busy machine many ticks are lost. The size is the
    98th percentile, for those that do not show.
    """
    if r.command is None or len(r) < LEAST_SAMPLES:
        return 0.0
    c, y = controller_row(model), r.position
    e, own = r.command - y, r.force - (0.0 if r.feedforward is None else r.feedforward)
    if c[CTL_MEAN] > 0.0:
        v = 0.5 * (y - np.concatenate([y[:1], y[:1], y[:-2]])) / model.sample_time_s
    else:
        steps = np.diff(y, prepend=y[0]) / model.sample_time_s
        v = lfilter([c[CTL_ALPHA]], [1.0, c[CTL_ALPHA] - 1.0], steps)
    u = c[CTL_K] * (e[1:] + c[CTL_KZ] * e[:-1]) - c[CTL_KP] * own[:-1] + c[CTL_KB] * v[1:] + c[CTL_OFFSET]
    off = np.abs(own[1:] - np.clip(u, -c[CTL_MAX], c[CTL_MAX]))[SETTLED:]
    recorded = _recorded(r)[1 + SETTLED :]
    off = off[recorded] if np.sum(recorded) >= LEAST_SAMPLES else off
    return float(np.quantile(off, 0.98) / max(float(np.quantile(np.abs(own), 0.98)), 1e-300))


def _recorded(r: Record) -> NDArray[np.bool_]:
    """Say which rows, with those before them that a speed is made of, were recorded and not interpolated."""
    if r.filled is None:
        return np.ones(len(r), dtype=bool)
    near = r.filled.copy()
    for late in range(1, REACH + 1):
        near[late:] |= r.filled[:-late]
    return ~near
