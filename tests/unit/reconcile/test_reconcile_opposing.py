"""What opposes the motion, all told, whatever its parts are called; and which of two forms is the simpler."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.blocks import combined, intervals
from sioms.reconcile.effects import library
from sioms.reconcile.effects.smooth import SIDE
from sioms.reconcile.engine.search import Tried
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import observer
from sioms.reconcile.opposing import at_rest, dwelt, friction_told, likened, opposing
from sioms.reconcile.records import Record, Session
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.simulate import pack, released

Array = NDArray[np.float64]
STAGE = AxisModel(rotary=False, sample_time_s=1e-3, inertia=2.0, viscous=40.0, resolution=1e-6, pitch=0.02,
                  rated_force=50.0, max_speed=0.5, effects={"coulomb": {"Fc": 5.0}})  # fmt: skip
BOTH_WAYS = STAGE.with_effect("viscous_direction", {"b_dir": -8.0})
SPEEDS = (0.1, 0.2, 0.4)
NOISE = 0.05


def moves() -> Array:
    """Return a speed that is held at three values, both ways, with ramps of 0.1 s between them."""
    steps = [w * v for v in SPEEDS for w in (1.0, -1.0)] * 2
    corners = np.cumsum([0.0, *[0.1, 0.4] * len(steps)])
    values = [0.0, *np.repeat(steps, 2)]
    return np.interp(np.arange(int(corners[-1] * 1000)) * 1e-3, corners, values)


def recorded(model: AxisModel) -> Record:
    """Return the record of a model that the force moves so, with noise of the drive."""
    v = moves()
    one_way = model.effects.get("viscous_direction", {"b_dir": 0.0})["b_dir"]
    force = model.inertia * np.gradient(v, 1e-3) + 40.0 * v + one_way * np.abs(v) + 5.0 * np.sign(v)
    place = released(
        pack(model), force + NOISE * np.random.default_rng(2).standard_normal(len(v)), np.zeros(7)
    ).position
    return Record("moves", place, force)


def problem(model: AxisModel) -> Problem:
    return Problem(Session((recorded(model),)), observer(STAGE, 1e-6, NOISE))


def with_law(model: AxisModel, course: Array) -> AxisModel:
    """Return a model with a law of speed through nine places, at zero in the middle."""
    values = {f"s{i}": float(f) for i, f in enumerate(np.delete(course, SIDE), 1)}
    return model.with_effect("term_law_of_speed", {**values, "middle": 0.0, "step": 0.1})


def test_friction_is_told_whatever_shares_it_out() -> None:
    places = 0.1 * np.arange(-SIDE, SIDE + 1)
    split = with_law(STAGE.with_effect("coulomb", {"Fc": 3.0}), -2.0 * np.sign(places))
    (span,), runs = [slice(0, None)], problem(STAGE).runs(STAGE)
    samples = dwelt(runs, [span])
    assert sorted({round(abs(s.speed), 2) for s in samples}) == pytest.approx(list(SPEEDS), abs=0.02)
    for s in samples:
        assert opposing(STAGE, s) == pytest.approx(5.0 + 40.0 * abs(s.speed), rel=0.02)
        assert opposing(split, s) == pytest.approx(opposing(STAGE, s), rel=5e-3)


def test_what_numbers_add_up_to_is_known_where_they_are_not() -> None:
    rng, ids = np.random.default_rng(1), np.repeat(np.arange(40), 50)
    shared = rng.standard_normal(2000)
    columns = np.stack([shared, shared + 1e-3 * rng.standard_normal(2000)], axis=1)
    fit = Fit(STAGE, (), rng.standard_normal(2000), columns)
    both, one = combined(fit, ids, np.array([[1.0, 1.0], [1.0, 0.0]]))
    assert both == pytest.approx(1.96 / np.sqrt(2000), rel=0.3)
    assert one > 100.0 * both
    assert one == pytest.approx(intervals(fit, ids)[0], rel=0.5)


def test_the_report_tells_friction_each_way_and_what_a_law_resembles() -> None:
    given = problem(BOTH_WAYS)
    start = with_law(replace(STAGE, refine=("viscous",)), np.zeros(2 * SIDE + 1))
    fit = refit(given, start, iterations=20)
    text = friction_told(given, fit)
    assert text.startswith("what opposes the motion adds up to ")
    assert "backward it is" in text
    more = float(text.split("backward it is")[1].split()[0])
    assert more == pytest.approx(2.0 * 8.0 * SPEEDS[-1], rel=0.02)
    assert at_rest(given, fit) == (pytest.approx(5.0, rel=0.02), pytest.approx(0.0, abs=0.1))
    searcher = Searcher(given, (), tuple(library()))
    (said,) = likened(searcher, Found(fit, searcher.loss(fit), ()))
    assert "direction-dependent viscous friction" in said


def test_of_two_forms_the_one_beside_which_more_may_leave_is_the_simpler() -> None:
    given = problem(BOTH_WAYS)
    searcher = Searcher(given, (), tuple(library()))
    nominal = STAGE.with_effect("offset", {"off": 0.5})
    old = searcher.loss(searcher.fit(nominal))
    counts = {}
    for name, start in (("viscous_direction", {"b_dir": -6.0}), ("quadratic_direction", {"c": -15.0})):
        fit = searcher.fit(nominal.with_effect(name, start), 12)
        losses = searcher.loss(fit)
        counts[name] = searcher.order(name, Tried(fit, losses, searcher.saving(losses, old)), fit)[1]
    assert counts == {"viscous_direction": 0, "quadratic_direction": 1}
