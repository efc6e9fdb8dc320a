"""Average over all touches that a frame allows, where it hardly tells the place: the mean of what is possible, not its
peak.

Beside the outermost elements a light touch and a heavier one further out look nearly alike: the best fit then runs
along the valley between them, and a covariance at its end is too small. The mean over the valley errs least
in the mean square, and its spread is an honest covariance. Taken as known beforehand: the touch lies on the
covered arc, it presses, all widths of contact up to that of a flat are as likely, and hollows the less the more hollow
they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.model import StrainTable
from sioms.tactile.width import WidthTable

Floats = NDArray[np.float64]

_PLACES = 31
_ROWS = 2  # every second half width of the table
DEVIATIONS = 5.0  # standard deviations of the best fit's place, both ways
_FALL = 1.5  # hollows count fully up to a third of the way from a flat to the most hollow, which does not count at all
_FARTHEST = np.radians(10.0)


@dataclass(frozen=True, slots=True)
class Average:
    """Hold the means of place [rad], load [N/m], R [m] and b = a^2, and the covariance of the first
    three; immutable.
    """

    angle: float
    load: float
    radius: float
    square: float
    covariance: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Averager:
    """Average over the touches of one finger; immutable, safe to share.

    Args:
        table: strains per unit load.
        widths: P R over b.
        arc: lowest and highest place [rad].
        largest: R of the most hollow indenter [m], at least that of a flat.
    """

    table: StrainTable
    widths: WidthTable
    arc: tuple[float, float]
    largest: float

    def average(
        self, left: Callable[[Floats], Floats], weights: Floats, load: float, load_weight: float, angle: float,
        deviation: float,
    ) -> Average | None:  # fmt: skip
        """Return the average over places within some deviations of the best fit's; None if no touch there presses.

        Args:
            left: returns the strains that are left for a touch at some places, shape (n, ns) or (1, ns) if the same for
                all.
            weights: inverse variances, shape (ns,).
            load: measured P [N/m], with its inverse variance; 0 and 0 without.
            load_weight: see above.
            angle: of the best fit [rad], on the arc.
            deviation: of that [rad].
        """
        reach = min(DEVIATIONS * deviation, _FARTHEST)
        t = np.linspace(max(angle - reach, self.arc[0]), min(angle + reach, self.arc[1]), _PLACES)
        y, f = left(t), self._strains(t)
        ff = np.square(f) @ weights + load_weight
        fy = np.matmul(f[:, :, None], (weights * y)[:, :, None])[:, :, 0, 0] + load_weight * load
        p, square = fy / ff, self.table.half_widths[::_ROWS] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            radius = self.widths.product(square)[:, None] / np.maximum(p, 0.0)
        chi = np.sum(y * y * weights, axis=1) - fy * p
        flat, likely = self.widths.cylinder.outer_m, np.ones_like(radius)
        if self.largest > flat:
            likely = np.clip(_FALL * (self.largest - radius) / (self.largest - flat), 0.0, 1.0)
        possible = (p > 0.0) & (radius <= self.largest) & (likely > 0.0)
        if not possible.any():
            return None
        # P integrates out to 1/sqrt(ff); rows are even steps of the half width
        share = np.exp(-0.5 * np.where(possible, chi - chi[possible].min(), np.inf)) / np.sqrt(ff)
        share[possible] *= likely[possible]
        share /= share.sum()
        values = np.stack([np.broadcast_to(t, p.shape)[possible], p[possible], radius[possible]])
        share_of, spread = share[possible], 1.0 / ff[possible]
        mean = values @ share_of
        off = values - mean[:, None]
        # what P leaves open at each place and width; R moves against it
        own = np.stack([np.zeros_like(spread), np.ones_like(spread), -values[2] / values[1]])
        covariance = (off * share_of) @ off.T + (own * (share_of * spread)) @ own.T
        return Average(
            float(mean[0]), float(mean[1]), float(mean[2]), float(share.sum(axis=1) @ square),
            tuple((float(a), float(b), float(c)) for a, b, c in covariance),
        )  # fmt: skip

    def _strains(self, t: Floats) -> Floats:
        """Return f at some widths of the table and some places, shape (nb, n, ns)."""
        at = (t - self.table.first) / self.table.step
        column = np.clip(at.astype(np.intp), 0, self.table.nodes.shape[1] - 2)
        s = (at - column)[:, None]
        r, nodes = 1.0 - s, self.table.nodes[::_ROWS]
        blend = np.stack([(1.0 + 2.0 * s) * r * r, s * r * r, s * s * (3.0 - 2.0 * s), -s * s * r], axis=1)
        low, high = nodes[:, column, :2], nodes[:, column + 1, :2]
        strains: Floats = np.einsum("tcn,btcn->btn", blend[:, :2], low) + np.einsum("tcn,btcn->btn", blend[:, 2:], high)
        return strains
