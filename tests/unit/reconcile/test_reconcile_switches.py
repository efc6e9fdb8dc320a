"""Switches in time, and the rules that keep a change in time from passing for something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import observer
from sioms.reconcile.plausible import physical, small
from sioms.reconcile.records import Record, Session
from sioms.reconcile.report.words import span
from sioms.reconcile.scale import check_scale
from sioms.reconcile.simulate import simulate
from sioms.reconcile.switches import Switches, _Sized, _Trials
from sioms.reconcile.verdict import Estimate
from sioms.reconcile.windows import NUMBERS, Seen, View

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-5, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
T = np.arange(3000) * 1e-3
COMMAND = 3.5 * np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)


def recorded(world: AxisModel, noise: float = 2e-3) -> Problem:
    run = simulate(world, COMMAND)
    return Problem(Session((Record("run", run.position, run.force, COMMAND),)), observer(AXIS, 1e-5, noise))


def test_a_course_of_two_values_is_what_its_switches_say() -> None:
    switches = Switches((False, True), ((2, 5), (3,)))
    assert switches.on(0, 7).tolist() == [0, 0, 1, 1, 1, 0, 0]
    assert switches.on(1, 5).tolist() == [1, 1, 1, 0, 0]
    assert switches.turned().on(0, 7).tolist() == [1, 1, 0, 0, 0, 1, 1]
    assert not Switches((True, True), ((), ())).any()
    assert Switches((False, True), ((), ())).any()


def test_fewer_switches_leave_the_rest_as_it_was() -> None:
    left = {tuple(s.on(0, 9)) for s in Switches((False,), ((2, 4, 7),)).fewer()}
    assert left == {
        (1, 1, 1, 1, 0, 0, 0, 1, 1),
        (0, 0, 1, 1, 0, 0, 0, 0, 0),
        (0, 0, 0, 0, 0, 0, 0, 1, 1),
        (0, 0, 1, 1, 1, 1, 1, 1, 1),
    }


def test_only_regular_switches_go_on() -> None:
    assert Switches((False,), ((100, 200, 301),)).continued([520]).edges == ((100, 200, 301, 402, 502),)
    assert Switches((False,), ((100, 200, 350),)).continued([900]).edges == ((100, 200, 350),)


def test_an_answer_to_a_force_knows_of_a_payload() -> None:
    """The innovation that a small force makes in the simulation is the one of the linear filter."""
    loaded = AXIS.with_effect("payload", {"J_extra": 1.5e-3})
    problem = recorded(loaded)
    force = 1e-3 * np.sin(2 * np.pi * 7.0 * T)
    (bare,) = problem.runs(loaded)
    record = replace(problem.session.records[0], external=force)
    (pushed,) = replace(problem, session=Session((record,))).runs(loaded)
    answer = problem.answer(loaded, force)
    np.testing.assert_allclose(
        answer[100:], (bare.innovation - pushed.innovation)[100:], atol=0.03 * np.abs(answer).max()
    )


def test_dry_friction_at_rest_holds_against_the_drive_up_to_its_level() -> None:
    dry = next(n for n in NUMBERS if n.symbol == "Fc")
    u, v = np.array([0.1, -0.1, 0.9, 0.1]), np.array([0.0, 0.0, 0.0, 2.0])
    seen = Seen(u, v, np.zeros(4), False, 1.0, 1e-3)
    assert 0.5 * dry.column(seen, 0.5) == pytest.approx([-0.1, 0.1, -0.5, -0.5])


@pytest.mark.parametrize(("tau", "possible"), [(0.5, False), (3.0, True), (1e4, True)])
def test_a_drive_does_not_warm_up_in_no_time(tau: float, possible: bool) -> None:
    fit = Fit(AXIS.with_effect("thermal_gain", {"loss": 0.2, "tau": tau}), (), np.zeros(3), np.zeros((3, 0)))
    assert physical(fit, "thermal_gain") is possible


def test_a_gap_within_a_step_of_the_sensor_is_none() -> None:
    gap = {"gap": 1.5e-3, "load_fraction": 0.5, "f_contact": 100.0, "zeta": 0.1}
    assert not small(AXIS.with_effect("backlash", gap), "backlash")
    assert small(replace(AXIS, resolution=2e-3).with_effect("backlash", gap), "backlash")


@pytest.mark.parametrize(("factor", "said"), [(1.5, False), (6.3, True)])
def test_an_inertia_that_is_hardly_a_payload_is_said(factor: float, said: bool) -> None:
    problem = recorded(replace(AXIS, inertia=factor * AXIS.inertia))
    notes = check_scale(problem, AXIS)
    assert bool(notes) is said
    assert not said or "turns for radians" in notes[0]


@pytest.mark.parametrize(
    ("value", "half", "said"),
    [(3.0, 1e-4, ("3.00000", "2.99990", "3.00010")), (6.465, 0.023, ("6.465", "6.442", "6.488"))],
)
def test_an_interval_has_the_digits_that_show_it(value: float, half: float, said: tuple[str, ...]) -> None:
    shown = span(Estimate("Fc", value, value - half, value + half, "N", ""))
    assert tuple(map(float, shown)) == pytest.approx(tuple(map(float, said)), rel=1e-9)
    assert len(set(shown)) == 3


def test_trials_of_switches_leave_what_a_fit_of_all_columns_leaves() -> None:
    """The products of each record add up to the fit; records whose switches are as before are not looked at again."""
    runs = [recorded(AXIS.with_effect("coulomb", {"Fc": level})).session.records[0] for level in (0.05, 0.03)]
    problem = Problem(Session(tuple(replace(r, name=str(i)) for i, r in enumerate(runs))), observer(AXIS, 1e-5, 2e-3))
    view = View(problem, refit(problem, AXIS.with_effect("viscous", {"b_extra": 1e-3})))
    dry = next(n for n in NUMBERS if n.symbol == "Fc")
    switches = Switches((False, True), ((900, 1700), (1200,)))
    sized = _Sized.of(view, [dry], switches)
    trials = _Trials(view, sized)
    for trial in (switches, switches.put(1, (1300,), True), switches.put(0, (), False)):
        assert trials.left(trial) == pytest.approx(_Sized.of(view, [dry], trial, sized.sizes).left, rel=1e-6)
    assert len(trials.known) == 4
