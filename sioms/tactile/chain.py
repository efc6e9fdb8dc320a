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
left out; it ends at half that level.  A touch from the first frame on cannot be told from an offset: call `rebase`
untouched, which keeps the old baseline until the new one is there and found to be steady, or `zero`, which trusts its
caller.

What is no touch is kept from freezing the baseline (`sioms.tactile.witness`):
an element that moves alone is suspect and left out, until it has stood still for `RECOVER_S` while nothing touched:
then it gets a baseline of its own again. So does an element that comes to life late. What moves all elements alike, a
step of the supply, is taken into the baseline at once.

A contact that grows so slowly that the baseline follows it is found by the change since the last zero
(`sioms.tactile.slow`): the baseline then goes back to where drift alone would have led it. Likewise a touch that has
been let go ends where what is left of it is drift.

Readings that repeat may be those of a converter with steps above its noise: they count as they are, with the step as
their uncertainty, for as long as a touch is held. But where most elements have been seen to be noisy since the last
`zero`, an element that repeats its reading for `DEAD_FRAMES` is dead; if all do, the converter is stuck, and the finger
blind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sioms.tactile.finger import LARGEST, LEAST, Finger
from sioms.tactile.linearity import linearise
from sioms.tactile.model import StrainTable
from sioms.tactile.rest import Rebase, Rest
from sioms.tactile.slow import EVERY_S, SURE, Change, SlowWatch
from sioms.tactile.witness import FEWEST, TOUCH_SIGMA, Sight, Witness, moves_alone

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

SETTLE_FRAMES = 20  # averaged for the first baseline
DEAD_FRAMES = 200  # without a change, where readings are noisy: dead
RECOVER_S = 2.0  # an element that moved alone must stand still so long, untouched, to be believed again
HELD_FRAMES = 16  # of a steady touch, of which two means must agree; then twice as many, and so on
MOST_HELD = 1024
_NOISY, _MOST_NOISY = 0.25, 0.75  # an element that changes in so many frames; share of all elements
_MEMORY = 64  # frames over which changes are counted
_STILL = 6.0  # standard deviations within which a suspect element stands still
_ALIKE = 0.15  # of a step of all elements, by which one may differ from it
_COMMON_SIGMA = 6.0  # of the elements' median, for a step of all
_MOST_SCALE = 25.0  # of the noise's variance over that of the finger's file
_STEADY, _STEADY_SHARE = 6.0, 0.02  # of a held touch: mean square in deviations, and share of the peak
_CREPT, _CREPT_AFTER_HOLD = (
    0.1,
    0.02,
)  # of the output of a touch, that may be left at once and after the release hold
_RELEASED = 8  # frames below the level that ends a touch, for one that was found slowly
_LEFT = 0.1  # of the strength of a touch, that drift during the touch may leave
_LEFT_S = 1.0  # for so long
_LESS = 0.8  # of the limit of hidden loads, below which a finger that had drifted is no longer blind
_UNLIKE = 5.0  # deviations of what drift leaves, below which nothing is like a contact
_DRIFT_SHARE = 0.2  # of the noise, by which the baseline may move unseen in one drift time


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Hold the mean strains over some frames of a steady touch, and their variances, shape (ns,); immutable."""

    strains: Floats
    variance: Floats
    frames: int


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
        blind: the usable elements cannot tell whether there is a touch; `touched` is then what it was.
        variance: of the strains, shape (ns,), where the converter's steps or noise are above those of the finger's
            file.
        held: the mean over a touch that has been steady; the same object until there is a longer one.
        slow: the touch was found by the change since the last zero, and may be drift.
        drifted: `blind` for contacts that grow slowly: uneven drift since the last zero would hide them.
    """

    strains: Floats
    usable: Flags
    saturated: Flags
    dead: Flags
    touched: bool
    settled: bool
    strength: float
    blind: bool = False
    variance: Floats | None = None
    held: Held | None = None
    slow: bool = False
    drifted: bool = False


class SignalChain:
    """Process the frames of one finger in order.  One caller at a time.

    Args:
        finger: the calibrated finger.
        settle_frames: frames averaged for the first baseline and after `zero`.
        table: the finger's, if it is at hand.
    """

    def __init__(self, finger: Finger, settle_frames: int = SETTLE_FRAMES, table: StrainTable | None = None) -> None:
        if settle_frames < 1:
            raise ValueError(f"make signal chain: {settle_frames} frames to settle; need at least 1")
        e, self._signal = finger.elements, finger.signal
        self._count = len(e.angle_rad)
        self._used = np.array(e.used)
        self._gain, self._quadratic = np.array(e.gain), np.array(e.quadratic)
        self._fading = math.log(_CREPT / _CREPT_AFTER_HOLD) / max(self._signal.release_hold_s, 1e-3)
        self._mixing: Floats | None = None  # the gains as a matrix, if they are more than a diagonal
        self._own_noise = np.array(e.noise) ** 2
        table = finger.strain_table() if table is None else table
        self._witness, self._watch_slow = Witness(finger, table), SlowWatch(finger, table)
        self._changes = np.zeros(self._count)
        self._frames, self._is_noisy, self._step = 0, False, math.inf
        self._settle = settle_frames
        self._last: Floats = np.full(self._count, np.nan)
        self._same: NDArray[np.int64] = np.zeros(self._count, dtype=np.int64)
        self._stamp_ns: int | None = None
        self._rebasing: Rebase | None = None
        self.zero()

    def zero(self) -> None:
        """Forget the baseline and take a new one from the next frames; the finger must be untouched."""
        self._rebasing = None
        self._first: Rest | None = Rest(self._count, self._settle)
        self._scale = 1.0
        self._begin(np.zeros(self._count), self._settle)

    def rebase(self, frames: int = 0, since_ns: int = 0) -> Rebase:
        """Take a new baseline from the next frames; the old one holds until that is done, or if it is refused.

        Args:
            frames: to be averaged, the finger being untouched and still; at least those of the first baseline.
            since_ns: frames with older stamps do not count.

        Returns:
            How it goes; it ends with one of the next frames.
        """
        rest = Rest(self._count, max(frames, self._settle))
        if self._first is not None:
            self._first = rest
        if self._rebasing is None:
            self._rebasing = Rebase(rest, since_ns, self._touched)
        else:  # who asked before is served by this one, too
            rest.left = rest.frames = max(rest.frames, self._rebasing.rest.frames)
            self._rebasing.rest, self._rebasing.since_ns = rest, since_ns
        return self._rebasing

    def _begin(self, baseline: Floats, frames: int) -> None:
        """Begin anew, untouched, with a baseline that so many frames made."""
        self._baseline = baseline
        self._touched = False
        # of the baseline, in squares of the noise; and what creep may have left in the readings
        self._variance = np.full(self._count, 1.0 / frames)
        self._crept = np.zeros(self._count)
        self._is_noisy = False
        self._suspect: Flags = np.zeros(self._count, dtype=np.bool_)
        self._still_s, self._stood, self._mark = (np.zeros(self._count) for _ in range(3))
        self._average = _Average(self._count)
        self._watch_slow.zero(baseline)
        self._is_slow, self._is_sure, self._drifted = False, False, False
        self._uneven: Floats = np.zeros(self._count)
        self._smooth: Floats = np.zeros(self._count)
        self._below, self._peak, self._unlike_s = 0, 0.0, 0.0
        self._weigh()

    def _weigh(self) -> None:
        """Take the noise of the file, or of the first readings, or the converter's steps, whichever is larger."""
        steps = 0.0 if math.isinf(self._step) else (self._step * self._signal.scale) ** 2 / 6.0
        self._noise: Floats = np.maximum(self._scale * self._own_noise, steps)
        self._is_own = self._scale == 1.0 and not np.any(self._own_noise < steps)

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
            raise ValueError(f"set gain: {new.size} gains in shape {new.shape}; the finger has {self._count} elements")
        own = new if new.ndim == 1 else np.diag(new)
        if not (np.all(np.abs(new) <= LARGEST) and np.all(own >= LEAST)):
            raise ValueError(
                f"set gain: gains of the elements {own.tolist()} hold one that is not positive, or the matrix one "
                f"that is not finite; want {LEAST:g} to {LARGEST:g}"
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
                f"process frame: {reading.size} readings in shape {reading.shape}; the finger has {self._count} "
                "elements"
            )
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            raise ValueError(f"process frame: stamp {stamp_ns} ns is before the last one, {self._stamp_ns} ns")
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        finite = np.isfinite(reading)
        saturated = finite & ((reading <= self._signal.lowest) | (reading >= self._signal.highest))
        dead = self._watch(reading, finite)
        alive = finite & ~saturated & ~dead & self._used
        output = np.where(alive, reading, 0.0) * self._signal.scale
        if self._first is not None:
            self._start(self._first, output, alive, stamp_ns)
            return StrainFrame(np.full(self._count, np.nan), alive, saturated, dead, False, False, math.nan)
        usable = alive & ~self._suspect
        sight = self._witness.sight(usable)
        change = output - self._baseline
        if sight.blind:
            strength = math.nan
            self._variance += (elapsed_s / self._signal.drift_time_s) ** 2
        else:
            usable, strength = self._judge(change, usable, sight)
            self._follow(change, usable, elapsed_s)
            self._recover(output, alive, elapsed_s)
            if self._watch_slow.take(output, alive, elapsed_s):
                change = self._look_slowly(output, change, usable)
        told = self._told(change, usable, saturated, dead, strength, sight.blind)
        if self._rebasing is not None:
            self._rebase(self._rebasing, output, alive, stamp_ns, sight.blind)
        return told

    def _judge(self, change: Floats, usable: Flags, sight: Sight) -> tuple[Flags, float]:
        """Find whether there is a touch; an element that moves alone is suspect from then on, a step of all is taken
        up.
        """
        square, common = self._squares(change, usable)
        strength, count = float(square.sum()), int(np.count_nonzero(usable))
        if strength > count + TOUCH_SIGMA * math.sqrt(2.0 * count):
            alone = moves_alone(square, sight.followed)
            if alone is not None:
                usable = self._accuse(alone, usable)
                square, common = self._squares(change, usable)
                strength, count = float(square.sum()), count - 1
        self._touch(strength / count, count)
        noise = math.sqrt(float(self._noise[usable].mean()) * 1.6 / count)
        if not self._touched and abs(common) > _COMMON_SIGMA * noise:
            step = np.where(usable, common + (change - common) * self._noise / (self._noise + self._crept**2), 0.0)
            self._baseline += step
            change -= step
            self._variance[usable] = 1.0
        return usable, strength / count

    def _squares(self, change: Floats, usable: Flags) -> tuple[Floats, float]:
        """Return each element's square in units of its noise, without what all have in common, and that."""
        # a touch is somewhere; what moves all elements alike is temperature or the supply, which a fast change would
        # else turn into a touch
        common = float(np.median(change[usable]))
        square = (change - common) ** 2 / (self._noise + (_ALIKE * common) ** 2)
        square[~usable] = 0.0
        return square, common

    def _accuse(self, element: int, usable: Flags) -> Flags:
        self._suspect[element] = True
        self._still_s[element] = self._stood[element] = 0.0
        usable = usable.copy()
        usable[element] = False
        return usable

    def _recover(self, output: Floats, alive: Flags, elapsed_s: float) -> None:
        """Give suspect elements a baseline again when they have stood still, untouched."""
        if self._touched or not self._suspect.any():
            return
        off = output - self._mark
        still = self._suspect & alive & (self._stood > 0.0) & (off**2 < _STILL**2 * self._noise)
        self._stood = np.where(still, self._stood + 1.0, 1.0)
        self._mark = np.where(still, self._mark + off / self._stood, output)
        self._still_s = np.where(still, self._still_s + elapsed_s, 0.0)
        back = still & (self._still_s >= RECOVER_S)
        if back.any():
            self._baseline[back] = self._mark[back]
            self._variance[back] = 1.0 / self._stood[back]
            self._crept[back] = 0.0
            self._suspect &= ~back
            self._watch_slow.adopt(back, self._mark, self._smooth)

    def _look_slowly(self, output: Floats, change: Floats, usable: Flags) -> Floats:
        """Look for a contact in the change since the last zero; return the change of the outputs."""
        found = self._watch_slow.look(usable, self._noise)
        if found is None:
            return change
        if self._touched:
            self._is_sure = self._is_sure or (found.contact and found.size > SURE)
            self._end_slowly(found, usable)
        elif found.contact:
            self._baseline = np.where(usable, self._watch_slow.reference(found), self._baseline)
            self._touched = self._is_slow = True
            self._is_sure, self._drifted = found.size > SURE, False
            self._below, self._peak, self._unlike_s = 0, 0.0, 0.0
            self._uneven, self._smooth = found.uneven, found.smooth
            return output - self._baseline
        else:
            limit = found.limit_n_per_m * (_LESS if self._drifted else 1.0)
            self._drifted, self._smooth = found.hidden_n_per_m > limit, found.smooth
            if found.pull:
                self._watch_slow.lower(found)
        return change

    def _end_slowly(self, found: Change, usable: Flags) -> None:
        """End a touch of which nothing is left but drift."""
        mean = self._watch_slow.mean(usable)
        square = self._squares(mean - self._baseline, usable)[0]
        strength = float(square.sum()) / np.count_nonzero(usable)
        self._peak = max(self._peak, strength)
        # a touch that was told at once is not undone by what drift hides, nor does drift hold it that is no contact
        is_drift = not found.contact and (found.size < _UNLIKE if self._is_slow else strength < _LEFT * self._peak)
        self._unlike_s = self._unlike_s + EVERY_S if is_drift else 0.0
        if self._unlike_s >= _LEFT_S:
            self._baseline = np.where(usable, mean, self._baseline)
            self._variance[usable] = 1.0
            self._release()
            self._drifted = found.hidden_n_per_m > found.limit_n_per_m  # from this frame on

    def _told(
        self, change: Floats, usable: Flags, saturated: Flags, dead: Flags, strength: float, blind: bool
    ) -> StrainFrame:
        linear = linearise(change, self._quadratic)
        strains = -self._gain * linear if self._mixing is None else -self._mixing @ np.where(usable, linear, 0.0)
        strains[~usable] = np.nan
        variance = None if self._is_own else self._gain**2 * self._noise
        held = None
        if self._is_slow:
            variance = self._gain**2 * (self._noise + self._uneven**2)
        if self._touched and not (blind or self._is_slow):
            before = self._average.held
            held = self._average.take(strains, usable, self._gain**2 * self._noise, self._variance, not self._is_own)
            if held is not None and held is not before:
                self._look_longer(held, usable)
        else:
            self._average.clear()
        drifted = self._drifted and not (self._touched or blind)
        return StrainFrame(
            strains, usable, saturated, dead, self._touched, True, strength, blind or drifted, variance, held,
            self._is_slow and not self._is_sure, drifted,
        )  # fmt: skip

    def _look_longer(self, held: Held, usable: Flags) -> None:
        """Find whether one element has moved alone, in the mean over a steady touch: its noise is that much less."""
        output, sight = -held.strains / self._gain, self._witness.sight(usable)
        square = (output - np.median(output[usable])) ** 2 / (held.variance / self._gain**2)
        square[~usable] = 0.0
        alone = moves_alone(square, sight.followed)
        if alone is not None:
            self._accuse(alone, usable)

    def _watch(self, reading: Floats, finite: Flags) -> Flags:
        """Count changes, learn the converter's step, and return which elements are dead."""
        with np.errstate(invalid="ignore"):
            moved = np.abs(reading - self._last)
        change = moved > 0.0
        self._last = reading.copy()
        self._changes += (change - self._changes) / _MEMORY
        self._same = np.where(change | ~finite, 0, self._same + 1)
        least = float(np.min(moved, initial=math.inf, where=change))
        if least < self._step * (1.0 - 1e-6):
            self._step = least
            self._weigh()
        self._frames += 1
        if self._frames % _MEMORY == 0 and not self._is_noisy:
            self._is_noisy = self._noisy(finite & self._used)
        still: Flags = self._same >= DEAD_FRAMES
        return still & self._is_noisy

    def _noisy(self, elements: Flags) -> bool:
        """Return whether most of these elements change often, so that one which never does is dead."""
        count = int(np.count_nonzero(elements))
        return bool(count > 0 and np.count_nonzero(self._changes[elements] > _NOISY) >= _MOST_NOISY * count)

    def _start(self, rest: Rest, output: Floats, alive: Flags, stamp_ns: int) -> None:
        """Take a frame for the first baseline; frames in which few elements read anything do not count."""
        asked = self._rebasing
        if asked is not None and stamp_ns < asked.since_ns:
            return
        if self._is_seen(alive):
            rest.take(output, alive)
        elif asked is not None:
            self._miss(asked, alive)
            if asked.refused:
                self._rebasing = None
        if rest.left == 0:
            self._first = None
            self._settled(rest)

    def _rebase(self, asked: Rebase, output: Floats, alive: Flags, stamp_ns: int, blind: bool) -> None:
        """Take a frame for another baseline, unless it shows that there can be none."""
        if stamp_ns < asked.since_ns:
            return
        rest = asked.rest
        if blind or not self._is_seen(alive):
            self._miss(asked, alive)
        elif self._touched is not asked.touched:
            asked.refused = "it was touched or released while its baseline was taken; keep off, and zero it again"
        else:
            rest.take(output, alive)
            if rest.left == 0:
                self._judge_rest(asked)
        if rest.left == 0 or asked.refused:
            self._rebasing = None

    def _judge_rest(self, asked: Rebase) -> None:
        """Take the baseline that has been averaged if the elements stood still; those that moved alone are suspect."""
        rest = asked.rest
        step = rest.moved(self._noise)
        usable = rest.known & ~self._suspect
        if self._has_moved(step, usable):
            alone = moves_alone(np.where(usable, step, 0.0), self._witness.sight(usable).followed)
            if alone is not None:
                usable[alone] = False
            if alone is None or self._has_moved(step, usable):
                asked.refused = (
                    "its readings moved while the baseline was taken, as those of something that touches; "
                    "keep off, and zero it again"
                )
                return
        self._settled(rest)
        self._suspect |= step > _STILL**2

    def _has_moved(self, step: Floats, usable: Flags) -> bool:
        count = int(np.count_nonzero(usable))
        return float(step[usable].sum()) > count + TOUCH_SIGMA * math.sqrt(2.0 * count)

    def _is_seen(self, alive: Flags) -> bool:
        return bool(np.count_nonzero(alive) >= max(FEWEST, 0.5 * np.count_nonzero(self._used)))

    def _miss(self, asked: Rebase, alive: Flags) -> None:
        asked.missed += 1
        if asked.missed >= asked.rest.frames:
            asked.refused = (
                f"it is blind: {np.count_nonzero(alive)} of {self._count} elements gave readings that can be believed; "
                "see to the elements and their converter"
            )

    def _settled(self, rest: Rest) -> None:
        self._scale = self._louder(rest)
        self._begin(rest.mean, rest.frames)
        self._suspect = self._used & ~rest.known
        if self._rebasing is not None:
            self._rebasing.done, self._rebasing = True, None

    def _louder(self, rest: Rest) -> float:
        """Return the noise's variance over that of the finger's file, 1 if the first readings do
        not tell it is more.
        """
        ratio, freedom = rest.variance / self._own_noise, float(np.sum(np.maximum(rest.seen - 1.0, 0.0)))
        if not np.isfinite(ratio).any():
            return 1.0
        found = float(np.nanmedian(ratio))
        return min(found, _MOST_SCALE) if found > 1.0 + 6.0 * math.sqrt(2.0 / freedom) + 0.2 else 1.0

    def _touch(self, strength: float, count: int) -> None:
        level = 1.0 + TOUCH_SIGMA * math.sqrt(2.0 / count)
        if strength > level:
            if not self._touched:
                self._touched, self._peak, self._unlike_s = True, 0.0, 0.0
            self._below = 0
        elif strength >= 0.5 * (1.0 + level):
            self._below = 0
        elif self._touched:
            self._below += 1
            if not self._is_slow or self._below >= _RELEASED:
                self._release()

    def _release(self) -> None:
        """End the touch."""
        self._touched = self._is_slow = self._is_sure = False
        self._watch_slow.restart()

    def _follow(self, change: Floats, usable: Flags, elapsed_s: float) -> None:
        self._crept *= math.exp(-elapsed_s * self._fading)
        share = elapsed_s / self._signal.drift_time_s
        if self._touched:
            self._variance = (np.sqrt(self._variance) + _DRIFT_SHARE * share) ** 2
            np.maximum(self._crept, _CREPT * np.abs(change), out=self._crept)
            return
        self._variance += share**2  # so much that in the long run a reading counts by its share of the drift time
        believed = self._variance / (self._variance + 1.0 + self._crept**2 / self._noise)
        believed[~usable] = 0.0
        self._baseline += believed * change
        self._variance *= 1.0 - believed


class _Average:
    """Averages the strains of a touch while it is steady, and says so after 32 frames, after 64, and so on."""

    def __init__(self, count: int) -> None:
        self._count = count
        self.clear()

    def clear(self) -> None:
        """Forget the touch."""
        self._sum, self._block = np.zeros(self._count), np.zeros(self._count)
        self._frames = self._in_block = 0
        self._usable: Flags | None = None
        self._held: Held | None = None

    @property
    def held(self) -> Held | None:
        """Return the mean so far."""
        return self._held

    def take(self, strains: Floats, usable: Flags, noise: Floats, baseline: Floats, stepped: bool) -> Held | None:
        """Add a frame of a touch; return the mean to be looked at.

        Args:
            strains: shape (ns,).
            usable: of them.
            noise: variance of a frame's strains.
            baseline: variance of the baseline, in units of the noise's.
            stepped: steps of the converter are in the noise: a mean keeps them.
        """
        if self._frames >= MOST_HELD:
            return self._held
        if self._usable is None or not np.array_equal(usable, self._usable):
            self.clear()
            self._usable = usable
        self._block += strains
        self._in_block += 1
        if self._in_block < HELD_FRAMES:
            return self._held
        block, share = self._block / HELD_FRAMES, 1.0 / HELD_FRAMES
        self._block, self._in_block = np.zeros(self._count), 0
        if self._frames:
            off = (block - self._sum / self._frames)[usable]
            own = noise[usable] * (1.0 if stepped else share + 1.0 / self._frames)
            if np.mean(off**2 / (own + (_STEADY_SHARE * np.abs(block[usable]).max()) ** 2)) > _STEADY:
                self._sum, self._frames, self._held = np.zeros(self._count), 0, None
        self._sum += block * HELD_FRAMES
        self._frames += HELD_FRAMES
        # one block alone may be a mean over a touch that moves
        if self._frames > HELD_FRAMES and self._frames & (self._frames - 1) == 0:
            kept = 1.0 if stepped else 1.0 / self._frames
            variance = noise * (kept + np.minimum(baseline, 1.0))
            self._held = Held(self._sum / self._frames, variance, self._frames)
        return self._held
