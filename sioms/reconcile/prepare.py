"""Before any mechanics: check the input, read the noise floor, go through the channels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sioms.reconcile.calibrate import calibrated
from sioms.reconcile.channels import Finding, index_fit, index_scale, lattice
from sioms.reconcile.checks import check
from sioms.reconcile.contradictions import check_law, usable
from sioms.reconcile.controlled import runs_the_loop
from sioms.reconcile.current import Law, drive, speeds
from sioms.reconcile.effects import library
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.experiment import Envelope
from sioms.reconcile.fit import SKIP, SKIP_S, Mapper, Problem, block_ids
from sioms.reconcile.imposed import carried
from sioms.reconcile.locked import INTERPOLATION, read_right
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import drive_noise, moves_at, observer, sensor_noise
from sioms.reconcile.polled import evened
from sioms.reconcile.rate import trusted_blindly
from sioms.reconcile.records import Session
from sioms.reconcile.refine import bounded
from sioms.reconcile.sampling import Sampling, read_as, sampling_of, trusted
from sioms.reconcile.scale import check_scale
from sioms.reconcile.timed import Timed, as_recorded, known_beside
from sioms.reconcile.timing import on_grid

#: Share at the end of every record that takes no part in any choice.
UNTOUCHED = 0.2
#: How much a sample counts goes by the noise, and the noise by how much each counts: so often.
TRUSTED = 2
#: What a little wrong in time would be named.
TIMES = ("delay", "lag")
#: Half a period of the loop, in samples of the log, above which the log has its pace.
OWN_PACE = 0.49
#: What a refined number of the model would be named as.
REFITTED = {"inertia": "payload", "viscous": "viscous"}


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of one analysis.

    Attributes:
        seed: of permutations, bootstrap and starts.
        pictures: keep curves and localisation for the report.
        resample: seed with which the blocks of time are drawn anew, to see whether the verdict stands; None: as they
            are.
        mapper: as of ``Problem``.
        envelope: within which an experiment may be proposed; None takes it from the records.
        without: effects that are left out of the library.
    """

    seed: int = 1
    pictures: bool = True
    resample: int | None = None
    mapper: Mapper = map
    envelope: Envelope | None = None
    without: tuple[str, ...] = ()
    progress: Callable[[str], None] = field(default=lambda text: None)


def quiet(mapper: Mapper) -> Mapper:
    """Return that mapper with no warning of numbers that overflow in its trials: numpy has that setting per thread."""

    def mapped(trial: Callable[[Any], Any], over: Iterable[Any]) -> Iterable[Any]:
        return mapper(np.errstate(over="ignore", invalid="ignore")(trial), over)

    return mapped


@dataclass(frozen=True, slots=True)
class Prepared:
    """State after channels and gate, before any mechanics.

    Attributes:
        nominal: the model to be corrected, without a controller where that is not what makes the records.
        held: nobody knows but it seems that the force is held from row to row.
        points: the force is known at the rows of the log only.
        timed: forces that keep their own time, by now among the known ones of the problems' records.
        apart: the final statement is made on whole records of their own.
        blind: nothing in the records tells their sample time.
        strays: why nothing can be told of an axis with this drive; empty: it can.
    """

    nominal: AxisModel
    model: AxisModel
    problem: Problem
    final: Problem
    findings: tuple[Finding, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...]
    held: bool = False
    points: bool = False
    timed: tuple[Timed, ...] = ()
    apart: bool = False
    blind: bool = False
    strays: str = ""

    def beside(self, force: Timed) -> Prepared:
        """Take a force in time for known; records of their own have had none of it."""
        final = self.final if self.apart else known_beside(self.final, force.forces)
        return replace(self, problem=known_beside(self.problem, force.forces), final=final, timed=(*self.timed, force))


def prepare(session: Session, nominal: AxisModel, o: Options) -> Prepared:
    """Check the input, read the noise floor and go through the channels.

    Raises:
        BadInputError: the data cannot be used.
    """
    if odd := sorted(set(o.without) - set(library())):
        raise BadInputError(f"leave out effects: {', '.join(odd)} not known; known are {', '.join(sorted(library()))}")
    return replace(_prepared(session, nominal, o), blind=trusted_blindly(session, nominal))


def _prepared(session: Session, nominal: AxisModel, o: Options) -> Prepared:
    session, polled = evened(session, nominal.sample_time_s)
    session, notes = on_grid(session, nominal.sample_time_s)
    notes = [*polled, *notes]
    if nominal.imposed:
        session, nominal = carried(session, nominal)
    session, left_out = usable(session, searched(session), nominal)
    notes += left_out
    notes += check(session, nominal)
    seen, dt = searched(session), nominal.sample_time_s
    nominal = replace(nominal, swings_hz=moves_at(seen, sensor_noise(seen, nominal.resolution), dt))
    if session.final:
        check(Session(session.final), nominal)
    if polled:
        return _polled(session, nominal, notes, o)
    if session.loop_time_s is not None:
        late = 0.5 * session.loop_time_s / nominal.sample_time_s
        if late < OWN_PACE:
            return _read(session, nominal, notes, o, Sampling(late, curved=True))
        return _channels(session, nominal, notes, o)
    ready = replace(_channels(session, nominal, notes, o), held=not runs_the_loop(session, nominal))
    if (other := reread(ready, ready.model, (), o)) is not None:
        return other
    check_law(searched(session), nominal)
    return ready


def _polled(session: Session, nominal: AxisModel, notes: Sequence[str], o: Options) -> Prepared:
    """Prepare records whose rows were interpolated: their force is known at the instants of the rows, no controller can
    be followed from one to the next, and what is late or early by a part of a step does not show.
    """
    nominal = replace(nominal, controller=None)
    if session.loop_time_s is not None:
        sampling = Sampling(0.5 * session.loop_time_s / nominal.sample_time_s)
    else:
        plain = _channels(session, nominal, notes, o)
        sampling = sampling_of(plain.problem, plain.model) or Sampling(0.0)
        sampling = Sampling(0.0) if sampling.late is None else sampling
        notes = [*notes, sampling.text(nominal.sample_time_s)]
    ready = _read(session, nominal, notes, o, sampling)
    return replace(ready, names=tuple(n for n in ready.names if n not in TIMES and not _between_rows(n)))


def _between_rows(name: str) -> bool:
    """Say whether an effect is over before the next row: a gap that is passed, friction that builds up."""
    mechanism = library()[name].mechanism
    return mechanism.bounces or mechanism.builds_up


def reread(ready: Prepared, model: AxisModel, frozen: Sequence[str], o: Options) -> Prepared | None:
    """Prepare anew where, beside what a model explains, the force is not what is held from row to row; None: it is, or
    is known to be.
    """
    if not ready.held:
        return None
    problem = replace(ready.problem, session=as_recorded(ready.problem, ready.timed).session)
    sampling = sampling_of(problem, model, frozen)
    if sampling is None:
        return None
    notes = [*ready.notes, sampling.text(model.sample_time_s)]
    other = _read(problem.session, ready.nominal, notes, o, replace(sampling, curved=True))
    return replace(other, names=tuple(n for n in other.names if n not in TIMES), blind=ready.blind)


def _read(session: Session, nominal: AxisModel, notes: Sequence[str], o: Options, sampling: Sampling) -> Prepared:
    """Prepare with the force read otherwise; the controller has made none of it row by row."""
    points = sampling.late is not None
    return _channels(read_as(session, sampling), replace(nominal, controller=None), notes, o, points)


def _channels(session: Session, nominal: AxisModel, notes: Sequence[str], o: Options, points: bool = False) -> Prepared:
    """Read the noise floor and go through the channels.

    Args:
        points: between the rows of the log the force is not known for certain.
    """
    o.progress("channels: sensor, then drive")
    seen = searched(session)
    findings: list[Finding] = []
    model = bounded(nominal)
    coarse = lattice(seen, nominal)
    scale = index_scale(seen, nominal)
    findings += [f for f in (coarse, scale) if f is not None]
    driven, strays = drive(seen, nominal)
    findings += driven
    for f in findings:
        model = model.with_effect(f.effect, dict(f.values))
    factor = coarse.values["factor"] if coarse is not None else 1.0
    law, dt = Law.of(driven), nominal.sample_time_s
    noise = observer(
        nominal,
        sensor_noise(seen, nominal.resolution * factor),
        drive_noise(seen, nominal.rated_force, lambda r: law.output(r.force, dt, speeds(r, dt))),
    )
    skip = max(SKIP, round(SKIP_S / nominal.sample_time_s))
    problem = Problem(session, noise, skip, end=1.0 if session.final else 1.0 - UNTOUCHED, mapper=quiet(o.mapper))
    if not nominal.imposed:  # the inertia is as large as fits
        notes = list(dict.fromkeys([*notes, *check_scale(problem, nominal)]))
    problem = noise_read(problem, model)
    for _ in range(TRUSTED if points else 0):
        problem = noise_read(trusted(problem, model), model)
    excluded = {"encoder_quantisation"} | {REFITTED[s] for s in nominal.refine if s in REFITTED}
    if index_fit(seen, nominal) is not None:
        excluded.add("encoder_scale")
    if any(r.force_measured is not None for r in session.records):
        excluded |= {"delay", "lag", "slew_limit", "saturation", "supply_limit"}
    excluded |= set(o.without)
    names = tuple(n for n, e in library().items() if e.rankable and nominal.applicable(e) and n not in excluded)
    final = replace(problem, begin=1.0 - UNTOUCHED, end=1.0)
    if session.final:
        final = replace(final, session=Session(session.final, continuous=False), begin=0.0)
        final = trusted(final, model) if points else final
    if o.resample is not None:
        problem = _resampled(problem, model, o.resample)
    return Prepared(
        nominal,
        model,
        problem,
        final,
        tuple(findings),
        names,
        tuple(notes),
        points=points,
        apart=bool(session.final),
        strays=strays,
    )


def searched(session: Session) -> Session:
    """Return the samples on which choices are made: all but the last part of every record, or all where whole records
    are kept apart.
    """
    if session.final:
        return session
    return replace(session, records=tuple(r.cut(0, int((1.0 - UNTOUCHED) * len(r))) for r in session.records))


def noise_read(problem: Problem, model: AxisModel) -> Problem:
    """Return the problem with the noise that its own samples show, and none after them."""
    records = tuple(r.cut(0, problem.span(r).stop) for r in problem.session.records)
    own = replace(problem, session=replace(problem.session, records=records), end=1.0)
    if INTERPOLATION in model.effects:  # which had been taken for noise
        coarse = model.effects.get("encoder_quantisation", {}).get("factor", 1.0)
        sensor = sensor_noise(read_right(own.session, model), model.resolution * coarse)
        own = replace(own, noise=observer(model, sensor, own.noise.drive))
    return replace(problem, noise=calibrated(own, own.session, model).noise)


def _resampled(problem: Problem, model: AxisModel, seed: int) -> Problem:
    """Draw the blocks of time anew with replacement, as weights."""
    ids = block_ids(problem, model.sample_time_s)
    count = int(ids.max()) + 1
    times = np.bincount(np.random.default_rng(seed).integers(0, count, count), minlength=count)
    return replace(problem, weights=np.sqrt(times.astype(np.float64))[ids])
