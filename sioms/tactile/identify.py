"""Identify the E map from touches directly: no mechanics assumed but linearity (dissertation 3.4.2).

strain_j = E p_j for every touch j.  Touches cover half the finger, so the matrix of their pressures is rank
deficient (about 68 of 121 for one edge a degree over 180 degrees): what no touch says must come from
elsewhere.  `truncated` takes zero for it, as the source does; `corrected` takes the model: it finds the
smallest relative change of the model's E that explains the touches, its weight chosen by leaving touches out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.series import pack, rotation
from sioms.tactile.touches import Touches, TouchLoads

Floats = NDArray[np.float64]

CUT = 0.02  # of the largest singular value
_FOLDS = 5
_WEIGHTS = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """Hold a map and how well it predicts.

    Args:
        rows: E, shape (ns, 2 nc + 1) [1/Pa].
        left_out: root mean square strain of every element over touches that were left out in turn, shape
            (ns,).
        rank: number of directions of pressure that the touches determine.
    """

    rows: Floats
    left_out: Floats
    rank: int


def series_of(touches: Touches, loads: TouchLoads) -> tuple[Floats, Floats]:
    """Return the series of p and of q under full adhesion for every touch [Pa], each of shape (nt, 2 nc + 1)."""
    highest = loads.normal.shape[1] - 1
    none = np.zeros(highest + 1)
    turns = [rotation(float(angle), highest) for angle in touches.angle_rad]
    normal = [turn @ pack(row, none) for turn, row in zip(turns, loads.normal, strict=True)]
    shear = [turn @ pack(none, row) for turn, row in zip(turns, loads.shear, strict=True)]
    return np.array(normal), np.array(shear)


def truncated(pressure: Floats, strain: Floats, cut: float = CUT) -> Identified:
    """Return E of least squares with singular values below `cut` of the largest dropped.

    Args:
        pressure: shape (nt, 2 nc + 1) [Pa].
        strain: shape (nt, ns).
        cut: 0 to 1.
    """
    _check(pressure, strain)

    def solve(p: Floats, y: Floats) -> tuple[Floats, int]:
        u, s, v = np.linalg.svd(p, full_matrices=False)
        kept = s > cut * s[0]
        return (v[kept].T / s[kept]) @ (u[:, kept].T @ y), int(kept.sum())

    left_out = _leave_out(pressure, strain, lambda p, y: solve(p, y)[0][None])[0]
    found, rank = solve(pressure, strain)
    return Identified(found.T, np.sqrt(np.mean(left_out**2, axis=0)), rank)


def corrected(pressure: Floats, strain: Floats, model: Floats) -> Identified:
    """Return the model's E with the smallest relative change that explains the touches.

    Change is measured against the model's own size at each wave number, so that what strain cannot feel stays
    put.

    Args:
        pressure: shape (nt, 2 nc + 1) [Pa].
        strain: shape (nt, ns).
        model: E by the model, shape (ns, 2 nc + 1) [1/Pa].
    """
    _check(pressure, strain)
    size = np.sqrt(np.mean(model**2, axis=0))
    size = np.maximum(size, 1e-6 * size.max())
    scaled, rest = pressure * size, strain - pressure @ model.T
    singular = np.linalg.svd(scaled, compute_uv=False)
    weights = 0.01 * singular[0] * np.array(_WEIGHTS)

    def solve(p: Floats, y: Floats) -> Floats:
        u, s, v = np.linalg.svd(p, full_matrices=False)
        answers: Floats = (v.T * (s / (s**2 + weights[:, None] ** 2))[:, None]) @ (u.T @ y)
        return answers

    misses = np.mean(_leave_out(scaled, rest, solve) ** 2, axis=1)
    best = int(np.argmin(misses.mean(axis=1)))
    change = solve(scaled, rest)[best]
    rank = int(np.count_nonzero(singular > weights[best]))
    return Identified(model + (change * size[:, None]).T, np.sqrt(misses[best]), rank)


def _leave_out(pressure: Floats, strain: Floats, solve: Callable[[Floats, Floats], Floats]) -> Floats:
    """Return the residual of each touch predicted from the others, in folds of every fifth touch.

    `solve` returns maps in some ways, shape (ways, directions, ns); the residuals have shape (ways, nt, ns).
    """
    miss: list[Floats] = [np.empty(0)] * _FOLDS
    fold = np.arange(pressure.shape[0]) % _FOLDS
    for number in range(_FOLDS):
        out = fold == number
        miss[number] = strain[out] - pressure[out] @ solve(pressure[~out], strain[~out])
    return np.concatenate(miss, axis=1)


def _check(pressure: Floats, strain: Floats) -> None:
    if pressure.shape[0] != strain.shape[0] or pressure.shape[0] < 2 * _FOLDS:
        raise ValueError(
            f"identify E: {pressure.shape[0]} pressures for {strain.shape[0]} touches; need as many of both, at least "
            "10"
        )
