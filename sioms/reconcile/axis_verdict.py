"""The verdict on an axis."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from sioms.reconcile.channels import Finding
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import library
from sioms.reconcile.experiment import Experiment
from sioms.reconcile.locate import Spectrum
from sioms.reconcile.session import State
from sioms.reconcile.verdict import Gap, Verdict


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


@dataclass(frozen=True, slots=True, kw_only=True)
class AxisVerdict(Verdict):
    """Everything the workflow found out about one axis.

    Attributes:
        others: numbers of each alternative, per symbol per effect.
        states: session parameters of the untouched part of each record.
        rungs: force error on the untouched samples after each step of the path, in closed loop where it can be.
    """

    rungs: tuple[float, ...]
    findings: tuple[Finding, ...]
    spectra: tuple[Spectrum, Spectrum] | None
    decisive: Experiment | None
    traces: tuple[Trace, ...]
    states: tuple[tuple[str, State], ...] = ()
    others: tuple[Mapping[str, Mapping[str, float]], ...] = ()

    @property
    def experiment(self) -> Experiment | None:
        """The command on which the rivals differ most, None where there is nothing to decide."""
        return self.decisive

    @property
    def speaking(self) -> Gap:
        """The gap in force, or of the one channel there is."""
        return self.gaps[min(1, len(self.gaps) - 1)]

    def title(self, name: str) -> str | None:
        """Return what an effect is called; None when the library has none of that name."""
        known = library()
        return known[name].title if name in known else None
