"""Refined numbers of the nominal model do not run away, and are those that predict.

The machines are integrated here by themselves: a joint that its weight pulls down, a cart from which a load hangs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.fit import Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import observer
from sioms.reconcile.prepare import Options, Prepared, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refine import ahead, bounded, nearest, runs_away, settled
from sioms.reconcile.refusals import needed
from sioms.reconcile.simulate import pack, released
from sioms.reconcile.thresholds import WITHIN

Array = NDArray[np.float64]
FINE = 20
#: What hangs from the cart [kg], and how deep [m].
LOAD, LENGTH = 0.12, 0.3
JOINT = AxisModel(True, 0.01, 0.8, 1.6, 1e-5, 2.0 * np.pi, 14.0, 2.0, refine=("inertia", "viscous"))
CART = AxisModel(False, 0.002, 0.24, 1.5, 1e-6, 0.1, 2.0, 1.0, refine=("inertia", "viscous"))


def joint(seed: int) -> Record:
    """A heavy joint that is moved slowly by a controller that nobody knows; its current is measured, with noise."""
    rng, dt, n = np.random.default_rng(seed), JOINT.sample_time_s, 2400
    t = np.arange(n) * dt
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    sizes, speeds = np.array([0.7, 0.3, 0.1]), 2.0 * np.pi * np.array([0.07, 0.19, 0.41])
    wanted = np.sin(np.outer(t, speeds) + phases) @ sizes - 1.57
    x, v, place, drive = wanted[0], 0.0, np.empty(n), np.empty(n)
    for i in range(n):
        speed = (wanted[min(i + 1, n - 1)] - wanted[i]) / dt
        place[i] = x
        drive[i] = 10.6 * math.sin(x + 1.57) + 150.0 * (wanted[i] - x) + 20.0 * (speed - v)
        for _ in range(FINE):
            a = (drive[i] - 10.6 * math.sin(x + 1.57) - 1.6 * v - 0.8 * math.tanh(v / 0.01)) / 0.8
            v += dt / FINE * a
            x += dt / FINE * v
    read = place + rng.normal(scale=2e-5, size=n)
    return Record(f"joint {seed}", read, drive + rng.normal(scale=0.15, size=n))


def cart(seed: int) -> Record:
    """A cart with a pendulum that hangs from it and swings along; nothing of it is recorded."""
    rng, dt, n = np.random.default_rng(seed), CART.sample_time_s, 3000
    steps = np.repeat(rng.uniform(-0.25, 0.25, 6), n // 6)
    x = v = q = w = 0.0
    place, drive = np.empty(n), np.empty(n)
    for i in range(n):
        place[i], drive[i] = x, np.clip(12.0 * (steps[i] - x), -6.0, 6.0)
        for _ in range(FINE):
            s, c = math.sin(q), math.cos(q)
            push, turn = drive[i] - 1.5 * v + LOAD * LENGTH * w * w * s, -LOAD * 9.81 * LENGTH * s - 2e-4 * w
            whole, cross, own = 0.24 + LOAD, LOAD * LENGTH * c, LOAD * LENGTH**2
            part = whole * own - cross**2
            a, b = (own * push - cross * turn) / part, (whole * turn - cross * push) / part
            v, w = v + dt / FINE * a, w + dt / FINE * b
            x, q = x + dt / FINE * v, q + dt / FINE * w
    return Record(f"cart {seed}", place + rng.normal(scale=1e-5, size=n), drive)


@cache
def prepared(machine: Callable[[int], Record]) -> Prepared:
    """Read two records of a machine as a search does."""
    model = JOINT if machine is joint else CART
    return prepare(Session((machine(1), machine(2))), model, Options(pictures=False))


def test_an_inertia_keeps_its_bounds_while_the_weight_is_missing() -> None:
    """Without bounds it grows until the model does not listen to its force, and hides what is missing."""
    problem = prepared(joint).problem
    assert refit(problem, JOINT).model.inertia > 10.0 * JOINT.inertia
    held = refit(problem, bounded(JOINT))
    assert held.model.inertia <= WITHIN * JOINT.inertia
    assert runs_away(held.model)
    assert held.cost > 2.0 * refit(problem, JOINT).cost, "what is missing shows"
    begins = replace(prepared(joint).model, swings_hz=JOINT.swings_hz)
    assert begins == bounded(JOINT), "that is where a search begins"


def test_beside_the_weight_the_inertia_is_that_of_the_joint() -> None:
    problem = prepared(joint).problem
    seen = bounded(JOINT).with_effect("gravity", {"amp": 9.0, "phase": -1.5}).with_effect("coulomb", {"Fc": 0.5})
    fit = settled(problem, JOINT, refit(problem, seen), ())
    assert fit.model.inertia == pytest.approx(JOINT.inertia, rel=0.1)
    assert not runs_away(fit.model)


def test_what_is_refined_predicts_no_worse_than_what_was_stated() -> None:
    """The load that swings along shows in short windows as inertia; over a second it is none."""
    ready = prepared(cart)
    windows = refit(ready.problem, ready.model)
    fit = settled(ready.problem, CART, windows, ())
    assert ahead(ready.final, fit.model) < 0.8 * ahead(ready.final, windows.model)
    assert ahead(ready.final, fit.model) < ahead(ready.final, CART)
    assert fit.model.refine == (), "a last fit to short windows must not undo it"


def test_a_search_goes_back_to_what_predicted_better() -> None:
    """A spring that is not there saves something in short windows of the cart."""
    problem = prepared(cart).problem
    worse = CART.with_effect("spring", {"k": 20.0})
    assert nearest(problem, worse, [CART, worse]) == CART
    assert nearest(problem, CART, [CART, worse]) is None


def test_what_untouched_samples_do_not_need_is_no_finding() -> None:
    """A wave that was there while the search looked, and not after it."""
    t = np.arange(4000) * CART.sample_time_s
    push = 2.0 * np.sin(2.0 * np.pi * 0.7 * t) + np.sin(2.0 * np.pi * 2.3 * t)
    start, still = np.zeros(7), np.zeros(len(t))
    dry = replace(CART, refine=(), effects={"coulomb": {"Fc": 0.3}})
    cut = int(0.8 * len(t))
    place = released(pack(dry), push, start, still).position
    wave = np.where(np.arange(len(t)) < cut, 0.2 * np.sin(2.0 * np.pi * place / CART.pitch), 0.0)
    record = Record("run", released(pack(dry), push, start, wave).position, push)
    noise = observer(replace(CART, refine=()), 1e-6, 0.01)
    problems = tuple(Problem(Session((record,)), noise, begin=a, end=b) for a, b in ((0.0, 0.8), (0.8, 1.0)))
    model = dry.with_effect("cogging", {"amp": 0.2, "phase": 0.0, "n": 1.0, "amp2": 0.0, "phase2": 0.0})
    fit = refit(problems[0], model)
    assert needed((problems[0], problems[1]), fit.model, "coulomb")
    assert not needed((problems[0], problems[1]), fit.model, "cogging")
