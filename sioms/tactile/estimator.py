"""Estimate place, load and radius of the touch in every frame of strains.

    estimator = Estimator(finger)
    shape = estimator.frame(strains)                        # (ns,) strains, tension positive
    shape = estimator.frame(strains, load=Load(203.0, 4.0))  # with a force sensor: N/m and its standard
    deviation

The model is the finger's E map with round contacts of the finger's width table (dissertation 3.5).  Errors
are propagated from the elements' noise and, in proportion to the touch, from the misfit that calibration
left; the covariance is that of weighted least squares, and where that leaves the place open the estimate is the
mean of what is possible (`sioms.tactile.posterior`).  An estimate always carries a quality; `Quality.GOOD` means no
flag is set.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.finger import Finger
from sioms.tactile.kernel import MOST_STEPS, NOT_DRAWN, Products, Solve, Status, compiled, drawn_frame, plain
from sioms.tactile.linearity import linearise
from sioms.tactile.model import StrainTable
from sioms.tactile.posterior import DEVIATIONS, Averager
from sioms.tactile.proximity import Proximity
from sioms.tactile.quality import BLANK, Load, Quality, ShapeEstimate, nothing

Floats = NDArray[np.float64]
Covariance = tuple[tuple[float, float, float], ...]
Found = tuple[int, float, float, Products, int, float]  # status, t, b, products there, steps, sum of weights


_HUGE = 1e30  # variance of an element that must not count
_PROXIMITY_STARTS = 3
_APART = math.radians(6.0)
_HOLD_PASSES = 8
_SURE = math.radians(2.0) / 4.0  # standard deviation of the place above which IMPRECISE is set
_RATHER_ROUND = 9.0  # chi square by which a hollow touch beside the last elements must be more likely than a round one
_HOLLOW = 1.2  # R in units of rb, beyond which noise alone does not make a flat
_TRIED = 3  # elements without which a poor fit is tried again
_SHIFTS = 4  # rounds in which a shift of all elements is found
_ALIKE = 0.05  # of a shift of all elements, by which one may differ from it


@dataclass(slots=True)
class _Frame:
    """One frame while it is fitted: strains, their variances, model errors as shares of the peak, squared, and the
    load.
    """

    y: Floats
    noise: Floats
    share: Floats
    load: float
    load_weight: float
    count: int


class Estimator:
    """Fit frames of one finger.  Not to be shared between threads while a frame is being fitted.

    Args:
        finger: the calibrated finger.
        compiled: True demands numba, False plain numpy, None takes numba if it is installed.
        poor_fit: misfit above which POOR_FIT is set.
        contact_sigma: how far above the noise the strains must be to count as a touch, in standard deviations
            of their chi square.
        conductor: what touches is a conductor; a finger calibrated with the proximity effect then undoes it.
        most_hollow: largest R of an estimate, in units of rb: 1 is a flat, 1.5 a hollow of radius 3 rb. Without a
            bound a light touch beside the last element can pass for a heavy, wide one further out.
        averaged: frames given are means of so many.
    """

    def __init__(
        self,
        finger: Finger,
        compiled: bool | None = False,
        poor_fit: float = 4.0,
        contact_sigma: float = 6.0,
        conductor: bool = True,
        most_hollow: float = 1.5,
        averaged: float = 1.0,
    ) -> None:
        if not most_hollow >= 1.0:
            raise ValueError(f"make estimator: most_hollow is {most_hollow}; need 1 (flats) or more")
        self.finger = finger
        self._table = finger.strain_table().in_single_precision()
        self._widths = finger.width_table()
        self._solve = self._choose(compiled)
        self._poor_fit, self._contact_sigma = poor_fit, contact_sigma
        if not averaged >= 1.0:
            raise ValueError(f"make estimator: frames are means of {averaged}; need 1 or more")
        noise = np.asarray(finger.strain_noise, dtype=np.float64) ** 2 / averaged
        self._used = np.isfinite(noise)
        self._noise = np.where(self._used, noise, _HUGE)
        self._share = np.asarray(finger.misfit, dtype=np.float64) ** 2
        angles = self._angles = np.asarray(finger.angles_rad, dtype=np.float64)
        self._gain = np.asarray(finger.elements.gain, dtype=np.float64)
        self._quadratic = np.asarray(finger.elements.quadratic, dtype=np.float64)
        near = Proximity(finger.signal.proximity, finger.signal.proximity_range_rad)
        self._drawn = near if conductor and near.amplitude != 0.0 else None
        pitch = self._pitch = float(np.ptp(angles)) / max(angles.size - 1, 1)
        self._arc = float(angles.min()) - 0.5 * pitch, float(angles.max()) + 0.5 * pitch
        self._radius, self._circles = finger.cylinder.outer_m, finger.contact.circles
        self._systematic = finger.systematic
        self._largest = most_hollow * self._radius
        table = self._table
        self._widest = float(table.half_widths[-1]) ** 2
        self._averager = Averager(table, self._widths, self._arc, self._largest)
        bank, places = self._templates()
        self._fixed = (
            table.nodes, table.first, table.step, float(table.half_widths[1]), bank, bank**2 + 1e-300, places,
        )  # fmt: skip

    @property
    def table(self) -> StrainTable:
        """Return the finger's strains."""
        return self._table

    @staticmethod
    def _choose(wanted: bool | None) -> Solve:
        if wanted is False:
            return plain()
        if wanted is True:
            return compiled()
        try:
            return compiled()
        except ImportError:
            return plain()

    def _templates(self) -> tuple[Floats, Floats]:
        """Return strain patterns of narrow to wide touches every two degrees, to start the search from the best."""
        table = self._table
        rows = np.searchsorted(table.half_widths, [0.05, 0.15, 0.3, 0.45]).clip(0, table.half_widths.size - 1)
        columns = np.arange(0, table.nodes.shape[1], 2)
        bank = table.nodes[rows[:, None], columns, 0].reshape(rows.size * columns.size, -1)
        angle = table.first + table.step * columns
        square = table.half_widths[rows] ** 2
        return np.ascontiguousarray(bank, np.float64), np.stack(
            [np.tile(angle, rows.size), np.repeat(square, columns.size)], axis=1
        )

    def frame(
        self, strains: ArrayLike, load: Load | None = None, usable: NDArray[np.bool_] | None = None,
        variance: Floats | None = None, floor: float = 0.0,
    ) -> ShapeEstimate:  # fmt: skip
        """Estimate the touch of one frame.

        Args:
            strains: shape (ns,), tension positive (a press is negative); values that are not finite are left
                out.
            load: what a force sensor says, if any.
            usable: which elements to use, shape (ns,); None takes all that are finite and not dead in the
                finger's file.
            variance: of the strains, shape (ns,), where it is not that of the finger's file.
            floor: error of the model [share of the peak] beside the finger's misfit, for means over so many frames that
                it shows.

        Raises:
            ValueError: wrong number of strains, or a load that is not finite and pressing.
        """
        y = np.asarray(strains, dtype=np.float64)
        if y.shape != self._noise.shape:
            raise ValueError(
                f"estimate shape: frame has {y.size} strains in shape {y.shape}; the finger has {self._noise.size} "
                "elements"
            )
        if load is not None and not (0.0 < load.value < math.inf and 0.0 <= load.deviation < math.inf):
            raise ValueError(
                f"estimate shape: load is {load.value} +- {load.deviation} N/m; need a finite pressing load"
            )
        noise, share = self._noise, self._share
        if variance is not None:
            noise = np.where(self._used, variance, _HUGE)
        if floor:
            share = share + floor**2
        return self._estimate(y, noise, share, load, usable)

    def _estimate(
        self, y: Floats, noise: Floats, share: Floats, load: Load | None, usable: NDArray[np.bool_] | None
    ) -> ShapeEstimate:
        quality, count = Quality.GOOD, y.size
        good = self._used & np.isfinite(y)
        if usable is not None:
            good &= usable
        if not good.all():
            quality, count = Quality.BAD_ELEMENTS, int(np.count_nonzero(good))
            y, noise = np.where(good, y, 0.0), np.where(good, noise, _HUGE)
        if count < 4:
            return nothing(quality | Quality.TOO_FEW_ELEMENTS)
        value, weight = 0.0, 0.0
        if load is not None:
            value, weight = load.value, 1.0 / max(load.deviation, 1e-6 * load.value) ** 2
        frame = _Frame(y, noise, share, value, weight, count)
        shape = self._fit(frame, quality)
        if shape.quality & (Quality.POOR_FIT | Quality.WRONG_SIGN):
            shape = self._mended(frame, shape, quality)
        return shape

    def _fit(self, frame: _Frame, quality: Quality) -> ShapeEstimate:
        """Fit one touch."""
        y, noise, value, weight, count = frame.y, frame.noise, frame.load, frame.load_weight, frame.count
        least = self._least(count)
        if self._drawn is None:
            pull, found = NOT_DRAWN, self._search(frame, least)
        else:
            pull = self._pull(self._drawn, y)
            found = self._search_drawn(frame, pull, least)
        if found[0] == Status.NO_CONTACT:
            return nothing(quality | Quality.NO_CONTACT)
        if found[0] == Status.WRONG_SIGN:
            return nothing(quality | Quality.WRONG_SIGN)
        shape = self._describe(*found[1:], value, weight, count, quality)
        if Quality.FLAT_OR_HOLLOW in shape.quality and self._at_end(shape.angle_rad) and not pull.shape[1]:
            other = self._search(frame, 0.0, start=self._narrow_start(y, noise, shape.angle_rad))
            if other[0] == Status.FITTED and _chi(other, value, weight) < _chi(found, value, weight) + _RATHER_ROUND:
                convex = self._describe(*other[1:], value, weight, count, quality)
                shape = shape if Quality.FLAT_OR_HOLLOW in convex.quality else convex
        deviation = self._open(shape)
        return self._averaged(shape, deviation, frame, pull) if deviation else shape

    def _least(self, count: int) -> float:
        """Return the chi square of strains from which on they are a touch."""
        return count + self._contact_sigma * math.sqrt(2.0 * count)

    def _mended(self, frame: _Frame, shape: ShapeEstimate, quality: Quality) -> ShapeEstimate:
        """Return the fit without one element, or without what all have in common, if that is what one touch does not
        explain.

        Else the poor fit as it is.
        """
        if frame.count <= 4:
            return shape
        z = frame.y**2 / frame.noise
        loudest = int(np.argmax(z))
        if float(z.sum() - z[loudest]) < self._least(frame.count - 1):
            return nothing(quality | Quality.NO_CONTACT | Quality.BAD_ELEMENTS)
        best = shape
        for element in {loudest, *self._blamed(frame, shape)}:
            if frame.noise[element] < _HUGE:
                noise = frame.noise.copy()
                noise[element] = _HUGE
                left = dataclasses.replace(
                    frame, y=np.where(noise < _HUGE, frame.y, 0.0), noise=noise, count=frame.count - 1
                )
                best = _better(best, self._fit(left, quality | Quality.SUSPECT | Quality.BAD_ELEMENTS))
        return _better(best, self._unshifted(frame, quality | Quality.SUSPECT))

    def _blamed(self, frame: _Frame, shape: ShapeEstimate) -> list[int]:
        """Return the elements without which most of a poor fit would go; of what looks like a pull the most stretched
        one.
        """
        if not shape.usable:
            return [int(np.argmax(frame.y))]
        rest, basis, _ = self._left_over(frame, shape)
        blame = rest**2 / np.maximum(1.0 - np.sum(basis**2, axis=0), 1e-3)
        return [int(element) for element in np.argsort(blame)[-_TRIED:]]

    def _unshifted(self, frame: _Frame, quality: Quality) -> ShapeEstimate:
        """Return the fit without a shift of all outputs alike, which elements far from the touch tell first."""
        known = frame.noise < _HUGE
        there = np.where(known, self._gain, 0.0)
        shift = float(np.median(frame.y[known] / self._gain[known]))
        for left in reversed(range(_SHIFTS)):
            noise = np.where(known, frame.noise + (_ALIKE * shift * self._gain) ** 2, _HUGE)
            unshifted = dataclasses.replace(frame, y=frame.y - shift * there, noise=noise)
            trial = self._fit(unshifted, quality)
            if not (left and trial.usable):
                break
            rest, basis, weights = self._left_over(unshifted, trial)
            own = there * np.sqrt(weights)
            own = own - basis.T @ (basis @ own)
            shift += float(own @ rest) / max(float(own @ own), 1e-300)
        return trial

    def _left_over(self, frame: _Frame, shape: ShapeEstimate) -> tuple[Floats, Floats, Floats]:
        """Return residuals in deviations, an orthonormal basis of what place, load and width can take up, and the
        weights.
        """
        y = frame.y
        if self._drawn is not None:
            y = self._left(self._pull(self._drawn, y), y, np.array([shape.angle_rad]))[0]
        weights = np.where(frame.noise < _HUGE, 1.0 / (frame.noise + frame.share * float(np.max(y**2))), 0.0)
        f, turned, widened = self._table.at(shape.angle_rad, 0.25 * shape.width_rad**2)
        basis = np.linalg.qr((np.stack([f, turned, widened]) * np.sqrt(weights)).T)[0].T
        rest = (y - shape.load_n_per_m * f) * np.sqrt(weights)
        return rest - basis.T @ (basis @ rest), basis, weights

    def _open(self, shape: ShapeEstimate) -> float:
        """Return the deviation of the place [rad] over which to average, 0 where the best fit stands.

        A hollow touch beside the last elements may as well be a narrow one within half a pitch, whatever its
        covariance.
        """
        variance = shape.covariance[0][0]
        if not variance < _SURE**2:
            return math.sqrt(variance) if variance > 0.0 else math.inf
        if self._at_end(shape.angle_rad) and shape.equivalent_radius_m > _HOLLOW * self._radius:
            return max(math.sqrt(variance), 0.5 * self._pitch / DEVIATIONS)
        return 0.0

    def _at_end(self, angle: float) -> bool:
        """Return whether a place lies within a pitch of the outermost elements."""
        return not self._arc[0] + 1.5 * self._pitch < angle < self._arc[1] - 1.5 * self._pitch

    def _narrow_start(self, y: Floats, noise: Floats, angle: float) -> tuple[float, float]:
        """Return place and width of the narrow pattern, some way off, that explains most.

        Few elements feel what lies between the last two: a narrow touch there looks like a hollow one further out.
        """
        bank, places = self._fixed[4], self._fixed[6]
        apart = np.abs(places[:, 0] - angle)
        near = (places[:, 1] == places[:, 1].min()) & (apart > 0.1 * self._pitch) & (apart < self._pitch)
        score = np.maximum(bank @ (y / noise), 0.0) ** 2 / (bank**2 @ (1.0 / noise))
        best = int(np.argmax(np.where(near, score, -1.0)))
        return float(places[best, 0]), float(places[best, 1])

    def _search(
        self, frame: _Frame, least: float, pull: Floats = NOT_DRAWN, start: tuple[float, float] = (0.0, -1.0)
    ) -> Found:
        """Fit, and fit again no wider than the most hollow indenter while the fit is wider."""
        top, load, load_weight = self._widest, frame.load, frame.load_weight
        for _ in range(1 + _HOLD_PASSES):
            found = self._solve(
                *self._fixed, frame.noise, frame.share, least, frame.y, pull, load, load_weight, top, *start
            )
            status, _, b, at, _, _ = found
            if status != Status.FITTED:
                break
            p = (at[3] + load_weight * load) / (at[0] + load_weight)
            if p <= 0.0:
                return Status.WRONG_SIGN, *found[1:]
            hold = self._hold(p, b)
            if hold >= b:
                break
            top = hold
        return found

    def _hold(self, load: float, b: float) -> float:
        """Return b, or the width of the most hollow indenter under this load if that is less."""
        for _ in range(8):  # Newton; R is nearly straight in b
            radius, slope = self._widths.radius(load, b)
            excess = radius / self._largest - 1.0
            if excess < 1e-3:
                break
            b = max(b - (radius - self._largest) / slope, 0.0)
        return b

    def _pull(self, drawn: Proximity, y: Floats) -> Floats:
        """Return what the search needs of a frame under a conductor: the pull is an output and acts before the
        quadratic.
        """
        linear = -y / self._gain
        output = linear + self._quadratic * linear**2
        return drawn_frame(self._angles, self._gain, self._quadratic, output, drawn.amplitude, drawn.range_rad)

    def _left(self, pull: Floats, y: Floats, t: Floats) -> Floats:
        """Return the strains without the pull of a conductor at places t, shape (n, ns); (1, ns) if there is none."""
        if not pull.shape[1]:
            return y[None]
        angle, gain, quadratic, output, amplitude, reach = pull
        drawn = amplitude * np.exp(-np.abs(angle - t[:, None]) / reach)
        strains: Floats = -gain * linearise(output - drawn, quadratic)
        return strains

    def _search_drawn(self, frame: _Frame, pull: Floats, least: float) -> Found:
        """Fit from the places where a touch and its pull together explain most; return the best."""
        blank, y, noise = (0.0,) * 10, frame.y, frame.noise
        load, load_weight = frame.load, frame.load_weight
        if float(np.sum(y * y / noise)) < least:
            return Status.NO_CONTACT, 0.0, 0.0, blank, 0, 0.0
        bank, places = self._fixed[4], self._fixed[6]
        clean = np.where(noise < _HUGE, self._left(pull, y, places[:, 0]), 0.0)
        score = np.sum(bank * clean / noise, axis=1)
        score *= np.abs(score) / np.sum(bank**2 / noise, axis=1)
        square = np.sum(clean**2 / noise, axis=1)
        best: Found = (Status.WRONG_SIGN, 0.0, 0.0, blank, 0, 0.0)
        if np.min(square - np.maximum(score, 0.0)) >= np.min(square + np.minimum(score, 0.0)):
            return best
        cost = square - np.maximum(score, 0.0)
        least_cost = math.inf
        for _ in range(_PROXIMITY_STARTS):
            start = int(np.argmin(cost))
            t, b = float(places[start, 0]), float(places[start, 1])
            cost[np.abs(places[:, 0] - t) < _APART] = math.inf
            found = self._search(dataclasses.replace(frame, y=clean[start]), 0.0, pull, (t, b))
            at, left = found[3], math.inf
            if found[0] == Status.FITTED:
                left = at[9] - (at[3] + load_weight * load) ** 2 / (at[0] + load_weight)
            if left < least_cost:
                best, least_cost = found, left
        return best

    def _averaged(self, shape: ShapeEstimate, deviation: float, frame: _Frame, pull: Floats) -> ShapeEstimate:
        """Return the mean over all touches that the frame allows, in place of a best fit whose
        place is hardly known.
        """
        t, arc, y, noise = shape.angle_rad, self._averager.arc, frame.y, frame.noise
        mean = None
        if arc[0] <= t <= arc[1]:
            there = np.where(noise < _HUGE, self._left(pull, y, np.array([t]))[0], 0.0)
            weights = 1.0 / (noise + frame.share * float(np.max(there**2)))
            mean = self._averager.average(
                lambda places: self._left(pull, y, places),
                weights,
                frame.load,
                frame.load_weight,
                t,
                deviation,
            )
        if mean is None:
            return dataclasses.replace(shape, quality=shape.quality | Quality.IMPRECISE)
        bend, rc = self._bent(mean.radius)
        judged = self._judge(mean.angle, mean.square, mean.load, mean.radius, shape.misfit, shape.steps)
        return dataclasses.replace(
            shape, angle_rad=mean.angle, load_n_per_m=mean.load, equivalent_radius_m=mean.radius,
            equivalent_curvature_per_m=bend, radius_m=rc, width_rad=2.0 * math.sqrt(mean.square),
            covariance=self._widened(mean.covariance, mean.load, mean.radius, mean.square),
            quality=shape.quality & (Quality.BAD_ELEMENTS | Quality.SUSPECT) | judged | Quality.IMPRECISE,
        )  # fmt: skip

    def _widened(self, covariance: Covariance, load: float, radius: float, b: float) -> Covariance:
        """Add the finger's systematic errors, and to the variance of R what circles taken for parabolas do to it.

        So much less is R of `sioms.plant.rubber`.
        """
        own, round_ = self._systematic, 0.0
        if self._circles and radius > 0.0:
            bend = max(self._radius / radius - 1.0, 0.0)  # rb/rc
            round_ = self._circles * radius * b * (0.36 + 0.7 * bend + 0.28 * bend**2)
        (aa, ap, ar), (pa, pp, pr), (ra, rp, rr) = covariance
        aa, pp = aa + own.place_rad**2, pp + (own.load * load) ** 2
        return (aa, ap, ar), (pa, pp, pr), (ra, rp, rr + (own.radius * radius) ** 2 + round_**2)

    def _bent(self, radius: float) -> tuple[float, float]:
        """Return 1/R [1/m] and rc [m]."""
        bend = 1.0 / radius if radius > 0.0 else math.inf
        own = bend - 1.0 / self._radius
        return bend, 1.0 / own if own > 0.0 else math.inf

    def _describe(
        self, t: float, b: float, at: Products, steps: int, total: float, load: float, load_weight: float, count: int,
        quality: Quality,
    ) -> ShapeEstimate:  # fmt: skip
        ff, ft, fb, fy, tt, tb, _, bb, _, yy = at
        ff, fy = ff + load_weight, fy + load_weight * load
        p = fy / ff
        chi = max(yy + load_weight * load * load - fy * fy / ff, 0.0)
        misfit = chi / max(count + (load_weight > 0.0) - 3, 1)
        radius, slope = self._widths.radius(p, b)
        covariance = _covariance(p, (p * p * tt, p * ft, p * p * tb, ff, p * fb, p * p * bb), radius, slope)
        quality |= self._judge(t, b, p, radius, misfit, steps)
        bend, rc = self._bent(radius)
        return ShapeEstimate(
            t, p, radius, bend, rc, 2.0 * math.sqrt(b),
            math.sqrt(chi / total), misfit, self._widened(covariance, p, radius, b), quality, steps,
        )  # fmt: skip

    def _judge(self, t: float, b: float, load: float, radius: float, misfit: float, steps: int) -> Quality:
        quality = Quality.GOOD
        if misfit > self._poor_fit:
            quality |= Quality.POOR_FIT
        if not self._arc[0] <= t <= self._arc[1]:
            quality |= Quality.OUT_OF_ARC
        if b >= self._widest or load > self.finger.most_load_n_per_m:
            quality |= Quality.OVERLOAD
        if b <= 0.0:
            quality |= Quality.SHARP
        if radius >= self._radius:
            quality |= Quality.FLAT_OR_HOLLOW
        if steps >= MOST_STEPS:
            quality |= Quality.NOT_CONVERGED
        return quality

    def batch(
        self,
        frames: Iterable[ArrayLike],
        load: Load | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> Iterator[ShapeEstimate]:
        """Estimate many frames in turn; `progress` is told how many are done."""
        for done, strains in enumerate(frames, 1):
            yield self.frame(strains, load)
            if progress is not None:
                progress(done)


def _better(one: ShapeEstimate, other: ShapeEstimate) -> ShapeEstimate:
    """Return the other if it is a touch that fits well, and better than the one."""
    if not other.usable or Quality.POOR_FIT in other.quality or other.misfit >= one.misfit:
        return one
    return other


def _chi(found: Found, load: float, load_weight: float) -> float:
    """Return the chi square of a fit, but for what all fits of the frame have in common."""
    at = found[3]
    return at[9] - (at[3] + load_weight * load) ** 2 / (at[0] + load_weight)


def _covariance(
    load: float, information: tuple[float, float, float, float, float, float], radius: float, slope: float
) -> tuple[tuple[float, float, float], ...]:
    """Invert the information on (t, P, b), upper triangle by rows, and turn b into R: dR = slope db - R/P dP."""
    a, b, c, d, e, f = information
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * m00 + b * m01 + c * m02
    if not det > 0.0:
        return BLANK
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    by_load = -radius / load
    tr = (m01 * by_load + m02 * slope) / det
    pr = (m11 * by_load + m12 * slope) / det
    rr = (m11 * by_load**2 + 2.0 * m12 * by_load * slope + m22 * slope**2) / det
    return (m00 / det, m01 / det, tr), (m01 / det, m11 / det, pr), (tr, pr, rr)
