"""A resonator whose period is nine rows of its log, against an integrator of another author, and fitted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sioms.reconcile.fit import refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.sampling import Sampling, read_as
from sioms.reconcile.simulate import pack, released

Array = NDArray[np.float64]
INERTIA, DAMPING, STIFFNESS, CUBIC, ROW_S = 5.17e-6, 2.157e-4, 0.953, 3.79, 0.0016384
MODEL = AxisModel(
    False, ROW_S, INERTIA, DAMPING, 0.0, 1.0, 0.1, 100.0, driven=False,
    effects={"spring": {"k": STIFFNESS}, "hardening_spring": {"k3": CUBIC}},
)  # fmt: skip
TONES = np.array([11.0, 38.0, 59.0, 68.0, 71.0, 83.0, 97.0, 118.0])


@cache
def swing(held: bool, rows: int = 1500) -> tuple[Array, Array]:
    """Return force and place of every row: a sum of tones, or that held from row to row."""
    phase = np.random.default_rng(3).uniform(0.0, 2.0 * np.pi, len(TONES))

    def force(t: float) -> float:
        at = np.floor(t / ROW_S + 1e-9) * ROW_S if held else t
        return 0.008 * float(np.sum(np.sin(2.0 * np.pi * TONES * at + phase)))

    def rates(t: float, y: Array) -> tuple[float, float]:
        x, v = y
        return v, (force(t) - DAMPING * v - STIFFNESS * x - CUBIC * x**3) / INERTIA

    t, y, place = np.arange(rows) * ROW_S, np.zeros(2), np.zeros(rows)
    for i in range(rows - 1):  # from row to row, as a held force leaps there
        ends = t[i], t[i + 1] - 1e-7 * ROW_S
        y = solve_ivp(rates, ends, y, method="DOP853", rtol=1e-8, atol=1e-11).y[:, -1]
        place[i + 1] = y[0]
    return np.array([force(at) for at in t]), place


@pytest.mark.parametrize("held", [True, False])
def test_steps_follow_the_motion_and_the_force_between_rows(held: bool) -> None:
    force, place = swing(held)
    record = Record("swing", place, force)
    if not held:
        (record,) = read_as(Session((record,)), Sampling(0.0, curved=True)).records
    run = released(pack(replace(MODEL, swings_hz=70.0)), record.force, np.zeros(7), bends=record.bends)
    assert np.std(run.position - place) < 3e-3 * np.std(place)


def test_a_resonator_is_fitted_to_a_thousandth() -> None:
    force, place = swing(False)
    noisy = place + np.random.default_rng(5).normal(scale=2e-5, size=len(place))
    stated = replace(MODEL, driven=True, inertia=0.95 * INERTIA, resolution=1e-7, refine=("inertia", "viscous"))
    ready = prepare(Session((Record("swing", noisy, force),), loop_time_s=1e-3 * ROW_S), stated, Options())
    assert ready.model.swings_hz == pytest.approx(70.0, abs=12.0)
    fit = refit(ready.problem, ready.model, iterations=20)
    assert fit.model.inertia == pytest.approx(INERTIA, rel=2e-3)
    assert fit.model.effects["hardening_spring"]["k3"] == pytest.approx(CUBIC, rel=5e-3)
