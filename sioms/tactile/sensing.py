"""Sense shape from raw frames: signal chain and estimator as one object, for drivers and programs.

    sensor = ShapeSensor(finger)
    for stamp_ns, raw in frames:
        sensed = sensor.frame(raw, stamp_ns)           # or frame(raw, stamp_ns, load) with a force sensor
        if sensed.shape.quality is Quality.GOOD: print(sensed.shape.angle_rad)

Pure: frames, stamps and loads go in, values come out.  `numbers` lays an estimate out as the row of numbers that
a driver publishes, described by `CHANNELS`.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.chain import SETTLE_FRAMES, Held, SignalChain, StrainFrame
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger
from sioms.tactile.quality import Load, Quality, ShapeEstimate, State, nothing, state_of
from sioms.tactile.rest import Rebase
from sioms.tactile.witness import FEWEST

Floats = NDArray[np.float64]

MEAN_FLOOR = 2.5e-4  # of the peak: what circles and tables leave of a model that fits
MEAN_MISFIT = 3.0
BROAD_LOAD = 300.0  # N/m, beyond which the model's own errors grow
_NOT_ONE = Quality.POOR_FIT | Quality.SUSPECT | Quality.WRONG_SIGN

CHANNELS: tuple[tuple[str, str, str], ...] = (
    ("touched", "", "1 while something touches, 0 while nothing does, nan while that is not known"),
    ("angle", "rad", "place of the contact"),
    ("load", "N/m", "load P, 0 while untouched"),
    ("radius", "m", "radius rc of the indenter, infinite for a flat"),
    ("equivalent_radius", "m", "R, 1/R = 1/rb + 1/rc"),
    ("curvature", "1/m", "1/R, which behaves for flats"),
    ("width", "rad", "width of the contact"),
    ("residual", "", "root mean square of strain less model"),
    ("misfit", "", "chi square per degree of freedom, 1 when the model fits"),
    ("var_angle", "rad^2", "variance of the angle"),
    ("var_load", "N^2/m^2", "variance of the load"),
    ("var_radius", "m^2", "variance of R"),
    ("cov_angle_load", "rad*N/m", "covariance of angle and load"),
    ("cov_angle_radius", "rad*m", "covariance of angle and R"),
    ("cov_load_radius", "N", "covariance of load and R"),
    ("quality", "", "sum of the flags of Quality, 0 when good"),
)
"""Name, unit and meaning of each of the numbers of an estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensed:
    """Hold what one frame said: its strains and the shape that made them; immutable."""

    strain: StrainFrame
    shape: ShapeEstimate


class LoadTare:
    """Turn readings of a force sensor into loads: scale, and subtract what it reads while untouched.

    One caller at a time.

    Args:
        scale: load [N/m] of one unit of the reading: one over the length of contact [1/m] for newtons, negative
            if pressing lowers the reading.
        deviation: standard deviation of the load [N/m], > 0.
        time_s: time constant with which the reading without touch is followed.

    Raises:
        ValueError: a scale of zero, or a deviation or time that is not positive and finite.
    """

    def __init__(self, scale: float, deviation: float, time_s: float) -> None:
        if not (math.isfinite(scale) and scale != 0.0):
            raise ValueError(f"tare load: scale is {scale} N/m a unit; need a finite number, not 0")
        for name, value in (("deviation", deviation), ("time", time_s)):
            if not 0.0 < value < math.inf:
                raise ValueError(f"tare load: {name} is {value}; need a positive, finite number")
        self._scale, self._deviation, self._time_s = scale, deviation, time_s
        self._rest: float | None = None

    def zero(self) -> None:
        """Forget the reading without touch."""
        self._rest = None

    def load(self, reading: float, touched: bool, elapsed_s: float) -> Load | None:
        """Take one reading; return the load under a touch.

        Returns:
            None while untouched, before the first reading without touch, and for a reading that is not finite or
            does not press: a sensor that says so under a touch is not to be believed.
        """
        if not math.isfinite(reading):
            return None
        if not touched:
            share = -math.expm1(-elapsed_s / self._time_s)
            self._rest = reading if self._rest is None else self._rest + share * (reading - self._rest)
            return None
        if self._rest is None:
            return None
        value = self._scale * (reading - self._rest)
        return Load(value, self._deviation) if value > 0.0 else None


class ShapeSensor:
    """Sense the shape of what touches one finger, frame by frame.  One caller at a time.

    Args:
        finger: the calibrated finger.
        compiled: True demands numba, False plain numpy, None takes numba if it is installed.
        conductor: see `Estimator`.
        tare: of the force sensor, if there is one.
        settle_frames: frames averaged for the baseline.
    """

    def __init__(
        self,
        finger: Finger,
        *,
        compiled: bool | None = False,
        conductor: bool = True,
        tare: LoadTare | None = None,
        settle_frames: int = SETTLE_FRAMES,
    ) -> None:
        self.finger = finger
        self._estimator = Estimator(finger, compiled=compiled, conductor=conductor)
        self._chain = SignalChain(finger, settle_frames, self._estimator.table)
        self._held: Held | None = None
        self._verdict = Quality.GOOD
        self._tare = tare
        self._stamp_ns: int | None = None
        self._rebasing: Rebase | None = None
        self._last = nothing(Quality.NO_BASELINE)

    def warm(self) -> None:
        """Fit a touch of the finger's own table, so that the first real one takes no longer than the others: what
        numba has compiled is loaded with the first fit, which takes as long as hundreds of frames.
        """
        nodes = self._estimator.table.nodes
        self._estimator.frame(50.0 * nodes[nodes.shape[0] // 2, nodes.shape[1] // 2, 0])

    def zero(self) -> None:
        """Forget the baseline and take a new one from the next frames, whatever they show; the finger must be
        untouched.
        """
        self._chain.zero()
        self._rebasing = None
        if self._tare is not None:
            self._tare.zero()

    def rebase(self, frames: int = 0, since_ns: int = 0) -> Rebase:
        """Take a new baseline, and what the force sensor reads untouched, from the next frames; the old one holds until
        then.

        A pull is no hindrance: it is what a finger shows that got its baseline under a touch.

        Args:
            frames: to be averaged, at least `settle_frames`.
            since_ns: frames with older stamps do not count.

        Returns:
            How it goes: done, or refused where something touches meanwhile, or the elements fail, with one of the next
                `frame` calls.

        Raises:
            ValueError: something touches, or the finger is blind.
        """
        quality = self._last.quality
        state = state_of(quality)
        if state is State.BLIND and not quality & (Quality.NO_BASELINE | Quality.DRIFTED):
            raise ValueError(
                "it is blind: its elements cannot tell whether anything touches; see to them and their converter"
            )
        if state in (State.TOUCHED, State.DOUBTFUL) and Quality.WRONG_SIGN not in quality:
            raise ValueError(
                f"{_told(self._last)}: lift that off and zero it again; if nothing touches, load the finger's file "
                "anew, which takes what is there for untouched"
            )
        self._rebasing = self._chain.rebase(frames, since_ns)
        return self._rebasing

    @property
    def gains(self) -> Floats:
        """Return strain per output, shape (ns, ns): a diagonal unless `set_gains` gave more."""
        return self._chain.gains

    def set_gains(self, gains: ArrayLike) -> None:
        """Replace the gains: one for each element, or a matrix with cross-talk.

        Raises:
            ValueError: wrong shape, a value that is not finite, a gain of an element that is not positive.
        """
        self._chain.set_gain(gains)

    def frame(self, raw: ArrayLike, stamp_ns: int, reading: float | None = None) -> Sensed:
        """Sense one frame.

        Args:
            raw: readings, shape (ns,); not finite where there is none.
            stamp_ns: monotonic time of the frame.
            reading: of the force sensor at that time; None if there is none to be had.

        Raises:
            ValueError: wrong number of readings, or a stamp before the last one.
        """
        return self.estimate(*self.strain(raw, stamp_ns, reading))

    def estimate(self, strain: StrainFrame, load: Load | None = None) -> Sensed:
        """Do the rest of `frame` after `strain`; of frames that come faster than that takes, some may do without."""
        self._last = self.shape(strain, load)
        return Sensed(strain, self._last)

    def strain(self, raw: ArrayLike, stamp_ns: int, reading: float | None = None) -> tuple[StrainFrame, Load | None]:
        """Do the part of `frame` that needs the frames in order: return the strains, and the load under a touch."""
        strain = self._chain.frame(raw, stamp_ns)
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        if self._rebasing is not None and (self._rebasing.done or self._rebasing.refused):
            if self._rebasing.done and self._tare is not None:
                self._tare.zero()
            self._rebasing = None
        if not strain.settled or strain.blind or self._tare is None or reading is None:
            return strain, None
        return strain, self._tare.load(reading, strain.touched, elapsed_s)

    def shape(self, strain: StrainFrame, load: Load | None = None) -> ShapeEstimate:
        """Do the rest of `frame`: estimate; depends on nothing but its arguments, so another sensor of the same finger
        may do it.
        """
        if not strain.settled:
            return nothing(Quality.NO_BASELINE)
        bad = Quality.GOOD if strain.usable.all() else Quality.BAD_ELEMENTS
        if strain.blind:
            few = Quality.TOO_FEW_ELEMENTS if np.count_nonzero(strain.usable) < FEWEST else Quality.GOOD
            return nothing(Quality.BLIND | bad | few | (Quality.DRIFTED if strain.drifted else Quality.GOOD))
        if not strain.touched:
            return nothing(Quality.NO_CONTACT | bad)
        shape = self._estimator.frame(strain.strains, load, strain.usable, strain.variance)
        if shape.quality & Quality.NO_CONTACT:
            # something moves, but too little to be a touch, or not as one does
            shape = nothing(shape.quality & ~Quality.NO_CONTACT | Quality.POOR_FIT | bad)
        if strain.held is not self._held:
            self._verdict = self._judged(strain, shape.load_n_per_m)
            self._held = strain.held
        more = self._verdict | (Quality.SLOW if strain.slow else Quality.GOOD)
        if self._tare is not None and load is None:
            more |= Quality.WITHOUT_LOAD
        return dataclasses.replace(shape, quality=shape.quality | more) if more else shape

    def _judged(self, strain: StrainFrame, load: float) -> Quality:
        """Return POOR_FIT if the mean over a steady touch shows that it is not one touch; its noise is that much
        less.
        """
        held = strain.held
        if held is None:
            return Quality.GOOD
        if self._verdict and self._held is not None and held.frames > self._held.frames:
            return self._verdict  # of the same touch; what the baseline may drift meanwhile hides it again
        floor = MEAN_FLOOR * max(1.0, load / BROAD_LOAD)
        shape = self._estimator.frame(held.strains, None, strain.usable, held.variance, floor)
        if shape.quality & _NOT_ONE or (shape.usable and shape.misfit > MEAN_MISFIT):
            return Quality.POOR_FIT
        return Quality.GOOD


def _told(shape: ShapeEstimate) -> str:
    """Return in words what touches."""
    if not shape.usable:
        return "something touches it"
    return f"it is touched ({shape.load_n_per_m:.0f} N/m at {math.degrees(shape.angle_rad):.0f} degrees)"


def numbers(sensed: Sensed) -> tuple[float, ...]:
    """Return the estimate as numbers in the order of CHANNELS; nan for what is not known."""
    shape = sensed.shape
    (aa, ap, ar), (_, pp, pr), (_, _, rr) = shape.covariance
    known = sensed.strain.settled and not sensed.strain.blind
    touched = float(sensed.strain.touched) if known else math.nan
    return (
        touched, shape.angle_rad, 0.0 if touched == 0.0 else shape.load_n_per_m, shape.radius_m,
        shape.equivalent_radius_m, shape.equivalent_curvature_per_m, shape.width_rad, shape.residual, shape.misfit,
        aa, pp, rr, ap, ar, pr, float(shape.quality.value),
    )  # fmt: skip
