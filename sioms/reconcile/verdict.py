"""What the workflow says, as data: the report, the JSON and the terminal summary are made from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum

from sioms.reconcile.channels import Finding
from sioms.reconcile.effect import TERM_PREFIX, Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.excitation import Gate
from sioms.reconcile.experiment import Experiment
from sioms.reconcile.locate import Place, Spectrum
from sioms.reconcile.model import AxisModel
from sioms.reconcile.search import Step
from sioms.reconcile.session import State

__all__ = [
    "EXIT", "EXIT_BAD_INPUT", "BadInputError", "Estimate", "Gap", "NamedEffect", "Outcome", "Trace", "Verdict", "apart",
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
        evidence: sentences; ruled_out, open: look-alikes with the reason.
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
        floor: what noise alone would leave, in ``unit``: an estimate of its own, which what is reached does not change.
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
    def closed(self) -> float:
        """Share of the gap above the floor that the model closes, at most 1; 0 where the gap did not stand above the floor."""
        gap = self.before - self.floor
        return min((self.before - self.after) / gap, 1.0) if gap > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Trace:
    """Curves of one record for the pictures: measured, and simulated before and after.

    Attributes:
        untouched_s: from when on nothing of the record was used for any choice or number [s].
    """

    name: str
    time_s: Array
    measured: Array
    before: Array
    after: Array
    untouched_s: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Everything the workflow found out about one axis.

    Attributes:
        others: numbers of each alternative, per symbol per effect.
        states: session parameters of the untouched part of each record.
        rungs: force error on the untouched samples after each step of the ladder, in closed loop where it can be.
    """

    outcome: Outcome
    nominal: AxisModel
    model: AxisModel
    effects: tuple[NamedEffect, ...]
    alternatives: tuple[tuple[str, ...], ...]
    symbolic: tuple[NamedEffect, ...]
    gaps: tuple[Gap, ...]
    ladder: tuple[Step, ...]
    rungs: tuple[float, ...]
    findings: tuple[Finding, ...]
    gate: Gate
    places: tuple[Place, ...]
    spectra: tuple[Spectrum, Spectrum] | None
    experiment: Experiment | None
    ratio: float
    smoother_share: float
    burst_share: float
    effective_samples: float
    samples: int
    notes: tuple[str, ...]
    traces: tuple[Trace, ...]
    states: tuple[tuple[str, State], ...] = ()
    rejected: tuple[str, ...] = ()
    others: tuple[Mapping[str, Mapping[str, float]], ...] = ()
