"""What a smooth law without a name is taken for, and what is typical of a force that no length of the axis tells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import SIDE
from sioms.reconcile.excitation import gate
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import Noise
from sioms.reconcile.plausible import formulas_of
from sioms.reconcile.records import Record, Session

STAGE = AxisModel(rotary=False, sample_time_s=1e-3, inertia=2.0, viscous=4.0, resolution=1e-6, pitch=0.02,
                  rated_force=50.0, max_speed=0.5)  # fmt: skip
NAMES = tuple(known())
STEP = 0.01


def with_law(name: str, course: Callable[[float], float]) -> AxisModel:
    """Return an axis with a law through a course of its places, in steps from the middle."""
    places = [*range(-SIDE, 0), *range(1, SIDE + 1)]
    values = {f"s{i}": float(course(z)) for i, z in enumerate(places, 1)}
    return STAGE.with_effect(name, {**values, "middle": 0.0, "step": STEP})


@pytest.mark.parametrize(
    ("law", "course", "formula", "number"),
    [
        ("term_law_of_speed", lambda z: -0.3 * z, "viscous", 30.0),
        ("term_law_of_speed", lambda z: -0.03 * z * abs(z), "quadratic_drag", 300.0),
        ("term_law_of_place", lambda z: -0.3 * z**3, "hardening_spring", 3e5),
        ("term_law_of_place", lambda z: -0.3 * z, "spring", 30.0),
        ("term_law_of_place", lambda z: -0.3 * abs(z), "asymmetric_spring", 30.0),
        ("term_drag_by_place", lambda z: 0.3 * z, "term_xv", 30.0),
        ("term_friction_by_place", lambda z: 0.3 * z, "term_place_friction", 30.0),
    ],
)
def test_a_law_with_the_course_of_a_formula_is_taken_for_it(
    law: str, course: Callable[[float], float], formula: str, number: float
) -> None:
    model, other = formulas_of(with_law(law, course), law, NAMES)[0]
    assert other == formula
    assert law not in model.effects
    assert next(iter(model.effects[formula].values())) == pytest.approx(number, rel=0.05)


def test_a_law_that_bends_is_taken_for_none() -> None:
    bent = with_law("term_law_of_speed", lambda z: -0.3 * z / (1.0 + z * z))
    assert not formulas_of(bent, "term_law_of_speed", NAMES)
    assert not formulas_of(STAGE.with_effect("coulomb", {"Fc": 1.0}), "coulomb", NAMES)


def test_what_cannot_be_is_not_put_in_the_place_of_a_law() -> None:
    """Friction that drives has the course of viscous friction, with the sign the other way."""
    assert not formulas_of(with_law("term_law_of_speed", lambda z: 0.3 * z), "term_law_of_speed", NAMES)


@pytest.mark.parametrize("reach", [1e-4, 0.05, 2.0])
@pytest.mark.parametrize("pitch", [1e-3, 0.02, 6.0])
def test_whether_a_hardening_spring_shows_does_not_depend_on_pitch_and_reach(reach: float, pitch: float) -> None:
    """At the end of the way it makes the force that a typical constant one makes everywhere: of a sine's cube the root
    mean square is sqrt(5/16) of that, whatever the lengths.
    """
    stage = replace(STAGE, pitch=pitch, resolution=1e-9, max_speed=10.0 * reach)
    t = np.arange(4000) * stage.sample_time_s
    x = reach * np.sin(2.0 * np.pi * t)
    record = Record("one", x, stage.inertia * np.gradient(np.gradient(x, t), t), command=x)
    problem = Problem(Session((record,)), Noise(1e-9, 0.1, (0.09, 8.0), 1e-6))
    found = gate(problem, stage, ("hardening_spring", "offset"))
    assert found.traces["hardening_spring"] == pytest.approx(np.sqrt(5 / 16) * found.traces["offset"], rel=0.05)
    assert not found.missing
