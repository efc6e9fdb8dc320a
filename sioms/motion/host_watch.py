"""The motion watch of axes whose loop the host closes: what watch.py finds of drives, for all axes of a bank at once.

The host knows in each tick where an axis should be, so less has to be reckoned with than of a drive that plans by
itself. Looked at is the raw position. Found are

* *lost*: a step between two readings that no axis can make, and that stands in the next. What was seen once is not
  believed: one damaged reading must stop nothing.
* *too fast*: as in watch.py: the distance covered beyond ``1 + speed_margin`` times velocity_max adds up.
* *uncommanded*: an axis that has settled and holds is farther than ``tolerance`` from where it came to rest.
* *away*: an axis runs against the velocity that is commanded: its motor or its encoder is connected the wrong way
    round.

Steps are looked at from each reading to the next; the rest every LOOK_S, and is a finding when it is seen twice. Time
is that of the readings: one that comes late, or twice, is no step. Why so:
docs/decisions/0165 and 0600.

Pure; concurrency: that of its bank.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .axis_step import AWAY, HOLD, LOOK_NS, TOO_FAST, looked_at, watch
from .law import ControlLaw
from .settings import AxisSettings
from .watch import (
    GAP_NS,
    Finding,
    away_text,
    fast_text,
    lost_text,
    tolerance_of,
    uncommanded_text,
)

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class HostWatch:
    """Watches the axes of a bank.

    Args:
        settings: of the axes.
        tick_s: nominal period [s].
        law: whose loop it watches.
    """

    def __init__(self, settings: Sequence[AxisSettings], tick_s: float, law: ControlLaw) -> None:
        self._settings, self._velocity, self._limp, self._kind = tuple(settings), law.velocity_limit, law.limp, law.kind
        loop = self._loop = law.loop
        arrays = law.arrays
        arrays["factor"][:] = [1.0 + one.watch.speed_margin for one in settings]
        arrays["tolerance"][:] = [tolerance_of(one) for one in settings]
        arrays["watched"][:] = [one.watch.uncommanded for one in settings]
        self._factor, self._tolerance, self._watched = arrays["factor"], arrays["tolerance"], arrays["watched"]
        self._raw, self._last, self._way, self._odd = arrays["raw"], arrays["last_raw"], arrays["way"], arrays["odd"]
        self._since_ns, self._place, self._reference = arrays["since_ns"], arrays["place"], arrays["reference"]
        self._sums = [arrays[name] for name in ("excess", "against", "fast", "off", "odd")]
        self._commanded = arrays["desired_velocity"]
        reach = self._factor * np.array([one.velocity_max for one in settings]) * tick_s + self._tolerance
        loop.bound = float(np.min(reach, initial=np.inf)) ** 2  # no step can be too wide where their squares make less
        self._doubted: dict[int, tuple[float, int, float]] = {}
        """Where an axis was before a step that it cannot have made, when [ns], and how far it can have come."""

    def begin(self) -> None:
        """Take the first readings, or the first after some that tell nothing of what comes."""
        loop = self._loop
        self._doubted.clear()
        loop.doubted = loop.any_odd = 0
        self._place[:] = self._reference[:] = self._raw
        for numbers in self._sums:
            numbers[:] = 0
        self._since_ns[:] = loop.seen_ns
        loop.before_ns = loop.watched_ns = loop.looked_ns = loop.earlier_ns = loop.due_ns = loop.seen_ns

    def look(self, now_ns: int) -> list[Finding]:
        """Judge the readings of a tick.

        Args:
            now_ns: time of the tick [ns].
        """
        loop = self._loop
        seen_ns = loop.seen_ns
        if seen_ns <= loop.watched_ns:
            return []  # they are those of the tick before
        found = self._steps(seen_ns, loop.watched_ns)
        dt = (seen_ns - loop.looked_ns) * 1e-9
        if seen_ns >= loop.due_ns and not self._doubted:
            watch(loop, now_ns)
        if loop.any_odd:
            loop.any_odd = 0
            found += [
                self._told(axis, self._way[axis] / (dt or LOOK_NS * 1e-9))
                for axis in np.flatnonzero(self._odd).tolist()
            ]
        for finding in found:
            self._forget(finding.axis, seen_ns)
        loop.doubted = len(self._doubted)
        looked_at(loop, now_ns)
        return found

    def _forget(self, axis: int, seen_ns: int) -> None:
        """Judge an axis by what comes from now on: what it did has been told."""
        self._place[axis] = self._reference[axis] = self._raw[axis]
        self._since_ns[axis] = seen_ns
        for numbers in self._sums:
            numbers[axis] = 0

    # -- steps --------------------------------------------------------------------------------

    def _steps(self, seen_ns: int, last_ns: int) -> list[Finding]:
        """Doubt steps that are too wide, and say at the next reading what they were."""
        raw, last = self._raw, self._last
        found, fastest = [], self._factor * self._velocity
        # a reading may be as old as the last tick: what the device counts is then what it was told before
        reach = fastest * (seen_ns - self._loop.before_ns) * 1e-9 + self._tolerance
        if seen_ns - last_ns > GAP_NS:  # the readings were lost: what was held must read as before
            held = (self._kind == HOLD) & ~self._limp & self._watched
            reach[held] = self._tolerance[held]
        wide = np.abs(raw - last) > reach
        for axis, (place, then_ns, most) in list(self._doubted.items()):
            del self._doubted[axis]
            one, place_now, within_s = self._settings[axis], float(raw[axis]), (seen_ns - then_ns) * 1e-9
            stands, wide[axis] = not wide[axis], False
            if abs(place_now - place) <= most + fastest[axis] * (seen_ns - last_ns) * 1e-9:
                continue  # it reads again what it can be
            if stands:
                found.append(Finding(axis, lost_text(one, place, place_now, within_s), lost=True))
            else:
                text = fast_text(one, (place_now - place) / within_s, float(self._velocity[axis]))
                found.append(Finding(axis, text, lost=False))
        for axis in np.flatnonzero(wide).tolist():
            self._doubted[axis] = float(last[axis]), last_ns, float(reach[axis])
        return found

    # -- motions ------------------------------------------------------------------------------

    def _told(self, axis: int, speed: float) -> Finding:
        one, odd = self._settings[axis], int(self._odd[axis])
        if odd & TOO_FAST:
            text = fast_text(one, speed, float(self._velocity[axis]))
        elif odd & AWAY:
            text = away_text(one, speed, float(self._commanded[axis]))
        else:
            text = uncommanded_text(one, float(self._reference[axis]), float(self._raw[axis]), speed)
        return Finding(axis, text, lost=False, drifts=not odd & (TOO_FAST | AWAY))
