"""Strain of the simulated finger against facts that do not use its formulas."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from sioms.plant.finger import FingerShape, TactileArray, half_width, hertz_stress, radial_strain

SHAPE = FingerShape()


def line_load(x, z, load):
    """Flamant: stresses below a line load on a half plane."""
    r4 = (x * x + z * z) ** 2
    return -2 * load / math.pi * x * x * z / r4, -2 * load / math.pi * z**3 / r4


@pytest.mark.parametrize("x", [0.0, 0.4e-3, -1.9e-3, 6e-3])
def test_stress_is_the_superposed_stress_of_line_loads(x):
    a, load, z = 1.7e-3, 150.0, 2.4e-3
    for part, value in enumerate(hertz_stress(np.array([x]), z, load, a)):

        def density(s, part=part):
            pressure = 2 * load / (math.pi * a) * math.sqrt(1 - (s / a) ** 2)
            return line_load(x - s, z, pressure)[part]

        assert value[0] == pytest.approx(quad(density, -a, a, epsabs=0, epsrel=1e-11)[0], rel=1e-9)


def test_stress_below_carries_the_load():
    total = quad(lambda x: hertz_stress(np.array([x]), 2e-3, 80.0, 1e-3)[1][0], -np.inf, np.inf)[0]
    assert total == pytest.approx(-80.0, rel=1e-6)


def test_half_width_flattens_the_surface():
    """Inside the contact the slope of the half plane under Hertz's ellipse is -x/R of the gap (numerically)."""
    load, rc = 200.0, 5e-3
    a = half_width(SHAPE, load, rc)
    stiffness = (1 - SHAPE.poisson_ratio) / (math.pi * SHAPE.shear_modulus_pa)

    def slope(x):
        """du_z/dx = (1 - nu)/(pi mu) times the principal value of p(s)/(x - s)."""
        pressure = lambda s: 2 * load / (math.pi * a) * math.sqrt(max(0.0, 1 - (s / a) ** 2))  # noqa: E731
        return -stiffness * quad(pressure, -a, a, weight="cauchy", wvar=x)[0]

    curvature = 1 / SHAPE.radius_m + 1 / rc
    for x in (0.2 * a, 0.7 * a):
        assert abs(slope(x)) == pytest.approx(curvature * x, rel=1e-6)


def test_known_width_of_a_cylinder():
    assert 2 * half_width(SHAPE, 200.0, 5e-3) / SHAPE.radius_m == pytest.approx(0.271481, rel=1e-5)


def test_pattern_is_symmetric_and_shifts_with_the_contact():
    shape = FingerShape(angles_rad=tuple(np.linspace(0.5, 2.5, 17)))
    middle = radial_strain(shape, 1.5, 200.0, 3e-3)
    np.testing.assert_allclose(middle, middle[::-1], rtol=1e-10)
    step = shape.angles_rad[1] - shape.angles_rad[0]
    np.testing.assert_allclose(radial_strain(shape, 1.5 + 2 * step, 200.0, 3e-3)[2:], middle[:-2], rtol=1e-9)
    assert np.argmin(middle) == 8 and middle[8] < -0.05


def test_sharper_and_deeper_change_the_pattern_as_they_must():
    sharp = radial_strain(SHAPE, 1.3, 200.0, 1e-3).min()
    flat = radial_strain(SHAPE, 1.3, 200.0, math.inf).min()
    assert sharp < flat < 0
    small = radial_strain(SHAPE, 1.3, 1e-3, 1e-3) / 1e-3
    x = SHAPE.radius_m * (np.array(SHAPE.angles_rad) - 1.3)
    along, down = line_load(x, SHAPE.depth_m, 1.0)
    line = ((1 - SHAPE.poisson_ratio) * down - SHAPE.poisson_ratio * along) / (2 * SHAPE.shear_modulus_pa)
    np.testing.assert_allclose(small, line, rtol=1e-4)


def test_array_noise_offset_steps_and_seed():
    out, again = np.zeros(16), np.zeros(16)
    array = TactileArray(SHAPE, gain=2.0, offset=0.5, noise=0.02, resolution=0.01, seed=3)
    readings = np.array([array.read(0.0, 1.3, 5e-3, out).copy() for _ in range(4000)])
    assert readings.mean() == pytest.approx(0.5, abs=2e-3)
    assert readings.std() == pytest.approx(math.hypot(0.02, 0.01 / math.sqrt(12)), rel=0.03)
    np.testing.assert_allclose(np.remainder(readings / 0.01 + 0.5, 1.0), 0.5, atol=1e-6)
    TactileArray(SHAPE, gain=2.0, offset=0.5, noise=0.02, resolution=0.01, seed=3).read(0.0, 1.3, 5e-3, again)
    np.testing.assert_array_equal(again, readings[0])
    quiet = TactileArray(SHAPE, gain=2.0)
    strain = radial_strain(SHAPE, 1.3, 4.0 / SHAPE.length_m, 5e-3)
    np.testing.assert_allclose(quiet.read(4.0, 1.3, 5e-3, out), -200 * strain)
