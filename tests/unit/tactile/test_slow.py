"""A contact that grows slowly is told, at any rate; drift is not, and hides no more than is stated.

The contacts are those of the plant (`sioms.plant.finger`), whose mechanics share nothing with the estimator's.
"""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sioms.plant.finger import FingerShape, TactileArray
from sioms.tactile.finger import Finger as CalibratedFinger
from sioms.tactile.finger import from_toml
from sioms.tactile.quality import Quality, ShapeEstimate, State
from sioms.tactile.sensing import ShapeSensor

pytestmark = pytest.mark.usefixtures("one_estimator")
FINGER = from_toml((Path(__file__).parents[3] / "etc" / "finger.toml").read_text(encoding="utf-8"))
PLANT = TactileArray(FingerShape(gain=3.0))
NONE = np.zeros(16)
NOISE, STEP = 0.023, 0.01  # per cent
TOLD = 12.0  # N/m, stated in docs/tactile-nodes.md
KNOWN = (State.TOUCHED, State.DOUBTFUL)


def touch(degrees: float, load: float, rc: float = 6e-3) -> np.ndarray:
    """Return the outputs [%] under a touch."""
    output: np.ndarray = -100.0 / 3.0 * PLANT.strain(load, math.radians(degrees), rc)
    return output


class Rig:
    """A finger in a driver's signal chain, with noise and a converter."""

    def __init__(self, seed: int, rate: float = 50.0, finger: CalibratedFinger = FINGER) -> None:
        self.random, self.rate = np.random.default_rng(seed), rate
        self.sensor, self.stamp_ns = ShapeSensor(finger), 0
        self.offset = self.random.uniform(-3.0, 3.0, 16)
        for _ in range(40):
            self.frame(NONE)

    def frame(self, output: np.ndarray) -> ShapeEstimate:
        self.stamp_ns += round(1e9 / self.rate)
        raw = self.offset + output + NOISE * self.random.normal(size=16)
        return self.sensor.frame(np.round(raw / STEP) * STEP, self.stamp_ns).shape

    def hold(self, output: np.ndarray, seconds: float) -> list[ShapeEstimate]:
        return [self.frame(output) for _ in range(round(seconds * self.rate))]


def told_at(
    rig: Rig, place: float, rc: float, rate: float, most: float = 30.0, drift: np.ndarray | float = 0.0,
    under: np.ndarray = NONE, rests: bool = False,
) -> float:  # fmt: skip
    """Let a contact grow and hold it; return the load from which on it was always told, and check the last one."""
    load, since, time_s = 0.0, math.nan, 0.0
    while load < most:
        time_s += 1.0 / rig.rate
        if not (rests and time_s % 20.0 > 10.0):
            load += rate / rig.rate
        shape = rig.frame(touch(place, load, rc) + under + drift * time_s / 3600.0)
        known = shape.state in KNOWN
        since = (load if math.isnan(since) else since) if known else math.nan
    if shape.state is State.TOUCHED and not under.any():
        assert shape.load_n_per_m == pytest.approx(most, abs=TOLD)
    return since


@pytest.mark.parametrize(
    ("rate", "place", "rc", "hz"),
    [
        (2.9, 79.6, 6e-3, 50.0), (2.0, 75.0, 0.5e-3, 50.0), (2.0, 20.0, math.inf, 50.0), (1.0, 138.0, 12.3e-3, 25.0),
        (0.3, 50.0, 0.5e-3, 20.0), (0.1, 84.0, math.inf, 10.0), (0.02, 100.0, 6e-3, 5.0), (0.02, 10.0, 0.5e-3, 5.0),
    ],
)  # fmt: skip
def test_a_contact_is_told_however_slowly_it_grows(rate: float, place: float, rc: float, hz: float) -> None:
    assert told_at(Rig(round(place), hz), place, rc, rate) < TOLD


def test_a_contact_that_grows_and_rests_is_told() -> None:
    assert told_at(Rig(1, 20.0), 61.0, 3e-3, 1.5, rests=True) < TOLD


@pytest.mark.parametrize("drift", [-12.0, 12.0])
def test_a_contact_that_grows_beside_uneven_drift_is_told(drift: float) -> None:
    """12 % an hour, a tenth of it uneven, and an element that drifts alone."""
    rig = Rig(2, 4.0)
    each = drift * (1.0 + 0.1 * rig.random.normal(size=16)) + 8.0 * np.eye(16)[3]
    assert told_at(rig, 88.0, 6e-3, 0.2, drift=each) < 2.0 * TOLD


@pytest.mark.parametrize("missing", [[7], [2, 12]])
def test_a_contact_is_told_without_an_element(missing: list[int]) -> None:
    rig, gone = Rig(3, 20.0), NONE.copy()
    gone[missing] = np.nan
    assert told_at(rig, 79.6, 6e-3, 1.0, under=gone) < 2.0 * TOLD


def test_a_contact_is_told_over_an_element_that_misses_frames() -> None:
    """A third of them, by a loose plug."""
    rig, peak, load = Rig(4, 20.0), int(np.argmax(np.abs(touch(70.0, 30.0)))), 0.0
    while load < 45.0:
        load += 1.0 / rig.rate
        output = touch(70.0, load)
        if rig.random.random() < 0.3:
            output[peak] = np.nan
        assert rig.frame(output).state in KNOWN or load < 2.0 * TOLD


def test_two_contacts_that_grow_together_are_told() -> None:
    rig = Rig(4, 20.0)
    for load in np.arange(0.0, 25.0, 1.0 / rig.rate):
        shape = rig.frame(touch(50.0, load) + touch(100.0, load))
        assert shape.state in KNOWN or load < 2.0 * TOLD


def test_a_contact_that_grows_beside_a_held_one_is_told_when_that_is_let_go() -> None:
    rig = Rig(5, 20.0)
    rig.hold(touch(40.0, 200.0), 1.0)
    for load in np.arange(0.0, 30.0, 1.0 / rig.rate):
        assert rig.frame(touch(40.0, 200.0) + touch(100.0, load)).state in KNOWN
    left = rig.hold(touch(100.0, 30.0), 20.0)
    assert {shape.state for shape in left} <= set(KNOWN)
    assert left[-1].load_n_per_m == pytest.approx(30.0, abs=TOLD)


def test_a_load_that_fades_and_comes_back_is_told() -> None:
    rig = Rig(6, 20.0)
    for load in np.concatenate([np.arange(60.0, 2.0, -1.0 / rig.rate), np.full(600, 2.0)]):
        shape = rig.frame(touch(70.0, load))
        assert shape.state in KNOWN or load < TOLD
    assert told_at(rig, 70.0, 6e-3, 1.0) < TOLD


def test_what_is_let_go_after_a_zero_under_a_touch_hides_nothing_later() -> None:
    rig = Rig(7, 20.0)
    rig.offset = rig.offset + touch(70.0, 40.0)
    rig.sensor.zero()
    rig.hold(NONE, 2.0)
    for load in np.arange(0.0, 40.0, 1.0 / rig.rate):
        rig.frame(-touch(70.0, load))
    rig.offset = rig.offset - touch(70.0, 40.0)
    rig.hold(NONE, 20.0)
    assert told_at(rig, 70.0, 6e-3, 1.0) < 2.0 * TOLD


@pytest.mark.parametrize("seed", range(2))
def test_an_hour_of_drift_is_no_touch(seed: int) -> None:
    """1 % that all elements share up to a tenth, waves of it, a warmer side, and each element's own walk."""
    rig = Rig(seed, 1.0)
    each, own = 1.0 + 0.1 * rig.random.normal(size=16), np.zeros(16)
    side = np.cos(np.array(FINGER.angles_rad) - rig.random.uniform(0.0, 3.0))
    for number in range(round(3600.0 * rig.rate)):
        hours = number / rig.rate / 3600.0
        own += 0.03 * math.sqrt(1.0 / rig.rate / 3600.0) * rig.random.normal(size=16)
        wave = math.sin(math.tau * hours / 0.7)
        assert rig.frame(own + each * (0.6 * hours + 0.4 * wave) + 0.5 * wave * side).state is State.UNTOUCHED


def test_the_warmth_that_calibration_has_seen_hides_nothing() -> None:
    """4 % of common drift, a tenth of it uneven: with each element's share in the finger's file, nothing is blind."""
    random = np.random.default_rng(8)
    shares = 1.0 + 0.1 * random.normal(size=16)
    known = tuple((shares / np.median(shares) * (1.0 + 0.005 * random.normal(size=16))).tolist())
    warmed = msgspec.structs.replace(FINGER, signal=msgspec.structs.replace(FINGER.signal, thermal=known))
    rig = Rig(8, 10.0, warmed)
    for share in np.linspace(0.0, 4.0, 4_000):
        assert rig.frame(shares * share).state is State.UNTOUCHED
    assert told_at(rig, 61.0, 6e-3, 0.5, under=4.0 * shares) < 2.0 * TOLD


def test_an_element_that_drifts_alone_is_no_touch() -> None:
    rig = Rig(9, 10.0)
    for number in range(8_000):
        assert rig.frame(2.5e-4 * number * np.eye(16)[7]).state is State.UNTOUCHED
    assert told_at(rig, 40.0, 6e-3, 1.0, under=2.0 * np.eye(16)[7]) < 2.0 * TOLD


def test_drift_under_a_held_touch_is_no_touch_when_that_is_let_go() -> None:
    """0.12 % uneven drift during a touch: 25 times the noise of all elements, which once held the baseline for ever."""
    rig = Rig(10, 20.0)
    drift = 0.12 * rig.random.normal(size=16)
    for share in np.linspace(0.0, 1.0, 1000):
        rig.frame(touch(70.0, 200.0) + share * drift)
    rig.hold(drift, 2.5)
    assert {shape.state for shape in rig.hold(drift, 5.0)} == {State.UNTOUCHED}
    held = rig.hold(touch(90.0, 150.0) + drift, 0.5)
    assert {shape.state for shape in held} == {State.TOUCHED}
    assert held[-1].load_n_per_m == pytest.approx(150.0, abs=4.0)
    assert rig.hold(drift, 0.2)[-1].state is State.UNTOUCHED


def test_drift_under_a_touch_that_would_hide_contacts_makes_blind_when_that_is_let_go() -> None:
    """Not a touch for ever, of which no zero is taken."""
    rig = Rig(14, 10.0)
    drift = 0.3 * rig.random.normal(size=16)
    for share in np.linspace(0.0, 1.0, 600):
        assert rig.frame(touch(70.0, 300.0) + share * drift).state in KNOWN
    for shape in rig.hold(drift, 5.0):
        assert shape.state is not State.UNTOUCHED
    assert all(Quality.DRIFTED in shape.quality for shape in rig.hold(drift, 2.0))
    asked = rig.sensor.rebase()
    rig.hold(drift, 5.0)
    assert asked.done
    assert {shape.state for shape in rig.hold(drift, 2.0)} == {State.UNTOUCHED}


def test_creep_after_a_long_hold_is_no_touch_that_stays() -> None:
    """A touch leaves 5 %, which fades in five minutes."""
    rig = Rig(11, 5.0)
    rig.hold(touch(70.0, 200.0), 5.0)
    pattern = touch(70.0, 10.0)
    states = [rig.frame(pattern * math.exp(-number / rig.rate / 100.0)).state for number in range(5 * 300)]
    assert set(states[5 * 150 :]) == {State.UNTOUCHED}
    assert told_at(rig, 70.0, 6e-3, 1.0) < 2.0 * TOLD


def test_drift_that_hides_contacts_makes_blind_until_it_is_zeroed() -> None:
    rig = Rig(12, 20.0)
    drift = 0.5 * np.random.default_rng(12).normal(size=16)
    for share in np.linspace(0.0, 1.0, 5_000):
        shape = rig.frame(share * drift)
        assert shape.state in (State.UNTOUCHED, State.BLIND)
    assert shape.state is State.BLIND and Quality.DRIFTED in shape.quality
    assert {one.state for one in rig.hold(touch(70.0, 200.0) + drift, 0.3)} == {State.TOUCHED}  # a fast one is told
    rig.hold(drift, 3.0)
    asked = rig.sensor.rebase()
    rig.hold(drift, 1.0)
    assert asked.done
    assert {one.state for one in rig.hold(drift, 2.0)} == {State.UNTOUCHED}


def test_a_slow_contact_is_doubtful_until_it_is_larger_than_drift_can_be() -> None:
    rig = Rig(13, 20.0)
    seen = []
    for load in np.arange(0.0, 60.0, 1.0 / rig.rate):
        shape = rig.frame(touch(70.0, load))
        seen.append(Quality.SLOW in shape.quality)
        if seen[-1]:
            assert shape.state is State.DOUBTFUL
            with pytest.raises(ValueError, match="lift that off"):
                rig.sensor.rebase()
    assert any(seen) and shape.state is State.TOUCHED
    assert shape.load_n_per_m == pytest.approx(60.0, abs=4.0 * shape.deviations[1] + 1.0)
