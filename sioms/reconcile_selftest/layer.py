"""A second implementation of the finger's mechanics, for blind tests: finite elements and pressed points.

The rubber layer is solved harmonic by harmonic with quadratic finite elements over the radius (displacement form, plane
strain); an indenter is pressed in on a grid of points, those that would pull are let go until none does; adhesion holds
the points of contact where they came down. Nothing here is shared with ``sioms.tactile``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HARMONICS = 90  # solved; beyond, a half plane
FAR = 1500  # harmonics of the surface's compliance
_ELEMENTS = 36
_STEP = 0.005  # of the grid of points [rad]
_REACH = 0.42


@dataclass(frozen=True, slots=True)
class Body:
    """Radii [m], shear modulus [Pa] and Poisson's ratio (below 0.49) of the layer."""

    core: float
    outer: float
    shear: float
    poisson: float


@lru_cache(maxsize=256)
def harmonic(body: Body, k: int) -> tuple[Array, Array]:
    """Solve one harmonic for unit p cos and unit q sin at the surface.

    Returns:
        Nodes [m], and displacements (u_r cos, u_t sin) per load, shape (2 loads, nodes, 2) [m/Pa].
    """
    # finer towards the surface, where a harmonic decays over rb/k
    s = np.linspace(0.0, 1.0, _ELEMENTS + 1)
    edges = body.core + (body.outer - body.core) * (1.0 - (1.0 - s) ** 1.6)
    nodes = np.sort(np.concatenate([edges, 0.5 * (edges[1:] + edges[:-1])]))
    n = len(nodes)
    lam = 2.0 * body.shear * body.poisson / (1.0 - 2.0 * body.poisson)
    d = np.array([[lam + 2 * body.shear, lam, 0.0], [lam, lam + 2 * body.shear, 0.0], [0.0, 0.0, body.shear]])
    x, w = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(edges)[:, None, None]
    r = 0.5 * (edges[1:] + edges[:-1])[:, None, None] + half * x[:, None]
    shape = np.stack([0.5 * x * (x - 1), 1 - x * x, 0.5 * x * (x + 1)], axis=1)[None]
    slope = np.stack([x - 0.5, -2 * x, x + 0.5], axis=1)[None] / half
    b = np.zeros((_ELEMENTS, 4, 3, 6))
    b[:, :, 0, 0::2] = slope
    b[:, :, 1, 0::2], b[:, :, 1, 1::2] = shape / r, k * shape / r
    b[:, :, 2, 0::2], b[:, :, 2, 1::2] = -k * shape / r, slope - shape / r
    own = np.einsum("egia,ij,egjb,eg->eab", b, d, b, (r * half * w[:, None])[:, :, 0], optimize=True)
    stiff = np.zeros((2 * n, 2 * n))
    for e in range(_ELEMENTS):
        stiff[4 * e : 4 * e + 6, 4 * e : 4 * e + 6] += own[e]
    load = np.zeros((2 * n, 2))
    load[-2, 0] = load[-1, 1] = body.outer
    u = np.zeros((2 * n, 2))
    u[2:] = np.linalg.solve(stiff[2:, 2:], load[2:])  # the first node is bonded to the core
    return nodes, u.T.reshape(2, n, 2)


def strain_factors(body: Body, radius: float) -> Array:
    """Return e_rr at a radius per p cos and per q sin of every harmonic, shape (HARMONICS + 1, 2) [1/Pa]."""
    out = np.zeros((HARMONICS + 1, 2))
    for k in range(HARMONICS + 1):
        nodes, u = harmonic(body, k)
        e = min(int(np.searchsorted(nodes[2::2], radius)), _ELEMENTS - 1)
        left, right = nodes[2 * e], nodes[2 * e + 2]
        half = 0.5 * (right - left)
        x = (radius - 0.5 * (left + right)) / half
        slope = np.array([x - 0.5, -2 * x, x + 0.5]) / half
        out[k] = u[:, 2 * e : 2 * e + 3, 0] @ slope
    return out


@lru_cache(maxsize=16)
def _compliance(body: Body) -> tuple[Array, Array, Array, Array]:
    """Surface displacement per unit of load in each harmonic: u_r and u_t for p cos, u_r and u_t for q sin."""
    rows = np.zeros((4, FAR + 1))
    for k in range(HARMONICS + 1):
        rows[:, k] = harmonic(body, k)[1][:, -1, :].ravel()
    far = np.arange(HARMONICS + 1, FAR + 1)
    own = (1 - body.poisson) * body.outer / body.shear / far
    cross = -(1 - 2 * body.poisson) * body.outer / (2 * body.shear) / far
    rows[:, HARMONICS + 1 :] = np.stack([own, cross, cross, own])
    return rows[0], rows[1], rows[2], rows[3]


def _points() -> tuple[Array, Array]:
    """Return the places of the grid [rad] and the harmonics of one point's load (a triangle's) per unit of pressure."""
    count = int(_REACH / _STEP)
    t = _STEP * np.arange(-count, count + 1, dtype=np.float64)
    k = np.arange(FAR + 1)
    spread: Array = _STEP / np.pi * np.sinc(k * _STEP / (2 * np.pi)) ** 2
    spread[0] *= 0.5
    return t, spread


@lru_cache(maxsize=16)
def _influence(body: Body) -> tuple[Array, Array, Array, Array]:
    """Displacements at the points per unit load of the points: u_r and u_t by pressure, u_r and u_t by shear."""
    t, spread = _points()
    k = np.arange(FAR + 1)
    x = np.arange(2 * len(t) - 1) - (len(t) - 1)
    even, odd = np.cos(k * x[:, None] * _STEP), np.sin(k * x[:, None] * _STEP)
    a, b, c, d = (row * spread for row in _compliance(body))
    place = np.subtract.outer(np.arange(len(t)), np.arange(len(t))) + len(t) - 1
    # p cos gives u_r cos and u_t sin; a shear of a point is even in its place: as q cos it gives u_t cos and u_r -sin
    return (even @ a)[place], (odd @ b)[place], -(odd @ c)[place], (even @ d)[place]


@dataclass(frozen=True, slots=True)
class Pressed:
    """One indenter pressed in: load [N/m], cosine harmonics of p [Pa] (pressing: negative), sine ones of sticking q."""

    load: float
    normal: Array
    stuck: Array


def press(body: Body, profile: Array, depth: float) -> Pressed:
    """Press a profile (height over the apex [m] at the points) in by a depth [m]; points never pull."""
    t, spread = _points()
    by_p = _influence(body)[0]
    wanted = depth - profile
    inside = np.flatnonzero(wanted > 0.0)
    w = np.zeros(len(t))
    for _ in range(60):
        w[:] = 0.0
        w[inside] = np.linalg.solve(by_p[np.ix_(inside, inside)], wanted[inside])
        keep = w[inside] > 0.0
        if keep.all():
            break
        inside = inside[keep]
    load = float(w.sum() * _STEP * body.outer)
    k = np.arange(HARMONICS + 1)
    phase = k[:, None] * t
    normal = -(np.cos(phase) @ w) * spread[: HARMONICS + 1]
    stuck = (np.sin(phase) @ _sticking(body, inside, w)) * spread[: HARMONICS + 1]
    return Pressed(load, normal, stuck)


def _sticking(body: Body, inside: NDArray[np.intp], w: Array) -> Array:
    """Return the shear that keeps the points of contact from moving apart, without resultant."""
    t, _ = _points()
    out = np.zeros(len(t))
    n = len(inside)
    if n < 3:
        return out
    _, slide_p, _, slide_q = _influence(body)
    system = np.zeros((n + 1, n + 1))
    system[:n, :n] = slide_q[np.ix_(inside, inside)]
    system[:n, n] = system[n, :n] = 1.0
    # the pressure acts as p = -w
    out[inside] = np.linalg.solve(system, np.append(slide_p[np.ix_(inside, inside)] @ w[inside], 0.0))[:n]
    return out


class Indenters:
    """Contacts of one body over load and indenter, tabulated over the depth."""

    def __init__(self, body: Body) -> None:
        t, _ = _points()
        self.body = body
        # a round indenter's pressures go with 1/R: one table of the flat (R = rb) serves all
        flat = 0.5 * body.outer * t**2
        edge = body.outer * np.abs(t) + flat
        deep = 0.6 * body.outer * np.linspace(0.02, 0.4, 20) ** 2
        self._round = [press(body, flat, float(d)) for d in deep]
        self._edge = [press(body, edge, float(d)) for d in body.outer * np.geomspace(0.01, 0.25, 14)]

    def touch(self, load: float, radius: float) -> tuple[Array, Array]:
        """Return harmonics of p and of sticking q [Pa]."""
        rows, argument = (
            (self._edge, load)
            if radius == 0.0
            else (self._round, load / (1 / self.body.outer + 1 / radius) / self.body.outer)
        )
        loads = np.sqrt([row.load for row in rows])
        x = np.sqrt(argument)
        i = int(np.clip(np.searchsorted(loads, x) - 1, 0, len(rows) - 3))
        near, p, q = loads[i : i + 3], 0.0, 0.0
        for j in range(3):  # a parabola through three contacts
            weight = np.prod([(x - near[m]) / (near[j] - near[m]) for m in range(3) if m != j])
            row = rows[i + j]
            p, q = p + weight * row.normal / row.load, q + weight * row.stuck / row.load
        return load * np.asarray(p), load * np.asarray(q)
