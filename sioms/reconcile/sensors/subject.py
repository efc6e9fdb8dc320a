"""What the workflow asks of a sensor that has been prepared: a finger, a force sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.sensors.effect import Array, SensorModel
from sioms.reconcile.sensors.fit import Data
from sioms.reconcile.sensors.verdict import Curve, Proposal
from sioms.reconcile.thresholds import BY_CHANCE
from sioms.reconcile.verdict import NamedEffect


@dataclass(frozen=True, slots=True)
class View:
    """How a view is reported: what it is called, its unit, and what one floor is in that unit."""

    title: str
    unit: str
    floor: float


class Variable(NamedTuple):
    """Something that the disagreement may go with.

    Attributes:
        view: number of the view whose rows it is given for.
        values: for each row of that view.
        bins: of the rows, from 0; None for bins of equal counts.
    """

    name: str
    unit: str
    view: int
    values: Array
    bins: NDArray[np.int64] | None = None


class Subject(Protocol):
    """A prepared sensor: rows, model and what the report wants.

    Attributes:
        whole, training, final: all rows; those of the search; those that take no part in it.
        model: the nominal model with the whole library (terms too).
        names, terms: effects that are tried, and the nameless terms beside them.
        settled: effects found by a channel of their own, with their values in the model as well.
    """

    @property
    def whole(self) -> Data: ...
    @property
    def training(self) -> Data: ...
    @property
    def final(self) -> Data: ...
    @property
    def model(self) -> SensorModel: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def terms(self) -> tuple[str, ...]: ...
    @property
    def settled(self) -> tuple[NamedEffect, ...]: ...
    @property
    def notes(self) -> tuple[str, ...]: ...

    def views(self) -> Mapping[str, View]:
        """Return how each view is reported."""
        ...

    def features(self) -> Mapping[int, Array]:
        """Return columns of the state for the generic smoother, per view of ``training``."""
        ...

    def groups(self) -> NDArray[np.int64]:
        """Return the number of the touch or sample of each row of view 0 of ``training``."""
        ...

    def variables(self, data: Any) -> Sequence[Variable]:
        """Return what a disagreement may go with, for the rows of ``whole`` or ``training``."""
        ...

    def sharpened(self, model: SensorModel, shares: Mapping[int, float]) -> Subject | None:
        """Return the subject with its floor told beside a model that explains more than the nominal one; None for the
        same.

        Args:
            shares: of what the model leaves in each view, that which a smoother explains: it is no noise.
        """
        ...

    def propose(self, models: Sequence[SensorModel]) -> tuple[Proposal, ...]:
        """Return experiments, that on which the models differ most first."""
        ...

    def curves(self, before: SensorModel, after: SensorModel) -> tuple[Curve, ...]:
        """Return curves for the pictures."""
        ...

    def unit(self, effect: str, symbol: str) -> str:
        """Return the unit of a parameter on this sensor."""
        ...


def untouched(count: int) -> NDArray[np.bool_]:
    """Say which of a number of touches (or samples) take no part in any choice: every fifth."""
    return np.asarray(np.arange(count) % 5 == 2)


def by_chance(count: int) -> float:
    """Return how many times too low a scatter may be by chance that the median of so many second differences tells.

    Of white noise the logarithm of such a scatter has a standard deviation of 1.41 over the root of their number, 12 to
    300 of them.
    """
    return float(np.exp(BY_CHANCE * 1.41 / np.sqrt(count)))
