"""Lay out, build, move and sum the Fourier series of tractions and strains on the finger.

One layout everywhere (dissertation 2.20): [x_0, x_1^s, x_1^c, x_2^s, x_2^c, ..., x_nc^s, x_nc^c], length 2 nc
+ 1. Angles in radians.  A traction is in Pa with tension positive; loads P are per length [N/m], compression
positive.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.cylinder import Cylinder

Floats = NDArray[np.float64]


def wave_numbers(highest: int) -> NDArray[np.intp]:
    """Return the wave number of every place of the layout: [0, 1, 1, 2, 2, ..., nc, nc].

    Example:
        >>> wave_numbers(2).tolist()
        [0, 1, 1, 2, 2]
    """
    if highest < 1:
        raise ValueError(f"lay out Fourier series: highest wave number is {highest}; need at least 1")
    return (np.arange(2 * highest + 1, dtype=np.intp) + 1) // 2


def pack(even: ArrayLike, odd: ArrayLike) -> Floats:
    """Interleave cosine coefficients (k = 0..nc) and sine coefficients (k = 0..nc, the first ignored)."""
    cosine, sine = np.asarray(even, dtype=np.float64), np.asarray(odd, dtype=np.float64)
    out = np.empty(2 * cosine.size - 1)
    out[0] = cosine[0]
    out[1::2] = sine[1:]
    out[2::2] = cosine[1:]
    return out


def basis(highest: int, theta: ArrayLike) -> Floats:
    """Return the values of 1, sin t, cos t, ..., sin nc t, cos nc t, shape (number of angles, 2 nc + 1)."""
    phase = np.atleast_1d(np.asarray(theta, dtype=np.float64))[:, None] * np.arange(1, highest + 1)
    out = np.ones((phase.shape[0], 2 * highest + 1))
    out[:, 1::2] = np.sin(phase)
    out[:, 2::2] = np.cos(phase)
    return out


def evaluate(coefficients: ArrayLike, theta: ArrayLike) -> Floats:
    """Sum a series at the angles theta [rad]; shape (number of angles,)."""
    series = np.asarray(coefficients, dtype=np.float64)
    total: Floats = basis(series.size // 2, theta) @ series
    return total


def line_load(cylinder: Cylinder, total: float, angle: float, highest: int) -> Floats:
    """Return the series [Pa] of a traction of `total` N/m gathered in one line at `angle` (tension positive)."""
    return spread(cylinder, total, np.ones(highest + 1), angle)


def spread(cylinder: Cylinder, total: float, spectrum: ArrayLike, angle: float) -> Floats:
    """Return the series [Pa] of a symmetric traction of `total` N/m about `angle`.

    Args:
        cylinder: gives the radius on which the traction acts.
        total: its resultant [N/m], with the sign of the traction (a pressing load is negative).
        spectrum: ratio of each coefficient to that of a line load, k = 0..nc, 1 at k = 0.
        angle: centre [rad].
    """
    ratio = np.asarray(spectrum, dtype=np.float64) * (total / (np.pi * cylinder.outer_m))
    phase = angle * np.arange(ratio.size)
    even, odd = ratio * np.cos(phase), ratio * np.sin(phase)
    even[0] *= 0.5
    return pack(even, odd)


def restriction(half_width: float, centre: float, highest: int) -> Floats:
    """Return the C map: cut a series to the strip |t - centre| <= half_width and take its series again.

    Shape (2 nc + 1, 2 nc + 1), wave numbers above nc dropped (dissertation 2.37).  It is symmetric and nearly
    a projector; its trace over its size is the share of the circle that the strip covers.
    """
    k = wave_numbers(highest).astype(np.float64)
    difference, total = k[:, None] - k[None, :], k[:, None] + k[None, :]
    narrow = half_width * np.sinc(difference * half_width / np.pi)
    wide = half_width * np.sinc(total * half_width / np.pi)
    sine = (np.arange(k.size) % 2 == 1)[:, None]
    same = sine == sine.T
    sign = np.where(sine & sine.T, -1.0, 1.0)
    # about its own centre the strip keeps even and odd parts apart; turn the basis there and back
    centred = np.where(same, narrow + sign * wide, 0.0) / np.pi
    centred[0] *= 0.5
    turn = rotation(centre, highest)
    return np.asarray(turn @ centred @ turn.T)


def rotation(angle: float, highest: int) -> Floats:
    """Return the matrix that moves a series by `angle`: series of f(t - angle) from that of f(t)."""
    turn = np.zeros((2 * highest + 1, 2 * highest + 1))
    turn[0, 0] = 1.0
    for k in range(1, highest + 1):
        c, s = np.cos(k * angle), np.sin(k * angle)
        turn[2 * k - 1 : 2 * k + 1, 2 * k - 1 : 2 * k + 1] = [[c, s], [-s, c]]
    return turn
