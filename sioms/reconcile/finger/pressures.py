"""Tractions under an indenter as Fourier series, tabulated so that a fit may ask for thousands of touches.

A table belongs to one body (core, outer radius, Poisson's ratio, shear modulus) and one coefficient of friction. Round
indenters are looked up by the product P R (their shape depends on the half width alone), edges by their load.
Everything is per unit load. Series are complex, ``z_k = c_k + i s_k`` of ``sum c_k cos kt + s_k sin kt``, t from the
indenter's apex.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from sioms.tactile.closedform import ellipse_spectrum, hertz_product
from sioms.tactile.contact import Contact, adhere, slide
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.indenter import FLAT, Wedge

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

HIGHEST = 60  # wave numbers; the peak of a line load misses 0.004 % at 10.3 of 12.7 mm
WAVES = np.arange(HIGHEST + 1)
EDGE = np.pi / 4.0  # half angle of the indenters with radius zero
_ROUND_AT = (0.04, 0.1, 0.17, 0.24, 0.32, 0.44)  # half widths at which contacts are solved [rad]
_EDGE_AT = (0.02, 0.05, 0.09, 0.15)
_STUCK_AT = (0.06, 0.14, 0.24, 0.44)
_FINE = 90
SLIDING = 0.5  # coefficient of friction at which sliding is solved


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Normal and shear series [1/m per N/m] and half width [rad] over a rising argument; immutable.

    The argument is P R [N] for round indenters and P [N/m] for edges.
    """

    top: float
    normal: CubicSpline
    shear: CubicSpline
    half_width: CubicSpline

    def series(self, argument: Floats) -> tuple[Complex, Complex]:
        """Return normal and shear series, shape (n, HIGHEST + 1); the last contact solved beyond the table."""
        root = np.sqrt(np.clip(argument, 0.0, self.top))
        return np.asarray(self.normal(root), dtype=np.complex128), np.asarray(self.shear(root), dtype=np.complex128)

    def width(self, argument: Floats) -> Floats:
        """Return half widths [rad]."""
        out: Floats = self.half_width(np.sqrt(np.clip(argument, 0.0, self.top)))
        return out


def pack(solved: Contact) -> tuple[Complex, Complex]:
    """Return p and q of a solved contact as complex series per unit load about the apex."""
    p, q = np.split(solved.series(-solved.offset, HIGHEST) / solved.load, 2)
    return _complex(p), _complex(q)


def _complex(series: Floats) -> Complex:
    out = np.zeros(HIGHEST + 1, dtype=np.complex128)
    out.real, out.imag[1:] = series[::2], series[1::2]
    return out


@lru_cache(maxsize=64)
def sheet(body: Cylinder, edge: bool, friction: float = 0.0) -> Sheet:
    """Tabulate contacts with the rigid core, frictionless or sliding.

    The coefficients in Chebyshev functions vary smoothly with the half width; series between the solved widths follow
    from them in closed form.
    """
    indenter, at, order, power = (Wedge(EDGE), _EDGE_AT, 32, 1) if edge else (FLAT, _ROUND_AT, 16, 2)
    solved = [slide(body, indenter, a, friction, order) for a in at]
    grid = np.concatenate([[0.0], np.array(at)])

    def between(values: Floats) -> CubicSpline:
        return CubicSpline(grid, np.concatenate([values[:1], values]))

    shape = between(np.array([c.normal / c.normal[0] for c in solved]))
    offset = between(np.array([c.offset / c.half_width for c in solved]))
    stiffness = between(np.array([c.load / c.half_width**power for c in solved]))
    widths = np.linspace(0.0, at[-1], _FINE)
    argument = stiffness(widths) * widths**power * (1.0 if edge else body.outer_m)
    rows = []
    for a in np.maximum(widths, 1e-9):
        c = shape(a)
        unit = 0.5 * np.pi * a * body.outer_m * float(c[0])
        rows.append(pack(Contact(body, float(a), 1.0, float(offset(a) * a), c / unit, friction, np.zeros(order + 1))))
    root = np.sqrt(argument)
    return Sheet(
        float(argument[-1]),
        CubicSpline(root, np.array([r[0] for r in rows])),
        CubicSpline(root, np.array([r[1] for r in rows])),
        CubicSpline(root, widths),
    )


@lru_cache(maxsize=16)
def hertz(body: Cylinder) -> Sheet:
    """Tabulate Hertz's round contact: the half plane's width, without the core."""
    widths = np.linspace(0.0, _ROUND_AT[-1], _FINE)
    normal = -ellipse_spectrum(WAVES * widths[:, None]) / (np.pi * body.outer_m) * np.where(WAVES == 0, 0.5, 1.0)
    root = np.sqrt(hertz_product(body, widths))
    return Sheet(
        float(root[-1] ** 2),
        CubicSpline(root, normal + 0j),
        CubicSpline(root, 0j * normal),
        CubicSpline(root, widths),
    )


@lru_cache(maxsize=8)
def stuck(body: Cylinder) -> CubicSpline:
    """Return the shear series per unit load of full adhesion over the half width [rad] (``adhere`` for its limits)."""
    rows = [np.zeros(HIGHEST + 1, dtype=np.complex128)]
    rows += [pack(adhere(body, FLAT, a))[1] for a in _STUCK_AT]
    return CubicSpline(np.concatenate([[0.0], np.array(_STUCK_AT)]), np.array(rows))
