"""What a measured current tells of a drive: as seldom as it is refreshed, and beside noise of any colour."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from sioms.reconcile.channels import Finding
from sioms.reconcile.current import Law, drive
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.stale import news

AXIS = AxisModel(True, 1e-3, 1e-3, 1e-3, 1e-5, 6.28, 0.5, 10.0)


def servo(seed: int) -> np.ndarray:
    """A command as loops make it: steps that are worked off, and an encoder's chatter."""
    t, rng = 1e-3 * np.arange(8000), np.random.default_rng(seed)
    worked = lfilter([0.1], [1.0, -0.9], 0.4 * np.sign(np.sin(2.0 * np.pi * 1.3 * t)))
    return np.asarray(worked + lfilter([0.3], [1.0, -0.7], 0.03 * rng.standard_normal(8000)))


def driven(force: np.ndarray, measured: np.ndarray) -> list[Finding]:
    place = 1e-3 * np.arange(len(force))
    found, strays = drive(Session((Record("current", place, force, place, measured),)), AXIS)
    assert not strays
    return found


@pytest.mark.parametrize("held", [2, 3, 5])
@pytest.mark.parametrize("counted", [0.0, 0.02])
def test_a_current_that_is_refreshed_seldom_tells_a_lag_as_long_as_it_is(held: int, counted: float) -> None:
    """Rows that repeat old news made 3.5 ms of 3."""
    force, rng = servo(1), np.random.default_rng(2)
    measured = Law(lag=3e-3).output(force, 1e-3) + 2e-3 * rng.standard_normal(8000)
    measured = counted * np.round(measured / counted) if counted else measured
    found = driven(force, measured[np.arange(8000) // held * held])
    assert [f.effect for f in found] == ["lag"] and not found[0].doubted
    assert f"one of {held}" in found[0].evidence
    assert found[0].values["tau"] == pytest.approx(3e-3, abs=5.0 * found[0].errors["tau"])
    assert found[0].errors["tau"] < 5e-5


def test_a_refreshed_current_that_is_a_mean_is_read_as_one_and_one_that_comes_irregularly_is_not_sure() -> None:
    """The mean of two rows is late by half of one, as a delay is."""
    force, rng = servo(1), np.random.default_rng(2)
    out = Law(lag=3e-3).output(force, 1e-3)
    mean = np.concatenate([out[:1], 0.5 * (out[1:] + out[:-1])]) + 2e-3 * rng.standard_normal(8000)
    (found,) = driven(force, mean[np.arange(8000) // 2 * 2])
    assert found.effect == "lag" and "mean of 2 rows" in found.evidence
    assert found.values["tau"] == pytest.approx(3e-3, abs=5.0 * found.errors["tau"])
    assert all(f.doubted for f in driven(force, mean[np.floor(np.floor(np.arange(8000) / 2.3) * 2.3).astype(int)]))


def test_a_delay_and_a_lag_at_once_are_both_found() -> None:
    force, rng = servo(1), np.random.default_rng(3)
    measured = Law(delay=2e-3, lag=3e-3).output(force, 1e-3) + 2e-3 * rng.standard_normal(8000)
    found = driven(force, measured)
    assert [f.effect for f in found] == ["delay", "lag"] and not any(f.doubted for f in found)
    assert found[0].values["delay"] == pytest.approx(2e-3, abs=4.0 * found[0].errors["delay"])
    assert found[1].values["tau"] == pytest.approx(3e-3, abs=4.0 * found[1].errors["tau"])


@pytest.mark.parametrize("what", ["filtered", "hum", "counts"])
def test_noise_of_any_colour_doubts_no_right_lag_and_widens_it(what: str) -> None:
    force, z = servo(4), []
    for seed in range(50, 58):
        rng = np.random.default_rng(seed)
        noise = {
            "filtered": 0.012 * 0.6 * lfilter([1.0], [1.0, -0.8], rng.standard_normal(8000)),
            "hum": 0.017 * np.sin(2.0 * np.pi * 0.05 * np.arange(8000) + seed),
            "counts": 2e-3 * rng.standard_normal(8000),
        }[what]
        measured = Law(lag=3e-3).output(force, 1e-3) + noise
        (found,) = driven(force, 0.02 * np.round(measured / 0.02) if what == "counts" else measured)
        assert found.effect == "lag" and not found.doubted
        z.append((found.values["tau"] - 3e-3) / found.errors["tau"])
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_drive_of_second_order_is_no_sure_delay_and_lag() -> None:
    force, rng = servo(1), np.random.default_rng(5)
    measured = lfilter([0.04], np.convolve([1.0, -0.8], [1.0, -0.8]), force) + 2e-3 * rng.standard_normal(8000)
    found = driven(force, measured)
    assert found and all(f.doubted for f in found)


def test_what_stays_where_it_is_limited_at_rest_or_counted_is_not_held() -> None:
    rng = np.random.default_rng(6)
    force = servo(6)
    for column in (
        np.clip(force, -0.3, 0.3),
        np.where(np.arange(8000) % 2000 < 900, 0.0, force),
        0.02 * np.round(force / 0.02),
        force + 1e-3 * rng.standard_normal(8000),
        np.zeros(8000),
    ):
        assert news(column).every == 1 and len(news(column).rows) == 8000
    assert news(force[np.arange(8000) // 4 * 4]).every == 4
    assert news(force[np.floor(np.floor(np.arange(8000) / 1.7) * 1.7).astype(int)]).every == 0


def test_a_delay_of_a_part_of_a_sample_is_followed_by_a_lag_as_it_is() -> None:
    """Against the response of a lag to each step of the command, added up."""
    dt, delay, lag = 1e-3, 1.37e-3, 0.8e-3
    force = np.random.default_rng(3).standard_normal(40)
    edges = dt * np.arange(41)

    def area(t: np.ndarray) -> np.ndarray:
        """Integral of the lag's response to a unit step at 0."""
        return np.where(t > 0.0, t - lag * (1.0 - np.exp(-np.maximum(t, 0.0) / lag)), 0.0)

    steps = np.diff(np.concatenate([[0.0], force]))
    total = sum(step * area(edges - i * dt - delay) for i, step in enumerate(steps))
    assert Law(delay=delay, lag=lag).output(force, dt) == pytest.approx(np.diff(total) / dt, abs=1e-9)
