"""Force sensor: statics, and what its electronics do to it."""

import numpy as np
import pytest

from sioms.plant.force_sensor import Contact, ForceSensor


def test_statics_of_a_lever():
    sensor = ForceSensor([Contact((0, 0, -2.0), (0.1, 0.0, 0.0)), Contact((1, 0, 0), (0, 0, 0.05))])
    reading = sensor.read(np.array([10.0, 4.0]), np.zeros(6))
    np.testing.assert_allclose(reading, [4, 0, -10, 0, 10 * 0.1 + 4 * 0.05, 0], atol=1e-12)


def test_couple_has_torque_only():
    sensor = ForceSensor([Contact((0, 1, 0), (0.2, 0, 0)), Contact((0, -1, 0), (-0.2, 0, 0))])
    np.testing.assert_allclose(sensor.read(np.array([3.0, 3.0]), np.zeros(6)), [0, 0, 0, 0, 0, 1.2], atol=1e-12)


def test_noise_bias_resolution_and_limit():
    sensor = ForceSensor(
        [Contact((1, 0, 0))], noise=0.05, resolution=0.01, bias=[0.2, 0, 0, 0, 0, 0], limit=5.0, seed=1
    )
    out = np.zeros(6)
    readings = np.array([sensor.read(np.array([1.0]), out).copy() for _ in range(5000)])
    np.testing.assert_allclose(readings.mean(0), [1.2, 0, 0, 0, 0, 0], atol=4e-3)
    np.testing.assert_allclose(readings.std(0), 0.05, rtol=0.05)
    np.testing.assert_allclose(np.remainder(readings / 0.01 + 0.5, 1), 0.5, atol=1e-6)
    assert sensor.read(np.array([100.0]), out)[0] == 5.0


def test_no_contact_reads_nothing():
    np.testing.assert_array_equal(ForceSensor([]).read(np.zeros(0), np.ones(6)), np.zeros(6))


def test_refuses_a_force_without_direction():
    with pytest.raises(ValueError, match="direction"):
        ForceSensor([Contact((0, 0, 0))])
