"""Turn raw frames into strains, one frame at a time: offset, drift, linearity, gain, contact, bad elements.

A pure object: frames and their time stamps go in, a `StrainFrame` comes out, nothing is read or slept.

    chain = SignalChain(finger)
    for stamp_ns, raw in frames:
        out = chain.frame(raw, stamp_ns)
        if out.touched: shape = estimator.frame(out.strains, usable=out.usable)

While untouched the baseline follows the readings, each element by a Kalman filter of one state: with the finger's
drift time in long rests (temperature moves it by per cents an hour), faster after a touch in which nothing was seen of
it, and hardly while what the touch left of creep is above the noise. So touches in quick succession leave it what
little their pauses tell. A touch is what rises above the noise in sum over all elements, what all have in common
left out; it ends at half that level.  A touch from the first frame on cannot be told from an offset: call `zero`
untouched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.finger import Finger
from sioms.tactile.linearity import linearise

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SETTLE_FRAMES = 20  # averaged for the first baseline
DEAD_FRAMES = 200  # an element whose reading has not changed for so long is dead; noise moves a living one
_TOUCH_SIGMA = 8.0  # above the mean of the noise's chi square, in its standard deviations
_CREPT, _CREPT_AFTER_HOLD = (
    0.1,
    0.02,
)  # of the output of a touch, that may be left at once and after the release hold
_DRIFT_SHARE = 0.2  # of the noise, by which the baseline may move unseen in one drift time


@dataclass(frozen=True, slots=True, eq=False)
class StrainFrame:
    """Hold one frame; immutable.

    Args:
        strains: tension positive, shape (ns,); nan where the element is unusable.
        usable: neither dead, saturated, unused nor not finite, shape (ns,).
        saturated: at the end of the converter's range, shape (ns,).
        dead: stuck, shape (ns,).
        touched: whether there is a touch.
        settled: whether the baseline is known yet; before, strains are nan.
        strength: chi square of the outputs against the noise, per element; about 1 when untouched.
    """

    strains: Floats
    usable: Flags
    saturated: Flags
    dead: Flags
    touched: bool
    settled: bool
    strength: float


class SignalChain:
    """Process the frames of one finger in order.  One caller at a time.

    Args:
        finger: the calibrated finger.
        settle_frames: frames averaged for the first baseline and after `zero`.
    """

    def __init__(self, finger: Finger, settle_frames: int = SETTLE_FRAMES) -> None:
        if settle_frames < 1:
            raise ValueError(f"make signal chain: {settle_frames} frames to settle; need at least 1")
        e, self._signal = finger.elements, finger.signal
        self._count = len(e.angle_rad)
        self._used = np.array(e.used)
        self._gain, self._quadratic = np.array(e.gain), np.array(e.quadratic)
        self._fading = math.log(_CREPT / _CREPT_AFTER_HOLD) / max(self._signal.release_hold_s, 1e-3)
        self._mixing: Floats | None = None  # the gains as a matrix, if they are more than a diagonal
        self._noise = np.array(e.noise) ** 2
        self._settle = settle_frames
        self._last: Floats = np.full(self._count, np.nan)
        self._same: NDArray[np.int64] = np.zeros(self._count, dtype=np.int64)
        self._stamp_ns: int | None = None
        self.zero()

    def zero(self) -> None:
        """Forget the baseline and take a new one from the next frames; the finger must be untouched."""
        self._sum = np.zeros(self._count)
        self._seen = np.zeros(self._count)
        self._left = self._settle
        self._baseline = np.zeros(self._count)
        self._touched = False
        # of the baseline, in squares of the noise; and what creep may have left in the readings
        self._variance = np.full(self._count, 1.0 / self._settle)
        self._crept = np.zeros(self._count)

    @property
    def baseline(self) -> Floats:
        """Return the untouched reading of each element in raw units."""
        return self._baseline / self._signal.scale

    @property
    def gains(self) -> Floats:
        """Return strain per output, shape (ns, ns); a diagonal unless `set_gain` gave a matrix."""
        return np.diag(self._gain) if self._mixing is None else self._mixing.copy()

    def set_gain(self, gain: ArrayLike) -> None:
        """Replace the gains: one for each element, or a matrix for elements that feel each other's outputs.

        Raises:
            ValueError: wrong shape, a value that is not finite, or a gain of an element that is not positive.
        """
        new = np.array(gain, dtype=np.float64)
        if new.shape not in ((self._count,), (self._count, self._count)):
            raise ValueError(
                f"set gain: {new.size} gains in shape {new.shape}; the finger has {self._count} elements"
            )
        own = new if new.ndim == 1 else np.diag(new)
        if not (np.all(np.isfinite(new)) and np.all(own > 0.0)):
            raise ValueError(
                f"set gain: gains of the elements {own.tolist()} hold one that is not positive, or the matrix one "
                "that is not finite"
            )
        self._gain = own.copy()
        self._mixing = new if new.ndim == 2 and np.count_nonzero(new - np.diag(own)) else None

    def frame(self, raw: ArrayLike, stamp_ns: int) -> StrainFrame:
        """Process one frame.

        Args:
            raw: readings, shape (ns,).
            stamp_ns: monotonic time of the frame.

        Raises:
            ValueError: wrong number of readings, or a stamp before the last one.
        """
        reading = np.asarray(raw, dtype=np.float64)
        if reading.shape != (self._count,):
            raise ValueError(
                f"process frame: {reading.size} readings in shape {reading.shape}; the finger has {self._count} elements"
            )
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            raise ValueError(
                f"process frame: stamp {stamp_ns} ns is before the last one, {self._stamp_ns} ns"
            )
        finite = np.isfinite(reading)
        saturated = finite & ((reading <= self._signal.lowest) | (reading >= self._signal.highest))
        dead = self._watch(reading)
        usable = finite & ~saturated & ~dead & self._used
        output = np.where(usable, reading, 0.0) * self._signal.scale
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        if self._left > 0:
            self._start(output, usable)
            return StrainFrame(np.full(self._count, np.nan), usable, saturated, dead, False, False, math.nan)
        usable &= self._seen > 0.0
        change = output - self._baseline
        strength, count = self._strength(change, usable)
        self._touch(strength, count)
        self._follow(change, usable, elapsed_s)
        linear = linearise(change, self._quadratic)
        if self._mixing is None:
            strains = -self._gain * linear
        else:
            strains = -self._mixing @ np.where(usable, linear, 0.0)
        strains[~usable] = np.nan
        return StrainFrame(strains, usable, saturated, dead, self._touched, True, strength)

    def _watch(self, reading: Floats) -> Flags:
        """Count how long each reading has stayed the same."""
        self._same = np.where(reading == self._last, self._same + 1, 0)
        self._last = reading.copy()
        dead: Flags = self._same >= DEAD_FRAMES
        return dead

    def _start(self, output: Floats, usable: Flags) -> None:
        self._sum += output
        self._seen += usable
        self._left -= 1
        if self._left == 0:
            self._baseline = self._sum / np.maximum(self._seen, 1.0)

    def _strength(self, change: Floats, usable: Flags) -> tuple[float, int]:
        count = int(np.count_nonzero(usable))
        if count == 0:
            return 0.0, 0
        # a touch is somewhere; what moves all elements alike is temperature, which a fast change would else
        # turn into a touch
        local = change[usable] - np.median(change[usable])
        return float(np.sum(local**2 / self._noise[usable])) / count, count

    def _touch(self, strength: float, count: int) -> None:
        level = 1.0 + _TOUCH_SIGMA * math.sqrt(2.0 / max(count, 1))
        if strength > level:
            self._touched = True
        elif strength < 0.5 * (1.0 + level):
            self._touched = False

    def _follow(self, change: Floats, usable: Flags, elapsed_s: float) -> None:
        self._crept *= math.exp(-elapsed_s * self._fading)
        share = elapsed_s / self._signal.drift_time_s
        if self._touched:
            self._variance = (np.sqrt(self._variance) + _DRIFT_SHARE * share) ** 2
            np.maximum(self._crept, _CREPT * np.abs(change), out=self._crept)
            return
        self._variance += (
            share**2
        )  # so much that in the long run a reading counts by its share of the drift time
        believed = self._variance / (self._variance + 1.0 + self._crept**2 / self._noise)
        believed[~usable] = 0.0
        self._baseline += believed * change
        self._variance *= 1.0 - believed
