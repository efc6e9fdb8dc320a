"""The simulated finger against facts that do not use its mesh: published answers, balance, symmetry, limits."""

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import solveh_banded

from sioms.plant.finger import FingerShape, TactileArray
from sioms.plant.rubber import POINTS, Layer, Rubber, gap, solve_banded

B = Layer()
ANGLE = 2 * math.pi / POINTS * np.arange(POINTS)


@pytest.fixture(scope="module")
def rubber():
    return Rubber(B, np.array([10.3e-3]), gauge_m=0.1e-3)


@pytest.fixture(scope="module")
def perfect():
    return TactileArray(FingerShape())


@pytest.mark.parametrize(
    "k, strain", [(0, 8.61209e-7), (1, 1.03953e-6), (5, 2.29009e-6), (10, 2.25037e-6), (20, 5.56699e-7)]
)
def test_strain_by_pressure_is_the_known_one(rubber, k, strain):
    assert rubber.strain[0, k, 0] == pytest.approx(strain, rel=2e-3)


def test_surface_compliance_is_the_known_one_and_joins_the_half_planes(rubber):
    assert rubber.compliance[0, 2] == pytest.approx(4.76088e-9, rel=1e-4)
    assert rubber.compliance[3, 8] == pytest.approx(9.67449e-9, rel=1e-4)
    # the mesh ends at 160: what follows is the half plane's limit
    np.testing.assert_allclose(
        rubber.compliance[0, 155:160] * np.arange(155, 160), rubber.compliance[0, 170] * 170, rtol=2e-3
    )


def test_flat_is_as_wide_as_the_bounded_solution_says(rubber):
    """Known answer: a flat at 200 N/m touches 0.4198 rad; exact shapes take up to 2 % off the parabola's."""
    pressed = rubber.press(200.0, math.inf)
    assert 2 * pressed.half_width == pytest.approx(0.419787, rel=0.025)


def test_strains_of_a_touch_are_the_known_ones(rubber):
    pressed = rubber.press(200.0, 6.01e-3)
    peak = 0.0832
    near, far = (np.interp(math.radians(d), ANGLE, pressed.profile[:, 0]) for d in (5.76, 12.68))
    assert near == pytest.approx(-0.0830872, abs=0.01 * peak)
    assert far == pytest.approx(0.00837931, abs=0.01 * peak)


def test_the_mean_strain_carries_the_load(rubber):
    """k = 0 sees the total load alone, whatever the indenter: mean strain = -P/(2 pi rb) times its coefficient."""
    for radius in (0.0, 3e-3, math.inf):
        mean = rubber.press(150.0, radius).profile[:, 0].mean()
        assert mean == pytest.approx(-150.0 / (2 * math.pi * B.outer_m) * 8.61209e-7, rel=1e-3)


def test_adhesion_narrows_the_strain_and_keeps_the_load(rubber):
    free, stuck = (rubber.press(200.0, math.inf, share).profile[:, 0] for share in (0.0, 1.0))
    assert stuck.mean() == pytest.approx(free.mean(), rel=1e-3)
    assert np.count_nonzero(stuck < stuck.min() / 2) < np.count_nonzero(free < free.min() / 2)


def test_gaps_begin_at_zero_with_the_curvature_of_the_pair():
    t = np.array([0.0, 1e-3])
    for radius, together in ((5e-3, 1 / (1 / 12.7e-3 + 1 / 5e-3)), (math.inf, 12.7e-3)):
        apart = gap(12.7e-3, radius, t)
        assert apart[0] == pytest.approx(0.0, abs=1e-15)
        assert apart[1] == pytest.approx((12.7e-3 * 1e-3) ** 2 / (2 * together), rel=1e-4)
    assert gap(12.7e-3, 0.0, t)[1] == pytest.approx(12.7e-3 * 1e-3, rel=2e-3)  # 45 degrees
    assert np.isinf(gap(12.7e-3, 1e-3, np.array([0.2]))[0])


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Layer(core_m=0.013), "need 0 < core < outer"),
        (lambda: Layer(poisson_ratio=0.5), "need 0 to 0.495"),
        (lambda: Rubber(B, np.array([12.69e-3])), "do not lie inside"),
        (lambda: FingerShape(angles_rad=()), "one or more"),
        (lambda: FingerShape(creep=2.0), "want 0 to 1"),
    ],
)
def test_what_cannot_be_moulded_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_pattern_turns_with_the_contact_and_grows_with_the_load(perfect):
    shape = perfect.shape
    pitch = shape.angles_rad[0] - shape.angles_rad[1]
    here = perfect.strain(200.0, shape.angles_rad[8], 6e-3)
    there = perfect.strain(200.0, shape.angles_rad[8] + pitch, 6e-3)
    np.testing.assert_allclose(there[:-1], here[1:], atol=2e-4 * np.abs(here).max())
    assert np.argmin(here) == 8 and here[8] < -0.07
    assert perfect.strain(0.0, 1.3, 6e-3).max() == 0.0
    small, large = (np.abs(perfect.strain(p, shape.angles_rad[8], 6e-3)).max() for p in (100.0, 200.0))
    assert 1.6 * small < large < 2.0 * small  # the contact grows: less than in proportion


def test_the_faults_are_as_large_as_asked_for(perfect):
    out = np.zeros(16)
    quiet = perfect.read(4.0, 1.29, 6e-3, out).copy()
    peak = quiet.max()

    def read(time_s=0.0, force=4.0, **faults):
        return TactileArray(FingerShape(**faults)).read(force, 1.29, 6e-3, out, time_s).copy()

    np.testing.assert_allclose(read(quadratic=0.01), quiet + 0.01 * quiet**2, rtol=1e-9)
    np.testing.assert_allclose(read(1 / 480, mains=0.3) - quiet, 0.3, rtol=1e-6)  # a quarter of 120 Hz
    np.testing.assert_allclose(read(150.0, drift=0.5) - quiet, 0.5, rtol=1e-6)
    pulled = read(proximity=-3.0) - quiet
    assert pulled.min() == pytest.approx(-3.0, rel=0.4) and pulled.argmin() == quiet.argmax()
    stripped = read(strip_gain=0.05) / quiet
    assert 1.0 < stripped.max() <= 1.05 and stripped.min() == pytest.approx(1.0, abs=1e-3)
    scatter = TactileArray(
        FingerShape(gain=3.0, gain_scatter=0.1, depth_scatter_m=2e-4, angle_scatter_rad=0.01, seed=4)
    ).truth
    assert 0.05 < np.std(np.log(scatter.gains)) < 0.2
    assert np.ptp(scatter.radii_m) > 1e-4 and np.ptp(scatter.angles_rad - perfect.truth.angles_rad) > 0.005
    late = TactileArray(FingerShape(creep=0.2, creep_s=0.25))
    late.read(0.0, 1.29, 6e-3, out, 0.0)
    first = late.read(4.0, 1.29, 6e-3, out, 1e-6).max()
    after = late.read(4.0, 1.29, 6e-3, out, 0.25).max()
    assert first == pytest.approx(0.8 * peak, rel=1e-3)
    assert after == pytest.approx((1 - 0.2 / math.e) * peak, rel=1e-3)


def test_array_noise_offset_steps_and_seed():
    out = np.zeros(16)
    array = TactileArray(FingerShape(), gain=2.0, offset=0.5, noise=0.02, resolution=0.01, seed=3)
    readings = np.array([array.read(0.0, 1.3, 5e-3, out).copy() for _ in range(4000)])
    assert readings.mean() == pytest.approx(0.5, abs=2e-3)
    assert readings.std() == pytest.approx(math.hypot(0.02, 0.01 / math.sqrt(12)), rel=0.03)
    np.testing.assert_allclose(np.remainder(readings / 0.01 + 0.5, 1.0), 0.5, atol=1e-6)
    again = TactileArray(FingerShape(), gain=2.0, offset=0.5, noise=0.02, resolution=0.01, seed=3)
    np.testing.assert_array_equal(again.read(0.0, 1.3, 5e-3, out), readings[0])


def test_elements_equally_deep_share_a_pattern(perfect):
    elements = np.array(perfect.shape.angles_rad)
    deeper = TactileArray(FingerShape(depth_scatter_m=1e-9))
    assert perfect._rubber.strain.shape[2] == 1 and deeper._rubber.strain.shape[2] == len(elements)
    for load, angle in ((5.0, 1.29), (300.0, elements[3])):
        one, each = (array.strain(load, angle, 6e-3) for array in (perfect, deeper))
        np.testing.assert_allclose(one, each, atol=1e-5 * np.abs(one).max())


def test_banded_systems_are_solved_as_one_by_one():
    chance = np.random.default_rng(1)
    bands = 0.3 * chance.normal(size=(7, 6, 40))
    bands[:, 5] += 6.0
    right = chance.normal(size=(40, 2))
    solved = solve_banded(bands, right)
    assert solved.shape == (7, 40, 2)
    for one, found in zip(bands, solved, strict=True):
        np.testing.assert_allclose(found, solveh_banded(one, right), rtol=1e-12, atol=1e-13)


def test_a_simulated_finger_without_an_estimator_loads_no_scipy():
    code = (
        "import sys; from sioms.sdk.finding import find_driver; find_driver('sim-tactile', ''); "
        "sys.exit(any(name.startswith('scipy') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-P", "-c", code]).returncode == 0
