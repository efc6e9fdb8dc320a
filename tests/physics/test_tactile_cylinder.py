"""The elastic layer obeys the laws of elasticity, none of which its formulas use as such."""

from __future__ import annotations

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray
from skfem.helpers import ddot, sym_grad, trace

from sioms.tactile import emap, halfplane, series
from sioms.tactile.cylinder import FINGER_A, FINGER_B, Cylinder, _amplitudes, _basis_many, respond

SHAPES = [(0.05, 0.0), (0.3, 0.3), (0.7, 0.5), (0.756, 0.46), (0.95, 0.2), (0.99, 0.5)]
WAVES = [0, 1, 2, 3, 7, 20]


def body(ratio: float, poisson: float) -> Cylinder:
    return Cylinder(ratio * 12.7e-3, 12.7e-3, poisson)


@pytest.mark.parametrize(("ratio", "poisson"), SHAPES)
@pytest.mark.parametrize("which", [0, 1])
def test_stress_is_in_equilibrium(ratio: float, poisson: float, which: int) -> None:
    layer = body(ratio, poisson)
    r = layer.core_m + (layer.outer_m - layer.core_m) * np.array([0.3, 0.6])
    step = 1e-5 * (layer.outer_m - layer.core_m)
    for k in WAVES:
        here, below, above = respond(layer, k, r), respond(layer, k, r - step), respond(layer, k, r + step)
        rr, rt, tt = (getattr(here, name)[0, :, which] for name in ("s_rr", "s_rt", "s_tt"))
        # fields S cos kt and -T sin kt of the second family: d/dt turns T into k T
        radial = (above.s_rr - below.s_rr)[0, :, which] / (2 * step) - k * rt / r + (rr - tt) / r
        tangential = -(above.s_rt - below.s_rt)[0, :, which] / (2 * step) - k * tt / r - 2 * rt / r
        size = np.abs([rr, rt, tt]).max() * (k + 1) / (layer.outer_m - layer.core_m) + 1e-30
        if k == 0 and which == 1:  # the twist is the first family: no sign
            tangential = (above.s_rt - below.s_rt)[0, :, which] / (2 * step) + 2 * rt / r
        assert np.abs([radial, tangential]).max() < 1e-6 * size


@pytest.mark.parametrize(("ratio", "poisson"), SHAPES)
def test_strains_are_gradients_of_displacements(ratio: float, poisson: float) -> None:
    layer = body(ratio, poisson)
    r = layer.core_m + (layer.outer_m - layer.core_m) * np.array([0.25, 0.8])
    step = 1e-5 * (layer.outer_m - layer.core_m)
    for k in WAVES:
        here, below, above = respond(layer, k, r), respond(layer, k, r - step), respond(layer, k, r + step)
        stretch = (above.u_r - below.u_r)[0] / (2 * step)
        assert stretch == pytest.approx(here.e_rr[0], rel=1e-5, abs=1e-6 * np.abs(here.e_rt).max() + 1e-13)
        turn = (above.u_t - below.u_t)[0] / (2 * step) - here.u_t[0] / r[:, None] + k * here.u_r[0] / r[:, None]
        assert turn / 2 == pytest.approx(here.e_rt[0], rel=1e-5, abs=1e-6 * np.abs(here.e_rt).max() + 1e-13)


@pytest.mark.parametrize(("ratio", "poisson"), SHAPES)
def test_boundary_conditions_up_to_500(ratio: float, poisson: float) -> None:
    layer = body(ratio, poisson)
    h = respond(layer, np.arange(501), [layer.core_m, layer.outer_m])
    size = layer.outer_m / layer.shear_pa
    assert np.abs(h.u_r[:, 0]).max() < 1e-13 * size
    assert np.abs(h.u_t[:, 0]).max() < 1e-13 * size
    assert h.s_rr[:, 1, 0] == pytest.approx(np.ones(501), abs=1e-11)
    assert h.s_rt[:, 1, 1] == pytest.approx(np.ones(501), abs=1e-11)
    assert np.abs(h.s_rr[:, 1, 1]).max() < 1e-11
    assert np.abs(h.s_rt[:, 1, 0]).max() < 1e-11


@pytest.mark.parametrize(("ratio", "poisson"), SHAPES)
def test_reciprocal_theorem(ratio: float, poisson: float) -> None:
    layer = body(ratio, poisson)
    h = respond(layer, np.arange(1, 501), layer.outer_m)
    size = np.abs(h.u_r[:, 0, 0])
    assert np.abs(h.u_r[:, 0, 1] - h.u_t[:, 0, 0]).max() < 1e-12 * size.max()
    assert np.all(h.u_r[:, 0, 0] * h.u_t[:, 0, 1] > h.u_r[:, 0, 1] ** 2)  # work is positive


@pytest.mark.parametrize("finger", [FINGER_A, FINGER_B])
def test_short_waves_feel_a_half_plane(finger: Cylinder) -> None:
    k = np.array([200, 500])
    surface = respond(finger, k, finger.outer_m)
    for got, limit in (
        (surface.u_r[:, 0, 0], finger.normal_limit),
        (surface.u_t[:, 0, 1], finger.normal_limit),
        (surface.u_r[:, 0, 1], finger.cross_limit),
        (surface.u_t[:, 0, 0], finger.cross_limit),
    ):
        assert k * got == pytest.approx([limit, limit], abs=0.01 * finger.normal_limit)
    depth = 0.1e-3
    inside = respond(finger, k, finger.outer_m - depth).e_rr[:, 0, 0]
    expected = halfplane.transfer(k / finger.outer_m, depth, finger.poisson, finger.shear_pa)
    assert np.abs(inside) == pytest.approx(expected, rel=0.02)


def test_incompressible_layer_keeps_its_thickness_on_average_and_at_the_core() -> None:
    h = respond(FINGER_A, np.arange(60), [FINGER_A.core_m, FINGER_A.outer_m])
    assert h.u_r[0, 1, 0] == 0.0
    assert np.abs(h.e_rr[:, 0]).max() < 1e-12 / FINGER_A.shear_pa


def test_core_carries_the_net_force() -> None:
    normal, tangential = -120.0, 45.0
    h = respond(FINGER_B, 1, FINGER_B.core_m)
    p = series.line_load(FINGER_B, normal, 0.0, 1)
    q = series.line_load(FINGER_B, tangential, 0.0, 1)
    # x force from s_rr cos t - s_rt sin t, y force from s_rr sin t + s_rt cos t
    s_rr_c, s_rt_s = h.s_rr[0, 0, 0] * p[2], -h.s_rt[0, 0, 0] * p[2]
    s_rr_s, s_rt_c = h.s_rr[0, 0, 1] * q[2], h.s_rt[0, 0, 1] * q[2]
    assert np.pi * FINGER_B.core_m * (s_rr_c - s_rt_s) == pytest.approx(normal, rel=1e-12)
    assert np.pi * FINGER_B.core_m * (s_rr_s + s_rt_c) == pytest.approx(tangential, rel=1e-12)


def test_thick_and_shallow_is_flamant() -> None:
    layer = Cylinder(1e-3, 1.0, 0.4)
    depth, theta = 2e-3, np.array([0.0, 1e-3, 3e-3, 8e-3])
    strain = emap.e_map(layer, theta, 1.0 - depth, 9000)[:, :18001] @ series.line_load(layer, -50.0, 0.0, 9000)
    expected = halfplane.normal_strain(theta * 1.0, depth, 50.0, layer.poisson, layer.shear_pa)
    assert strain == pytest.approx(expected, abs=0.01 * np.abs(expected).max())


def test_truncation_rule() -> None:
    needed = emap.highest_needed(FINGER_B, 10.3e-3)
    exact = emap.e_map(FINGER_B, 0.0, 10.3e-3, 200)[:, :401] @ series.line_load(FINGER_B, -1.0, 0.0, 200)
    for highest, fine in ((needed, True), (needed - 1, False)):
        count = 2 * highest + 1
        cut = emap.e_map(FINGER_B, 0.0, 10.3e-3, highest)[:, :count] @ series.line_load(FINGER_B, -1.0, 0.0, highest)
        assert bool(abs(cut[0] / exact[0] - 1) < 2e-3) is fine


def test_an_element_of_some_width_feels_the_mean_over_it() -> None:
    points, weights = np.polynomial.legendre.leggauss(12)
    mean = sum(w / 2 * emap.e_map(FINGER_B, 1.0 + 0.08 * x, 10.3e-3, 60) for x, w in zip(points, weights, strict=True))
    wide = emap.e_map(FINGER_B, 1.0, 10.3e-3, 60, extent_rad=0.08)
    assert wide == pytest.approx(mean, abs=1e-6 * np.abs(wide).max())


def test_finite_elements_agree() -> None:
    layer = Cylinder(9.6e-3, 12.7e-3, 0.40)
    theta = np.array([0.0, 0.15, 0.4, 1.0])
    got = _finite_element_strain(layer, 10.8e-3, theta)
    highest = 30
    k = np.arange(highest + 1)
    even = -4e3 * np.exp(-(k**2) * 0.3**2 / 2) * np.where(k == 0, 0.5, 1.0)  # a smooth pressure about t = 0
    matrix = emap.e_map(layer, theta, 10.8e-3, highest)
    odd = 1e3 * k * np.exp(-(k**2) * 0.3**2 / 2)
    expected = matrix @ np.concatenate([series.pack(even, 0 * k), series.pack(0.0 * k, odd)])
    assert got == pytest.approx(expected, abs=3e-3 * np.abs(expected).max())


def _finite_element_strain(layer: Cylinder, radius: float, theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve the half 0 <= t <= pi with quadratic elements; u_t = 0 on the symmetry line."""
    mesh = skfem.MeshQuad.init_tensor(np.linspace(layer.core_m, layer.outer_m, 9), np.linspace(0, np.pi, 241))
    r, t = mesh.p
    mesh = skfem.MeshQuad(np.array([r * np.cos(t), r * np.sin(t)]), mesh.t)
    space = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()))
    mu, nu = layer.shear_pa, layer.poisson
    lame = 2 * mu * nu / (1 - 2 * nu)

    @skfem.BilinearForm
    def stiffness(u, v, _):  # type: ignore[no-untyped-def]
        return 2 * mu * ddot(sym_grad(u), sym_grad(v)) + lame * trace(sym_grad(u)) * trace(sym_grad(v))

    k = np.arange(1, 31)
    smooth = np.exp(-(k**2) * 0.3**2 / 2)

    @skfem.LinearForm
    def load(v, w):  # type: ignore[no-untyped-def]
        angle = np.arctan2(w.x[1], w.x[0])
        p = -4e3 * (0.5 + np.tensordot(smooth, np.cos(k[:, None, None] * angle), 1))
        q = 1e3 * np.tensordot(k * smooth, np.sin(k[:, None, None] * angle), 1)
        c, s = np.cos(angle), np.sin(angle)
        return (p * c - q * s) * v[0] + (p * s + q * c) * v[1]

    outer = mesh.facets_satisfying(lambda x: np.hypot(*x) > 0.5 * (layer.core_m + layer.outer_m), True)
    rim = [f for f in outer if abs(np.hypot(*mesh.p[:, mesh.facets[:, f]]).min() / layer.outer_m - 1) < 1e-9]
    force = load.assemble(skfem.FacetBasis(mesh, space.elem, facets=np.array(rim)))
    core = space.get_dofs(lambda x: np.hypot(*x) < layer.core_m * 1.0005)
    line = space.get_dofs(lambda x: np.abs(x[1]) < 1e-9).all("u^2")
    fixed = np.unique(np.concatenate([core.all(), line]))
    u = skfem.solve(*skfem.condense(stiffness.assemble(space), force, D=fixed))
    step = 1e-5
    turned = np.maximum(theta, 1e-6)
    points = [radius * np.array([np.cos(turned), np.sin(turned)]) * (1 + s * step) for s in (-1, 1)]
    moved = [space.probes(point) @ u for point in points]
    radial = [m[: theta.size] * np.cos(theta) + m[theta.size :] * np.sin(theta) for m in moved]
    gradient: NDArray[np.float64] = (radial[1] - radial[0]) / (2 * step * radius)
    return gradient


def test_bad_geometry_is_refused() -> None:
    with pytest.raises(ValueError, match=r"core must be smaller.*need 0 < core < outer"):
        Cylinder(12.7e-3, 12.7e-3, 0.46)
    with pytest.raises(ValueError, match=r"Poisson's ratio is 0\.51"):
        Cylinder(9e-3, 12.7e-3, 0.51)
    with pytest.raises(ValueError, match=r"outside the layer; need 0\.0096 to 0\.0127 m"):
        respond(FINGER_B, 1, 9e-3)


def test_amplitudes_that_are_kept_keep_nothing_else():
    body = Cylinder(3e-3, 6e-3, 0.45, 1e6)
    kept = _amplitudes(body, (2.0, 3.0), _basis_many)
    assert kept.base is None and kept.shape == (2, 4, 2)
