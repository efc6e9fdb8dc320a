"""Write the contact equations of one strip in Chebyshev functions; `sioms.tactile.contact` solves them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.bessel import bessel
from sioms.tactile.cylinder import Cylinder, respond

Floats = NDArray[np.float64]


@lru_cache(maxsize=32)
def _remainders(cylinder: Cylinder, count: int) -> Floats:
    """Return k H_k(rb) less its limit for k = 1..count: rows u_r^p, u_r^q, u_t^p, u_t^q [m/Pa]."""
    k = np.arange(1, count + 1)
    h = respond(cylinder, k, cylinder.outer_m)
    own, cross = cylinder.normal_limit, cylinder.cross_limit
    rows = [(h.u_r, 0, own), (h.u_r, 1, cross), (h.u_t, 0, cross), (h.u_t, 1, own)]
    return np.stack([k * field[:, 0, which] - limit for field, which, limit in rows])


def _turns(rows: int, columns: int, first: int = 0) -> NDArray[np.complex128]:
    """Return i^(m - n) for tests m = 0..rows-1 and trial functions n = first..first+columns-1."""
    quarter = (np.arange(rows)[:, None] - np.arange(first, first + columns)) % 4
    turns: NDArray[np.complex128] = np.array([1, 1j, -1, -1j])[quarter]
    return turns


def _gap(t: Floats) -> Floats:
    """Return cot(t/2)/2 - 1/t, the smooth difference between the circle's and the line's kernel."""
    small = np.abs(t) < 1e-3
    safe = np.where(small, 1.0, t)
    difference: Floats = np.where(small, -t / 12.0, 0.5 / np.tan(safe / 2.0) - 1.0 / safe)
    return difference


def _nodes(order: int) -> int:
    """Return how many nodes keep the functions up to `order` apart and integrate the smooth kernel to rounding."""
    return max(64, 2 * order)


def _first_kind(order: int) -> tuple[Floats, Floats]:
    """Return nodes and weights, shape (order + 1, nodes), of (2/pi) int T_m f/sqrt(1 - x^2) dx."""
    nodes = _nodes(order)
    angle = np.pi * (np.arange(nodes) + 0.5) / nodes
    return np.cos(angle), 2.0 / nodes * np.cos(np.arange(order + 1)[:, None] * angle)


def _second_kind(order: int) -> tuple[Floats, Floats]:
    """Return nodes and weights, shape (order, nodes), of (2/pi) int U_m f sqrt(1 - x^2) dx."""
    nodes = _nodes(order)
    angle = np.pi * np.arange(1, nodes + 1) / (nodes + 1)
    return np.cos(angle), 2.0 / (nodes + 1) * np.sin((np.arange(order)[:, None] + 1) * angle) * np.sin(angle)


class StripTables:
    """Build the blocks of the contact equations of one strip.

    Trial functions: w or q = sqrt(1 - x^2) U_n, n < order ("normal", "bounded"), and q = T_n/sqrt(1 - x^2), n
    = 1..order ("edge").  Tests: T_0..T_order or U_0..U_(order-1).  Three parts each: the half plane's in
    closed form, the circle's smooth remainder `_gap` by Gauss quadrature, and the layer's, summed over k with
    e^(izx) = J_0 + 2 sum i^m J_m(z) T_m = 2 sum i^m (m + 1) J_(m+1)(z)/z U_m.
    """

    def __init__(self, cylinder: Cylinder, a: float, order: int, reach: float = 80.0) -> None:
        # beyond k a = 1 the layer's terms fall as k^-3 between bounded functions, as k^-2 with the edge
        # functions
        count = 256 * int(np.ceil(np.clip(reach / a + 2 * order, 256, 50.0 * reach) / 256))
        z = a * np.arange(1, count + 1, dtype=np.float64)
        self.cylinder, self.a, self.order = cylinder, a, order
        self.rest = _remainders(cylinder, count)
        self.on_t = bessel(order, z)
        self.on_u: Floats = self.on_t[:, 1:] * np.arange(1, order + 1) / z[:, None]
        self.own, self.cross = cylinder.normal_limit, cylinder.cross_limit

    def _layer(self, which: int, tests: Floats, trials: Floats) -> Floats:
        total: Floats = 2.0 * self.a * (tests * self.rest[which][:, None]).T @ trials
        return total

    def slope_of_normal(self) -> Floats:
        """Return c_n -> du_r/dt on T_0..T_order, shape (order + 1, order)."""
        size = self.order
        out = _turns(size + 1, size).imag * self._layer(0, self.on_t, self.on_u)
        (x, test), (y, trial) = _first_kind(size), _second_kind(size)
        out += self.own * self.a / 2.0 * (test @ _gap(self.a * (x[:, None] - y)) @ trial.T)
        out[0] *= 0.5
        out[np.arange(1, size + 1), np.arange(size)] += self.own
        return out

    def slope_of_bounded_shear(self) -> Floats:
        """Return q = sqrt(1 - x^2) sum c_n U_n -> du_r/dt on T_0..T_order; the limit is q less its mean."""
        size = self.order
        out = _turns(size + 1, size).real * self._layer(1, self.on_t, self.on_u)
        x, test = _first_kind(size)
        out += self.cross * (test @ np.sin(np.arccos(x)[:, None] * np.arange(1, size + 1)))
        out[0] *= 0.5
        out[0, 0] -= self.cross * self.a / 4.0
        return out

    def slope_of_normal_on_u(self) -> Floats:
        """Return c_n -> du_r/dt on U_0..U_(order-1), shape (order, order)."""
        size = self.order
        out = _turns(size, size).imag * self._layer(0, self.on_u, self.on_u)
        (x, test), (y, trial) = _second_kind(size), _second_kind(size)
        out += self.own * self.a / 2.0 * (test @ _gap(self.a * (x[:, None] - y)) @ trial.T)
        # 2 T_(n+1) = U_(n+1) - U_(n-1)
        return out + 0.5 * self.own * (np.eye(size, k=-1) - np.eye(size, k=1))

    def slope_of_edge(self) -> Floats:
        """Return d_1..d_order -> du_r/dt on U_0..U_(order-1); the limit gives back q."""
        size = self.order
        out = _turns(size, size, 1).real * self._layer(1, self.on_u, self.on_t[:, 1:])
        m, n = np.arange(1, size + 1)[:, None], np.arange(1, size + 1)
        with np.errstate(divide="ignore"):
            overlap = np.where((m + n) % 2 == 1, 1.0 / (m + n) + 1.0 / (m - n), 0.0)  # int U_(m-1) T_n dx
        return out + self.cross * 2.0 / np.pi * overlap

    def stretch_of_normal(self) -> Floats:
        """Return c_n -> du_t/dt on U_0..U_(order-1); the limit gives back w less its mean."""
        size = self.order
        out = _turns(size, size).real * self._layer(2, self.on_u, self.on_u) + self.cross * np.eye(size)
        out[0, 0] -= self.cross * self.a / 4.0
        return out

    def stretch_of_edge(self) -> Floats:
        """Return d_1..d_order -> du_t/dt on U_0..U_(order-1)."""
        size = self.order
        out = -_turns(size, size, 1).imag * self._layer(3, self.on_u, self.on_t[:, 1:])
        (x, test), (y, trial) = _second_kind(size), _first_kind(size)
        out -= self.own * self.a / 2.0 * (test @ _gap(self.a * (x[:, None] - y)) @ trial[1:].T)
        return out + self.own * np.eye(size)
