"""What the workflow says of any subject, as data: the report, the JSON and the terminal summary are made from it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

from sioms.reconcile.effect import TERM_PREFIX, Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.selection import Step

__all__ = [
    "EXIT", "EXIT_BAD_INPUT", "BadInputError", "Candidate", "Estimate", "Gap", "NamedEffect", "Outcome", "Place",
    "Verdict", "apart",
]  # fmt: skip


class Outcome(Enum):
    """The verdict; the value is what verdict.json says."""

    NONE = "none"
    NAMED = "named"
    UNEXPLAINED = "unexplained"
    AMBIGUOUS = "ambiguous"


#: Exit status per verdict.
EXIT = {Outcome.NONE: 0, Outcome.NAMED: 0, Outcome.UNEXPLAINED: 3, Outcome.AMBIGUOUS: 4}
EXIT_BAD_INPUT = 2


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter with its 95 % interval (blocks of time left out in turn)."""

    symbol: str
    value: float
    low: float
    high: float
    unit: str
    text: str


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """One effect of the verdict.

    Attributes:
        saved: share of the remaining residual energy that it explains, beyond all the others.
        errors: standard errors of that, over blocks.
        frequency: share of block bootstrap replicates in which it earns its place; None where that was not tried.
        evidence: sentences; ruled_out, open: confounders with the reason.
    """

    name: str
    title: str
    equation: str
    channel: str
    parameters: tuple[Estimate, ...]
    saved: float
    errors: float
    frequency: float | None
    evidence: tuple[str, ...]
    ruled_out: dict[str, str] = field(default_factory=dict)
    open: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect of a model that was refused: what was tried, and no finding. It has no numbers for that reason."""

    name: str
    title: str
    why: str


def apart(effects: Iterable[NamedEffect]) -> tuple[list[NamedEffect], list[NamedEffect]]:
    """Part effects into named ones and nameless terms, each in the given order."""
    parted: tuple[list[NamedEffect], list[NamedEffect]] = [], []
    for e in effects:
        parted[e.name.startswith(TERM_PREFIX)].append(e)
    return parted


@dataclass(frozen=True, slots=True)
class Gap:
    """Disagreement on samples that took no part in any choice, before and after.

    Attributes:
        before, after: root mean square, in ``unit``; frozen model parameters.
        floor: what noise alone would leave, in ``unit``: an estimate of its own, which what is reached does not change;
            nan where nothing tells it from what is missing.
        frozen, session: on the later half of these samples only, frozen and with the session parameters
            re-estimated on the earlier half; None where that was not done.
        floor_from: how the floor was found, in words.
    """

    channel: str
    unit: str
    before: float
    after: float
    floor: float
    frozen: float | None = None
    session: float | None = None
    floor_from: str = ""

    @property
    def known(self) -> bool:
        """Whether the floor is known."""
        return not math.isnan(self.floor)

    @property
    def closed(self) -> float:
        """Share of the gap above the floor that the model closes, at most 1; 0 where the gap did not stand above the
        floor, nan where that is not known.
        """
        if not self.known:
            return math.nan
        gap = self.before - self.floor
        return min((self.before - self.after) / gap, 1.0) if gap > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Place:
    """How far one variable orders the residual.

    Attributes:
        explained: share of the residual's variance between bins; p: permutation p-value.
        centres, means, spread: per bin, for the picture; force in {F}.
    """

    variable: str
    unit: str
    explained: float
    p: float
    centres: Array
    means: Array
    spread: Array


class Decides(Protocol):
    """An experiment that would decide: what to do, and by how many times the noise the rivals then differ."""

    @property
    def text(self) -> str: ...
    @property
    def separation(self) -> float: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Everything the workflow found out about one subject, as far as all subjects have it.

    Attributes:
        nominal, model: before and after; effects found by a channel of their own are in ``model`` as well.
        missing: effects that the records did not excite, with the record that would.
        pairs: effects that look the same in these records, with the share they have in common.
        places: where the nominal model disagreed.
        ratio: residual of the final model in units of what is expected.
        candidates: effects of ``model`` that are no findings, as the model, or they in it, were refused.
    """

    outcome: Outcome
    nominal: Any
    model: Any
    effects: tuple[NamedEffect, ...]
    alternatives: tuple[tuple[str, ...], ...]
    symbolic: tuple[NamedEffect, ...]
    gaps: tuple[Gap, ...]
    path: tuple[Step[Any], ...]
    missing: dict[str, str]
    pairs: tuple[tuple[str, str, float], ...]
    places: tuple[Place, ...]
    ratio: float
    smoother_share: float
    burst_share: float
    effective_samples: float
    samples: int
    notes: tuple[str, ...]
    rejected: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = ()

    @property
    def experiment(self) -> Decides | None:
        """The experiment that would decide best, None where there is nothing to decide."""
        raise NotImplementedError

    @property
    def speaking(self) -> Gap:
        """The gap that speaks for all."""
        raise NotImplementedError

    def title(self, name: str) -> str | None:
        """Return what an effect is called; None when the library has none of that name."""
        raise NotImplementedError
