"""Encoder: steps, scale, eccentricity and index marks."""

import numpy as np
import pytest

from sioms.plant.effects import build_effects
from sioms.plant.encoder import Encoder
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor, Wall


def encoder(step=1e-3, pitch=np.inf, **effects):
    return Encoder(np.array([step]), np.array([pitch]), build_effects({"x": effects}, ["x"]))


def test_reading_is_the_step_below():
    e = encoder()
    for true, shown in ((0.0, 0.0), (0.0019999, 0.001), (0.002, 0.002), (-0.0001, -0.001), (0.3, 0.3)):
        e.read(np.array([true]))
        assert e.position[0] == pytest.approx(shown, abs=1e-12)


def test_scale_eccentricity_and_coarser_steps():
    e = encoder(encoder_scale={"gain": 1.01}, encoder_quantisation={"factor": 10})
    e.read(np.array([0.1]))
    assert e.position[0] == pytest.approx(0.1)
    e.read(np.array([0.0991]))
    assert e.position[0] == pytest.approx(0.1)
    e = encoder(step=0.0, encoder_eccentricity={"amplitude": 0.002, "pitch": 0.4})
    e.read(np.array([0.1]))
    assert e.position[0] == pytest.approx(0.102)


@pytest.mark.parametrize(
    "path, mark", [([0.0, 0.004, 0.0123], 0.010), ([0.015, 0.0099], 0.010), ([0.001, 0.031], 0.030)]
)
def test_index_is_latched_at_the_mark(path, mark):
    e = encoder(pitch=0.01)
    e.start(np.array(path[:1]))
    for position in path[1:-1]:
        e.read(np.array([position]))
        assert not e.index[0] and np.isnan(e.latch[0])
    e.read(np.array(path[-1:]))
    assert e.index[0] and e.latch[0] == pytest.approx(mark)
    e.read(np.array(path[-1:]))
    assert not e.index[0] and e.latch[0] == pytest.approx(mark)


@pytest.mark.parametrize(
    "motor, word",
    [
        (Motor(mass=0.0), "mass"),
        (Motor(mass=1.0, coulomb=2.0, stiction=1.0), "stiction"),
        (Motor(mass=1.0, start=2.0, stop_plus=1.0), "stops"),
        (Motor(mass=1.0, wall=Wall(0.0, -1.0)), "wall"),
        (Motor(mass=1e-3, wall=Wall(0.0, 1e9)), "substeps"),
    ],
)
def test_bank_refuses_what_no_motor_can_be(motor, word):
    with pytest.raises(ValueError, match=word):
        MotorBank([motor], 1e-3)
