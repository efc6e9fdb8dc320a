"""What the workflow says about a sensor, as data: report, JSON and terminal summary are made from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import Array
from sioms.reconcile.verdict import Gap, Verdict


@dataclass(frozen=True, slots=True)
class Proposal:
    """An experiment that would decide: what to do, and by how many times the noise the rivals then differ at best."""

    name: str
    text: str
    separation: float


@dataclass(frozen=True, slots=True)
class Curve:
    """Curves for a picture: measured, and simulated before and after, over one variable.

    Attributes:
        apart: rows that took no part in any choice.
    """

    title: str
    axis: str
    unit: str
    at: Array
    measured: Array
    before: Array
    after: Array
    apart: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorVerdict(Verdict):
    """Everything the workflow found out about one sensor.

    Attributes:
        floors: per view, residual of the final model in units of its noise floor.
        experiments: what would decide where effects look alike, the best first.
    """

    floors: dict[str, float]
    experiments: tuple[Proposal, ...]
    curves: tuple[Curve, ...]

    @property
    def experiment(self) -> Proposal | None:
        """The experiment that would decide best, None where there is nothing to decide."""
        return self.experiments[0] if self.experiments else None

    @property
    def speaking(self) -> Gap:
        """The largest gap before."""
        return max(self.gaps, key=lambda g: g.before / g.floor)

    def title(self, name: str) -> str | None:
        """Return what an effect is called; None when the library has none of that name."""
        known = self.nominal.library
        return known[name].title if name in known else None
