"""The motion watch of axes whose loop the host closes: what watch.py finds of drives, for all axes of a bank at once.

The host knows in each tick where an axis should be, so less has to be reckoned with than of a drive that plans by
itself. Looked at is the raw position. Found are

* *lost*: a step between two ticks that no axis can make, and that stands in the next tick. What was seen once is not
  believed: one damaged reading must stop nothing.
* *too fast*: as in watch.py: the distance covered beyond ``1 + speed_margin`` times velocity_max adds up.
* *uncommanded*: an axis that has settled and holds is farther than ``tolerance`` from where it came to rest.
* *away*: an axis runs against the velocity that is commanded: its motor or its encoder is connected the wrong way
    round.

Steps are looked at in each tick; the rest every LOOK_S, and is a finding when it is seen twice. Why so:
docs/decisions/0165-the-watch-of-host-closed-loops.md.

Pure; concurrency: that of its bank.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .settings import AxisSettings
from .watch import (
    GAP_NS,
    JITTER_S,
    SETTLE_NS,
    Finding,
    away_text,
    fast_text,
    lost_text,
    tolerance_of,
    uncommanded_text,
)

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

LOOK_NS = 10_000_000
AGAINST = 3.0
"""Tolerances by which an axis may run against the commanded velocity: it follows late when that changes its sign."""


class HostWatch:
    """Watches the axes of a bank.

    Args:
        settings: of the axes.
        tick_s: nominal period [s].
        velocity: velocity limits in force (n,), the bank's own array [unit/s].
    """

    def __init__(self, settings: Sequence[AxisSettings], tick_s: float, velocity: Floats) -> None:
        n = len(settings)
        self._settings, self._velocity = tuple(settings), velocity
        self._factor = np.array([1.0 + one.watch.speed_margin for one in settings])
        self._tolerance = np.array([tolerance_of(one) for one in settings])
        self._watched = np.array([one.watch.uncommanded for one in settings], dtype=bool)
        reach = self._factor * np.array([one.velocity_max for one in settings]) * tick_s + self._tolerance
        self._bound = float(np.min(reach, initial=np.inf)) ** 2
        """No step can be too wide where their squares make less than this."""
        self._doubted: dict[int, tuple[float, int, float]] = {}
        """Where an axis was before a step that it cannot have made, when [ns], and how far it can have come."""
        self._place, self._reference = np.zeros(n), np.zeros(n)
        self._excess, self._against = np.zeros(n), np.zeros(n)
        self._fast, self._off = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._since_ns = np.zeros(n, dtype=np.int64)
        self._before_ns = self._last_ns = self._looked_ns = self._earlier_ns = self._due_ns = 0

    def is_due(self, now_ns: int, step: Floats) -> bool:
        """Tell whether the readings of a tick have to be judged: it is time, or a step is wide.

        Args:
            now_ns: time of the readings [ns].
            step: how far they are from those of the last tick (n,).
        """
        if now_ns >= self._due_ns or self._doubted or step.dot(step) > self._bound:
            return True
        self._before_ns, self._last_ns = self._last_ns, now_ns
        return False

    def look(
        self, now_ns: int, raw: Floats, last: Floats, commanded: Floats, holds: Flags, limp: Flags
    ) -> list[Finding]:
        """Judge the readings of a tick.

        Args:
            now_ns: time of the readings [ns].
            raw: raw positions (n,).
            last: those of the last tick.
            commanded: velocities that were commanded in the last tick [unit/s].
            holds: axes that are to hold.
            limp: axes that the host has let go; they may be moved.
        """
        last_ns = self._last_ns
        if not last_ns:
            self._place[:] = self._reference[:] = raw
            self._since_ns[:] = now_ns
            self._before_ns = self._last_ns = self._looked_ns = self._earlier_ns = now_ns
            self._due_ns = now_ns + LOOK_NS
            return []
        found = self._steps(now_ns, last_ns, raw, last, holds & ~limp & self._watched)
        if now_ns >= self._due_ns and not self._doubted:
            self._due_ns = now_ns + LOOK_NS
            found += self._motions(now_ns, last_ns, raw, commanded, holds, limp)
        for finding in found:
            self._forget(finding.axis, now_ns, raw)
        self._before_ns, self._last_ns = last_ns, now_ns
        return found

    def _forget(self, axis: int, now_ns: int, raw: Floats) -> None:
        """Judge an axis by what comes from now on: what it did has been told."""
        self._place[axis] = self._reference[axis] = raw[axis]
        self._since_ns[axis], self._excess[axis], self._against[axis] = now_ns, 0.0, 0.0
        self._fast[axis] = self._off[axis] = 0

    # -- steps --------------------------------------------------------------------------------

    def _steps(self, now_ns: int, last_ns: int, raw: Floats, last: Floats, held: Flags) -> list[Finding]:
        """Doubt steps that are too wide, and say in the next tick what they were."""
        found, fastest = [], self._factor * self._velocity
        # a reading may be as old as the last tick: what the device counts is then what it was told before
        reach = fastest * (now_ns - self._before_ns) * 1e-9 + self._tolerance
        if now_ns - last_ns > GAP_NS:  # the readings were lost: what was held must read as before
            reach[held] = self._tolerance[held]
        wide = np.abs(raw - last) > reach
        for axis, (place, then_ns, most) in list(self._doubted.items()):
            del self._doubted[axis]
            one, place_now, within_s = self._settings[axis], float(raw[axis]), (now_ns - then_ns) * 1e-9
            stands, wide[axis] = not wide[axis], False
            if abs(place_now - place) <= most + fastest[axis] * (now_ns - last_ns) * 1e-9:
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

    def _motions(
        self, now_ns: int, last_ns: int, raw: Floats, commanded: Floats, holds: Flags, limp: Flags
    ) -> list[Finding]:
        """Look at what has added up since the last look."""
        # a reading may be as old as the tick before
        dt, longest = (now_ns - self._looked_ns) * 1e-9, (now_ns - self._earlier_ns) * 1e-9
        self._looked_ns, self._earlier_ns = now_ns, last_ns
        way = raw - self._place
        self._place[:] = raw
        fastest = self._factor * self._velocity
        beyond = np.abs(way) - fastest * longest
        beyond[limp] = 0.0
        self._excess = np.maximum(0.0, self._excess + beyond)
        self._fast = np.where(beyond > 0.0, self._fast + 1, 0)
        too_fast = (self._fast > 1) & (self._excess > JITTER_S * fastest)
        # an axis that settles, or is let go, may be anywhere
        self._since_ns[~(holds & ~limp & self._watched)] = now_ns
        settles = now_ns - self._since_ns <= SETTLE_NS
        self._reference[settles] = raw[settles]
        self._off = np.where(np.abs(raw - self._reference) > self._tolerance, self._off + 1, 0)
        along = way * np.sign(commanded)
        self._against = np.where(holds | limp | (along >= 0.0), 0.0, self._against - along)
        away = self._against > AGAINST * self._tolerance
        odd = too_fast | (self._off > 1) | away
        return [
            self._told(axis, way[axis] / dt, raw, commanded, too_fast, away) for axis in np.flatnonzero(odd).tolist()
        ]

    def _told(self, axis: int, speed: float, raw: Floats, commanded: Floats, too_fast: Flags, away: Flags) -> Finding:
        one = self._settings[axis]
        if too_fast[axis]:
            text = fast_text(one, speed, float(self._velocity[axis]))
        elif away[axis]:
            text = away_text(one, speed, float(commanded[axis]))
        else:
            text = uncommanded_text(one, float(self._reference[axis]), float(raw[axis]), speed)
        return Finding(axis, text, lost=False)
