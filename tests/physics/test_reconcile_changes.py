"""Numbers of an axis that change in time: a load picked up, a brake that drags, a supply that sags and swings.

The axis is made here, in plain steps of 0.2 ms, by equations that share nothing with the solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import copysign, pi, sin

import numpy as np
import pytest

from sioms.reconcile import axis
from sioms.reconcile.axis import _changed, _explained, analyse
from sioms.reconcile.changes import change, settled
from sioms.reconcile.course import Course
from sioms.reconcile.fit import refit
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.verdict import Outcome

DT, FINE, INERTIA, VISCOUS, STEP = 2e-3, 10, 0.05, 0.2, 2 * pi / 65536
LAW = (40.0, -2.4)  # of position and of speed
AXIS = AxisModel(
    True, DT, INERTIA, VISCOUS, STEP, 2 * pi, 6.0, 10.0, Controller(LAW[0], 0.0, 0.0, LAW[1], 0.0, 20.0, 0.0)
)
#: At a time: gain of the drive, inertia, dry friction, constant force.
Plant = Callable[[float], tuple[float, float, float, float]]


def between(t: float, start: float, stop: float) -> float:
    return 1.0 if start <= t < stop else 0.0


def picked(t: float) -> tuple[float, float, float, float]:
    on = between(t, 2.3, 5.1)
    return 1.0, INERTIA + 0.02 * on, 0.0, -0.8 * on


def braked(t: float) -> tuple[float, float, float, float]:
    return 1.0, INERTIA, 0.9 * between(t, 1.7, 4.4), 0.0


def sagged(t: float) -> tuple[float, float, float, float]:
    return 1.0 - 0.15 * between(t, 3.2, 99.0), INERTIA, 0.4, 0.0


def swung(t: float) -> tuple[float, float, float, float]:
    return 1.0 + 0.12 * sin(2 * pi * 0.37 * t + 1.0), INERTIA, 0.0, 0.0


@cache
def drive(plant: Plant, seconds: float = 9.0) -> Session:
    """Let the axis follow three swings that share no period, and record it."""
    rng = np.random.default_rng(5)
    count, h = int(seconds / DT), DT / FINE
    t = np.arange(count) * DT
    want = np.minimum(t / 0.5, 1.0) * (1.1 * np.sin(3.1 * t) + 0.5 * np.sin(7.7 * t) + 0.1 * np.sin(19.0 * t))
    x = v = u = before = 0.0
    rows = np.empty((count, 2))
    for k in range(count):
        seen = STEP * round(x / STEP + 0.2 * rng.standard_normal())
        u, before = LAW[0] * (want[k] - seen) + LAW[1] * (seen - before) / DT, seen
        rows[k] = seen, u
        noise = 0.01 * rng.standard_normal()
        for s in range(FINE):
            gain, inertia, dry, constant = plant(t[k] + s * h)
            push = gain * (u + noise) + constant - VISCOUS * v
            after = v + h * push / inertia
            drop = h * dry / inertia
            v = 0.0 if abs(after) <= drop else after - copysign(drop, after)
            x += h * v
    return Session((Record("run", rows[:, 0], rows[:, 1], want),))


@pytest.mark.parametrize(
    ("plant", "known", "expected"),
    [
        (picked, {}, {"m": 0.02, "w": -0.8}),
        (braked, {}, {"Fc": 0.9}),
        (sagged, {"coulomb": {"Fc": 0.3}}, {"g": -0.15}),
        (swung, {}, {"g": 0.12, "f": 0.37}),
    ],
)
def test_what_changes_in_time_is_found_with_its_size(
    plant: Plant, known: dict[str, dict[str, float]], expected: dict[str, float]
) -> None:
    ready = prepare(drive(plant), AXIS, Options())
    model = ready.model
    for name, values in known.items():
        model = model.with_effect(name, values)
    fit = refit(ready.problem, model)
    course = change(ready.problem, fit)
    assert course is not None
    found = settled(ready.problem, fit, course, ())
    sizes = {e.symbol: e for e in found.estimates}
    assert {s: e.value for s, e in sizes.items()} == pytest.approx(expected, rel=0.03)
    assert all(e.low < e.value < e.high for e in sizes.values())
    assert found.left < 0.05 * fit.cost


def test_a_switch_is_found_to_within_a_few_samples() -> None:
    ready = prepare(drive(braked), AXIS, Options())
    course = change(ready.problem, refit(ready.problem, ready.model))
    assert course is not None
    on = np.flatnonzero(np.abs(course.forces[0]) > 0.0)
    assert (on[0] * DT, on[-1] * DT) == pytest.approx((1.7, 4.4), abs=0.03)


def test_a_sagging_supply_beside_friction_is_said_and_not_named() -> None:
    verdict = analyse(drive(sagged), AXIS, Options(pictures=False))
    assert verdict.outcome is Outcome.UNEXPLAINED
    assert [e.name for e in verdict.effects] == ["coulomb"]
    assert verdict.effects[0].parameters[0].value == pytest.approx(0.4, rel=0.02)
    assert [t.name for t in verdict.symbolic] == ["term_switch"]
    assert "gain of the drive switches in time, on in run: 3." in verdict.symbolic[0].evidence[0]
    gap = next(g for g in verdict.gaps if g.channel == "force, closed loop")
    assert gap.after < 0.15 * gap.before
    assert not gap.known  # what the switch leaves is no noise


def test_a_change_is_believed_where_the_axis_keeps_it_and_the_loop_is_no_faster(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quick = Options(pictures=False)
    s = _explained(prepare(drive(picked), AXIS, quick), quick)
    assert _changed(s) is not None
    assert _changed(replace(s, ready=replace(s.ready, points=True))) is None

    def promised(*given: object) -> Course:
        course = settled(*given)  # type: ignore[arg-type]
        return replace(course, forces=tuple(0.0 * f for f in course.forces))

    monkeypatch.setattr(axis, "settled", promised)
    assert _changed(s) is None
