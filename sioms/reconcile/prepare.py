"""Before any mechanics: check the input, read the noise floor, go through the channels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sioms.reconcile.blocks import block_ids
from sioms.reconcile.calibrate import calibrated
from sioms.reconcile.channels import Finding, drive, drive_output, index_fit, index_scale, lattice
from sioms.reconcile.checks import check, check_scale
from sioms.reconcile.effects import library
from sioms.reconcile.experiment import Envelope
from sioms.reconcile.fit import SKIP, SKIP_S, Mapper, Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import drive_noise, observer, sensor_noise
from sioms.reconcile.records import Session
from sioms.reconcile.timed import Timed, known_beside
from sioms.reconcile.timing import on_grid

#: Share at the end of every record that takes no part in any choice.
UNTOUCHED = 0.2
#: What a refined number of the model would be named as.
REFITTED = {"inertia": "payload", "viscous": "viscous"}


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of one analysis.

    Attributes:
        seed: of permutations and bootstrap.
        replicates: bootstrap replicates.
        pictures: keep curves and localisation for the report.
        resample: seed with which the blocks of time are drawn anew, to see whether the verdict stands; None: as they are.
        mapper: as of ``Problem``.
        envelope: within which an experiment may be proposed; None takes it from the records.
    """

    seed: int = 1
    replicates: int = 200
    pictures: bool = True
    resample: int | None = None
    mapper: Mapper = map
    envelope: Envelope | None = None
    progress: Callable[[str], None] = field(default=lambda text: None)


@dataclass(frozen=True, slots=True)
class Prepared:
    """State after channels and gate, before any mechanics.

    Attributes:
        timed: forces that keep their own time, by now among the known ones of the problems' records.
    """

    model: AxisModel
    problem: Problem
    final: Problem
    findings: tuple[Finding, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...]
    timed: tuple[Timed, ...] = ()

    def beside(self, force: Timed) -> Prepared:
        """Take a force in time for known."""
        final = self.final if self.final.session.final else known_beside(self.final, force.forces)
        return replace(
            self, problem=known_beside(self.problem, force.forces), final=final, timed=(*self.timed, force)
        )


def prepare(session: Session, nominal: AxisModel, o: Options) -> Prepared:
    """Check the input, read the noise floor and go through the channels."""
    session, notes = on_grid(session, nominal.sample_time_s)
    notes += check(session, nominal)
    if session.final:
        check(Session(session.final), nominal)
    o.progress("channels: sensor, then drive")
    findings: list[Finding] = []
    model = nominal
    coarse = lattice(session, nominal)
    scale = index_scale(session, nominal)
    findings += [f for f in (coarse, scale) if f is not None]
    driven = drive(session, nominal)
    findings += driven
    for f in findings:
        model = model.with_effect(f.effect, dict(f.values))
    factor = coarse.values["factor"] if coarse is not None else 1.0
    seen = {symbol: value for f in driven for symbol, value in f.values.items()}
    noise = observer(
        nominal,
        sensor_noise(session, nominal.resolution * factor),
        drive_noise(
            session,
            nominal.rated_force,
            lambda force: drive_output(
                force,
                seen.get("delay", 0.0),
                seen.get("tau", 0.0),
                seen.get("limit", np.inf),
                nominal.sample_time_s,
            ),
        ),
    )
    skip = max(SKIP, round(SKIP_S / nominal.sample_time_s))
    problem = Problem(session, noise, skip, end=1.0 if session.final else 1.0 - UNTOUCHED, mapper=o.mapper)
    notes += check_scale(problem, nominal)
    problem = calibrated(problem, session, model)
    excluded = {"encoder_quantisation"} | {REFITTED[s] for s in nominal.refine if s in REFITTED}
    if index_fit(session, nominal) is not None:
        excluded.add("encoder_scale")
    if any(r.force_measured is not None for r in session.records):
        excluded |= {"delay", "lag", "saturation"}
    names = tuple(
        n for n, e in library().items() if e.rankable and nominal.applicable(e) and n not in excluded
    )
    final = replace(problem, begin=1.0 - UNTOUCHED, end=1.0)
    if session.final:
        final = replace(final, session=Session(session.final, continuous=False), begin=0.0)
    if o.resample is not None:
        problem = _resampled(problem, model, o.resample)
    return Prepared(model, problem, final, tuple(findings), names, tuple(notes))


def _resampled(problem: Problem, model: AxisModel, seed: int) -> Problem:
    """Draw the blocks of time anew with replacement, as weights."""
    ids = block_ids(problem, model.sample_time_s)
    count = int(ids.max()) + 1
    times = np.bincount(np.random.default_rng(seed).integers(0, count, count), minlength=count)
    return replace(problem, weights=np.sqrt(times.astype(np.float64))[ids])
