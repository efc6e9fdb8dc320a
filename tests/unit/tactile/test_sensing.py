"""Sensing from raw frames: baseline, contact, load information, and every kind of bad input."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.tactile import kernel
from sioms.tactile.finger import Finger
from sioms.tactile.quality import Load, Quality
from sioms.tactile.sensing import CHANNELS, LoadTare, ShapeSensor, numbers

MS = 1_000_000
PERIOD = 5 * MS


class Rig:
    """Feed a sensor with frames: strains in, outputs as the finger would give them, noise on top."""

    def __init__(self, finger: Finger, tare: LoadTare | None = None, settle: bool = True) -> None:
        self.sensor = ShapeSensor(finger, tare=tare)
        self.random = np.random.default_rng(2)
        self.now_ns = 0
        if settle:
            for _ in range(40):
                self.frame(np.zeros(16), 0.0)

    def frame(self, strains, reading=None, **changes):
        raw = 100.0 * (-np.asarray(strains) + 1e-3 * self.random.normal(size=16))
        for place, value in changes.items():
            raw[int(place[1:])] = value
        self.now_ns += PERIOD
        return self.sensor.frame(raw, self.now_ns, reading)


def test_a_touch_is_felt_where_how_hard_and_how_round_it_is(nominal, touch) -> None:
    rig = Rig(nominal)
    before = rig.frame(np.zeros(16))
    assert not before.strain.touched and before.shape.quality is Quality.NO_CONTACT
    strains = touch(np.radians(75.0), 200.0, 6e-3)
    found = [rig.frame(strains).shape for _ in range(20)]
    assert all(shape.quality is Quality.GOOD for shape in found)
    assert np.mean([shape.angle_rad for shape in found]) == pytest.approx(np.radians(75.0), abs=1e-3)
    assert np.mean([shape.load_n_per_m for shape in found]) == pytest.approx(200.0, rel=0.04)
    assert np.mean([shape.radius_m for shape in found]) == pytest.approx(6e-3, rel=0.2)
    assert rig.frame(np.zeros(16)).shape.quality is Quality.NO_CONTACT


def test_numbers_follow_the_channels(nominal, touch) -> None:
    rig = Rig(nominal, settle=False)
    names = [name for name, _, _ in CHANNELS]
    first = dict(zip(names, numbers(rig.frame(np.zeros(16))), strict=True))
    assert first["quality"] == Quality.NO_BASELINE.value and np.isnan(first["load"])
    for _ in range(30):
        still = rig.frame(np.zeros(16))
    quiet = dict(zip(names, numbers(still), strict=True))
    assert (quiet["touched"], quiet["load"], quiet["quality"]) == (0.0, 0.0, Quality.NO_CONTACT.value)
    sensed = rig.frame(touch(np.radians(60.0), 150.0, np.inf))
    felt = dict(zip(names, numbers(sensed), strict=True))
    assert felt["touched"] == 1.0 and felt["curvature"] == pytest.approx(1.0 / felt["equivalent_radius"])
    assert felt["var_load"] == sensed.shape.covariance[1][1]
    assert felt["cov_angle_radius"] == sensed.shape.covariance[0][2]


def test_zero_takes_a_new_baseline(nominal) -> None:
    rig = Rig(nominal)
    shift = -0.02 * np.eye(16)[4]  # an element that has moved under a touch nobody sees any more
    assert rig.frame(shift).strain.touched
    rig.sensor.zero()
    assert rig.frame(shift).shape.quality is Quality.NO_BASELINE
    for _ in range(20):
        after = rig.frame(shift)
    assert not after.strain.touched and abs(after.strain.strains[4]) < 5e-3


def test_load_information_narrows_load_and_is_tared(nominal, touch) -> None:
    rig = Rig(nominal, LoadTare(scale=-50.0, deviation=1.0, time_s=2.0))
    for _ in range(20):
        rig.frame(np.zeros(16), 3.0)  # the sensor's own offset, N
    rig = rig_after_tare(rig)
    strains = touch(np.radians(75.0), 200.0, 6e-3)
    alone = Rig(nominal).frame(strains).shape
    with_load = rig.frame(strains, 3.0 - 4.0).shape
    assert with_load.deviations[1] < 1.1 < alone.deviations[1]
    assert with_load.load_n_per_m == pytest.approx(200.0, abs=3.0)
    assert with_load.quality is Quality.GOOD


def rig_after_tare(rig: Rig) -> Rig:
    for _ in range(2000):  # ten seconds: the tare has followed from 0 to 3
        rig.frame(np.zeros(16), 3.0)
    return rig


@pytest.mark.parametrize("reading", [None, float("nan"), +4.0])
def test_without_a_believable_load_the_strains_decide(nominal, touch, reading) -> None:
    """None: no reading, or too old. nan: broken. Of the wrong sign: the sensor contradicts the touch."""
    rig = Rig(nominal, LoadTare(scale=-50.0, deviation=1.0, time_s=2.0))
    shape = rig.frame(touch(np.radians(75.0), 200.0, 6e-3), reading).shape
    assert shape.quality is Quality.WITHOUT_LOAD
    assert shape.load_n_per_m == pytest.approx(200.0, rel=0.05)


def test_a_load_that_contradicts_the_strains_shows_as_a_poor_fit(nominal, touch) -> None:
    rig = Rig(nominal, LoadTare(scale=1.0, deviation=1.0, time_s=2.0))
    shape = rig.frame(touch(np.radians(75.0), 200.0, 6e-3), 400.0).shape
    assert Quality.POOR_FIT in shape.quality


def test_nan_saturated_and_dead_elements_are_left_out_and_said(nominal, touch) -> None:
    rig = Rig(nominal)
    strains = touch(np.radians(75.0), 200.0, 6e-3)
    hurt = rig.frame(strains, e3=np.nan, e12=100.0)
    assert Quality.BAD_ELEMENTS in hurt.shape.quality and hurt.strain.saturated[12]
    assert np.isnan(hurt.strain.strains[[3, 12]]).all()
    assert hurt.shape.angle_rad == pytest.approx(np.radians(75.0), abs=5e-3)
    nothing = rig.frame(np.full(16, np.nan))
    assert not nothing.shape.usable and np.isnan(nothing.shape.load_n_per_m)


def test_wrong_input_is_refused_with_the_reason(nominal) -> None:
    rig = Rig(nominal)
    with pytest.raises(ValueError, match="15 readings in shape"):
        rig.sensor.frame(np.zeros(15), rig.now_ns)
    with pytest.raises(ValueError, match="before the last one"):
        rig.sensor.frame(np.zeros(16), 0)
    with pytest.raises(ValueError, match="need a finite number, not 0"):
        LoadTare(0.0, 1.0, 2.0)
    with pytest.raises(ValueError, match="deviation is -1"):
        LoadTare(1.0, -1.0, 2.0)
    with pytest.raises(ValueError, match="finite pressing load"):
        rig.sensor._estimator.frame(np.zeros(16), Load(-200.0, 4.0))


def test_gain_matrix_mixes_outputs_and_refuses_nonsense(nominal) -> None:
    rig = Rig(nominal)
    assert np.array_equal(rig.sensor.gains, np.diag(nominal.elements.gain))
    mixing = np.eye(16)
    mixing[0, 1] = 0.5
    rig.sensor.set_gains(mixing)
    assert np.array_equal(rig.sensor.gains, mixing)
    strains = rig.frame(-0.05 * np.eye(16)[1]).strain.strains
    assert strains[0] == pytest.approx(-0.025, abs=4e-3) and strains[1] == pytest.approx(-0.05, abs=4e-3)
    for bad, words in (
        (np.zeros(16), "not positive"),
        (np.full((16, 16), np.nan), "not positive"),
        (np.ones(15), "15 gains"),
    ):
        with pytest.raises(ValueError, match=words):
            rig.sensor.set_gains(bad)


def test_a_sensor_that_is_warm_has_fitted_and_forgotten_it(nominal: Finger) -> None:
    pytest.importorskip("numba")
    solver = kernel.compiled()
    cold, warm = (ShapeSensor(nominal, compiled=True, settle_frames=2) for _ in range(2))
    warm.warm()
    assert solver.nopython_signatures  # type: ignore[attr-defined]  # loaded
    raw = np.zeros(len(nominal.angles_rad))
    for stamp_ns in (1, 2, 3):
        assert numbers(cold.frame(raw, stamp_ns)) == pytest.approx(numbers(warm.frame(raw, stamp_ns)), nan_ok=True)
