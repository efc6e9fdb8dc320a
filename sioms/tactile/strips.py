"""Find and describe what copper strips in the layer do: they stand at even distances, and the finger answers unevenly.

Where the contact lies over copper the layer is stiffer: all strains are smaller in one proportion and the contact is
narrower. To first order both go as a sine of the place of touch t: strains times 1 + G sin(2 pi t/T + phase), half
width times 1 + W sin(2 pi t/T + turn). The dissertation shows the ripple in its estimates (figure 3.34); the form is
fitted.
A strain map cannot hold it: it acts on the touch as a whole, not on each piece of its pressure.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize_scalar

from sioms.tactile.model import StrainTable

Floats = NDArray[np.float64]

_LEAST = 0.15  # of the squares, that the sines must explain; of even fingers they explain 0.03
_CHANCE = 1e-3  # that touches of scattered loads are taken for strips
_LONGEST = np.radians(60.0)
_FEWEST = 2.5  # touches in the shortest period looked for
_FINENESS = 6.0  # frequencies tried in one over the arc


class Strips(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How strain and width of contact go with the place of touch; immutable.

    Args:
        period_rad: T, distance of the strips.
        gain: G, relative amplitude of the strains.
        phase_rad: of the gain at angle zero.
        width: W, relative amplitude of the half width.
        turn_rad: of the width at angle zero.
    """

    period_rad: float
    gain: float
    phase_rad: float
    width: float
    turn_rad: float

    def __post_init__(self) -> None:
        if not 0.0 < self.period_rad < math.inf:
            raise ValueError(f"strips: period_rad is {self.period_rad}; need a positive, finite angle")
        for name, value in (("gain", self.gain), ("width", self.width)):
            if not abs(value) < 0.9:
                raise ValueError(f"strips: {name} is {value}; need an amplitude below 0.9")

    def strain_factor(self, angle_rad: ArrayLike) -> Floats:
        """Return by what the strains of touches at these places are larger."""
        return self._wave(angle_rad, self.gain, self.phase_rad)

    def width_factor(self, angle_rad: ArrayLike) -> Floats:
        """Return by what contacts at these places are wider."""
        return self._wave(angle_rad, self.width, self.turn_rad)

    def _wave(self, angle_rad: ArrayLike, amplitude: float, phase: float) -> Floats:
        angle = np.asarray(angle_rad, dtype=np.float64)
        wave: Floats = 1.0 + amplitude * np.sin(2.0 * np.pi * angle / self.period_rad + phase)
        return wave

    def applied(self, table: StrainTable) -> StrainTable:
        """Return the table of an even layer as that of one with strips: g(t, b) = c(t) f(t, m(t) b), m the width's
        square.
        """
        k, b = 2.0 * np.pi / self.period_rad, table.half_widths**2
        nodes = np.empty_like(table.nodes)
        for column in range(nodes.shape[1]):
            t = table.first + column * table.step
            c, w = float(self.strain_factor(t)), float(self.width_factor(t))
            dc = table.step * self.gain * k * math.cos(k * t + self.phase_rad)
            m, dm = w * w, 2.0 * w * table.step * self.width * k * math.cos(k * t + self.turn_rad)
            f, ft, fb, ftb = table.nodes[:, column].transpose(1, 0, 2)
            value, turned = CubicHermiteSpline(b, f, fb), CubicHermiteSpline(b, ft, ftb)
            at, along = m * b, (dm * b)[:, None]
            f, fb, fbb, ft, ftb = value(at), value(at, 1), value(at, 2), turned(at), turned(at, 1)
            nodes[:, column, 0] = c * f
            nodes[:, column, 1] = dc * f + c * (ft + fb * along)
            nodes[:, column, 2] = c * m * fb
            nodes[:, column, 3] = dc * m * fb + c * (m * ftb + m * along * fbb + dm * fb)
        return StrainTable(table.first, table.step, table.half_widths, nodes)


def find_strips(rest: Floats, model: Floats, widening: Floats, place: Floats) -> Strips | None:
    """Fit the sines; None if they do not explain much.

    Args:
        rest: output less model of every touch and element, shape (nt, ns).
        model: output of an even layer, same shape.
        widening: its derivative by the logarithm of the half width, same shape; zero for edges.
        place: of the touches [rad], shape (nt,).
    """
    span, apart = float(np.ptp(place)), np.diff(np.unique(np.round(place, 6)))
    if apart.size < 10:
        return None
    shortest = _FEWEST * float(np.median(apart))
    if shortest >= min(_LONGEST, span):
        return None
    # what each touch says, summed over its elements
    mm, md, dd = (np.sum(a * b, axis=1) for a, b in ((model, model), (model, widening), (widening, widening)))
    mr, dr = np.sum(model * rest, axis=1), np.sum(widening * rest, axis=1)

    def solve(frequency: float) -> tuple[Floats, float]:
        wave = np.stack([np.sin(frequency * place), np.cos(frequency * place)])
        pairs = [(wave * weight) @ wave.T for weight in (mm, md, dd)]
        normal = np.block([[pairs[0], pairs[1]], [pairs[1].T, pairs[2]]])
        right = np.concatenate([wave @ mr, wave @ dr])
        answer = np.linalg.pinv(normal, rcond=1e-9, hermitian=True) @ right
        return answer, float(right @ answer)

    lowest, highest = 2.0 * np.pi / min(_LONGEST, span), 2.0 * np.pi / shortest
    tried = np.arange(lowest, highest, 2.0 * np.pi / (_FINENESS * span))
    best = float(tried[int(np.argmax([solve(float(f))[1] for f in tried]))])
    step = 2.0 * np.pi / (_FINENESS * span)
    found = minimize_scalar(lambda f: -solve(f)[1], bounds=(best - step, best + step), method="bounded")
    (a, b, c, d), explained = solve(float(found.x))
    # the best of as many sines as touches explains so much of pure scatter of the loads
    count = place.size
    by_chance = 1.0 - (_CHANCE / count) ** (2.0 / (count - 5))
    if explained < max(_LEAST, by_chance) * float(np.sum(rest**2)):
        return None
    return Strips(2.0 * np.pi / float(found.x), math.hypot(a, b), math.atan2(b, a), math.hypot(c, d), math.atan2(d, c))
