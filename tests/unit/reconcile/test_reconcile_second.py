"""Two masses of which only the motor shows in short windows: the load swings far below what the force is made of."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.reconcile.fit import Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import observer
from sioms.reconcile.records import Record, Session
from sioms.reconcile.second import nearer, off, second

DT = 5e-4
#: The model knows the motor alone; what it turns is ten times as heavy, on a soft coupling, with friction of its own.
MOTOR = AxisModel(True, DT, 0.01, 0.14, 1e-6, 2.0 * np.pi, 14.0, 12.0, refine=("inertia", "viscous"))
LOAD, STIFF, LOSS, DRAG = 0.1, 4.5, 5e-4, 0.4
RINGS_HZ = np.sqrt(STIFF * (1.0 / 0.01 + 1.0 / LOAD)) / (2.0 * np.pi)


def bench() -> Record:
    """Drive it by sines from 11 to 250 Hz of random phases, under a slow disturbance."""
    rng, n, fine = np.random.default_rng(5), 6000, 4
    t = np.arange(n) * DT
    tones = np.arange(11.0, 250.0, 4.0)
    force = 1.2 * np.cos(2.0 * np.pi * np.outer(t, tones) + rng.uniform(0.0, 2.0 * np.pi, len(tones))).sum(axis=1)
    slow = np.convolve(rng.standard_normal(n), np.exp(-np.arange(400) * DT / 0.05), "full")[:n]
    push = force + 0.1 * slow / slow.std()
    x = v = y = w = 0.0
    place = np.empty(n)
    for i in range(n):
        place[i] = x
        for _ in range(fine):
            between = STIFF * (x - y) + LOSS * (v - w)
            v += DT / fine * (push[i] - between - 0.14 * v) / 0.01
            w += DT / fine * (between - DRAG * w) / LOAD
            x, y = x + DT / fine * v, y + DT / fine * w
    return Record("bench", place + rng.normal(scale=1e-5, size=n), force)


def test_a_slow_second_mass_is_found_by_free_runs() -> None:
    session, noise = Session((bench(),)), observer(MOTOR, 1e-5, 0.3)
    searched, untouched = (Problem(session, noise, begin=a, end=b) for a, b in ((0.0, 0.8), (0.8, 1.0)))
    rigid = refit(searched, MOTOR)
    fit = second(searched, rigid, MOTOR, ())
    assert fit is not None
    assert off(untouched, fit.model) < 0.5 * off(untouched, rigid.model)
    assert fit.model.effects["elastic"]["f_res"] == pytest.approx(RINGS_HZ, rel=0.3)
    assert second(searched, fit, MOTOR, ()) is None, "that runs free near enough"


@pytest.mark.parametrize(
    ("now", "counts"),
    [
        ((0.5, 1.0, 9.0), True),
        ((0.8, 0.5, 9.0), False),  # hardly nearer over short segments
        ((0.5, 1.2, 9.0), False),  # farther off over longer ones
        ((0.5, 1.0, 20.0), True),  # where nothing was predicted before
    ],
)
def test_a_second_mass_is_no_farther_off_where_anything_was_predicted(now: tuple[float, ...], counts: bool) -> None:
    assert nearer((1.0, 1.0, 9.0), now, (2.0, 4.0, 8.0)) is counts
    assert nearer((1.0, np.inf, 9.0), now, (2.0, 0.0, 8.0)) is (now[0] < 0.7), "no record holds longer segments"
