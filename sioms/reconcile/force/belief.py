"""What the simulation believes about a force/torque sensor, and the readings that follow from known loads.

Loads and readings are shares of each component's full range, so that forces and torques stand on one footing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.jit import kernel

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
        names: of the components; full: full range of each [N, N m]; both only for reports and files.
        matrix: reading per load as stated, both in shares of full range, shape (components, components).
        gain, cross: relative departures of its rows and what is added to it; None for none.
        responses: further changes of the reading with their parameters, in order.
    """

    names: tuple[str, ...]
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
def late(loads: Loads, tau: float) -> Floats:
    """Return how far every load is ahead of itself seen through a lag of first order, zero at the first row of a
    record.

    Args:
        tau: time constant [s]. A load is taken to have come right after the row before, as weights do.
    """
    out = np.zeros_like(loads.load)
    if len(out) > 1:
        ease = np.exp(-np.maximum(np.diff(loads.time), 0.0) / tau)
        _compiled(catch_up)(np.diff(loads.load, axis=0), ease, np.diff(loads.record) != 0, out)
    out.setflags(write=False)
    return out


def catch_up(step: Floats, ease: Floats, new: NDArray[np.bool_], out: Floats) -> None:
    """Fill rows 1 and on of ``out`` with how far a load is ahead of itself; ``new`` records begin at 0."""
    for i in range(step.shape[0]):
        if not new[i]:
            for j in range(step.shape[1]):
                out[i + 1, j] = (out[i, j] + step[i, j]) * ease[i]


@lru_cache(maxsize=32)
def _lag(loads: Loads, reach: tuple[float, ...], power: float, forgets: float) -> Floats:
    out = lagged(loads.load, np.array(reach), power, loads.record, forgets)
    out.setflags(write=False)
    return out


def lag(loads: Loads, reach: Floats, power: float, forgets: float) -> Floats:
    """Return the lag of known loads, see ``lagged``; the search asks for the same ones again and again."""
    return _lag(loads, tuple(reach), power, forgets)


class Loops:
    """Loops about each of some loads: of plays, which remember where they turned round, and of one law that forgets it.

    A play follows the load once that has moved its width. They weigh with a power of their width; even weights make
    loops of parabolas, as metal under loads well below yield has them (Rayleigh's law). The other law is that of Bouc
    and Wen: straight back to the middle, and from there on as an exponential of a third of the reach. A full loop of
    either has height one. One caller at a time.
    Source: M. A. Krasnosel'skii, A. V. Pokrovskii, "Systems with Hysteresis", 1989, sec. 2 and 34 (play,
    Prandtl-Ishlinskii); Y. K. Wen, "Method for random vibration of hysteretic systems", J. Eng. Mech. Div. ASCE 102
    (1976), eq. 3 (n = 1, beta = gamma).

    Args:
        reach: largest width, shape (n,); power: of the weights; forgets: share of the law that does.
        load: where they stand at rest, shape (n,).
    """

    def __init__(self, reach: Floats, power: float, forgets: float, load: Floats) -> None:
        share = ((np.arange(PLAYS) + 0.5) / PLAYS)[:, None]
        self._width, self._weight = reach * share, (share**power / np.sum(share**power))[:, 0]
        self._plays = np.repeat(load[None], PLAYS, axis=0)
        self._forgets, self._slope = forgets, 3.0 / reach
        self._load, self._ahead = load, np.zeros(len(load))

    def follow(self, load: Floats) -> Floats:
        """Move on through loads, shape (t, n); return how far the loops lag behind each in their height, -1 to 1, shape
        (t, n).
        """
        out = (1.0 - self._forgets) * self._follow_plays(load)
        if self._forgets:
            out -= self._forgets * self._follow_forgetful(load)
        return out

    def _follow_plays(self, load: Floats) -> Floats:
        out = np.empty_like(load)
        _of_rows(load, play)(self._plays, self._width, self._weight, load, out)
        return out

    def _follow_forgetful(self, load: Floats) -> Floats:
        out = np.diff(load, axis=0, prepend=self._load[None]) * self._slope
        _of_rows(load, forget)(self._ahead, out)
        self._load, self._ahead = load[-1], out[-1].copy()
        return out


def play(plays: Floats, width: Floats, weight: Floats, load: Floats, out: Floats) -> None:
    """Move plays, shape (plays, n), on through loads; fill ``out`` with how far they lag behind each, shape (t, n)."""
    for i in range(load.shape[0]):
        for j in range(load.shape[1]):
            here, total = load[i, j], 0.0
            for k in range(len(weight)):
                state = min(max(plays[k, j], here - width[k, j]), here + width[k, j])
                plays[k, j] = state
                total += weight[k] * (state - here) / width[k, j]
            out[i, j] = total


def forget(ahead: Floats, steps: Floats) -> None:
    """Put how far ahead the loops are, -1 to 1, in the place of steps of the load in units of their slope, shape (t,
    n).
    """
    for j in range(steps.shape[1]):
        here = ahead[j]
        for i in range(steps.shape[0]):
            step = steps[i, j]
            way, far = (-1.0, -step) if step < 0.0 else (1.0, step)
            back = min(max(-here * way, 0.0), far)
            here = way * (1.0 - (1.0 - here * way - back) * np.exp(back - far))
            steps[i, j] = here


@cache
def _compiled(loop: Callable[..., None]) -> Callable[..., None]:
    return kernel(loop)


def _of_rows(load: Floats, loop: Callable[..., None]) -> Callable[..., None]:
    """Return a loop over rows: compiled, for a single one (a device reads row by row) as it is."""
    return _compiled(loop) if len(load) > 1 else loop


def lagged(load: Floats, reach: Floats, power: float, record: NDArray[np.int64], forgets: float = 0.0) -> Floats:
    """Return how far every column lags behind itself, see ``Loops``; at rest in every record's first row."""
    parts = np.split(load, np.flatnonzero(np.diff(record)) + 1)
    return np.concatenate([Loops(reach, power, forgets, p[0]).follow(p) for p in parts])
