"""The generator of the blind test, by facts that do not use its formulas."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.command.selftest import generate, record, write_public
from sioms.reconcile.effects import library
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.prepare import Options
from sioms.reconcile.verdict import Outcome
from sioms.reconcile_selftest import near
from sioms.reconcile_selftest.axis import Axis, Servo
from sioms.reconcile_selftest.draw import NAMED, SATURATED, draw_axis
from sioms.reconcile_selftest.score import PRIMARY, is_right
from sioms.reconcile_selftest.world import Recording, World

#: An axis of 2 kg without friction, on a soft spring of a controller.
BARE = Axis(
    name="bare",
    kind="null",
    rotary=False,
    sample_s=1e-3,
    inertia=2.0,
    viscous=0.0,
    rated=20.0,
    speed=0.3,
    resolution=1e-9,
    pitch=0.01,
    servo=Servo(800.0, 0.0, 0.0, 0.0, 1e3),
    excitation="full",
    current=True,
    marks=True,
    seed=1,
)


def run(command: np.ndarray, axis: Axis = BARE, **hidden: dict[str, float]) -> Recording:
    return World(replace(axis, named=hidden)).record(command, noise=0.0)


def test_the_whole_library_is_hidden_and_scored() -> None:
    assert set(NAMED) == set(library()) == set(PRIMARY)
    for name, symbol in PRIMARY.items():
        assert symbol in {p.symbol for p in library()[name].parameters}


def test_a_free_axis_keeps_its_energy_and_its_period() -> None:
    seen = run(np.where(np.arange(3000) < 2, 0.0, 0.01))
    # a spring of 800 N/m that a sampled loop holds half a sample late gains a little
    x = seen.counts * 1e-9 - 0.01
    crossings = np.flatnonzero((x[1:] > 0) != (x[:-1] > 0))
    assert np.mean(np.diff(crossings)) == pytest.approx(1e3 * np.pi * np.sqrt(2.0 / 800.0), rel=0.01)
    assert np.max(np.abs(x[-400:])) == pytest.approx(0.01, rel=0.7)


@pytest.mark.parametrize(
    "hidden",
    [
        {"viscous": {"b_extra": 8.0}},
        {"quadratic_drag": {"c": 60.0}},
        {"coulomb": {"Fc": 1.0}},
        {"coulomb_position": {"Fc": 1.0, "Fm": 0.5, "n": 2.0, "phase": 0.0}},
        {"stribeck": {"Fc": 1.0, "Fs": 2.0, "vs": 0.01}},
        {"presliding": {"Fc": 1.0, "xs": 2e-5}},
        {"lugre": {"Fc": 1.0, "Fs": 2.0, "vs": 0.01, "xs": 2e-5}},
        {"load_friction": {"mu": 0.2}},
    ],
    ids=lambda hidden: next(iter(hidden)),
)
def test_friction_takes_energy(hidden: dict[str, dict[str, float]]) -> None:
    command = np.where(np.arange(1200) < 2, 0.0, 0.01)
    free, rubbed = (float(np.max(np.abs(run(command, **h).counts[-400:] * 1e-9 - 0.01))) for h in ({}, hidden))
    assert rubbed < 0.8 * free


def test_presliding_is_a_spring_until_it_slides() -> None:
    """A force far below the level moves the axis by force over stiffness, and back."""
    weak = replace(BARE, servo=Servo(800.0, 0.0, 0.0, -20.0, 1e3))
    command = np.where((np.arange(2000) > 10) & (np.arange(2000) < 1200), 1.25e-4, 0.0)
    seen = run(command, weak, presliding={"Fc": 1.0, "xs": 1e-4}, viscous={"b_extra": 100.0})
    place, force = seen.counts[1150] * 1e-9, seen.force[1150]
    assert 0.05 < force < 0.15
    # Dahl: F = Fc (1 - exp(-x/xs)); it overshot a little
    assert place == pytest.approx(-1e-4 * np.log(1.0 - force), rel=0.06)
    assert abs(seen.counts[-1] * 1e-9) < 0.2 * place


def test_the_current_lags_by_its_time_constant() -> None:
    stiff = replace(BARE, inertia=1e6)
    seen = run(np.where(np.arange(100) < 20, 0.0, 0.01), stiff, lag={"tau": 5e-3})
    assert np.interp(1.0 - np.exp(-1.0), seen.force_measured[20:40] / seen.force[40], np.arange(20)) + 0.5 == (
        pytest.approx(5.0, rel=0.02)
    )


def hides(**nameless: dict[str, float]) -> Recording:
    command = 0.03 * np.sign(np.sin(2.0 * np.pi * np.arange(3000) / 1000.0))
    return World(replace(BARE, nameless=nameless)).record(command, noise=0.0)


def test_a_drive_of_a_limited_rate_changes_by_no_more_and_gets_there() -> None:
    seen = hides(slew_limit={"rate": 2000.0})
    steps = np.abs(np.diff(seen.force_measured))
    assert np.max(steps) == pytest.approx(2.0, rel=1e-6)
    assert np.max(np.abs(seen.force)) > 40.0 and np.mean(steps > 1.999) > 0.02


def test_a_weak_supply_gives_nothing_at_its_speed_and_all_at_rest() -> None:
    seen = hides(supply_limit={"F0": 15.0, "v0": 0.2})
    speed = np.gradient(seen.counts * 1e-9, 1e-3)
    along = seen.force_measured * np.sign(speed) > 0.0
    assert np.max(np.abs(seen.force_measured[along])) == pytest.approx(15.0, rel=0.02)
    assert np.all(np.abs(seen.force_measured)[along] <= 15.0 * (1.0 - np.abs(speed[along]) / 0.2) + 0.3)


def test_an_encoder_errs_within_its_signal_period_and_nowhere_else() -> None:
    size, n = 2e-6, 50.0
    plain, wrong = hides(), hides(interpolation_error={"amp": size, "n": n, "phase": 0.0})
    off = (wrong.counts - plain.counts) * 1e-9
    early = slice(0, 30)  # before the controller has acted on it
    place = plain.counts[early] * 1e-9
    np.testing.assert_allclose(off[early], size * np.sin(2.0 * np.pi * n * place / 0.01), atol=0.1 * size)


def verdict_on(axis: Axis, folder: Path) -> AxisVerdict:
    write_public(axis, record(axis), folder / "axis")
    model = read_model(folder / "axis" / "nominal.toml")
    return analyse(read_data(folder / "axis", model), model, Options(pictures=False))


def test_an_encoder_that_errs_within_its_signal_period_is_named(tmp_path: Path) -> None:
    """Its waves pass for noise of the sensor."""
    axis = draw_axis("waves", "single", np.random.default_rng(32), "interpolation_error")
    truth, verdict = axis.named["interpolation_error"], verdict_on(axis, tmp_path)
    assert verdict.outcome is Outcome.NAMED and [e.name for e in verdict.effects] == ["interpolation_error"]
    amp, phase, n = (p.value for p in verdict.effects[0].parameters)
    assert n == truth["n"] and amp == pytest.approx(truth["amp"], rel=0.02)
    assert np.cos(phase - truth["phase"]) > 0.999


@pytest.mark.parametrize("name", ["slew_limit", "supply_limit"])
def test_limits_of_the_power_stage_are_named_by_the_measured_force(tmp_path: Path, name: str) -> None:
    axis = draw_axis("limited", "single", np.random.default_rng(13), name)
    verdict = verdict_on(replace(axis, current=True), tmp_path)
    assert verdict.outcome is Outcome.NAMED and [e.name for e in verdict.effects] == [name]
    for p in verdict.effects[0].parameters:
        assert p.value == pytest.approx(axis.named[name][p.symbol], rel=0.02)


def test_an_eccentric_encoder_is_right_at_every_mark() -> None:
    ramp = 0.05 * np.arange(2000) * 1e-3
    loop = replace(BARE, servo=Servo(5e3, -0.98, -0.6, 0.0, 1e3), viscous=5.0)
    seen = run(ramp, loop, eccentricity={"amp": 2e-4, "phase": 0.0})
    at = np.flatnonzero(seen.index)[1:]
    assert len(at) > 5
    np.testing.assert_allclose(np.diff(seen.counts[at] * 1e-9), 0.01, atol=2e-4)


@pytest.mark.parametrize(("kind", "only"), [("confounded", "small"), ("unknown", "load_square_friction")])
def test_a_draw_that_is_asked_for_is_drawn(kind: str, only: str) -> None:
    axis = draw_axis("a", kind, np.random.default_rng(2), only)
    assert axis.excitation == (only if kind == "confounded" else "full")
    assert set(axis.nameless) == ({only} if kind == "unknown" else set())


def test_a_drive_saturates_in_some_of_the_samples() -> None:
    axis = draw_axis("a", "single", np.random.default_rng(3), "saturation")
    beyond = [np.abs(r.force) > axis.named["saturation"]["limit"] for r in record(axis)]
    assert SATURATED[0] < np.mean(beyond) < SATURATED[1]


NEAR = {"size": 1.0, "scale": 0.01, "shape": 2.0, "more": 1.0, "phase": 0.0}


@pytest.mark.parametrize(
    ("hidden", "named"),
    [
        ({"near_drop": NEAR}, {"stribeck": {"Fc": 1.0, "Fs": 2.0, "vs": 0.01}}),
        ({"near_load": {**NEAR, "scale": 20.0, "shape": 1.0}}, {"load_friction": {"mu": 0.05}}),
        ({"near_heat": {**NEAR, "scale": 5.0, "more": 1e9}}, {"thermal_gain": {"loss": 1.0, "tau": 5.0}}),
        ({"near_spring": {**NEAR, "scale": 1e6, "size": 2e8}}, {"spring": {"k": 200.0}}),
        ({"near_drag": {**NEAR, "scale": 1e6, "size": 8e6}}, {"viscous": {"b_extra": 8.0}}),
    ],
    ids=["drop", "load", "heat", "spring", "drag"],
)
def test_a_form_near_the_library_becomes_that_of_the_library(
    hidden: dict[str, dict[str, float]], named: dict[str, dict[str, float]]
) -> None:
    """... where its shape is that, so that it is the shape alone in which it differs."""
    t = np.arange(1500) * 1e-3
    command = 0.02 * np.sin(2 * np.pi * 2.0 * t) * np.minimum(t / 0.2, 1.0)
    other = World(replace(BARE, nameless=hidden)).record(command, noise=0.0)
    assert np.allclose(other.force, run(command, **named).force, atol=2e-3 * np.max(np.abs(other.force)))


def test_forms_near_the_library_are_drawn_anew_and_held_by_their_loops() -> None:
    drawn = generate(10, 3, near=True)
    assert [a.kind for a in drawn] == ["near"] * 10
    assert {name for a in drawn for name in a.nameless} == set(near.NEAR)
    assert not is_right(drawn[0], {"verdict": "named", "effects": [*drawn[0].named, "coulomb"]})
    assert is_right(drawn[0], {"verdict": "unexplained", "effects": [*drawn[0].named]})
