"""Known answers of the tactile model, computed elsewhere by shooting integration, 80-digit arithmetic and boundary
elements.
"""

from __future__ import annotations

import numpy as np
import pytest

from sioms.tactile import closedform, contact, emap, series
from sioms.tactile.cylinder import FINGER_A, FINGER_B, Cylinder, respond
from sioms.tactile.indenter import FLAT
from sioms.tactile.width import rigid_core_table

DEPTH = {FINGER_A: 9.4e-3, FINGER_B: 10.3e-3}
ANGLES = np.radians(143.0 - 9.22 * np.arange(16))
RB = FINGER_B.outer_m

COEFFICIENTS = [
    (FINGER_A, "e_rr", "p", 0, 0.0),
    (FINGER_A, "e_rr", "p", 1, 2.48176e-07),
    (FINGER_A, "e_rr", "p", 2, 6.8509e-07),
    (FINGER_A, "e_rr", "p", 5, 1.59373e-06),
    (FINGER_A, "e_rr", "p", 10, 1.29428e-06),
    (FINGER_A, "e_rr", "p", 20, 1.42808e-07),
    (FINGER_A, "e_rr", "p", 50, 3.72113e-11),
    (FINGER_A, "e_rr", "q", 5, -1.41035e-07),
    (FINGER_A, "e_rt", "p", 3, 2.81789e-06),
    (FINGER_A, "e_rt", "q", 1, 8.53632e-06),
    (FINGER_A, "u_r", "p", 2, 4.89106e-09),
    (FINGER_A, "u_t", "q", 8, 9.26123e-09),
    (FINGER_B, "e_rr", "p", 0, 8.61209e-07),
    (FINGER_B, "e_rr", "p", 1, 1.03953e-06),
    (FINGER_B, "e_rr", "p", 2, 1.409e-06),
    (FINGER_B, "e_rr", "p", 5, 2.29009e-06),
    (FINGER_B, "e_rr", "p", 10, 2.25037e-06),
    (FINGER_B, "e_rr", "p", 20, 5.56699e-07),
    (FINGER_B, "e_rr", "p", 50, 2.24528e-09),
    (FINGER_B, "e_rr", "q", 5, 1.04686e-07),
    (FINGER_B, "e_rt", "p", 3, 2.08504e-06),
    (FINGER_B, "e_rt", "q", 1, 7.90385e-06),
    (FINGER_B, "u_r", "p", 2, 4.76088e-09),
    (FINGER_B, "u_t", "q", 8, 9.67449e-09),
]

LINE_LOADS = [
    (FINGER_A, 0.00, -200.0, 0.0, -0.0921206),
    (FINGER_A, 0.20, -200.0, 0.0, 0.00279595),
    (FINGER_A, 0.15, 0.0, 150.0, -0.0187127),
    (FINGER_B, 0.00, -200.0, 0.0, -0.181331),
    (FINGER_B, 0.20, -200.0, 0.0, 0.0151679),
    (FINGER_B, 0.15, 0.0, 150.0, -0.0255296),
]


@pytest.mark.parametrize(("finger", "field", "traction", "k", "value"), COEFFICIENTS)
def test_coefficient(finger: Cylinder, field: str, traction: str, k: int, value: float) -> None:
    radius = finger.outer_m if field.startswith("u") else DEPTH[finger]
    got = getattr(respond(finger, k, radius), field)[0, 0, "pq".index(traction)]
    assert got == pytest.approx(value, rel=1e-5, abs=1e-20)


@pytest.mark.parametrize(("finger", "angle", "normal", "tangential", "value"), LINE_LOADS)
def test_strain_under_line_load(finger: Cylinder, angle: float, normal: float, tangential: float, value: float) -> None:
    matrix = emap.e_map(finger, angle, DEPTH[finger], 150)
    loads = [series.line_load(finger, total, 0.0, 150) for total in (normal, tangential)]
    assert (matrix @ np.concatenate(loads))[0] == pytest.approx(value, rel=1e-5)


def test_hertz() -> None:
    width = closedform.hertz_width(FINGER_B, 200.0, closedform.equivalent_radius(FINGER_B, 5e-3))
    assert width == pytest.approx(0.271481, rel=1e-5)
    w10 = 200.0 / (np.pi * RB) * closedform.ellipse_spectrum(10 * width / 2)
    assert w10 == pytest.approx(3943.54, rel=1e-5)


def test_wedge_and_punch() -> None:
    width = closedform.wedge_width(FINGER_B, 150.0, np.radians(60.0))
    assert width == pytest.approx(0.133096, rel=1e-5)
    assert 150.0 / (np.pi * RB) * closedform.wedge_spectrum(20 * width / 2) == pytest.approx(3240.18, rel=1e-5)
    assert 100.0 / (np.pi * RB) * closedform.punch_spectrum(15 * 2e-3 / RB) == pytest.approx(55.9377, rel=1e-5)
    radius = closedform.equivalent_radius(FINGER_B, 3e-3)
    assert np.degrees(closedform.equivalent_wedge(FINGER_B, 100.0, radius)) == pytest.approx(72.0233, rel=1e-5)


@pytest.mark.parametrize(("width", "product"), [(0.10, 0.100366), (0.20, 0.43556), (0.40, 2.24323)])
def test_rigid_core_product(width: float, product: float) -> None:
    solved = contact.frictionless(FINGER_B, FLAT, width / 2)
    assert solved.load * RB == pytest.approx(product, rel=1e-5)


def test_rigid_core_flat() -> None:
    solved = contact.width_for_load(FINGER_B, FLAT, 200.0)
    assert 2 * solved.half_width == pytest.approx(0.419787, rel=1e-5)


def test_pressure_spectrum_of_wide_contact() -> None:
    pressure = contact.frictionless(FINGER_B, FLAT, 0.20).series(0.0, 10)
    assert pressure[20] / pressure[0] == pytest.approx(1.16926, rel=1e-5)
    assert 2 * closedform.ellipse_spectrum(10 * 0.20) == pytest.approx(1.15345, rel=1e-5)


def test_adhesion() -> None:
    half = 2e-3 / RB
    assert contact.frictionless(FINGER_A, FLAT, half).load == pytest.approx(97.6769, rel=1e-5)
    stuck = contact.adhere(FINGER_A, FLAT, half)
    assert stuck.load == pytest.approx(102.565, rel=1e-4)
    assert stuck.series(0.0, 5)[11 + 9] == pytest.approx(-364.074, rel=1e-4)


def test_condition_of_e_map() -> None:
    matrix = emap.e_map(FINGER_B, ANGLES, 10.3e-3, 40)[:, :81]
    assert np.linalg.cond(matrix) == pytest.approx(2.78769, rel=1e-4)


def test_approximate_frictionless_touch() -> None:
    radius = closedform.equivalent_radius(FINGER_B, 6.01e-3)
    half = rigid_core_table(FINGER_B).half_width(200.0 * radius)
    spectrum = closedform.ellipse_spectrum(half * np.arange(61))
    strain = emap.e_map(FINGER_B, ANGLES, 10.3e-3, 60)[:, :121] @ series.spread(
        FINGER_B, -200.0, spectrum, np.radians(75.0)
    )
    assert strain[[6, 8]] == pytest.approx([0.00837931, -0.0830872], abs=2e-5 * 0.18)
