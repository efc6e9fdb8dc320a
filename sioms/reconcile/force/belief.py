"""What the simulation believes about a force/torque sensor, and the readings that follow from known loads.

Loads and readings are shares of each component's full range, so that forces and torques stand on one footing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
PLAYS = 8
Response = Callable[[Floats, "Loads", Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Loads:
    """Known loads in the order of time; immutable.

    Attributes:
        load: share of full range, shape (n, components).
        time: since the first row [s]; warmth: temperature less its mean [K], zero where not known; shape (n,).
        record: number of the recording of each row, shape (n,).
    """

    load: Floats
    time: Floats
    warmth: Floats
    record: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ForceBelief:
    """The sensor as the simulation has it; immutable.

    Attributes:
        full: full range of each component [N, N m]; only for reports.
        matrix: reading per load as stated, both in shares of full range, shape (components, components).
        gain, cross: relative departures of its rows and what is added to it; None for none.
        responses: further changes of the reading with their parameters, in order.
    """

    full: Floats
    matrix: Floats
    gain: Floats | None = None
    cross: Floats | None = None
    responses: tuple[tuple[Response, Floats], ...] = field(default=())

    @property
    def total(self) -> Floats:
        """Reading per load."""
        out = self.matrix if self.gain is None else self.matrix * (1.0 + self.gain)[:, None]
        return out if self.cross is None else out + self.cross

    def responding(self, response: Response, parameters: Floats) -> ForceBelief:
        """Return the belief with one more response."""
        return replace(self, responses=(*self.responses, (response, parameters)))


def readings(b: ForceBelief, loads: Loads) -> Floats:
    """Return the readings without their zero, shape (n, components)."""
    out: Floats = loads.load @ b.total.T
    for response, parameters in b.responses:
        out = response(out, loads, parameters)
    return out


@lru_cache(maxsize=32)
def lag(loads: Loads, reach: float) -> Floats:
    """Return the lag of known loads, see ``lagged``; the search asks for the same reaches again and again."""
    out = lagged(loads.load, reach, loads.record)
    out.setflags(write=False)
    return out


def lagged(load: Floats, reach: float, record: NDArray[np.int64]) -> Floats:
    """Return how far every column lags behind itself, -1 to 1: the mean of plays whose widths are even up to ``reach``.

    A play follows the load once that has moved its width from where it turned. Even widths make loops of parabolas, as metal
    under loads well below yield has them (Rayleigh's law), and a full loop of height one; at rest in every record's first row.
    Source: M. A. Krasnosel'skii, A. V. Pokrovskii, "Systems with Hysteresis", 1989, sec. 2 and 34 (play, Prandtl-Ishlinskii).
    """
    width = reach * ((np.arange(PLAYS) + 0.5) / PLAYS)[:, None]
    out = np.empty_like(load)
    state = np.repeat(load[:1], PLAYS, axis=0)
    for i, here in enumerate(load):
        if i and record[i] != record[i - 1]:
            state[:] = here
        np.clip(state, here - width, here + width, out=state)
        out[i] = ((state - here) / width).mean(0)
    return out
