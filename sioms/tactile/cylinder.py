"""Answer an elastic layer on a rigid core to surface tractions, wave number by wave number.

The layer is the annulus ra <= r <= rb in plane strain: linear, homogeneous, isotropic, bonded to a rigid core
at ra, loaded at rb by the normal traction p and the tangential traction q.  Every field is a Fourier series
in the angle; this module gives the factors that turn a Fourier coefficient of p or q into that of a
displacement, strain or stress at any radius.

Conventions: tension is positive (a pressed finger has p < 0); e_rt is the tensor shear strain, half the
engineering one.  With U cos kt for the radial and V sin kt for the tangential displacement the two families
of each wave number k share one map H_k:

    [s_rr^s,  s_rt^c, u_r^s,  u_t^c, e_rr^s] = H_k(r) [p^s,  q^c]
    [s_rr^c, -s_rt^s, u_r^c, -u_t^s, e_rr^c] = H_k(r) [p^c, -q^s]

Valid for any 0 < ra < rb, for 0 <= nu <= 1/2 with both ends included, and for k from 0 to thousands: growing
solutions are scaled by rb and decaying ones by ra, so that no power exceeds one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Extended = NDArray[np.longdouble]

DEFAULT_SHEAR_MODULUS_PA = 8.3e4


Basis = Callable[["Cylinder", Extended, Extended], Extended]


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Hold the geometry and the material of an elastic layer on a rigid core; immutable, safe to share.

    Args:
        core_m: core radius ra [m], 0 < ra < rb.
        outer_m: outer radius rb [m].
        poisson: Poisson's ratio nu, 0 <= nu <= 1/2.
        shear_pa: shear modulus mu [Pa], > 0.
    """

    core_m: float
    outer_m: float
    poisson: float
    shear_pa: float = DEFAULT_SHEAR_MODULUS_PA

    def __post_init__(self) -> None:
        where = f"describe cylinder with core {self.core_m:g} m and outer radius {self.outer_m:g} m"
        if not 0.0 < self.core_m < self.outer_m < np.inf:
            raise ValueError(f"{where}: the core must be smaller than the finger; need 0 < core < outer")
        if not 0.0 <= self.poisson <= 0.5:
            raise ValueError(f"{where}: Poisson's ratio is {self.poisson}; need 0 <= nu <= 0.5")
        if not 0.0 < self.shear_pa < np.inf:
            raise ValueError(f"{where}: shear modulus is {self.shear_pa} Pa; need a positive finite value")

    @property
    def normal_limit(self) -> float:
        """Return the limit of k u_r^p and k u_t^q at rb for large k, (1 - nu) rb/mu [m/Pa]: half plane."""
        return (1.0 - self.poisson) * self.outer_m / self.shear_pa

    @property
    def cross_limit(self) -> float:
        """Return the limit of k u_r^q and k u_t^p at rb for large k, -(1 - 2 nu) rb/(2 mu) [m/Pa]."""
        return -(1.0 - 2.0 * self.poisson) * self.outer_m / (2.0 * self.shear_pa)


FINGER_A = Cylinder(core_m=8.9e-3, outer_m=12.7e-3, poisson=0.5)
FINGER_B = Cylinder(core_m=9.6e-3, outer_m=12.7e-3, poisson=0.46)


@dataclass(frozen=True, slots=True)
class Response:
    """Hold the entries of H_k(r), each of shape (number of k, number of r, 2): last axis 0 for p, 1 for q.

    Stresses [Pa/Pa], displacements [m/Pa], strains [1/Pa].  s_tt goes with s_rr, and e_rt with s_rt.
    """

    s_rr: Floats
    s_rt: Floats
    s_tt: Floats
    u_r: Floats
    u_t: Floats
    e_rr: Floats
    e_rt: Floats


def respond(cylinder: Cylinder, k: ArrayLike, r: ArrayLike) -> Response:
    """Return H_k(r) for all pairs of wave number and radius.

    Source: the biharmonic solutions of the annulus (Michell's series, dissertation 2.9 to 2.15 and appendix
    A).

    Args:
        cylinder: geometry and material.
        k: wave numbers, integers >= 0, shape (nk,) or scalar.
        r: radii [m], ra <= r <= rb, shape (nr,) or scalar.

    Raises:
        ValueError: a wave number is negative or fractional, or a radius lies outside the layer.

    Example:
        >>> h = respond(FINGER_A, 5, 9.4e-3)
        >>> print(f"{h.e_rr[0, 0, 0]:.5e} per Pa")
        1.59373e-06 per Pa
    """
    wave = np.atleast_1d(np.asarray(k, dtype=np.float64))
    radius = np.atleast_1d(np.asarray(r, dtype=np.float64))
    _check(cylinder, wave, radius)
    out = np.empty((5, wave.size, radius.size, 2))
    zero, one, many = wave == 0.0, wave == 1.0, wave > 1.0
    if zero.any():
        out[:, zero] = _uniform(cylinder, radius)[:, None]
    if one.any():
        out[:, one] = _match(cylinder, wave[one], radius, _basis_one)
    if many.any():
        out[:, many] = _match(cylinder, wave[many], radius, _basis_many)
    s_rr, s_rt, u_r, u_t, e_tt = out
    nu, mu = cylinder.poisson, cylinder.shear_pa
    s_tt = (2.0 * mu * e_tt + nu * s_rr) / (1.0 - nu)
    e_rr = ((1.0 - nu) * s_rr - nu * s_tt) / (2.0 * mu)
    return Response(s_rr, s_rt, s_tt, u_r, u_t, e_rr, s_rt / (2.0 * mu))


def _check(cylinder: Cylinder, wave: Floats, radius: Floats) -> None:
    if not np.all((wave >= 0.0) & (wave == np.floor(wave)) & np.isfinite(wave)):
        raise ValueError(f"compute response: wave numbers {wave} contain one that is not an integer >= 0")
    slack = 1e-12 * cylinder.outer_m
    inside = (radius >= cylinder.core_m - slack) & (radius <= cylinder.outer_m + slack)
    if not inside.all():
        raise ValueError(
            f"compute response: radius {radius[~inside][0]} m is outside the layer; "
            f"need {cylinder.core_m} to {cylinder.outer_m} m"
        )


def _uniform(cylinder: Cylinder, r: Floats) -> Floats:
    """Return (s_rr, s_rt, u_r, u_t, e_tt) of k = 0, shape (5, nr, 2)."""
    ra, rb, mu = cylinder.core_m, cylinder.outer_m, cylinder.shear_pa
    free = 1.0 - 2.0 * cylinder.poisson
    swell = free / (1.0 + free * (ra / rb) ** 2) / (2.0 * mu)  # u_r = swell (r - ra^2/r), zero on the core
    out = np.zeros((5, r.size, 2))
    out[0, :, 0] = (1.0 + free * (ra / r) ** 2) / (1.0 + free * (ra / rb) ** 2)
    out[1, :, 1] = (rb / r) ** 2
    out[2, :, 0] = swell * (r - ra**2 / r)
    out[3, :, 1] = rb**2 / (2.0 * mu) * (r / ra**2 - 1.0 / r)
    out[4, :, 0] = swell * (1.0 - (ra / r) ** 2)
    return out


def _basis_many(cylinder: Cylinder, k: Extended, r: Extended) -> Extended:
    """Return the four independent solutions of k >= 2 as (s_rr, s_rt, 2mu U, 2mu V), shape (4 fields, 4, nk,
    nr).

    Lengths are in units of rb for the growing and ra for the decaying solutions; fields of one power share
    one factor.
    """
    kappa = 3.0 - 4.0 * cylinder.poisson
    out = np.empty((4, 4, k.size, r.size), dtype=np.longdouble)
    k = k[:, None]
    square = k**2
    # upper sign grows outwards, lower sign decays
    for at, sign, length in ((0, 1.0, cylinder.outer_m), (2, -1.0, cylinder.core_m)):
        x: Extended = r / length
        n, m = 1.0 + sign * k, sign * k - 1.0
        near: Extended = x ** (n - 1.0)
        far: Extended = near / x**2  # x^(m - 1)
        # the pair is divided by k^2 and k, so that no column outgrows the other
        out[0, at] = n * (3.0 - n) * near / square
        out[1, at] = sign * n * (n - 1.0) * near / square
        out[2, at] = (kappa - n) * near * r / square
        out[3, at] = sign * (kappa + n) * near * r / square
        out[0, at + 1] = -m * far / k
        out[1, at + 1] = sign * m * far / k
        out[2, at + 1] = -far * r / k
        out[3, at + 1] = sign * far * r / k
    return out


def _basis_one(cylinder: Cylinder, k: Extended, r: Extended) -> Extended:
    """Return the four solutions of k = 1: translation, n = 2, m = -2, and that of a net force."""
    ra, rb = cylinder.core_m, cylinder.outer_m
    kappa = 3.0 - 4.0 * cylinder.poisson
    x = r / rb
    cube = (ra / r) ** 3
    turn = 2.0 * kappa * np.log(x)
    out = np.empty((4, 4, k.size, r.size), dtype=np.longdouble)
    out[:2, 0], out[2, 0], out[3, 0] = 0.0, rb, -rb
    out[:2, 1], out[2, 1], out[3, 1] = 2.0 * x, (kappa - 2.0) * x * r, (kappa + 2.0) * x * r
    out[:2, 2], out[2:, 2] = 2.0 * cube, -cube * r
    out[0, 3], out[1, 3] = (3.0 + kappa) / x, (1.0 - kappa) / x
    out[2, 3], out[3, 3] = (turn - 1.0) * rb, -(turn + 1.0) * rb
    return out


def _match(cylinder: Cylinder, k: Floats, r: Floats, basis: Basis) -> Floats:
    """Fit the four amplitudes to the core and the surface; return (s_rr, s_rt, u_r, u_t, e_tt), shape (5, nk,
    nr, 2).

    Extended precision, because growing and decaying solutions are nearly alike across a thin layer.
    """
    wave, radius = k.astype(np.longdouble), r.astype(np.longdouble)
    amplitude = _amplitudes(cylinder, tuple(k.tolist()), basis)
    fields = np.einsum("fskr,ksc->fkrc", basis(cylinder, wave, radius), amplitude)
    s_rr, s_rt, u_r, u_t = fields
    u_r, u_t = u_r / (2.0 * cylinder.shear_pa), u_t / (2.0 * cylinder.shear_pa)
    out = np.empty((5, k.size, r.size, 2))
    out[0], out[1], out[2], out[3] = s_rr, -s_rt, u_r, -u_t
    out[4] = (u_r + wave[:, None, None] * u_t) / radius[None, :, None]
    return out


@lru_cache(maxsize=16)
def _amplitudes(cylinder: Cylinder, wave: tuple[float, ...], basis: Basis) -> Extended:
    """Return the amplitudes of the four solutions, shape (nk, 4, 2); the same at every radius of a cylinder."""
    k = np.array(wave, dtype=np.longdouble)
    edges = basis(cylinder, k, np.array([cylinder.core_m, cylinder.outer_m], dtype=np.longdouble))
    conditions = np.stack([edges[2, :, :, 0], edges[3, :, :, 0], edges[0, :, :, 1], edges[1, :, :, 1]])
    loads = np.zeros((k.size, 4, 2), dtype=np.longdouble)
    loads[:, 2, 0] = 1.0  # p cos kt alone
    loads[:, 3, 1] = -1.0  # q sin kt = -1: the second argument of H is -q^s
    return _solve(np.moveaxis(conditions, 2, 0), loads)


def forget_amplitudes() -> None:
    """Give back what is kept for further tables, some MiB that a process with one finger needs no more."""
    _amplitudes.cache_clear()


def _solve(matrix: Extended, right: Extended) -> Extended:
    """Solve many small systems by Gauss-Jordan elimination with scaled rows (numpy solves no long doubles)."""
    scale = 1.0 / np.abs(matrix).max(axis=2, keepdims=True)
    table = np.concatenate([matrix * scale, right * scale], axis=2)
    every, size = np.arange(table.shape[0]), table.shape[1]
    for column in range(size):
        pivot = column + np.abs(table[:, column:, column]).argmax(axis=1)
        table[every, column], table[every, pivot] = table[every, pivot].copy(), table[every, column].copy()
        table[:, column] /= table[:, column, column, None]
        factor: Extended = table[:, :, column, None].copy()
        factor[:, column] = 0.0
        table -= factor * table[:, None, column]
    answer: Extended = table[:, :, size:].copy()  # a view would keep the whole table, as long as answers are kept
    return answer
