"""Solve the contact of an indenter with the finger: frictionless, sliding, and fully adhering.

The strip |t| <= a is given; the pressure w = -p >= 0 that bends the surface to the indenter's slope, and the
load P, follow. The solution sought is the BOUNDED one: w falls as a square root to zero at both edges.  (The
plain pseudo-inverse of the slope map is not reliable: the flat punch's 1/sqrt(a^2 - t^2) has zero slope and
may be added freely.)

Method: with x = t/a the pressure is sqrt(1 - x^2) sum c_n U_n(x), hence bounded by construction.  The half
plane's part of the slope operator turns these functions into Chebyshev polynomials T_(n+1); what curvature
and core add is smooth and is summed over wave numbers with Bessel functions in closed form.  Galerkin's
equations converge spectrally for smooth profiles.
Adhesion: q = sum d_n T_n(x)/sqrt(1 - x^2) without d_0 (no resultant), du_t/dt = 0 in the strip; see `adhere`
for its limits.

Sources: dissertation 2.4 in the bounded form of Bentall and Johnson (1967) and Nowell and Hills (1988);
Chebyshev pairs of the Hilbert transform: Erdogan and Gupta (1972).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from sioms.tactile.bessel import bessel
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import Indenter
from sioms.tactile.series import pack, rotation
from sioms.tactile.strip import StripTables

Floats = NDArray[np.float64]

ORDER = 32  # Chebyshev terms; a round indenter needs 8, a sharp wedge 30 for 1e-4 in what strain sees
EDGE_ORDER = 16  # under full adhesion it also sets the resolution of the edge, about a/256: see `adhere`
_EDGE_REACH = 400.0
_PROFILE_NODES = 4096
_WIDEST = 1.5  # half width [rad] beyond which the strip would wrap half the finger


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """Hold a solved contact; immutable.

    Args:
        cylinder: the finger.
        half_width: a [rad].
        load: P [N/m], compression positive.
        offset: angle [rad] from the middle of the strip to the indenter's apex (sliding moves it).
        normal: c_n [Pa], shape (ORDER,): w = sqrt(1 - x^2) sum c_n U_n(x).
        sliding: q = sliding * p, zero without friction.
        adhering: d_n [Pa], shape (ORDER + 1,): q = sum d_n T_n(x)/sqrt(1 - x^2), all zero unless adhering.
    """

    cylinder: Cylinder
    half_width: float
    load: float
    offset: float
    normal: Floats
    sliding: float
    adhering: Floats

    def pressure(self, t: ArrayLike) -> Floats:
        """Return w [Pa], compression positive, at angles t [rad] from the middle; zero outside the strip."""
        x, inside = self._within(t)
        angle = np.arccos(x)
        n = np.arange(1, self.normal.size + 1)
        value: Floats = np.where(inside, np.sin(angle[..., None] * n) @ self.normal, 0.0)
        return value

    def shear(self, t: ArrayLike) -> Floats:
        """Return q [Pa] at angles t [rad] from the middle; infinite at the edges under full adhesion."""
        x, inside = self._within(t)
        angle = np.arccos(x)
        n = np.arange(self.adhering.size)
        with np.errstate(divide="ignore", invalid="ignore"):
            stuck = (np.cos(angle[..., None] * n) @ self.adhering) / np.sin(angle)
        own = stuck if self.adhering.any() else 0.0
        value: Floats = np.where(inside, own - self.sliding * self.pressure(t), 0.0)
        return value

    def _within(self, t: ArrayLike) -> tuple[Floats, NDArray[np.bool_]]:
        x = np.asarray(t, dtype=np.float64) / self.half_width
        return np.clip(x, -1.0, 1.0), np.abs(x) <= 1.0

    def series(self, angle: float, highest: int) -> Floats:
        """Return [p; q] [Pa], tension positive, with the middle of the strip at `angle` [rad]; length 4 nc + 2."""
        z = self.half_width * np.arange(highest + 1, dtype=np.float64)
        n, m = np.arange(self.normal.size), np.arange(self.adhering.size)
        every = bessel(max(n.size, m.size - 1), z)
        bounded = 1j**n * (n + 1) * _over(every[:, 1 : n.size + 1], z)
        w = self.half_width * (bounded @ self.normal)
        q = self.half_width * ((1j**m * every[:, : m.size]) @ self.adhering) - self.sliding * w
        w[0], q[0] = 0.5 * w[0], 0.5 * q[0]
        turn = rotation(angle, highest)
        return np.concatenate([turn @ pack(-w.real, -w.imag), turn @ pack(q.real, q.imag)])


def frictionless(cylinder: Cylinder, indenter: Indenter, half_width: float, order: int = ORDER) -> Contact:
    """Solve the contact without friction on the half width a [rad].

    Raises:
        ValueError: the half width is not within 0 to 1.5 rad, or the profile cannot fill the strip.

    Example:
        >>> from sioms.tactile.cylinder import FINGER_B
        >>> from sioms.tactile.indenter import FLAT
        >>> contact = frictionless(FINGER_B, FLAT, 0.20)
        >>> print(f"P R = {contact.load * FINGER_B.outer_m:.4f} N")
        P R = 2.2432 N
    """
    return slide(cylinder, indenter, half_width, 0.0, order)


def slide(cylinder: Cylinder, indenter: Indenter, half_width: float, friction: float, order: int = ORDER) -> Contact:
    """Solve full sliding, q = friction * p (either sign); the apex is where both edges come out free.

    Raises:
        ValueError: as `frictionless`.
    """
    _check_width(half_width)
    tables = StripTables(cylinder, half_width, order)
    operator = tables.slope_of_normal()
    if friction != 0.0:
        operator = operator - friction * tables.slope_of_bounded_shear()
    inverse = np.linalg.inv(operator[1:])

    def miss(offset: float) -> float:
        slope = _profile(cylinder, indenter, half_width, offset, order)
        return float(slope[0] - operator[0] @ (inverse @ slope[1:]))

    offset = _apex(miss, half_width)
    normal = inverse @ _profile(cylinder, indenter, half_width, offset, order)[1:]
    load = 0.5 * np.pi * half_width * cylinder.outer_m * float(normal[0])
    return Contact(cylinder, half_width, load, offset, normal, friction, np.zeros(order + 1))


def adhere(cylinder: Cylinder, indenter: Indenter, half_width: float, order: int = EDGE_ORDER) -> Contact:
    """Solve full adhesion of a symmetric indenter: du_t/dt = 0 in the strip and no resultant of q.

    At nu = 1/2 normal and tangential edge behaviour are independent and the answer does not depend on
    `order`.  Below, the exact singularity r^(-1/2 + i e), e = ln(3 - 4 nu)/(2 pi), turns q's singularity into
    p's with the logarithm of the distance from the edge, so that "p is bounded" holds at one resolution only:
    the load falls 1 % for each doubling of `order` at nu = 0.46.  A real edge slips; the default resolves
    about a/256.

    Raises:
        ValueError: as `frictionless`.
    """
    _check_width(half_width)
    tables, places = StripTables(cylinder, half_width, order, _EDGE_REACH), np.arange(order)
    even, odd = places[::2], places[1::2]  # w even and q odd; slope odd and stretch even
    angle = np.pi * (np.arange(_PROFILE_NODES) + 0.5) / _PROFILE_NODES
    slope = indenter.slope(cylinder, half_width * np.cos(angle))
    on_u = 2.0 / _PROFILE_NODES * (np.sin((odd[:, None] + 1) * angle) * np.sin(angle)) @ slope
    blocks = np.block(
        [
            [tables.slope_of_normal_on_u()[np.ix_(odd, even)], tables.slope_of_edge()[np.ix_(odd, even)]],
            [tables.stretch_of_normal()[np.ix_(even, even)], tables.stretch_of_edge()[np.ix_(even, even)]],
        ]
    )
    solution = np.linalg.solve(blocks, np.concatenate([on_u, np.zeros(even.size)]))
    normal, adhering = np.zeros(order), np.zeros(order + 1)
    normal[even], adhering[even + 1] = solution[: even.size], solution[even.size :]
    load = 0.5 * np.pi * half_width * cylinder.outer_m * float(normal[0])
    return Contact(cylinder, half_width, load, 0.0, normal, 0.0, adhering)


def width_for_load(cylinder: Cylinder, indenter: Indenter, load: float, friction: float | None = 0.0) -> Contact:
    """Find the strip on which an indenter carries `load` [N/m] > 0; friction None means full adhesion.

    Raises:
        ValueError: the load is not positive, or so high that the strip would wrap round the finger.
    """
    if not load > 0.0:
        raise ValueError(f"find contact width: load is {load} N/m; need a positive (pressing) load")

    def solve(half_width: float) -> Contact:
        if friction is None:
            return adhere(cylinder, indenter, half_width)
        return slide(cylinder, indenter, half_width, friction)

    def over(log_width: float) -> float:
        """Return the logarithm of load over load wanted: nearly straight over that of the width."""
        return math.log(max(solve(math.exp(log_width)).load, 1e-300) / load)

    low = high = math.log(0.05)
    while over(low) > 0.0:
        high, low = low, low - 1.5
        if low < math.log(1e-9):
            raise ValueError(f"find contact width: {load} N/m needs a strip under 1e-9 rad; the load is too small")
    while low == high or over(high) < 0.0:
        if high == math.log(_WIDEST):
            raise ValueError(f"find contact width: {load} N/m presses a strip over {_WIDEST} rad; the load is too high")
        low, high = high, min(high + 0.8, math.log(_WIDEST))
    return solve(math.exp(float(brentq(over, low, high, xtol=1e-10))))


def _check_width(half_width: float) -> None:
    if not 0.0 < half_width <= _WIDEST:
        raise ValueError(f"solve contact: half width is {half_width} rad; need 0 < a <= {_WIDEST}")


def _apex(miss: Callable[[float], float], half_width: float) -> float:
    at_zero = miss(0.0)
    if abs(at_zero) <= 1e-12 * (abs(miss(half_width)) + 1e-300):
        return 0.0
    if miss(-half_width) * miss(half_width) > 0.0:
        raise ValueError(
            f"solve contact: no apex within a half width of {half_width} rad frees both edges; widen the strip"
        )
    return float(brentq(miss, -half_width, half_width, xtol=1e-12))


def _profile(cylinder: Cylinder, indenter: Indenter, a: float, offset: float, order: int) -> Floats:
    """Return the coefficients of the slope [m/rad] in T_0..T_order."""
    places, tests = _profile_tests(order)
    coefficients: Floats = tests @ indenter.slope(cylinder, a * places - offset)
    return coefficients


@lru_cache(maxsize=4)
def _profile_tests(order: int) -> tuple[Floats, Floats]:
    """Return nodes in -1..1 and the weights that take a slope at them to its coefficients in T_0..T_order."""
    angle = np.pi * (np.arange(_PROFILE_NODES) + 0.5) / _PROFILE_NODES
    tests = 2.0 / _PROFILE_NODES * np.cos(np.arange(order + 1)[:, None] * angle)
    tests[0] *= 0.5
    return np.cos(angle), tests


def _over(values: Floats, z: Floats) -> Floats:
    """Return J_n(z)/z for n = 1, 2, .. of J_n(z), with its limit at 0, shape (len(z), n)."""
    zero = z == 0.0
    ratio: Floats = values / np.where(zero, 1.0, z)[:, None]
    ratio[zero] = 0.5 * np.eye(1, values.shape[1])
    return ratio
