"""An elastic layer on a rigid core under an indenter, by finite elements in the radius and complementarity at the
surface.

Independent of `sioms.tactile`, which it is there to test: no closed forms, exact shapes of the indenters, the
contact found point by point.  Plane strain; traction and strain positive in tension, loads in compression.
All fields are Fourier series in the angle; for each wave number the radius is meshed by quadratic elements.

Accuracy at the default resolution: strains to 0.3 % of their peak, contact widths to one point (0.18 degrees).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS = 2048  # round the surface
_MESHED = 160  # wave numbers that are meshed; above, the surface answers as a half plane's
_ELEMENTS = 48
_BANDS = 5
_REACH = 0.7  # rad, half of the arc in which contact is looked for


@dataclass(frozen=True, slots=True)
class Layer:
    """Geometry and material of the layer.

    Args:
        core_m: ra.
        outer_m: rb.
        poisson_ratio: below 1/2: the mesh locks there.
        shear_modulus_pa: mu.
    """

    core_m: float = 9.6e-3
    outer_m: float = 12.7e-3
    poisson_ratio: float = 0.46
    shear_modulus_pa: float = 8.3e4

    def __post_init__(self) -> None:
        if not 0.0 < self.core_m < self.outer_m:
            raise ValueError(f"build layer: core {self.core_m} m, outer {self.outer_m} m; need 0 < core < outer")
        if not 0.0 <= self.poisson_ratio <= 0.495:
            raise ValueError(f"build layer: Poisson's ratio {self.poisson_ratio}; need 0 to 0.495")
        if not self.shear_modulus_pa > 0.0:
            raise ValueError(f"build layer: shear modulus {self.shear_modulus_pa} Pa; need > 0")


def gap(outer_m: float, radius_m: float, angle: Array, edge_half_angle: float = math.pi / 4) -> Array:
    """Return the radial distance [m] from the round surface to an indenter that just touches it at angle 0.

    Args:
        outer_m: rb.
        radius_m: rc; 0 for an edge, infinite for a flat.
        angle: along the surface [rad]; where a ray misses the indenter the gap is infinite.
        edge_half_angle: of the edge [rad].
    """
    cosine, sine = np.cos(angle), np.abs(np.sin(angle))
    if radius_m == 0.0:
        reach = cosine - sine / math.tan(edge_half_angle)
        with np.errstate(divide="ignore"):
            return np.where(reach > 1e-9, outer_m / np.maximum(reach, 1e-9), np.inf) - outer_m
    if math.isinf(radius_m):
        return np.asarray(outer_m / cosine - outer_m)
    centre = outer_m + radius_m
    inside = radius_m**2 - (centre * sine) ** 2
    return np.where(inside > 0.0, centre * cosine - np.sqrt(np.maximum(inside, 0.0)) - outer_m, np.inf)


class Rubber:
    """The layer's answers to tractions, computed once.  One caller at a time.

    Args:
        layer: the body.
        radii_m: where strains are asked for, shape (nr,).
        gauge_m: thickness over which the radial strain is averaged.
    """

    def __init__(self, layer: Layer, radii_m: Array, gauge_m: float = 0.2e-3) -> None:
        self.layer = layer
        radii = np.asarray(radii_m, dtype=np.float64)
        if not (np.all(radii - gauge_m / 2 >= layer.core_m) and np.all(radii + gauge_m / 2 <= layer.outer_m)):
            raise ValueError(f"build finger: elements at {radii.min()} to {radii.max()} m do not lie inside the layer")
        answers = _mesh(layer, radii, gauge_m)
        half = POINTS // 2
        k = np.arange(half + 1, dtype=np.float64)
        limit = layer.outer_m / layer.shear_modulus_pa / np.maximum(k, 1.0)
        own, cross = (1 - layer.poisson_ratio) * limit, (1 - 2 * layer.poisson_ratio) / 2 * limit
        # u_r by p, u_r by q, u_t by p, u_t by q: meshed below, the half plane's above
        self.compliance = np.stack([own, cross, cross, own])
        self.compliance[:, : _MESHED + 1] = answers[:4]
        self._patterns: dict[tuple[float, float], Array] = {}
        place = self._place = np.arange(round(_REACH * POINTS / (2 * math.pi)))  # one side; the other is its mirror
        push = np.fft.irfft(self.compliance[0], POINTS)  # u_r at 0 of p = 1 at one point
        self._normal: Array = push[place[:, None] - place] + push[place[:, None] + place]
        self._normal[:, 0] *= 0.5
        self.strain = np.zeros((2, half + 1, radii.size))
        self.strain[:, : _MESHED + 1] = answers[4:].reshape(2, radii.size, -1).transpose(0, 2, 1)

    def press(self, load: float, radius_m: float, adhesion: float = 0.0, guess: int = 8) -> Pressing:
        """Press an indenter on at angle 0.

        Args:
            load: P [N/m], > 0.
            radius_m: rc; 0 for an edge, infinite for a flat.
            adhesion: share of the tangential traction that would keep the surface from sliding at all.
            guess: points of half the contact to begin with; only the speed depends on it.
        """
        rb, step, place = self.layer.outer_m, 2 * math.pi / POINTS, self._place
        h = gap(rb, radius_m, np.asarray(place * step, dtype=np.float64))
        weight = np.where(place == 0, 1.0, 2.0) * rb * step
        q = np.zeros(place.size)
        for _ in range(3 if adhesion else 1):
            w = _complement(self._normal, h - self._lift(q, place), weight, load, guess)
            guess = int(np.count_nonzero(w))
            if adhesion:
                q = adhesion * self._stick(w, place)
        series_p, series_q = np.zeros(POINTS), np.zeros(POINTS)
        series_p[place], series_p[-place] = -w, -w
        series_q[-place], series_q[place] = -q, q
        p_hat = np.fft.rfft(series_p).real
        q_hat = -np.fft.rfft(series_q).imag
        total = self.strain[0] * p_hat[:, None] + self.strain[1] * q_hat[:, None]
        profile = np.fft.irfft(total, POINTS, axis=0)
        approach = float(self._normal[0] @ w) - float(self._lift(q, place)[0])
        return Pressing(load, step * float(np.count_nonzero(w) - 0.5), profile, approach)

    def shear_stiffness(self, half_width: float) -> float:
        """Return the force per length that moves a contact along the surface by one metre against the core [N/m^2].

        Args:
            half_width: of an elliptical traction [rad], > 0.
        """
        angle = 2 * math.pi / POINTS * (np.arange(POINTS) - POINTS // 2)
        traction = np.sqrt(np.maximum(1.0 - (angle / half_width) ** 2, 0.0))
        share = traction / np.sum(traction)
        load = self.layer.outer_m * 2 * math.pi / POINTS
        spread = np.abs(np.fft.rfft(share)) ** 2 * self.compliance[3]  # mean displacement, weighted by the traction
        return 1.0 / float(np.fft.irfft(spread, POINTS)[0] / load)

    def pattern(self, loads: Array, radius_m: float, adhesion: float) -> Array:
        """Return the profiles per unit load at some loads, shape (loads, POINTS, nr); tabulated
        once for an indenter.
        """
        key = (radius_m, adhesion)
        if key not in self._patterns:
            profiles, points = [], 8
            for load in loads:
                one = self.press(float(load), radius_m, adhesion, points)
                points = round(one.half_width / (2 * math.pi / POINTS)) + 4
                profiles.append(one.profile / one.load)
            self._patterns[key] = np.stack(profiles)
        return self._patterns[key]

    def _lift(self, q: Array, place: NDArray[np.intp]) -> Array:
        """Return u_r of an odd traction q."""
        if not q.any():
            return np.zeros(place.size)
        series = np.zeros(POINTS)
        series[-place], series[place] = -q, q
        lifted: Array = np.fft.irfft(self.compliance[1] * -np.fft.rfft(series).imag, POINTS)[place]
        return lifted

    def _stick(self, w: Array, place: NDArray[np.intp]) -> Array:
        """Return the odd traction q that keeps u_t at zero where the pressure w acts."""
        series = np.zeros(POINTS)
        series[place], series[-place] = -w, -w
        # u_t = sum V_k sin k t of p_k cos k t
        slid = np.fft.irfft(-1j * self.compliance[2] * np.fft.rfft(series).real, POINTS)[place]
        inside = np.flatnonzero(w > 0.0)[1:]  # q is zero in the middle
        if inside.size == 0:
            return np.zeros(place.size)
        push = np.fft.irfft(self.compliance[3], POINTS)
        own = push[inside[:, None] - inside] - push[inside[:, None] + inside]
        q = np.zeros(place.size)
        q[inside] = np.linalg.solve(own, -slid[inside])
        return q


@lru_cache(maxsize=4)
def rubber(layer: Layer, radii_m: tuple[float, ...]) -> Rubber:
    """Return the body with elements at these radii; fingers that differ in other things share it."""
    return Rubber(layer, np.array(radii_m))


@dataclass(frozen=True, slots=True, eq=False)
class Pressing:
    """Hold what an indenter at angle 0 does; immutable.

    Args:
        load: P [N/m].
        half_width: of the contact [rad], to the middle between points.
        profile: strain at the radii over the angle, shape (POINTS, nr), angle 2 pi n/POINTS in row n.
        approach: of the indenter from first touch [m].
    """

    load: float
    half_width: float
    profile: Array
    approach: float


def _complement(normal: Array, h: Array, weight: Array, load: float, guess: int) -> Array:
    """Return the pressure w >= 0 of total `load` with no point inside the indenter: an active set, grown and shrunk."""
    count = h.size
    active = np.zeros(count, dtype=np.bool_)
    active[: max(3, guess)] = True
    active &= np.isfinite(h)
    w = np.zeros(count)
    for _ in range(200):
        at = np.flatnonzero(active)
        system = np.zeros((at.size + 1, at.size + 1))
        system[:-1, :-1], system[:-1, -1], system[-1, :-1] = normal[np.ix_(at, at)], -1.0, weight[at]
        # -u_r = depth - h: compliance w + h = depth
        answer = np.linalg.solve(system, np.concatenate([-h[at], [load]]))
        w[:] = 0.0
        w[at], depth = answer[:-1], float(answer[-1])
        inside = np.isfinite(h) & ~active & (normal @ w + np.where(np.isfinite(h), h, 0.0) < depth)
        pulled = active & (w <= 0.0)
        if not (inside.any() or pulled.any()):
            return w
        active = (active & ~pulled) | (inside & ~pulled.any())
    raise ValueError(f"press indenter: no contact found under {load} N/m; the load is too high for the finger")


def _mesh(layer: Layer, radii: Array, gauge_m: float) -> Array:
    """Return for wave numbers 0.._MESHED: u_r^p, u_r^q, u_t^p, u_t^q at rb, then strains by p and by q at the radii.

    Shape (4 + 2 nr, _MESHED + 1).  u_r = U cos kt, u_t = V sin kt; quadratic elements, finer towards the surface.
    """
    mu, nu = layer.shear_modulus_pa, layer.poisson_ratio
    lam = 2 * mu * nu / (1 - 2 * nu)
    ends = layer.outer_m - (layer.outer_m - layer.core_m) * np.linspace(1.0, 0.0, _ELEMENTS + 1) ** 1.5
    nodes = np.empty(2 * _ELEMENTS + 1)
    nodes[::2], nodes[1::2] = ends, (ends[1:] + ends[:-1]) / 2
    size = nodes.size
    matrices = np.zeros((3, 2 * size, 2 * size))  # the factors of 1, k and k^2; u and v of a node side by side
    constant, linear, square = matrices
    abscissae, weights = np.polynomial.legendre.leggauss(4)
    for element in range(_ELEMENTS):
        low, high = ends[element], ends[element + 1]
        own = np.arange(2 * element, 2 * element + 3)
        where = np.concatenate([2 * own, 2 * own + 1])
        for x, weight in zip(abscissae, weights, strict=True):
            r = (low + high) / 2 + x * (high - low) / 2
            n = np.array([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2])
            dn = np.array([x - 0.5, -2 * x, x + 0.5]) * 2 / (high - low)
            none = np.zeros(3)
            # strains e_rr, e_tt, 2 e_rt as rows: without k, and the factor of k
            plain = np.stack([np.r_[dn, none], np.r_[n / r, none], np.r_[none, dn - n / r]])
            by_k = np.stack([np.r_[none, none], np.r_[none, n / r], np.r_[-n / r, none]])
            stiff = np.array([[lam + 2 * mu, lam, 0], [lam, lam + 2 * mu, 0], [0, 0, mu]])
            stiff = stiff * (r * weight * (high - low) / 2)
            cell = np.ix_(where, where)
            constant[cell] += plain.T @ stiff @ plain
            linear[cell] += plain.T @ stiff @ by_k + by_k.T @ stiff @ plain
            square[cell] += by_k.T @ stiff @ by_k
    # the core holds both: the first node's are left out; what remains has five bands above the diagonal
    bands = np.zeros((3, _BANDS + 1, 2 * size - 2))
    for above in range(_BANDS + 1):
        bands[:, _BANDS - above, above:] = np.diagonal(matrices[:, 2:, 2:], above, axis1=1, axis2=2)
    force = np.zeros((2 * size - 2, 2))
    force[-2, 0] = force[-1, 1] = layer.outer_m
    look = _gauge(nodes, radii, gauge_m)
    out = np.empty((4 + 2 * radii.size, _MESHED + 1))
    k = np.arange(_MESHED + 1.0)[:, None, None]
    found = np.zeros((_MESHED + 1, 2 * size, 2))
    found[:, 2:] = solve_banded(bands[0] + k * bands[1] + k * k * bands[2], force)
    u, v = found[:, ::2], found[:, 1::2]
    out[:4] = u[:, -1, 0], u[:, -1, 1], v[:, -1, 0], v[:, -1, 1]
    out[4:] = np.moveaxis(look @ u, 0, -1).swapaxes(0, 1).reshape(2 * radii.size, _MESHED + 1)
    return out


def solve_banded(bands: Array, right: Array) -> Array:
    """Return the solutions of several symmetric positive definite systems of the same size and width, shape (m, n, r).

    By L D L^T, all systems at once (Golub and Van Loan, Matrix Computations, 4.3.6). ``scipy.linalg`` has the like for
    one system; its import takes longer, and 20 MB in every driver.

    Args:
        bands: the diagonals, the outermost first, shape (m, width + 1, n): [:, width - a, j] is row j - a of column j.
        right: right-hand sides, shape (n, r), the same for all.
    """
    count, rows, n = bands.shape
    width = rows - 1
    low = np.zeros((rows, n + width, count))  # [a, i] is row i + a of column i, behind the end 0
    for a in range(rows):
        low[a, : n - a] = bands[:, width - a, a:].T
    x = np.zeros((n + width, right.shape[1], count))
    x[:n] = right[:, :, None]
    for i in range(n):
        column = low[1:, i].copy()
        low[1:, i] /= low[0, i]
        for a in range(1, rows):
            low[: rows - a, i + a] -= low[a, i] * column[a - 1 :]
        x[i + 1 : i + rows] -= low[1:, i, None] * x[i]
    for i in reversed(range(n)):
        x[i] = x[i] / low[0, i] - (low[1:, i, None] * x[i + 1 : i + rows]).sum(axis=0)
    return np.ascontiguousarray(np.moveaxis(x[:n], -1, 0))


def _gauge(nodes: Array, radii: Array, gauge_m: float) -> Array:
    """Return the matrix from U at the nodes to the mean strain over the gauge at each radius, shape (nr, nodes)."""
    out = np.zeros((radii.size, nodes.size))
    for row, radius in enumerate(radii):
        for sign in (1.0, -1.0):
            r = radius + sign * gauge_m / 2
            element = min(int(np.searchsorted(nodes[::2], r, side="right")) - 1, _ELEMENTS - 1)
            low, middle, high = nodes[2 * element : 2 * element + 3]
            x = (r - middle) / ((high - low) / 2)
            out[row, 2 * element : 2 * element + 3] += (
                sign / gauge_m * np.array([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2])
            )
    return out
