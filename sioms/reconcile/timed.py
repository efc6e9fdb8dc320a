"""A force that keeps its own time, whatever the axis does: not an effect of its state, and no noise either.

Left in, it passes for noise, or whatever bends itself to follow it gets a name. Found, it is taken for a known force
beside the drive's, the search begins anew, and the verdict describes it as a nameless term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.verdict import NamedEffect


@dataclass(frozen=True, slots=True)
class Timed:
    """A force in time.

    Attributes:
        forces: in every record, from its first sample to its last, shape (n,) each, [{F}].
        left: squares of the residual that it leaves.
        term: how the verdict describes it.
        text: what is told of it while the work goes on.
        beside: effects that may be a part of it: of a number that swings by less than a whole period nobody can tell
            about which value it does.
    """

    forces: tuple[Array, ...]
    left: float
    term: NamedEffect
    text: str
    beside: tuple[str, ...] = ()


def waves(count: int, frequency_hz: float, dt: float) -> Array:
    """Sine and cosine of one frequency, shape (count, 2)."""
    turn = 2.0 * np.pi * frequency_hz * dt * np.arange(count)
    return np.stack([np.sin(turn), np.cos(turn)], axis=1)


def known_beside(problem: Problem, forces: Sequence[Array]) -> Problem:
    """Take forces, shape (n,) for every record, for known ones beside the drive's."""
    records = tuple(
        replace(r, external=f + (0.0 if r.external is None else r.external))
        for r, f in zip(problem.session.records, forces, strict=True)
    )
    return replace(problem, session=replace(problem.session, records=records))


def as_recorded(problem: Problem, found: Sequence[Timed]) -> Problem:
    """Take forces in time out of those that are known."""
    for force in found:
        problem = known_beside(problem, [-f for f in force.forces])
    return problem
