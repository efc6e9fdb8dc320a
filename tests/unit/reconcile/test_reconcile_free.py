"""A model that nothing holds: how far it comes, what noise makes of it, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.disturbance import Disturbance, disturbance
from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.floor import ON_MODEL, closed_floor
from sioms.reconcile.free import freely
from sioms.reconcile.gaps import free_gaps, measure
from sioms.reconcile.judge import Judgement, judge, less_than_none, power_given
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import observer
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import pack, released, replay

DT, COUNT = 1e-3, 8000
LOOP = Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
AXIS = AxisModel(True, DT, 2e-3, 1e-3, 2e-5, 2.0 * np.pi, 0.7, 20.0, LOOP)
#: A mass on a spring, 22 Hz, whose free vibration lasts a quarter of a second, and no controller.
RESONATOR = AxisModel(False, DT, 1.0, 8.0, 1e-7, 0.01, 100.0, 0.5).with_effect("spring", {"k": 2e4})
HARD = RESONATOR.with_effect("hardening_spring", {"k3": 4e8})


def coloured(size: float, seed: int) -> Array:
    """Return a force of so much root mean square, most of it slow."""
    white = np.random.default_rng(seed).standard_normal(COUNT)
    slow = np.convolve(white, np.exp(-np.arange(200) * DT / 0.02), "full")[:COUNT]
    return np.asarray(size * slow / slow.std())


def swung(world: AxisModel, noise: float = 0.0, drive: float = 40.0) -> Problem:
    """Record what moves freely under a force of many frequencies."""
    force = coloured(drive, 1)
    start = np.array([0.0, 0.0, 0.0, 0.0, force[0], 0.0, 0.0])
    run = released(pack(world), force, start, coloured(noise, 2) if noise else None)
    record = Record("swung", run.position, force)
    return Problem(Session((record,)), observer(replace(world, effects={}), 1e-7, max(noise, 0.1)))


def looped(world: AxisModel, noise: float, seed: int = 3) -> Problem:
    """Record a closed loop under a force that is no part of the record."""
    t = np.arange(COUNT) * DT
    command = 3.5 * np.sin(2.0 * np.pi * 0.5 * t) + 0.4 * np.sin(2.0 * np.pi * 3.1 * t)
    asked = Record("looped", command, np.zeros(COUNT), command, external=coloured(noise, seed))
    run = replay(world, asked)
    record = Record("looped", run.position, run.force, command)
    return Problem(Session((record,)), observer(AXIS, 1e-5, 1e-3))


def judged(problem: Problem, nominal: AxisModel, model: AxisModel, explained: float = 0.0) -> Judgement:
    """Judge a model as a verdict does."""
    rng = np.random.default_rng(1)
    noise = disturbance(problem, model, explained)
    gaps = measure(problem, nominal, model, closed_floor(problem, model, noise, rng))
    free = freely((problem, problem), (nominal, model), noise, rng)
    return judge(problem, model, free, gaps, noise.size)


def test_a_hardening_spring_shows_in_the_free_run_alone() -> None:
    problem = swung(HARD, noise=0.5)
    assert any("of the motion" in r for r in judged(problem, RESONATOR, RESONATOR).refusals)
    assert judged(problem, RESONATOR, HARD).refusals == ()


def test_a_model_that_predicts_worse_than_the_nominal_one_is_refused() -> None:
    """However little it leaves above the floor, and whatever short windows say."""
    problem = swung(RESONATOR, noise=0.5)
    off = RESONATOR.with_effect("payload", {"J_extra": 0.03})
    assert any("no correction" in r for r in judged(problem, RESONATOR, off).refusals)
    assert judged(problem, off, RESONATOR).refusals == ()
    closed = looped(AXIS, 1e-3)
    assert any("no correction" in r for r in judged(closed, AXIS, AXIS.with_effect("coulomb", {"Fc": 0.02})).refusals)


@pytest.mark.parametrize(("world", "share"), [(RESONATOR, 0.34), (HARD, 0.5)])
def test_the_floor_of_a_free_run_is_right_within_a_third(world: AxisModel, share: float) -> None:
    problem = swung(world, noise=0.5)
    found = freely((problem, problem), (world, world), disturbance(problem, world, 0.0), np.random.default_rng(1))
    assert [f.horizon_s for f in found] == [0.25, 1.0, np.inf]
    for f in found[:2]:
        assert f.after == f.before == pytest.approx(f.floor, rel=share)
    assert [g.floor for g in free_gaps(found, "m")] == [f.floor for f in found]


@pytest.mark.parametrize("effects", [{}, {"coulomb": {"Fc": 0.06}}, {"gravity": {"amp": 0.1, "phase": 0.3}}])
def test_the_floor_of_a_closed_loop_is_right_within_a_third(effects: dict[str, dict[str, float]]) -> None:
    """The linear loop under white noise told a quarter of it: most of what pushes a machine is slow."""
    world = replace(AXIS, effects=effects)
    problem = looped(world, 4e-3)
    floor = closed_floor(problem, world, disturbance(problem, world, 0.0), np.random.default_rng(1))
    force = next(g for g in measure(problem, world, world, floor) if g.channel == "force, closed loop")
    assert floor.how == ON_MODEL
    assert force.after == pytest.approx(force.floor, rel=0.34)


def test_what_the_state_explains_is_no_noise() -> None:
    problem = looped(AXIS.with_effect("coulomb", {"Fc": 0.06}), 1e-3)
    floors = [
        closed_floor(problem, AXIS, disturbance(problem, AXIS, share), np.random.default_rng(1)).force
        for share in (0.0, 0.99)
    ]
    assert floors[1] < 0.2 * floors[0]


def test_a_drawn_disturbance_has_its_spectrum() -> None:
    at = np.linspace(0.0, 500.0, 501)
    noise = Disturbance(DT, at, np.where(at < 50.0, 0.02, 0.0))
    drawn = noise.drawn(200_000, np.random.default_rng(1))
    assert np.std(drawn) == pytest.approx(1.0, rel=0.03)
    assert noise.size == pytest.approx(1.0, rel=0.03)
    assert np.std(np.diff(drawn)) < 0.3


def test_a_cruise_in_which_nothing_changes_is_not_refused() -> None:
    """Beside a constant speed there is no motion that noise could be small against."""
    turning = replace(AXIS, controller=None, viscous=2e-3)
    force, start = np.full(COUNT, 0.02), np.array([0.0, 10.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    run = released(pack(turning), force, start, coloured(4e-4, 5))
    problem = Problem(Session((Record("cruise", run.position, force),)), observer(AXIS, 1e-5, 1e-3))
    assert judged(problem, turning, turning).refusals == ()


def test_friction_above_the_force_that_moved_the_machine_is_refused() -> None:
    turning = replace(AXIS, controller=None, viscous=2e-3)
    force = 0.02 + 0.005 * np.sign(np.sin(2.0 * np.pi * np.arange(COUNT) * DT))
    start = np.array([0.0, 10.0, 0.0, 0.0, force[0], 0.0, 0.0])
    run = released(pack(turning), force, start)
    problem = Problem(Session((Record("one way", run.position, force),)), observer(AXIS, 1e-5, 1e-3))
    model = replace(turning, viscous=0.0).with_effect("coulomb", {"Fc": 0.03})
    assert any("at rest" in r for r in judged(problem, turning, model).refusals)
    assert judged(problem, turning, turning).refusals == ()


def test_energy_from_nowhere_is_refused() -> None:
    problem = looped(AXIS, 1e-3)
    assert power_given(problem, AXIS) < 0.0
    assert power_given(problem, AXIS.with_effect("coulomb", {"Fc": 0.05})) < power_given(problem, AXIS)
    odd = AXIS.with_effect("viscous", {"b_extra": -4e-3})
    assert power_given(problem, odd) > 0.02
    assert any("energy" in r for r in judged(problem, AXIS, odd).refusals)
    # what helps one way and hinders the other
    assert power_given(problem, AXIS.with_effect("viscous_direction", {"b_dir": 5e-3})) <= 0.0
    # what depends on the place alone gives back what it takes
    unstable = AXIS.with_effect("spring", {"k": -0.1})
    assert power_given(problem, unstable) == pytest.approx(power_given(problem, AXIS))


def test_dry_friction_that_would_be_less_than_none_is_refused() -> None:
    """What lowers friction as the axis runs in cannot take more than there is: cut off, it bends another law."""
    problem = looped(AXIS.with_effect("coulomb", {"Fc": 0.05}), 1e-3)
    ran_in = AXIS.with_effect("warming_friction", {"g": -2e-3, "tau": 1.0})
    beside = ran_in.with_effect("coulomb", {"Fc": 0.05})
    assert less_than_none(problem, AXIS) == 0.0 == less_than_none(problem, beside)
    assert less_than_none(problem, ran_in) > 0.9
    below = ran_in.with_effect("load_friction", {"mu": 0.02})
    assert less_than_none(problem, below) > 0.1
    assert any("less than none" in r for r in judged(problem, AXIS, below).refusals)
    assert not any("less than none" in r for r in judged(problem, AXIS, beside).refusals)
