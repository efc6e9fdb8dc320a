"""A resonator whose motion reaches the highest frequencies of its log: its noise, its stated spring, what repeats.

It is integrated here by itself: a mass on a spring that hardens, driven up to 200 Hz and logged at 610.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.effects import library
from sioms.reconcile.evidence import spans_of
from sioms.reconcile.fit import free_parameters, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import moves_at, sensor_noise
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refine import bounded
from sioms.reconcile.search import Searcher
from sioms.reconcile.steps import halved
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


def test_a_spring_stated_just_inside_its_bound_has_as_much_room_as_an_inertia() -> None:
    (_, most) = STATED.bounds("spring", library()["spring"].parameters[0])
    stated = STATED.with_effect("spring", {"k": 0.95 * most})
    ready = bounded(stated)
    assert ready.bounds("spring", library()["spring"].parameters[0]) == (0.0, WITHIN * 0.95 * most)
    assert not bounded(STATED.with_effect("spring", {"k": 0.2 * most})).within
    two = STATED.with_effect("elastic", {"f_res": 20.0, "load_fraction": 0.9, "zeta": 0.05})
    assert not any("load_fraction" in name for name in bounded(two).within), "nothing is behind more than all of it"


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


def steady(stiffness: float, seed: int = 100, rows: int = 6000) -> Record:
    """A linear resonator in its steady state, by its response to each sine: no step of time is in it."""
    rng, n, h = np.random.default_rng(seed), rows * 16, PERIOD_S / 32
    f = np.fft.rfftfreq(n, h)
    w = 2.0 * np.pi * f
    force = np.where((f > 0.0) & (f < 150.0), np.exp(2j * np.pi * rng.random(len(f))), 0.0)
    force *= 0.022 / np.std(np.fft.irfft(force, n))
    place = np.fft.irfft(force / (stiffness - INERTIA * w**2 + 1j * DAMPING * w), n)[::16]
    noise = rng.normal(scale=1e-3 * np.std(place), size=rows)
    return Record("steady", place + noise, np.fft.irfft(force, n)[::16])


@pytest.mark.parametrize("seed", [100, 101, 102])
def test_the_interval_of_a_stiffness_has_room_for_the_steps_of_its_simulation(seed: int) -> None:
    """Steps make a spring 0.015 % softer in the fit, where the noise leaves 0.005 %."""
    model = replace(STATED, sample_time_s=0.5 * PERIOD_S)
    ready = prepare(Session((steady(STIFFNESS, seed),)), model, Options())
    coarse = refit(ready.problem, ready.model)
    fit, changed = halved(ready.problem, coarse, ())
    (low, high), found = spans_of(ready.problem, fit)["spring", "k"], fit.model.effects["spring"]["k"]
    assert abs(coarse.model.effects["spring"]["k"] - STIFFNESS) > 0.5 * (high - low)
    assert abs(found - STIFFNESS) < np.hypot(0.5 * (high - low), changed["spring", "k"])
    assert fit.model.swings_hz == coarse.model.swings_hz


def test_steps_that_an_effect_decides_stay_as_they_are() -> None:
    slow = replace(STATED, swings_hz=0.5)
    ready = prepare(Session((swing(0.0),)), STATED, Options())
    fit = refit(ready.problem, slow, (), 1)
    assert halved(ready.problem, fit, ()) == (fit, {})
