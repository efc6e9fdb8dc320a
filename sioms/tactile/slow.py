"""Tell a contact that grows slowly from drift, by the change of the readings since the last zero.

A baseline that follows drift follows a contact that grows as slowly, at any rate below some.  Rate does not separate
the two; their patterns do.  Drift moves all elements alike, or smoothly along the arc, or each by a little of its own
as temperature does; a contact moves a few neighbours in the ratios of the contact's mechanics, far above what is left
of all others.  So the reading of the last zero is kept, and nothing of the change since then is ever forgotten: the
mean over a quarter of a second, less a parabola along the arc, is compared with all contacts that press.  What is left
of the elements is the measure of drift, and thereby of the load that drift may hide.

Not told: more than two contacts that grow together while they are smaller than what they make of each other; and one
whose growth is undone by drift of that very pattern.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.finger import Finger
from sioms.tactile.model import StrainTable

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

MEAN_S = 0.25  # of readings
EVERY_S = 0.2  # between two looks
MOST_HIDDEN = 60.0  # N/m that uneven drift may hide before the finger is blind for slow contacts
WORSE = 4.0  # or so many times what it hides without drift, if that is more: noisy fingers
SURE = 15.0  # standard deviations of what drift leaves, beyond which a contact is no drift
_ONE, _TWO = 6.5, 7.0  # the same for one contact to be told, and for the weaker one of two
_OTHERS, _SHARE = 2.5, 0.5  # what the others must show of it when its strongest element is left out: deviations, share
_FLOOR = 1.1  # of what drift leaves, in units of a frame's noise
_WIDTHS = (0.0, 0.1, 0.2, 0.3)  # rad, half widths of the contacts looked for
_WIDEST_HIDDEN = 0.12  # rad, half the width of a flat under as much load as may be hidden
_BEYOND = 0.5  # pitches beyond the outermost elements
_LONE = 0.25  # share of the squares that is left when one element is left out, for that one to drift alone
_FEWEST = 4  # elements
_FOR_PARABOLA = 9  # elements
_PASSES = 2


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """What has changed since the last zero; immutable.

    Args:
        contact: of one contact that presses or two, that drift does not explain.
        pull: as of a contact that presses less than at the last zero.
        size: of the contact in standard deviations of what drift leaves.
        hidden_n_per_m: load that could be there without being told.
        limit_n_per_m: `hidden_n_per_m` beyond which the finger is blind for slow contacts.
        smooth: share of drift that is smooth along the arc, in output, shape (ns,).
        pattern: of the contact or pull in output, shape (ns,).
        uneven: standard deviation of the rest, in output, shape (ns,).
    """

    contact: bool
    pull: bool
    size: float
    hidden_n_per_m: float
    limit_n_per_m: float
    smooth: Floats
    pattern: Floats
    uneven: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Bank:
    """The contacts as some elements feel them, free of a parabola along the arc.

    Args:
        elements: numbers of the elements, shape (n,).
        smooth: orthonormal, of all elements; shape (n, 1 or 3).
        patterns: of a unit load in deviations of the noise, shape (patterns, n).
        unit: of length 1.
        length: what was divided by, shape (patterns,).
        least: length within the outermost elements.
    """

    elements: NDArray[np.intp]
    smooth: Floats
    patterns: Floats
    unit: Floats
    length: Floats
    least: float

    def freed(self, z: Floats) -> Floats:
        """Return what is left of the elements' readings."""
        own = z[self.elements]
        return np.asarray(own - self.smooth @ (self.smooth.T @ own))


class SlowWatch:
    """Watch the change of one finger since its last zero.  One caller at a time.

    Args:
        finger: the calibrated finger.
        table: its strains.
    """

    def __init__(self, finger: Finger, table: StrainTable) -> None:
        angles = np.array(finger.angles_rad)
        self._noise = np.array(finger.elements.noise)
        along = (angles - angles.mean()) / max(float(np.ptp(angles)), 1e-9)
        # what drift does together: temperature, of which an element may take more than another, and what is smooth
        self._powers = np.stack([np.array(finger.signal.thermal or (1.0,) * angles.size), along, along**2], axis=1)
        used = np.array(finger.elements.used)
        known = angles[used] if used.any() else angles
        beyond = _BEYOND * float(np.ptp(angles)) / max(angles.size - 1, 1)
        place = table.first + table.step * np.arange(table.nodes.shape[1])
        rows = np.searchsorted(table.half_widths, _WIDTHS).clip(0, table.half_widths.size - 1)
        there = (place >= known.min() - beyond) & (place <= known.max() + beyond)
        within = (place >= known.min()) & (place <= known.max())
        self._patterns = -table.nodes[rows][:, there, 0].reshape(-1, angles.size) / finger.strain_noise
        narrow = np.array(_WIDTHS) <= _WIDEST_HIDDEN
        self._within = (narrow[:, None] & within[there]).ravel()
        self._banks: dict[bytes, _Bank] = {}
        self._reference, self._mean = np.zeros(angles.size), np.zeros(angles.size)
        self._age_s = np.zeros(angles.size)
        self._since_s = 0.0

    def zero(self, reference: Floats) -> None:
        """Begin anew: the finger is untouched, with these outputs."""
        self._reference = reference.copy()
        self.restart()

    def restart(self) -> None:
        """Forget the mean, not the zero."""
        self._age_s[:] = 0.0
        self._since_s = 0.0

    def adopt(self, elements: Flags, output: Floats, smooth: Floats) -> None:
        """Give elements a new zero, for they failed and work again: their change is what is smooth along the arc."""
        self._reference[elements] = (output - smooth)[elements]
        self._age_s[elements] = 0.0

    def lower(self, change: Change) -> None:
        """Take the zero from where a pull has led: what was let go then had touched at the last zero."""
        self._reference += change.pattern

    def mean(self, elements: Flags) -> Floats:
        """Return the mean outputs, of other elements those of the last zero."""
        return np.where(elements & (self._age_s > 0.0), self._mean, self._reference)

    def reference(self, change: Change) -> Floats:
        """Return the outputs of the untouched finger: those of the last zero, moved by smooth drift."""
        return np.asarray(self._reference + change.smooth)

    def take(self, output: Floats, alive: Flags, elapsed_s: float) -> bool:
        """Take a frame; return whether it is time to look."""
        # an element that now and then misses a frame is believed all the same
        age_s = np.where(alive, self._age_s + elapsed_s, self._age_s - elapsed_s)
        self._age_s = age_s.clip(0.0, max(MEAN_S, elapsed_s))
        share = elapsed_s / np.clip(self._age_s, max(elapsed_s, 1e-9), max(MEAN_S, elapsed_s, 1e-9))
        self._mean += np.where(alive, share, 0.0) * (output - self._mean)
        self._since_s += elapsed_s
        if self._since_s < EVERY_S:
            return False
        self._since_s = 0.0
        return True

    def look(self, usable: Flags, noise: Floats) -> Change | None:
        """Say what has changed; None while too few elements have been there for long enough.

        Args:
            usable: shape (ns,).
            noise: variance of a frame's output, shape (ns,).
        """
        known = usable & (self._age_s >= MEAN_S)
        if 2 * np.count_nonzero(known) <= np.count_nonzero(usable) or np.count_nonzero(known) < _FEWEST:
            return None
        z = (self._mean - self._reference) / self._noise
        floor = _FLOOR * math.sqrt(float(np.mean(noise[known] / self._noise[known] ** 2)))
        found = self._test(z, known, floor)
        if found.contact or found.pull:
            return found
        # one element may drift alone, beside a contact or without
        size = found.size
        for element in self._loudest(z, known):
            without = known.copy()
            without[element] = False
            if np.count_nonzero(without) >= _FEWEST:
                other = self._test(z, without, floor)
                if other.contact or other.hidden_n_per_m < math.sqrt(_LONE) * found.hidden_n_per_m:
                    return replace(other, size=max(size, other.size))
                size = max(size, other.size)
        return replace(found, size=size)

    def _loudest(self, z: Floats, known: Flags) -> list[int]:
        """Return the element that one contact explains least, and the one that moves most."""
        bank = self._bank(known)
        own = bank.freed(z)
        felt = bank.unit @ own
        one = int(felt.argmax())
        among = (np.abs(own - felt[one] * bank.unit[one]), np.abs(own))
        return list(dict.fromkeys(int(bank.elements[int(each.argmax())]) for each in among))

    def _bank(self, known: Flags) -> _Bank:
        key = known.tobytes()
        bank = self._banks.get(key)
        if bank is None:
            if len(self._banks) > 64:
                self._banks.clear()
            bank = self._banks[key] = self._make(known)
        return bank

    def _make(self, known: Flags) -> _Bank:
        elements = np.flatnonzero(known)
        order = 3 if elements.size >= _FOR_PARABOLA else 1
        # in units of each element's noise
        columns = self._powers[elements, :order] / self._noise[elements, None]
        smooth = np.linalg.qr(columns)[0]
        raw = self._patterns[:, elements]
        free = raw - (raw @ smooth) @ smooth.T
        length = np.maximum(np.sqrt(np.sum(free**2, axis=1)), 1e-12)
        return _Bank(elements, smooth, raw, free / length[:, None], length, float(length[self._within].min()))

    def _test(self, z: Floats, known: Flags, floor: float) -> Change:
        """Compare with one contact, and with two; then with a pull."""
        bank = self._bank(known)
        own = bank.freed(z)
        felt = bank.unit @ own
        one = int(felt.argmax())
        left = _left(bank, own - felt[one] * bank.unit[one], 1, floor)
        size, chosen, sizes = float(felt[one]) / left, [one], np.array([felt[one]])
        contact = size > _ONE and self._others(z, known, bank, chosen, sizes, floor)
        if not contact:
            two, amounts, rest = _pair(bank, own, one)
            among = _left(bank, rest, 2, floor)
            if amounts.min() > _TWO * among and self._others(z, known, bank, two, amounts, floor):
                contact, size, left, chosen, sizes = True, float(amounts.max()) / among, among, two, amounts
        pull = False
        if not contact:
            least = int(felt.argmin())
            still = _left(bank, own - felt[least] * bank.unit[least], 1, floor)
            if -felt[least] > _ONE * still and self._others(-z, known, bank, [least], np.array([-felt[least]]), floor):
                pull, chosen, sizes, left = True, [least], np.array([felt[least]]), still
        pattern = np.zeros(z.size)
        if contact or pull:
            pattern = self._noise * ((sizes / bank.length[chosen]) @ self._patterns[chosen])
        smooth = self._smooth(z * self._noise - pattern, bank)
        return Change(
            contact, pull, size, _ONE * left / bank.least,
            max(MOST_HIDDEN, WORSE * _ONE * floor / bank.least), smooth, pattern, self._noise * left,
        )  # fmt: skip

    def _smooth(self, change: Floats, bank: _Bank) -> Floats:
        """Return the parabola along the arc of these changes of output, of all elements."""
        powers, some = self._powers[:, : bank.smooth.shape[1]], bank.elements
        weight = 1.0 / self._noise[some]
        found = np.linalg.lstsq(powers[some] * weight[:, None], change[some] * weight, rcond=None)[0]
        return np.asarray(powers @ found)

    def _others(
        self, z: Floats, known: Flags, bank: _Bank, chosen: list[int], sizes: Floats, floor: float
    ) -> bool:  # fmt: skip
        """Return whether what is felt of contacts remains when the strongest element of each is left out.

        An element that drifts alone moves no neighbours.
        """
        own = bank.freed(z)
        fewer = known.copy()
        for number in chosen:
            fewer[bank.elements[int((bank.unit[number] * own).argmax())]] = False
        if np.count_nonzero(fewer) < max(_FEWEST, len(chosen) + 3):
            return True  # too few to tell
        rest = self._bank(fewer)
        those = rest.unit[chosen]
        free = rest.freed(z)
        again = np.linalg.lstsq(those.T, free, rcond=None)[0]
        left = _left(rest, free - again @ those, len(chosen), floor)
        expected = sizes / bank.length[chosen] * rest.length[chosen]
        return bool(np.all(again > np.maximum(_OTHERS * left, _SHARE * expected)))


def _left(bank: _Bank, rest: Floats, contacts: int, floor: float) -> float:
    """Return the standard deviation of what is left of the elements, in units of their noise."""
    freedom = max(bank.elements.size - bank.smooth.shape[1] - 3 * contacts, 1)
    return math.hypot(math.sqrt(float(rest @ rest) / freedom), floor)


def _pair(bank: _Bank, own: Floats, one: int) -> tuple[list[int], Floats, Floats]:
    """Return the two contacts that explain most, what is felt of each, and what is left."""
    first, second = one, int((bank.unit @ (own - (bank.unit[one] @ own) * bank.unit[one])).argmax())
    for _ in range(_PASSES):
        both = bank.unit[[first, second]]
        amounts: Floats = np.asarray(np.linalg.lstsq(both.T, own, rcond=None)[0], dtype=np.float64)
        first = int((bank.unit @ (own - amounts[1] * both[1])).argmax())
        second = int((bank.unit @ (own - amounts[0] * bank.unit[first])).argmax())
    both = bank.unit[[first, second]]
    amounts = np.asarray(np.linalg.lstsq(both.T, own, rcond=None)[0], dtype=np.float64)
    return [first, second], amounts, own - amounts @ both
