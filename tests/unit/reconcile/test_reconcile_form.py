"""A name says how a force goes with its variable: where a law of any form does better, the name is gone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.fit import Problem
from sioms.reconcile.form import of_any_form
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import drive_noise, observer, sensor_noise
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refusals import dwarfed, formulas
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.simulate import replay, simulate
from sioms.reconcile.swings import swinging
from sioms.reconcile.verdict import NamedEffect
from sioms.reconcile.windows import NUMBERS, View

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
T = np.arange(4000) * 1e-3
COMMAND = 3.5 * np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)
LAW = "term_friction_by_force"


def problem(world: AxisModel, seed: int = 4) -> Problem:
    """Record a world with the small noises of a good axis."""
    rng = np.random.default_rng(seed)
    run = simulate(world, COMMAND)
    measured = run.applied + 2e-3 * rng.standard_normal(len(T))
    s = Session((Record("made", run.position, run.force, COMMAND, measured),))
    return Problem(s, observer(AXIS, sensor_noise(s, AXIS.resolution), drive_noise(s, AXIS.rated_force)))


def formed(world: AxisModel, named: AxisModel) -> Found:
    s = Searcher(problem(world), names=("load_friction", "coulomb", "viscous"))
    fit = s.fit(named)
    return of_any_form(s, Found(fit, s.loss(fit), ()))


SQUARE = AXIS.with_effect("load_square_friction", {"g": 0.2})
LINEAR = AXIS.with_effect("load_friction", {"mu": 0.2})


def test_friction_of_another_form_than_its_name_is_a_law_without_one() -> None:
    """F = g u^2 told as mu |u|: at the places that the force came to, the law comes to g u^2."""
    found = formed(SQUARE, AXIS.with_effect("load_friction", {"mu": 0.1}))
    assert list(found.fit.model.effects) == [LAW]
    law = found.fit.model.effects[LAW]
    for symbol, at in (("s3", -2), ("s5", 1), ("s6", 2), ("s7", 3), ("s8", 4)):
        assert law[symbol] == pytest.approx(0.2 * (at * law["step"]) ** 2, rel=0.1, abs=5e-3), symbol
    assert found.path[-1].action == "form"


def test_a_name_of_the_right_form_stays() -> None:
    found = formed(LINEAR, AXIS.with_effect("load_friction", {"mu": 0.1}))
    assert list(found.fit.model.effects) == ["load_friction"]
    assert found.fit.model.effects["load_friction"]["mu"] == pytest.approx(0.2, rel=0.02)


def effect(name: str, saved: float = 0.5) -> NamedEffect:
    return NamedEffect(name, name.title(), "", "", (), saved, 9.0, None, ())


def test_beside_a_formula_that_explains_far_more_a_small_effect_may_be_its_error() -> None:
    """Of 99 squares that a formula takes off for one that is left, its form may be wrong by two."""
    term = effect("term_dull_force", 0.99)
    assert dwarfed(effect("swinging_load", 0.4), [term])
    assert not dwarfed(effect("payload", 0.8), [term])
    assert not dwarfed(effect("payload", 0.01), [])


@pytest.mark.parametrize(("hz", "names"), [(0.18, ("coulomb", "stribeck", "presliding", "lugre")), (0.55, ())])
def test_less_than_a_period_of_a_swing_does_not_tell_about_what_it_swings(hz: float, names: tuple[str, ...]) -> None:
    """Records of 4 s: friction that swings at 0.18 Hz may be friction that comes up from none."""
    quiet = problem(AXIS.with_effect("coulomb", {"Fc": 0.05})).session.records[0]
    swing = -0.04 * np.sign(np.gradient(COMMAND)) * np.sin(2.0 * np.pi * hz * T)
    run = replay(AXIS.with_effect("coulomb", {"Fc": 0.05}), replace(quiet, external=swing))
    session = Session((replace(quiet, position=run.position, force=run.force, force_measured=run.applied),))
    given = Problem(session, problem(AXIS).noise)
    view = View(given, Searcher(given).fit(AXIS.with_effect("coulomb", {"Fc": 0.05})))
    dry = next(n for n in NUMBERS if n.symbol == "Fc")
    read = view.read(dry)
    assert read is not None
    course = swinging(view, dry, read)
    assert course is not None and course.timed(0.9).beside == names
    named = [effect("coulomb"), effect("payload")]
    left = ["payload"] if names else ["coulomb", "payload"]
    assert [e.name for e in formulas(named, [], changing=course.beside)[0]] == left
