"""What the workflow says about a sensor, as data: report, JSON and terminal summary are made from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.locate import Place
from sioms.reconcile.sensors.effect import Array, SensorModel
from sioms.reconcile.sensors.search import Step
from sioms.reconcile.verdict import Gap, NamedEffect, Outcome


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


@dataclass(frozen=True, slots=True)
class SensorVerdict:
    """Everything the workflow found out about one sensor.

    Attributes:
        nominal, model: before and after; effects found by a channel of their own are in ``model`` as well.
        floors: per view, residual of the final model in units of its noise floor.
        missing: effects that the records did not excite, with the record that would.
        pairs: effects that look the same in these records, with the share they have in common.
        places: where the nominal model disagreed.
        experiments: what would decide where effects look alike, the best first.
    """

    outcome: Outcome
    nominal: SensorModel
    model: SensorModel
    effects: tuple[NamedEffect, ...]
    alternatives: tuple[tuple[str, ...], ...]
    symbolic: tuple[NamedEffect, ...]
    gaps: tuple[Gap, ...]
    ladder: tuple[Step, ...]
    floors: dict[str, float]
    missing: dict[str, str]
    pairs: tuple[tuple[str, str, float], ...]
    places: tuple[Place, ...]
    experiments: tuple[Proposal, ...]
    ratio: float
    smoother_share: float
    burst_share: float
    effective_samples: float
    samples: int
    notes: tuple[str, ...]
    curves: tuple[Curve, ...]
    rejected: tuple[str, ...] = ()

    @property
    def experiment(self) -> Proposal | None:
        """The experiment that would decide best, None where there is nothing to decide."""
        return self.experiments[0] if self.experiments else None
