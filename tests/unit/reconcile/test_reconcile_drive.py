"""The law of a drive by its measured force: which is named, how well its numbers are known, what doubts it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sioms.reconcile.current import Law, drive
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import simulate

from .test_reconcile_parts import AXIS, COMMAND, T, session


@pytest.mark.parametrize(
    ("effect", "symbol", "value", "within"),
    [("delay", "delay", 2.7e-3, 2e-5), ("lag", "tau", 3e-3, 1e-4), ("saturation", "limit", 0.35, 2e-3)],
)
def test_the_drive_is_judged_by_its_current(effect: str, symbol: str, value: float, within: float) -> None:
    found, strays = drive(session(AXIS.with_effect(effect, {symbol: value}), 2.0 * COMMAND), AXIS)
    assert [f.effect for f in found] == [effect] and not found[0].doubted and not strays
    assert found[0].values[symbol] == pytest.approx(value, abs=within)


def test_a_good_drive_shows_nothing() -> None:
    assert drive(session(), AXIS) == ([], "")


@pytest.mark.parametrize("seed", range(6))
def test_a_measured_force_that_does_not_follow_the_command_is_refused_not_named(seed: int) -> None:
    """White noise in the column: some delay always lowers the misfit a little, or takes the command away."""
    rng = np.random.default_rng(seed)
    place, force, measured = rng.standard_normal((3, 2000))
    with pytest.raises(BadInputError, match=r"variance does not follow the commanded force; needs"):
        drive(Session((Record("noise", place, force, place, measured),)), AXIS)


def fine(force: np.ndarray, follow: Callable[[float, float], float], noise: float = 2e-3) -> Session:
    """Record a drive that follows its command by 200 steps a sample, and its mean over every sample."""
    now, mean = 0.0, np.zeros(len(force))
    for i, goal in enumerate(force):
        for _ in range(200):
            now = follow(now, goal)
            mean[i] += now / 200
    measured = mean + noise * np.random.default_rng(7).standard_normal(len(force))
    place = 1e-3 * np.arange(len(force))
    return Session((Record("steps", place, force, place, measured),))


STEPS = 0.4 * np.sign(np.sin(2.0 * np.pi * 1.5 * T[:2000])) + 0.1 * np.sin(2.0 * np.pi * 0.4 * T[:2000])


@pytest.mark.parametrize("rate", [10.0, 30.0, 80.0, 300.0])
def test_a_drive_of_a_limited_rate_of_change_is_known_by_its_rate_and_is_no_lag(rate: float) -> None:
    step = rate * 1e-3 / 200
    found, strays = drive(fine(STEPS, lambda now, goal: now + np.clip(goal - now, -step, step)), AXIS)
    assert [f.effect for f in found] == ["slew_limit"] and not found[0].doubted and not strays
    assert abs(found[0].values["rate"] - rate) < 0.01 * rate + 4.0 * found[0].errors["rate"]


@pytest.mark.parametrize(("hz", "damping"), [(60.0, 0.4), (80.0, 0.7)])
def test_a_drive_that_rings_is_doubted_whatever_law_is_nearest(hz: float, damping: float) -> None:
    turn, step, rate = 2.0 * np.pi * hz, 1e-3 / 200, 0.0

    def follow(now: float, goal: float) -> float:
        nonlocal rate
        rate += step * (turn**2 * (goal - now) - 2.0 * damping * turn * rate)
        return now + step * rate

    found, _ = drive(fine(STEPS, follow), AXIS)
    assert len(found) == 1 and found[0].doubted


def test_a_lag_of_the_same_steps_is_no_limited_rate() -> None:
    found, strays = drive(fine(STEPS, lambda now, goal: now + (goal - now) * 1e-3 / 200 / 4e-3), AXIS)
    assert [f.effect for f in found] == ["lag"] and not found[0].doubted and not strays


@pytest.mark.parametrize(("zero", "scale"), [(0.0, 0.93), (0.02, 1.0), (-0.02, 1.06)])
def test_zero_and_scale_of_the_measured_force_doubt_no_drive(zero: float, scale: float) -> None:
    rng = np.random.default_rng(9)
    force = 0.4 * np.sin(2.0 * np.pi * 1.5 * T[:2000]) + 0.1 * rng.standard_normal(2000)
    place = 1e-3 * np.arange(2000)
    for lag_s, expected in ((3e-3, ["lag"]), (0.0, [])):
        measured = zero + scale * Law(0.0, lag_s).output(force, 1e-3) + 2e-3 * rng.standard_normal(2000)
        found, strays = drive(Session((Record("sensor", place, force, place, measured),)), AXIS)
        assert not strays
        if scale == 1.0:
            assert [f.effect for f in found] == expected and not any(f.doubted for f in found)
        else:
            assert all(f.doubted for f in found), "a scale looks like a lag"


@pytest.mark.parametrize("what", ["filtered", "hum"])
def test_noise_of_the_current_that_has_a_colour_is_no_law_of_the_drive(what: str) -> None:
    """It may doubt a lag, but it does not go with the command: of the mechanics everything can be told."""
    rng = np.random.default_rng(9)
    force = 0.4 * np.sin(2.0 * np.pi * 1.5 * T[:2000]) + 0.1 * np.sign(np.sin(2.0 * np.pi * 3.7 * T[:2000]))
    noise = np.convolve(rng.standard_normal(2000), np.exp(-np.arange(60) / 12.0), "same")
    noise = np.sin(2.0 * np.pi * 50.0 * T[:2000]) if what == "hum" else noise
    measured = force + 0.03 * noise / np.std(noise)
    place = 1e-3 * np.arange(2000)
    found, strays = drive(Session((Record("rough", place, force, place, measured),)), AXIS)
    assert strays == "" and all(f.doubted for f in found)


@pytest.mark.parametrize("swing", [4.0, 0.0])
def test_a_supply_that_gives_less_at_speed_is_known_by_both_its_numbers(swing: float) -> None:
    """A limit that stays where it is at any speed is a saturation."""
    rng = np.random.default_rng(8)
    force, t = 0.6 * np.sin(2.0 * np.pi * 1.5 * T[:2000]), T[:2000] + 0.5e-3  # the middle of every sample
    place, speed = (12.0 / (3.0 * np.pi) * f(3.0 * np.pi * at - 0.6) for f, at in ((np.sin, T[:2000]), (np.cos, t)))
    speed *= 3.0 * np.pi
    most, least = (0.4 * (1.0 + way * speed * swing / 80.0) for way in (-1.0, 1.0))
    measured = np.clip(force, -least, most) + 2e-3 * rng.standard_normal(2000)
    (found,), strays = drive(Session((Record("supply", place, force, place, measured),)), AXIS)
    assert found.effect == ("supply_limit" if swing else "saturation") and not found.doubted and not strays
    truth = {"F0": 0.4, "v0": 20.0} if swing else {"limit": 0.4}
    for symbol, value in truth.items():
        assert abs(found.values[symbol] - value) < min(4.0 * found.errors[symbol] + 2e-3 * value, 0.02 * value)


def test_a_drive_of_another_law_is_doubted_and_says_what_to_do() -> None:
    """One that goes with the root of its command."""
    rng = np.random.default_rng(8)
    force = 0.4 * np.sin(2.0 * np.pi * 1.5 * T[:2000])
    measured = 0.6 * np.sign(force) * np.abs(force) ** 0.5 + 2e-3 * rng.standard_normal(2000)
    place = 1e-3 * np.arange(2000)
    found, strays = drive(Session((Record("root", place, force, place, measured),)), AXIS)
    assert all(f.doubted for f in found) and "describe force_measured as force" in strays


def test_a_drive_later_than_is_searched_is_refused_not_named_by_the_bound() -> None:
    force = np.cumsum(np.random.default_rng(4).standard_normal(2000)) * 1e-2
    place = 1e-3 * np.arange(2000)
    with pytest.raises(BadInputError, match=r"follows 20 samples late or more"):
        drive(Session((Record("late", place, force, place, Law(0.0, 31e-3).output(force, 1e-3)),)), AXIS)


@pytest.mark.parametrize("lag_s", [2e-3, 5e-3])
def test_a_slow_drive_of_a_restless_command_is_not_limited_and_known_as_well_as_is_said(lag_s: float) -> None:
    """A coarse encoder's chatter is steep, but a lag takes most of it away, and its peaks."""
    z = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        force = 0.4 * np.sin(2.0 * np.pi * 1.5 * T[:2000]) + 0.2 * rng.standard_normal(2000)
        measured = Law(0.0, lag_s).output(force, 1e-3) + 2e-3 * rng.standard_normal(2000)
        place = 1e-3 * np.arange(2000)
        (found,), strays = drive(Session((Record("restless", place, force, place, measured),)), AXIS)
        assert found.effect == "lag" and not found.doubted and not strays
        z.append((found.values["tau"] - lag_s) / found.errors["tau"])
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6


def test_the_drive_model_is_that_of_the_simulation() -> None:
    model = AXIS.with_effect("delay", {"delay": 2.7e-3}).with_effect("lag", {"tau": 2e-3})
    run = simulate(model, COMMAND)
    np.testing.assert_allclose(Law(2.7e-3, 2e-3).output(run.force, 1e-3)[5:], run.applied[5:], atol=4e-3)
