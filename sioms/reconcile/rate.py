"""Does anything in the records tell their sample time? Without a time column it is somebody's word.

A record whose rows come r times as often as stated is, row by row, the record of an axis with r^2 times the inertia.
Only what knows seconds by itself tells: time stamps, or a controller whose law holds the sample time (a derivative, a
filter in hertz) and makes the recorded force at the stated one and at no other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sioms.reconcile.controlled import beyond_feedback
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import LAW_LEAST, LAW_TELLS, OTHER_RATE

#: What stands for another sample time among the alternatives of a verdict.
SAMPLE_TIME = "sample_time"


def trusted_blindly(session: Session, model: AxisModel) -> bool:
    """Say whether the sample time is only stated: no record shows it.

    Args:
        model: with the controller as stated; None where that is not known.
    """
    return not any(r.time_s is not None or _by_law(r, model) for r in (*session.records, *session.final))


def _by_law(r: Record, model: AxisModel) -> bool:
    """Say whether the controller makes the force at the stated sample time and not at another."""
    if model.controller is None or r.command is None:
        return False
    other = replace(model, sample_time_s=OTHER_RATE * model.sample_time_s)
    return beyond_feedback(r, other) > LAW_TELLS * max(beyond_feedback(r, model), LAW_LEAST)


def as_rate(nominal: AxisModel, extra: float) -> float:
    """Return the sample time [s] at which the rows show the nominal inertia where they now show ``extra`` more."""
    return nominal.sample_time_s * float(np.sqrt(nominal.inertia / max(nominal.inertia + extra, 1e-300)))


def remark(nominal: AxisModel) -> str:
    """Say what rests on a sample time that nothing shows."""
    return (
        f"every number rests on the stated sample time of {1e3 * nominal.sample_time_s:g} ms: there is no time column, "
        "and nothing else in the records tells it; were it r times as long, all times would be r times, viscous "
        "coefficients r times and inertias r^2 times as large"
    )


def instead(nominal: AxisModel, extra: float) -> str:
    """Say which sample time would do what a payload does."""
    return (
        f"not ruled out: a sample time of {1e3 * as_rate(nominal, extra):.3g} ms instead of the stated "
        f"{1e3 * nominal.sample_time_s:g} ms makes the same inertia; record the time, or add a known mass"
    )
