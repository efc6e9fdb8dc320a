"""A resonator whose motion reaches the highest frequencies of its log: its noise, its stated spring, what repeats.

It is integrated here by itself: a mass on a spring that hardens, driven up to 200 Hz and logged at 610.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.fit import free_parameters, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import moves_at, sensor_noise
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.search import Searcher
from sioms.reconcile.thresholds import WITHIN

Array = NDArray[np.float64]
INERTIA, DAMPING, STIFFNESS, CUBIC = 5.17e-6, 2.157e-4, 0.953, 3.79
PERIOD_S, FINE, NOISE = 0.0016384, 8, 2e-5
#: The stated spring is larger than any is sought: five times rated force over pitch.
STATED = AxisModel(False, PERIOD_S, INERTIA, DAMPING, 1e-6, 1.0, 0.1, 100.0, effects={"spring": {"k": 0.9 * STIFFNESS}})


@cache
def swing(cubic: float, rows: int = 3000) -> Record:
    rng, n, h = np.random.default_rng(7), rows * FINE, PERIOD_S / FINE
    f = np.fft.rfftfreq(n, h)
    u = np.fft.irfft(np.where((f > 0.0) & (f < 200.0), np.exp(2j * np.pi * rng.random(len(f))), 0.0), n)
    u *= 0.022 / np.std(u)
    x = v = 0.0
    place = np.empty(rows)
    for i in range(n):  # semi-implicit Euler with 8 steps in a row
        if i % FINE == 0:
            place[i // FINE] = x
        v += h * (u[i] - DAMPING * v - STIFFNESS * x - cubic * x**3) / INERTIA
        x += h * v
    return Record("swing", place + rng.normal(scale=NOISE, size=rows), u[::FINE])


def test_motion_up_to_the_highest_frequencies_is_no_noise_of_the_sensor() -> None:
    session = Session((swing(0.0),))
    assert sensor_noise(session, 0.0) == pytest.approx(NOISE, rel=0.2)
    assert 50.0 < moves_at(session, NOISE, PERIOD_S) < 90.0


def test_a_wrong_reading_now_and_then_is_no_noise_of_the_sensor() -> None:
    rng, t = np.random.default_rng(1), np.arange(6000) * 1e-3
    place = np.sin(2.0 * np.pi * t) + rng.normal(scale=1e-4, size=len(t))
    place[[1500, 4000]] += 3.0
    assert sensor_noise(Session((Record("r", place, np.zeros(len(t))),)), 0.0) == pytest.approx(1e-4, rel=0.1)


def test_a_stated_spring_larger_than_any_that_is_sought_is_fitted() -> None:
    ready = prepare(Session((swing(0.0),)), STATED, Options())
    (spring,) = (f for f in free_parameters(ready.model) if f.effect == "spring")
    assert spring.upper == pytest.approx(WITHIN * 0.9 * STIFFNESS)
    fit = refit(ready.problem, ready.model)
    assert fit.model.effects["spring"]["k"] == pytest.approx(STIFFNESS, rel=0.02)


@pytest.mark.parametrize(("order", "told"), [(2.0, False), (5.0, True)])
def test_a_wave_has_a_name_where_the_travel_holds_enough_of_its_periods(order: float, told: bool) -> None:
    session = Session((swing(CUBIC),))
    travel = float(np.ptp(session.records[0].position))
    model = replace(STATED, pitch=2.5 * travel)
    ready = prepare(session, model, Options())
    searcher = Searcher(ready.problem, (), ready.names)
    wave = {"amp": 0.01, "phase": 0.3, "n": order, "amp2": 0.0, "phase2": 0.0}
    bare = searcher.fit(ready.model, 1)
    new = replace(bare, model=ready.model.with_effect("cogging", wave))
    assert searcher.may_leave(new, bare) is told
