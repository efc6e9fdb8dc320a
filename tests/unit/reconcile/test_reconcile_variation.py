"""Dry friction that varies over the turn: its name beside each law, and the force of it on a motion that is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.dry import dry_friction
from sioms.reconcile.effects import known
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.plausible import swapped, vacant
from sioms.reconcile.simulate import simulate
from sioms.reconcile.variation import FACTOR, WHOLE, accompanied, exchanged, named, room_for

AXIS = AxisModel(True, 1e-3, 2e-3, 1e-3, 1e-9, 2 * np.pi, 0.7, 20.0)
VARYING = AXIS.with_effect(WHOLE, {"Fc": 0.04, "Fm": 0.01, "phase": 0.4, "n": 3.0})
STRIBECK = {"Fc": 0.03, "Fs": 0.06, "vs": 0.2}
LUGRE = {"Fc": 0.03, "xs": 1e-2, "Fs": 0.05, "vs": 0.2}
FACTORS = {"depth": 0.25, "phase": 0.4, "n": 3.0}


@pytest.mark.parametrize(("law", "values"), [("stribeck", STRIBECK), ("lugre", LUGRE)])
def test_what_varies_goes_on_varying_under_another_law(law: str, values: dict[str, float]) -> None:
    model = exchanged(VARYING, law, values)
    assert dict(model.effects) == {law: values, FACTOR: FACTORS}
    back = swapped(model, law, "coulomb")
    assert set(back.effects) == {WHOLE}
    assert back.effects[WHOLE] == pytest.approx({"Fc": 0.03, "Fm": 0.0075, "phase": 0.4, "n": 3.0})


def test_the_factor_leaves_with_what_it_stood_beside() -> None:
    model = exchanged(VARYING, "stribeck", STRIBECK)
    assert not named(model.without_effect("stribeck")).effects
    assert set(named(model.without_effect(FACTOR)).effects) == {"stribeck"}


def test_a_law_that_varies_by_itself_takes_no_factor() -> None:
    assert not room_for(VARYING, "coulomb").effects
    assert not accompanied(VARYING, FACTOR)
    assert not accompanied(AXIS.with_effect("coulomb", {"Fc": 0.04}), FACTOR)
    assert all(accompanied(AXIS, n) == (not known()[n].beside) for n in known())


def test_coulomb_friction_with_the_factor_is_coulomb_friction_that_varies() -> None:
    t = np.arange(1500) * 1e-3
    axis = replace(AXIS, controller=Controller(20.0, -0.985, -0.7, -1e-4, 0.0, 1.8, 100.0))
    command = 1.2 * np.sin(2 * np.pi * 1.1 * t)
    whole = simulate(replace(axis, effects=VARYING.effects), command)
    parted = simulate(replace(axis, effects={"coulomb": {"Fc": 0.04}, FACTOR: FACTORS}), command)
    np.testing.assert_allclose(parted.force, whole.force, atol=1e-3 * np.ptp(whole.force))


def test_the_dry_friction_of_a_motion_is_built_up_and_varies() -> None:
    """Moved slowly one way, Dahl's closed solution; far on, and for a level, the law times the factor."""
    x = np.linspace(0.0, 4.0, 4001)
    v, zero, one = np.full_like(x, 0.1), np.zeros_like(x), np.ones_like(x)
    dahl = AXIS.with_effect("presliding", {"Fc": 0.04, "xs": 2e-2})
    np.testing.assert_allclose(dry_friction(dahl, x, v, zero, zero, one), -0.04 * (1 - np.exp(-x / 2e-2)), atol=1e-12)
    share = 1.0 + 0.25 * np.sin(3.0 * x + 0.4)
    level = AXIS.with_effect("stribeck", STRIBECK).with_effect(FACTOR, FACTORS)
    law = 0.03 + 0.03 * np.exp(-0.25)
    np.testing.assert_allclose(dry_friction(level, x, v, zero, zero, -one), share * law)
    bristles = AXIS.with_effect("lugre", LUGRE).with_effect(FACTOR, FACTORS)
    slid = dry_friction(bristles, x, v, zero, zero, one)[1000:]
    law = 0.03 + 0.02 * np.exp(-0.25)
    np.testing.assert_allclose(slid, -law * share[1000:], atol=0.02 * law)


def test_a_place_is_not_given_to_a_law_that_another_in_the_model_excludes() -> None:
    model = AXIS.with_effect("lugre", LUGRE).with_effect(
        "backlash", {"gap": 0.01, "load_fraction": 0.5, "f_contact": 100.0, "zeta": 0.3}
    )
    assert not vacant(model, "backlash", "stribeck")
    assert not vacant(model, "backlash", "lugre")
    assert vacant(model, "backlash", "elastic")
    assert vacant(model, "lugre", "stribeck")
