"""Channels, screening, blocks, location and ambiguity on small made records."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sioms.reconcile.ambiguity import confounders, settle, told
from sioms.reconcile.blocks import better, formal, heldout, intervals
from sioms.reconcile.bounces import bent, deepest
from sioms.reconcile.channels import index_fit, lattice
from sioms.reconcile.descent import descend
from sioms.reconcile.engine.fit import get
from sioms.reconcile.evidence import spans_of
from sioms.reconcile.excitation import common, gate
from sioms.reconcile.experiment import Envelope, catalogue, demands, one_speed, repeated, separate
from sioms.reconcile.fit import LEFT, Fit, Problem, block_ids, free_parameters, jacobian, refit
from sioms.reconcile.locate import locate
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import drive_noise, observer, sensor_noise
from sioms.reconcile.plausible import leans, unspecific
from sioms.reconcile.prepare import quiet
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refuse import loud_turns
from sioms.reconcile.screen import screen
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.simulate import replay, simulate
from sioms.reconcile.thresholds import TONE
from sioms.reconcile.timed import known_beside
from sioms.reconcile.tones import hum, tone

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
T = np.arange(4000) * 1e-3
COMMAND = 3.5 * np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)


def session(model: AxisModel = AXIS, command: np.ndarray = COMMAND) -> Session:
    """Record ``model`` with the small noises of a good axis."""
    rng = np.random.default_rng(4)
    run = simulate(model, command)
    marks = np.floor(run.x / model.pitch)
    index = np.concatenate([np.diff(marks) != 0, [False]])
    measured = run.applied + 2e-3 * rng.standard_normal(len(command))
    return Session((Record("made", run.position, run.force, command, measured, index),))


def problem(s: Session) -> Problem:
    return Problem(s, observer(AXIS, sensor_noise(s, AXIS.resolution), drive_noise(s, AXIS.rated_force)))


@pytest.mark.parametrize("at_turns", [True, False])
def test_bursts_at_turns_of_the_motion_are_told_from_those_at_any_time(at_turns: bool) -> None:
    """Pushes nobody recorded, 10 ms long: just after the command turns (every second), or at times that keep away from
    it.
    """
    command = 3.5 * np.sin(np.pi * np.arange(8000) * 1e-3)
    push = np.zeros(8000)
    for second in range(8):
        start = 1000 * second + (520 if at_turns else 70 + 37 * second)
        push[start : start + 10] = 0.3
    quiet = session(command=command).records[0]
    run = replay(AXIS, replace(quiet, external=push))
    pushed = replace(quiet, position=run.position, force=run.force)
    made = problem(Session((pushed,)))
    turning, loud, usual = loud_turns(made, refit(made, AXIS, (), 4))
    assert 6 <= loud <= 24
    assert 0.1 < usual < 0.35
    assert (turning >= 0.7 * loud) if at_turns else (turning <= 0.35 * loud)


def test_the_lattice_of_a_coarse_encoder_is_seen() -> None:
    found = lattice(session(replace(AXIS, resolution=8 * AXIS.resolution)), AXIS)
    assert found is not None
    assert found.values["factor"] == 8.0
    assert lattice(session(), AXIS) is None


@pytest.mark.parametrize("gain", [0.97, 1.0, 1.02])
def test_index_marks_give_the_scale(gain: float) -> None:
    fit = index_fit(session(AXIS.with_effect("encoder_scale", {"gain": gain}), 3.0 * COMMAND), AXIS)
    assert fit is not None
    value, error, _ = fit
    assert abs(value - gain) < 4.0 * error
    assert error < 2e-3


def test_screening_puts_the_hidden_effect_first_and_starts_near_it() -> None:
    hidden = AXIS.with_effect("gravity", {"amp": 0.15, "phase": 0.8})
    p = problem(session(hidden))
    best = screen(p, refit(p, AXIS), ["viscous", "coulomb", "gravity", "payload", "offset", "delay"])[0]
    assert best.effect == "gravity"
    assert best.values["amp"] == pytest.approx(0.15, rel=0.1)
    assert best.values["phase"] == pytest.approx(0.8, abs=0.1)


def test_many_periods_a_turn_are_found_within_a_third_of_a_turn() -> None:
    hidden = AXIS.with_effect("torque_ripple", {"depth": 0.15, "phase": 0.8, "n": 22.0})
    p = problem(session(hidden, 0.27 * COMMAND))
    assert np.ptp(p.session.records[0].position) < 0.36 * AXIS.pitch
    best = screen(p, refit(p, AXIS), ["torque_ripple", "cogging", "gravity", "spring"])[0]
    assert (best.effect, best.values["n"]) == ("torque_ripple", 22.0)


def test_a_refit_finds_the_parameters() -> None:
    hidden = AXIS.with_effect("coulomb", {"Fc": 0.06}).with_effect("payload", {"J_extra": 4e-4})
    p = problem(session(hidden))
    fit = refit(p, AXIS.with_effect("coulomb", {"Fc": 0.03}).with_effect("payload", {"J_extra": 1e-4}))
    assert fit.model.effects["coulomb"]["Fc"] == pytest.approx(0.06, rel=0.02)
    assert fit.model.effects["payload"]["J_extra"] == pytest.approx(4e-4, rel=0.02)


@pytest.mark.parametrize(("left", "found"), [(LEFT, True), (0.0, False)])
def test_a_number_that_can_only_be_positive_does_not_vanish_in_one_step(left: float, found: bool) -> None:
    rng, width = np.random.default_rng(1), 0.03
    speed = np.concatenate([rng.uniform(0.0, 1.5, 600), rng.uniform(0.0, 0.05, 6)])
    noise = 0.02 * rng.standard_normal(len(speed))

    def residual(p: np.ndarray) -> np.ndarray:
        return p[0] + p[1] * np.exp(-((speed / p[2]) ** 2)) - 0.79 - 0.53 * np.exp(-((speed / width) ** 2)) + noise

    size = np.array([0.75, 0.1, 0.05])

    def slopes(p: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.stack([(residual(p + h) - r) / 2e-3 for h in np.diag(2e-3 * size)], axis=1)

    lower, upper = np.array([0.0, 0.0, 2e-4]), np.array([2.0, 3.0, 1.0])
    at, _, _ = descend(residual, slopes, size, size, lower, upper, 8, 1e-3, left=left)
    assert bool(abs(at[2] - width) < 0.1 * width) is found


def test_a_search_adds_what_is_missing_and_nothing_else() -> None:
    hidden = AXIS.with_effect("offset", {"off": 0.06})
    s = Searcher(
        problem(session(hidden)),
        names=("viscous", "coulomb", "offset", "payload", "spring", "viscous_direction"),
    )
    assert set(s.run(AXIS).fit.model.effects) == {"offset"}
    assert set(s.run(hidden).fit.model.effects) == {"offset"}


def test_an_effect_that_is_not_needed_leaves() -> None:
    hidden = AXIS.with_effect("viscous", {"b_extra": 8e-3})
    s = Searcher(problem(session(hidden)), names=("viscous", "coulomb", "offset"))
    start = AXIS.with_effect("offset", {"off": 0.05})
    assert set(s.run(start).fit.model.effects) == {"viscous"}


def test_a_confounder_that_does_better_takes_the_place_of_what_was_named() -> None:
    s = Searcher(problem(session(AXIS.with_effect("viscous", {"b_extra": 8e-3}))), names=("viscous", "quadratic_drag"))
    fit = s.fit(AXIS.with_effect("quadratic_drag", {"c": 1e-4}))
    found, others = settle(s, Found(fit, s.loss(fit), ()), ())
    assert set(found.fit.model.effects) == {"viscous"}
    assert [step.action for step in found.path] == ["swap"]
    assert not any(r.open for r in others)


def test_one_law_of_the_speed_may_be_what_was_told_as_two() -> None:
    """Between the powers one and two, viscous friction and quadratic drag together come near one drag."""
    s = Searcher(
        problem(session(AXIS.with_effect("power_drag", {"c": 2e-3, "n": 1.5}))),
        names=("viscous", "quadratic_drag", "power_drag"),
    )
    fit = s.fit(AXIS.with_effect("viscous", {"b_extra": 4e-3}).with_effect("quadratic_drag", {"c": 2e-4}))
    found, others = settle(s, Found(fit, s.loss(fit), ()), ())
    assert set(found.fit.model.effects) == {"power_drag"} and not others
    assert found.fit.model.effects["power_drag"]["n"] == pytest.approx(1.5, rel=0.01)


def test_a_power_near_none_is_dry_friction() -> None:
    """At its least exponent a drag stands for Coulomb friction, and is no confounder of it at one speed."""
    assert leans(AXIS.with_effect("power_drag", {"c": 0.1, "n": 0.3}), "power_drag")
    assert leans(AXIS.with_effect("power_drag", {"c": 0.1, "n": 3.5}), "power_drag")
    assert not leans(AXIS.with_effect("power_drag", {"c": 0.1, "n": 1.5}), "power_drag")


def test_friction_that_rises_with_the_speed_is_no_drop_at_low_speed() -> None:
    """A joint with a harmonic drive: friction rises over the first half of the speed and levels off."""
    for name, beside in (("stribeck", {}), ("lugre", {"xs": 2e-3})):
        assert leans(AXIS.with_effect(name, {"Fc": 0.18, **beside, "Fs": 0.12, "vs": 0.3}), name)
        assert not leans(AXIS.with_effect(name, {"Fc": 0.12, **beside, "Fs": 0.18, "vs": 0.3}), name)


def test_a_richer_law_that_contains_a_named_one_is_no_confounder_of_it() -> None:
    """A drag with a power of the speed is quadratic at the exponent two: no record could rule it out."""
    for plain in ("viscous", "quadratic_drag"):
        assert "power_drag" not in confounders(plain) and plain not in confounders("power_drag")
    assert "dead_band" in confounders("coulomb") and "coulomb" in confounders("dead_band")


def test_a_residual_that_suits_everything_has_no_name() -> None:
    assert unspecific("saturation", {"saturation": 0.15, "cogging": 0.13})
    assert not unspecific("coulomb", {"coulomb": 0.15, "stribeck": 0.16, "offset": 0.02})


def test_a_record_that_begins_in_motion_begins_with_the_transmission_wound_up() -> None:
    hidden = AXIS.with_effect("elastic", {"f_res": 9.0, "load_fraction": 0.5, "zeta": 0.03})
    whole = session(hidden).records[0]
    later = Session((whole.cut(620, 2200),))
    p = Problem(later, problem(Session((whole,))).noise)
    assert np.sqrt(np.mean(p.residual(hidden) ** 2)) < 1.3


def test_a_coarse_encoder_does_not_set_a_record_in_motion() -> None:
    """One count of 0.1 rad within the first 20 ms is no speed of 10 rad/s, which the slow observer of such an encoder
    would keep.
    """
    coarse = replace(AXIS, resolution=0.1)
    whole = session(coarse).records[0]
    at = int(np.flatnonzero(np.diff(whole.position[200:]))[3]) + 200
    later = Session((whole.cut(at - 12, 3000),))
    p = Problem(later, observer(coarse, sensor_noise(later, 0.1), 2e-3))
    assert np.sqrt(np.mean(p.residual(coarse) ** 2)) < 1.5


def test_a_closed_loop_over_a_record_cut_in_motion_goes_on_as_the_whole() -> None:
    """From rest the controller would throw the axis after its command: errors some fifty times as large."""
    whole = session().records[0]
    later = whole.cut(500, 2500)
    assert abs(later.position[8] - later.position[0]) > 0.02
    off = replay(AXIS, later).position - replay(AXIS, whole).position[500:2500]
    assert np.abs(off).max() < 0.02 * np.abs(whole.position - COMMAND).max()
    early = session(AXIS, 3.5 * (1.0 - np.cos(2 * np.pi * T))).records[0]
    assert np.abs(replay(AXIS, early).position - early.position).max() < 5.0 * AXIS.resolution


def test_beside_a_gap_wide_slopes_find_what_narrow_ones_miss() -> None:
    """Every bounce that falls otherwise is a step in the cost; intervals are as wide as its minima lie apart."""
    gap = {"gap": 0.05, "load_fraction": 0.5, "f_contact": 110.0, "zeta": 0.08}
    truth = AXIS.with_effect("backlash", gap).with_effect("offset", {"off": 0.06})
    truth = truth.with_effect("viscous", {"b_extra": 4e-3})
    legs = np.cumsum(4e-3 * np.repeat(([1, -1, 2, -2, -1, 1, 1, -1] * 3)[:20], 200))
    p = problem(session(truth, legs))
    start = AXIS.with_effect("backlash", {**gap, "gap": 0.053, "load_fraction": 0.48})
    start = start.with_effect("offset", {"off": 0.064}).with_effect("viscous", {"b_extra": 3.7e-3})
    judged, narrow = bent(p, start), refit(bent(p, start), start)
    fit, *others = deepest(p, start, (), np.random.default_rng(1))
    left = [float(np.sum(judged.residual(f.model) ** 2)) for f in (narrow, fit)]
    assert left[1] < 0.8 * left[0]
    spans = spans_of(p, fit, others)
    for name, symbol in (("offset", "off"), ("viscous", "b_extra"), ("backlash", "gap")):
        true, (low, high) = truth.effects[name][symbol], spans[name, symbol]
        assert low < true < high
        assert high - low < 0.1 * true


def test_a_stop_is_found_where_it_is() -> None:
    hidden = AXIS.with_effect("term_stop_above", {"k": 0.05, "x0": 1.3})
    p = problem(session(hidden))
    best = screen(p, refit(p, AXIS), ["term_stop_above", "term_stop_below", "spring", "gravity"])[0]
    assert best.effect == "term_stop_above"
    found = refit(p, AXIS.with_effect(best.effect, best.values)).model.effects[best.effect]
    assert found == pytest.approx({"k": 0.05, "x0": 1.3}, rel=0.02)


def test_friction_that_follows_the_motion_is_told_from_one_that_stays() -> None:
    slow = np.repeat([0.2, 1.0, 0.2, 1.0], 1000) * COMMAND / 1.4
    slow = np.convolve(np.concatenate([np.zeros(100), slow]), np.ones(101) / 101, "valid")
    values = {"g": 0.02, "tau": 0.8}
    p = problem(session(AXIS.with_effect("warming_friction", values), slow))
    fits = [
        refit(p, AXIS.with_effect(*s))
        for s in (("coulomb", {"Fc": 0.05}), ("warming_friction", {"g": 0.01, "tau": 2.0}))
    ]
    assert fits[1].model.effects["warming_friction"] == pytest.approx(values, rel=0.03)
    assert fits[0].ratio > 3.0 * fits[1].ratio


def test_few_loud_moments_do_not_rule_what_a_bent_residual_says_of_the_rest() -> None:
    """Pushes of four times a constant force for a hundredth of the time: straight, they pass for more of it."""
    true, push = 0.02, np.zeros(len(T))
    for start in range(300, 4000, 1000):
        push[start : start + 10] = 0.3
    quiet = session(AXIS.with_effect("offset", {"off": true})).records[0]
    pushed = replay(AXIS.with_effect("offset", {"off": true}), replace(quiet, external=push))
    loud = problem(Session((replace(quiet, position=pushed.position, force=pushed.force),)))
    model = AXIS.with_effect("offset", {"off": true})
    straight = refit(loud, model).model.effects["offset"]["off"]
    found = refit(bent(loud, model), model).model.effects["offset"]["off"]
    assert abs(found - true) < 0.2 * abs(straight - true)


def test_the_slope_of_a_bent_residual_is_how_it_goes_with_the_straight_one() -> None:
    p = replace(problem(session()), bend=0.7, weights=np.linspace(0.5, 2.0, len(T) - 50))
    near = [p.residual(replace(AXIS, viscous=1.5e-3 + h)) for h in (-1e-8, 0.0, 1e-8)]
    free = replace(p, bend=np.inf, weights=None)
    moved = np.subtract(*(free.residual(replace(AXIS, viscous=1.5e-3 + h)) for h in (1e-8, -1e-8)))
    assert np.max(np.abs(near[1])) > 3.0 * p.bend
    np.testing.assert_allclose(near[2] - near[0], p.slope(near[1]) * moved, atol=1e-3 * np.max(np.abs(moved)))


def test_a_force_that_keeps_time_is_told_from_what_the_motion_does() -> None:
    beside = 0.05 * np.sin(2 * np.pi * 12.37 * T + 0.4)
    shaken = Record("shaken", np.zeros(len(T)), beside, COMMAND, external=beside)
    run = replay(AXIS, replace(shaken, force=np.zeros(len(T))))
    p = problem(Session((Record("shaken", run.position, run.force, COMMAND),)))
    found = hum(p, refit(p, AXIS))
    assert found is not None
    assert found.frequency_hz == pytest.approx(12.37, abs=0.005)
    assert found.amplitude == pytest.approx(0.05, rel=0.02)
    alone = refit(known_beside(p, found.forces), AXIS)
    assert alone.ratio < 0.1 * refit(p, AXIS).ratio
    lap = 3.5 * np.sin(2 * np.pi * 0.7 * T)
    heavy = problem(session(AXIS.with_effect("payload", {"J_extra": 4e-4}), lap))
    assert tone(heavy, refit(heavy, AXIS)).share > TONE
    assert hum(heavy, refit(heavy, AXIS)) is None


def test_blocks_agree_with_refitting() -> None:
    """Leaving a tenth out by one Gauss-Newton step is what a refit without it would do, for a linear effect."""
    p = problem(session(AXIS.with_effect("viscous", {"b_extra": 5e-3})))
    fit = refit(p, AXIS.with_effect("viscous", {"b_extra": 1e-3}))
    ids = block_ids(p, AXIS.sample_time_s)
    loss = heldout(fit, ids)
    assert len(loss) == ids.max() + 1
    assert loss.sum() == pytest.approx(fit.cost, rel=0.02)
    half = intervals(fit, ids)[0] * fit.free[0].scale
    assert abs(fit.model.effects["viscous"]["b_extra"] - 5e-3) < 2.5 * half + 5e-5


def test_a_fold_that_tells_a_parameter_is_tried_without_it() -> None:
    """Straight at the fit, level away from it: without the only block that tells it, the parameter is thrown a long
    way.
    """
    ids = np.repeat(np.arange(10), 50)
    noise = np.random.default_rng(5).standard_normal(500)
    alone = np.where(ids == 3, 40.0, 0.02)
    noise += np.where(ids == 3, 0.0, 0.016)

    def moved(d: np.ndarray) -> np.ndarray:
        return noise + alone * np.tanh(d[0] / 0.05) * 0.05

    fit = Linear(noise, alone[:, None])
    believed, tried = heldout(fit, ids), heldout(fit, ids, moved=moved)
    assert believed[3] > 20.0 * np.sum(noise[ids == 3] ** 2)
    assert tried[3] < 5.0 * np.sum(noise[ids == 3] ** 2)
    np.testing.assert_allclose(np.delete(tried, 3), np.delete(believed, 3))


def test_a_jump_of_the_residual_is_no_slope() -> None:
    """A residual that jumps where friction passes a level, beside one that grows with it."""

    class Sticks(Problem):
        def residual(self, model: AxisModel) -> np.ndarray:
            level = model.effects["coulomb"]["Fc"]
            return np.array([*np.full(200, 3.0 * level), 8.0 * (level > 0.1001), 900.0 * level])

    p = Sticks(session(), observer(AXIS, 1e-4, 2e-3))
    model = AXIS.with_effect("coulomb", {"Fc": 0.1})
    free = free_parameters(model)
    at = get(model, free)
    slopes = jacobian(p, model, free, at, p.residual(model), 0.02)[:, 0] / free[0].scale
    np.testing.assert_allclose(slopes, [*np.full(200, 3.0), 0.0, 900.0], atol=1e-6)


@dataclass
class Linear:
    """A linear fit."""

    residual: np.ndarray
    jacobian: np.ndarray


def test_formal_intervals_cover_nineteen_of_twenty_under_white_noise() -> None:
    """Two thousand linear fits of two correlated columns to forty samples."""
    rng, n = np.random.default_rng(8), 40
    columns = np.stack([np.sin(0.3 * np.arange(n)), np.sin(0.3 * np.arange(n) + 0.5)], axis=1)
    hits = np.zeros(2)
    for _ in range(2000):
        noise = rng.standard_normal(n)
        moved = np.linalg.lstsq(columns, noise, rcond=None)[0]  # the truth is zero
        hits += np.abs(moved) <= formal(Linear(columns @ moved - noise, columns))
    assert np.all(np.abs(hits / 2000 - 0.95) < 0.015)


def test_intervals_cover_where_few_blocks_tell_a_parameter() -> None:
    """Four hundred linear fits to correlated noise; of two parameters the second acts in three of
    thirty blocks only.
    """
    rng, blocks, size = np.random.default_rng(2), 30, 20
    ids = np.repeat(np.arange(blocks), size)
    columns = np.stack([np.sin(0.3 * np.arange(len(ids))), np.where(ids % 10 == 0, 1.0, 0.0)], axis=1)
    hits = np.zeros(2)
    for _ in range(400):
        white = rng.standard_normal(len(ids) + 4)
        noise = np.convolve(white, [1.0, 0.8, 0.6, 0.4, 0.2], "valid")
        moved = np.linalg.lstsq(columns, noise, rcond=None)[0]  # the truth is zero
        hits += np.abs(moved) <= intervals(Linear(columns @ moved - noise, columns), ids)
    assert np.all(hits > 368)
    assert hits[0] < 396


def test_intervals_are_not_wild_where_two_blocks_tell_each_of_many() -> None:
    """Eight elements, each touched in two blocks of sixteen: 95 % cover, and no interval is far wider than the
    others.
    """
    rng, blocks, size = np.random.default_rng(4), 16, 20
    ids = np.repeat(np.arange(blocks), size)
    columns = (ids[:, None] % 8 == np.arange(8)).astype(np.float64)
    hits, widths = 0, []
    for _ in range(200):
        noise = rng.standard_normal(len(ids)) + np.repeat(rng.standard_normal(blocks), size)
        moved = np.linalg.lstsq(columns, noise, rcond=None)[0]  # the truth is zero
        widths.append(intervals(Linear(columns @ moved - noise, columns), ids))
        hits += int(np.sum(np.abs(moved) <= widths[-1]))
    assert 0.88 * 1600 < hits < 0.995 * 1600
    assert np.quantile(widths, 0.99) < 4.0 * np.median(widths)


def test_a_lucky_fit_to_loud_blocks_is_not_sure() -> None:
    quiet, loud = np.ones(40), np.ones(40)
    loud[:3] = 500.0
    lucky = 1.3 * quiet
    lucky[:3] = 100.0
    gain, errors = better(lucky, loud)
    assert gain > 0.5
    assert errors < 0.0


def test_the_gate_sees_confounders_and_what_is_not_excited() -> None:
    one_way = session(AXIS.with_effect("coulomb", {"Fc": 0.05}), 2.0 * T + 0.1 * np.sin(9 * T))
    pairs = {frozenset(p[:2]) for p in gate(problem(one_way), AXIS, ("coulomb", "offset", "viscous")).pairs}
    assert frozenset(("coulomb", "offset")) in pairs
    both = {frozenset(p[:2]) for p in gate(problem(session()), AXIS, ("coulomb", "offset", "viscous")).pairs}
    assert frozenset(("coulomb", "offset")) not in both


def test_common_energy_of_equal_and_of_orthogonal_traces() -> None:
    a = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    assert common(a, a @ np.array([[2.0], [1.0]])) == pytest.approx(1.0)
    assert common(a, np.array([[0.0], [0.0], [1.0]])) == pytest.approx(0.0)


def test_the_residual_is_located_where_it_lives() -> None:
    p = problem(session(AXIS.with_effect("gravity", {"amp": 0.15, "phase": 0.8})))
    places = locate(p, AXIS, np.random.default_rng(1), 39)
    assert places[0].variable.startswith("position")
    assert places[0].p <= 0.05


def test_the_experiment_that_separates_is_the_one_that_excites() -> None:
    rivals = [AXIS.with_effect("coulomb", {"Fc": 0.06}), AXIS.with_effect("offset", {"off": -0.06})]
    plan = separate(rivals, Envelope.of(AXIS, 0.0, 6.0), 2e-3)
    assert plan is not None
    assert plan.separation > 20.0


@pytest.mark.parametrize(
    "envelope",
    [
        Envelope(0.3, 6.0, 12.0, 170.0, 17000.0),
        Envelope(-0.2, 0.04, 0.25, 3.0, 60.0),
        Envelope(0.0, 0.002, 0.5, 5.0, 1000.0),
    ],
)
@pytest.mark.parametrize("duration", [1.5, 5.0])
def test_experiments_stay_within_their_envelope(envelope: Envelope, duration: float) -> None:
    e = envelope
    laps = [*catalogue(AXIS, e, duration), one_speed(AXIS, e, duration)]
    assert len({x.name for x in laps}) == 5
    for lap in laps:
        x = repeated(lap, 2).command
        speed, acceleration, jerk = demands(x, AXIS.sample_time_s)
        assert np.max(np.abs(x - e.centre)) <= e.reach * 1.001, lap.name
        assert np.max(np.abs(x - e.centre)) > 1e-4 * e.reach, lap.name
        assert speed <= e.speed * 1.001, lap.name
        assert acceleration <= e.acceleration * 1.02, lap.name
        assert jerk <= e.jerk * 1.1, lap.name
        assert np.abs(x[[0, -1, len(lap.command) - 1]] - e.centre).max() < 1e-9 * e.reach, lap.name


def test_the_plain_path_gives_the_same_numbers() -> None:
    code = (
        "import numpy as np; from sioms.reconcile.jit import numba; from sioms.reconcile.model import *; "
        "from sioms.reconcile.simulate import simulate; "
        "m = AxisModel(True, 1e-3, 2e-3, 1e-3, 2e-4, 6.28, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, "
        "100.0)); "
        "m = m.with_effect('stribeck', {'Fc': 0.05, 'Fs': 0.1, 'vs': 0.3}).with_effect('offset', {'off': 0.01}); "
        "r = simulate(m, np.sin(np.arange(300) * 0.01)); print(numba() is not None, repr(float(r.force.sum())), "
        "repr(float(r.position[-1])))"
    )
    out = [
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code],
            env={**os.environ, **extra},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for extra in ({}, {"SIOMS_PLAIN": "1"})
    ]
    assert [o[0] for o in out] == ["True", "False"]
    assert float(out[0][1]) == pytest.approx(float(out[1][1]), rel=1e-9)
    assert out[0][2] == out[1][2]


def test_trials_that_overflow_are_quiet_in_every_thread() -> None:
    huge = np.array([1e308])
    with ThreadPoolExecutor(2) as pool, warnings.catch_warnings():
        warnings.simplefilter("error")
        leaves = list(quiet(pool.map)(lambda times: huge * times - huge * times, [1.0, 1e10]))
    assert leaves[0] == 0.0 and np.isnan(leaves[1])


def test_a_rival_is_told_by_every_block_or_stays() -> None:
    """Of two models that differ by as much in all, one differs everywhere, the other in a few turns."""
    rng = np.random.default_rng(1)
    noise, blocks = rng.standard_normal(4000), np.repeat(np.arange(40), 100)
    everywhere = 5.0 * np.sin(2.0 * np.pi * np.arange(4000) / 50.0)
    seldom = np.where(blocks % 8 == 0, np.sqrt(8.0) * everywhere, 0.0)

    def fit(residual: np.ndarray) -> Fit:
        return Fit(AXIS, (), residual, np.empty((len(residual), 0)))

    def says(mine: np.ndarray, off: np.ndarray) -> str:
        losses, others = (np.bincount(blocks, weights=r**2) for r in (mine, mine + off))
        return told(fit(mine), losses, fit(mine + off), others)

    slow = lfilter([np.sqrt(1.0 - 0.99**2)], [1.0, -0.99], rng.standard_normal(4000))
    assert "of 40 blocks" in says(noise, everywhere)
    assert not says(noise, seldom)
    assert not says(noise, 0.5 * everywhere), "less than all that is left could be a part of it"
    assert not says(1.5 * noise, 2.0 * everywhere), "what is named is above the noise"
    assert not says(slow, everywhere), "a block of slow noise is one sample, or less"
