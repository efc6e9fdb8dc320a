"""The workflow for a motor axis: locate, name, add, show, refuse.

``analyse`` takes records and a nominal model and returns a ``Verdict``. It is deterministic by ``seed`` and
reads and writes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import binom

from sioms.reconcile.ambiguity import Rival, settle
from sioms.reconcile.blocks import better, block_ids
from sioms.reconcile.calibrate import calibrated
from sioms.reconcile.channels import (
    Finding,
    drive,
    drive_output,
    index_fit,
    index_scale,
    lattice,
    with_resolution,
)
from sioms.reconcile.checks import check, check_scale
from sioms.reconcile.effect import Array
from sioms.reconcile.effects import library
from sioms.reconcile.effects.terms import TERMS
from sioms.reconcile.evidence import describe, spans_of
from sioms.reconcile.excitation import Gate, gate
from sioms.reconcile.experiment import Envelope, Experiment, separate
from sioms.reconcile.fit import SKIP, SKIP_S, Fit, Mapper, Problem, refit
from sioms.reconcile.gaps import measure, rungs, session_states
from sioms.reconcile.locate import Place, Spectrum, locate, spectra
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import drive_noise, effective_samples, observer, sensor_noise
from sioms.reconcile.records import Session
from sioms.reconcile.refuse import bursts, loud_turns, smoother_share
from sioms.reconcile.rules import SPECIFIC, SURE
from sioms.reconcile.search import Found, Searcher, Step, rattles
from sioms.reconcile.simulate import replay
from sioms.reconcile.timing import on_grid
from sioms.reconcile.tones import Tone, as_term, hum, known_beside
from sioms.reconcile.verdict import Outcome, Trace, Verdict

#: Share at the end of every record that takes no part in any choice.
UNTOUCHED = 0.2
#: A generic smoother explaining this share more than the named model: something is missing.
UNEXPLAINED = 0.2
#: Loudest tenth of the time holds this share of the residual's energy: bursts.
BURSTS = 0.8
#: A residual beyond this multiple of the expected innovation is no noise, whatever it looks like. (The bounces in a gap leave more.)
LARGE = 3.0
#: Above this multiple, and with this share of the disagreement left, nothing is named at all.
HOPELESS, HALF = 5.0, 0.33
#: So large a share of the bursts at turns of the motion belongs to them, if chance brings it no oftener than this.
MOSTLY, CHANCE = 0.5, 0.01
#: Below these multiples of the expected innovation nothing is called unexplained, or a burst.
LEAST_ODD = 1.25
QUIET = 1.6
#: Above this multiple a nameless term is looked for, though no smoother explains anything (a bend in force is no function of motion).
LOUD = 1.4
#: The noise is taken again from what a search leaves, and the search repeated, when it fell below this share; so often.
FELL, AGAIN = 0.7, 2


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
        tones: forces of one frequency in time, by now among the known ones of the problems' records.
    """

    model: AxisModel
    problem: Problem
    final: Problem
    findings: tuple[Finding, ...]
    names: tuple[str, ...]
    notes: tuple[str, ...]
    tones: tuple[Tone, ...] = ()


def analyse(session: Session, nominal: AxisModel, options: Options | None = None) -> Verdict:
    """Find what the nominal model lacks.

    Args:
        session: recordings of one axis, in order.
        nominal: the model to be corrected; effects already in it may be re-estimated and may leave. A resolution of zero
            is the smallest step of the recorded position.

    Returns:
        The verdict with its evidence.

    Raises:
        BadInputError: the data cannot be used.
    """
    o = options or Options()
    nominal = with_resolution(nominal, session)
    ready = prepare(session, nominal, o)
    ready, excited, searcher, found = _search(ready, o)
    share = smoother_share(ready.problem, found.fit)
    rejected: tuple[str, ...] = ()
    odd = found.fit.ratio > LEAST_ODD and share > UNEXPLAINED
    if odd:
        o.progress(f"a smoother explains {100 * share:.0f} % of what remains: searching for a term")
        before = found
        found = _run_with_terms(searcher, ready.model)
        rejected = tuple(n for n in before.fit.model.effects if n not in found.fit.model.effects)
        share = smoother_share(ready.problem, found.fit)
    elif found.fit.ratio > LOUD and not rattles(found.fit.model) and _promising(searcher, ready.model, found):
        o.progress(f"{found.fit.ratio:.1f} times what is expected remains: searching for a term")
        other = _run_with_terms(searcher, ready.model)
        gain, sure = better(other.losses, found.losses)
        if gain > SPECIFIC and sure > SURE:
            found, share = other, smoother_share(ready.problem, other.fit)
    large = found.fit.ratio > LARGE and not rattles(found.fit.model)
    if large or (found.fit.ratio > LEAST_ODD and share > UNEXPLAINED):
        found = searcher.plainly(found)
    burst = bursts(ready.problem, found.fit)
    hopeless = found.fit.ratio > HOPELESS and found.fit.cost > HALF * searcher.fit(ready.model).cost
    if hopeless:
        # Names given to half of nothing mislead: the model, or a column, belongs to something else.
        fit = searcher.fit(ready.model)
        found = replace(found, fit=fit, losses=searcher.loss(fit))
        note = (
            f"whatever is added, {found.fit.ratio:.0f} times what noise would leave remains: the nominal model does not match these "
            "data; are model, force and position of the same axis?"
        )
        ready = replace(ready, notes=(*ready.notes, note))
    o.progress("identifiability: look-alikes in the place of each effect")
    settled, others = settle(searcher, found, excited.pairs)
    if settled is not found:
        found, share, burst = (
            settled,
            smoother_share(ready.problem, settled.fit),
            bursts(ready.problem, settled.fit),
        )
    return _conclude(ready, nominal, o, excited, found, searcher, others, odd, share, burst, rejected)


def _terms(model: AxisModel) -> tuple[str, ...]:
    return tuple(t.name for t in TERMS if model.applicable(t))


def _promising(searcher: Searcher, model: AxisModel, found: Found) -> bool:
    """Say whether a nameless term, beside what was found or in the place of one of it, could save enough to be worth a search."""
    named = [n for n in found.fit.model.effects if n not in searcher.frozen]
    bare = [found.fit, *(searcher.fit(found.fit.model.without_effect(n), 6) for n in named)]
    left = [(1.0 - s.gain) * fit.cost for fit in bare for s in searcher.screen(fit, _terms(model))]
    return min(left, default=np.inf) < (1.0 - 0.5 * SPECIFIC) * found.fit.cost


def _run_with_terms(searcher: Searcher, model: AxisModel) -> Found:
    """Search anew with nameless terms beside the library."""
    names = searcher.names
    searcher.names = names + _terms(model)
    found = searcher.run(model)
    searcher.names = names
    return found


def _search(ready: Prepared, o: Options) -> tuple[Prepared, Gate, Searcher, Found]:
    """Search among what the records can show; the noise may look smaller under a better model: then they show more."""
    start, earlier = ready.model, tuple[Step, ...]()
    for turn in range(AGAIN + 1):
        o.progress("excitation: what can these records show")
        excited = gate(ready.problem, ready.model, ready.names)
        names = tuple(n for n in ready.names if n not in excited.missing)
        searcher = Searcher(
            ready.problem, tuple(f.effect for f in ready.findings), names, progress=o.progress
        )
        found = searcher.run(start)
        if earlier:
            found = replace(
                found,
                ladder=(*earlier, replace(found.ladder[0], action="noise read again"), *found.ladder[1:]),
            )
        if turn < AGAIN and (beside := _beside(ready, searcher, found)) is not None:
            o.progress(f"a force of {beside.frequency_hz:.3f} Hz keeps time: searching anew beside it")
            ready = replace(
                ready,
                problem=known_beside(ready.problem, beside),
                final=ready.final if ready.final.session.final else known_beside(ready.final, beside),
                tones=(*ready.tones, beside),
            )
            start, earlier = ready.model, ()
            continue
        start = found.fit.model
        anew = calibrated(ready.problem, ready.problem.session, start)
        if turn == AGAIN or anew.noise.drive > FELL * ready.problem.noise.drive:
            break
        o.progress(
            f"the noise is {anew.noise.drive / ready.problem.noise.drive:.2f} of what it seemed: searching on"
        )
        earlier = found.ladder
        final = replace(
            anew, weights=None, session=ready.final.session, begin=ready.final.begin, end=ready.final.end
        )
        ready = replace(ready, problem=anew, final=final)
    return ready, excited, searcher, found


def _beside(ready: Prepared, searcher: Searcher, found: Found) -> Tone | None:
    """Return the force of one frequency that most of what remains is, or that explains more than all that was named."""
    if found.fit.ratio < LEAST_ODD:
        return None
    fits = [found.fit, *(searcher.fit(step.model) for step in found.ladder)]
    lines = [(line, (1.0 - line.share) * f.cost) for f in fits if (line := hum(ready.problem, f)) is not None]
    best, left = min(lines, key=lambda q: q[1], default=(None, np.inf))
    return best if left < found.fit.cost else None


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
    known = {symbol: value for f in driven for symbol, value in f.values.items()}
    noise = observer(
        nominal,
        sensor_noise(session, nominal.resolution * factor),
        drive_noise(
            session,
            nominal.rated_force,
            lambda force: drive_output(
                force,
                known.get("delay", 0.0),
                known.get("tau", 0.0),
                known.get("limit", np.inf),
                nominal.sample_time_s,
            ),
        ),
    )
    skip = max(SKIP, round(SKIP_S / nominal.sample_time_s))
    problem = Problem(session, noise, skip, end=1.0 if session.final else 1.0 - UNTOUCHED, mapper=o.mapper)
    check_scale(problem, nominal)
    problem = calibrated(problem, session, model)
    refitted = {"inertia": "payload", "viscous": "viscous"}
    excluded = {"encoder_quantisation"} | {
        refitted[symbol] for symbol in nominal.refine if symbol in refitted
    }
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


def _conclude(
    ready: Prepared,
    nominal: AxisModel,
    o: Options,
    excited: Gate,
    found: Found,
    searcher: Searcher,
    others: Sequence[Rival],
    odd: bool,
    share: float,
    burst: float,
    rejected: tuple[str, ...],
) -> Verdict:
    rng = np.random.default_rng(o.seed)
    o.progress("untouched samples: gap before and after")
    states = session_states(ready.final, found.fit.model)
    gaps = measure(ready.final, nominal, found.fit.model, states)
    if ready.tones and not ready.final.session.final:
        before = measure(_as_recorded(ready.final, ready.tones), nominal, nominal)
        gaps = tuple(replace(g, before=p.before) for g, p in zip(gaps, before, strict=True))
    whole = replace(ready.problem, end=1.0, weights=None)
    fit = refit(whole, found.fit.model, searcher.frozen, 12)
    if fit.cost > float(np.sum(whole.residual(found.fit.model) ** 2)):
        fit = replace(fit, model=found.fit.model)
    spans = spans_of(whole, fit, o.replicates, rng)
    named, terms = describe(ready.findings, fit, found, searcher, others, spans, rng)
    terms += [as_term(beside, nominal) for beside in ready.tones]
    open_rivals = [r for r in others if r.open]
    gap = rattles(found.fit.model)
    disturbance = found.fit.ratio > QUIET and burst > BURSTS and share < UNEXPLAINED and not gap
    large = found.fit.ratio > LARGE and not gap
    outcome = _outcome(
        bool(named),
        bool(terms) or disturbance or large or (found.fit.ratio > LEAST_ODD and share > UNEXPLAINED),
        bool(open_rivals),
    )
    alternatives = tuple(_set(r, fit.model) for r in open_rivals) if outcome is Outcome.AMBIGUOUS else ()
    plan = _plan(ready, o, fit.model, open_rivals) if outcome is Outcome.AMBIGUOUS else None
    notes = list(ready.notes)
    if disturbance:
        notes.append(_of_bursts(ready.problem, found.fit, burst))
    elif large:
        ordered = (
            f"the state of the axis orders {100 * share:.0f} % of it, in no form that is known"
            if share > UNEXPLAINED
            else "no state of the axis orders it"
        )
        notes.append(f"what remains is {found.fit.ratio:.1f} times what noise would leave; {ordered}")
    places: tuple[Place, ...] = ()
    spectrum: tuple[Spectrum, Spectrum] | None = None
    traces: tuple[Trace, ...] = ()
    if o.pictures:
        o.progress("locating the disagreement")
        plain = _as_recorded(whole, ready.tones)
        places = tuple(locate(plain, nominal, rng))
        spectrum = spectra(plain, nominal)
        traces = _traces((plain, whole), (nominal, fit.model))
    return Verdict(
        outcome,
        nominal,
        fit.model,
        tuple(named),
        alternatives,
        tuple(terms),
        gaps,
        found.ladder,
        rungs(ready.final, [s.model for s in found.ladder]),
        ready.findings,
        excited,
        places,
        spectrum,
        plan,
        found.fit.ratio,
        share,
        burst,
        effective_samples(found.fit.residual),
        len(found.fit.residual),
        tuple(notes),
        traces,
        tuple((r.name, s) for r, s in zip(ready.final.session.records, states, strict=True)),
        rejected,
    )


def _of_bursts(problem: Problem, fit: Fit, burst: float) -> str:
    """Say what bursts of the residual are, as far as that shows."""
    text = f"the residual comes in bursts ({100 * burst:.0f} % of its energy in a tenth of the time)"
    turning, loud, usual = loud_turns(problem, fit)
    if turning > MOSTLY * loud and binom.sf(turning - 1, loud, usual) < CHANCE:
        return (
            f"{text}, {turning} of {loud} where the motion turns, starts or stops (which is {100 * usual:.0f} % of the time): "
            "play, presliding or stick-slip in a form that no effect of the library has, rather than a disturbance from outside"
        )
    return f"{text} that no state of the axis orders: a disturbance from outside, not an effect"


def _outcome(named: bool, unexplained: bool, ambiguous: bool) -> Outcome:
    if unexplained:
        return Outcome.UNEXPLAINED
    if ambiguous:
        return Outcome.AMBIGUOUS
    return Outcome.NAMED if named else Outcome.NONE


def _set(r: Rival, model: AxisModel) -> tuple[str, ...]:
    return tuple(r.rival if n == r.effect else n for n in model.effects)


def _plan(ready: Prepared, o: Options, model: AxisModel, open_rivals: Sequence[Rival]) -> Experiment | None:
    """Choose the experiment that separates the model from its open rivals."""
    envelope = o.envelope or _seen(ready.problem.session, model)
    return separate([model, *(q.fit.model for q in open_rivals)], envelope, ready.problem.noise.drive)


def _seen(session: Session, model: AxisModel) -> Envelope:
    """Take the travel that the records show, on a rotary axis one turn at least."""
    centre = float(session.records[0].position[0])
    reach = max(float(np.max(np.abs(r.position - centre))) for r in session.records)
    return Envelope.of(model, centre, max(reach, 1.1 * model.pitch) if model.rotary else reach)


def _as_recorded(problem: Problem, tones: Sequence[Tone]) -> Problem:
    """Take the forces that keep time out of those that are known."""
    for beside in tones:
        problem = known_beside(problem, beside, -1.0)
    return problem


def _traces(problems: tuple[Problem, Problem], models: tuple[AxisModel, AxisModel]) -> tuple[Trace, ...]:
    """Keep force curves for the pictures, before and after: in closed loop where it can be, else what short windows leave."""
    curves: list[list[Array]] = []
    for problem, model in zip(problems, models, strict=True):
        unit, heat = problem.noise.drive / problem.noise.innovation, 0.0
        own: list[Array] = []
        for r, tracked in zip(problem.session.records, problem.runs(model), strict=True):
            if model.controller is None or r.command is None:
                own.append(r.force + tracked.innovation * unit)
                continue
            run = replay(model, r, heat)
            heat = run.end_temperature
            own.append(run.force)
        curves.append(own)
    return tuple(
        Trace(r.name, np.arange(len(r), dtype=np.float64) * models[0].sample_time_s, r.force, before, after)
        for r, before, after in zip(problems[0].session.records, *curves, strict=True)
    )
