"""From what a search ended with to a verdict: figures on untouched samples, intervals, evidence, what to say and to do
next.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom

from sioms.reconcile.ambiguity import Rival, lookalikes
from sioms.reconcile.axis_verdict import AxisVerdict, Trace
from sioms.reconcile.bounces import deepest, rattles
from sioms.reconcile.controlled import foreign
from sioms.reconcile.disturbance import disturbance
from sioms.reconcile.effect import Array, Over
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import CONSTANT, LAWS, OPPOSING, SIDE
from sioms.reconcile.engine.evidence import alternative, outcome
from sioms.reconcile.evidence import describe, spans_of
from sioms.reconcile.excitation import Gate
from sioms.reconcile.experiment import Envelope, Experiment, separate
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.floor import ON_MODEL, closed_floor
from sioms.reconcile.free import freely
from sioms.reconcile.gaps import free_gaps, measure, rungs, session_states
from sioms.reconcile.judge import Judgement, judge
from sioms.reconcile.locate import Spectrum, locate, spectra
from sioms.reconcile.locked import locked
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.opposing import at_rest, friction_told, likened
from sioms.reconcile.plausible import leans
from sioms.reconcile.prepare import TIMES, Options, Prepared, searched
from sioms.reconcile.rate import SAMPLE_TIME, instead, remark
from sioms.reconcile.records import Session
from sioms.reconcile.refine import runs_away
from sioms.reconcile.refuse import loud_turns
from sioms.reconcile.search import Found, Searcher
from sioms.reconcile.session import State
from sioms.reconcile.simulate import replay
from sioms.reconcile.thresholds import (
    AXIS,
    BURSTS,
    CHANCE,
    DWARFED,
    LARGE,
    LOCKED,
    LOUD,
    MISSED,
    MOSTLY,
    MOSTLY_LOCKED,
    PLACES_A_PERIOD,
    QUIET,
    REFUTED,
    REMAINS,
    UNEXPLAINED,
)
from sioms.reconcile.timed import as_recorded
from sioms.reconcile.uneven import Uneven, uneven
from sioms.reconcile.variation import named as varied
from sioms.reconcile.verdict import Candidate, Gap, NamedEffect, Outcome, Place

HELD = (
    "delay and lag are counted from a force that is held from row to row of the log; of a loop much faster than the "
    "log they are up to {:.2g} ms longer (loop_time_s in columns.toml would tell)"
)
#: What another drive is called among the alternatives, and what is said of it.
OTHER_LAW = "another_law_of_the_drive"
OF_DRIVE = "measured and commanded force do not tell {} from another law of the drive"
TO_TELL = "{} would be told from {} by {}, with less noise of the force"
AT_REST = (
    "the level of Coulomb friction is that of all friction, extrapolated to rest; in model.toml a law without a name "
    "has a part of it"
)
#: Steps of the last fit.
LAST = 12
#: The effect that another sample time looks like.
PAYLOAD = "payload"
#: Why an effect of the model is no finding.
REFUSED_FREE = "the model with it does not move as the machine did"
REFUSED_BEYOND = "too much remains beside it for a part to be told"
REFUSED_IDLE = "held-out samples are met as well without it: it may stand for a part of what remains"
REFUSED_SMALL = "beside a formula without a name that explains far more it may be what that formula lacks"
REFUSED_BOUND = "a number of it is at the end of what it can be: it stands for something else"
REFUSED_UNEVEN = "its numbers are not the same everywhere, they change with {}: its law is another one"
REFUSED_ALIKE = "the law of what it looks like is another one, and it may make up for that"


@dataclass(frozen=True, slots=True)
class Searched:
    """What a search ended with.

    Attributes:
        share: that a generic smoother explains of what remains.
        rejected: effects that left when nameless terms came in.
    """

    ready: Prepared
    excited: Gate
    searcher: Searcher
    found: Found
    share: float
    rejected: tuple[str, ...]


def conclude(s: Searched, o: Options, others: Sequence[Rival], burst: float) -> AxisVerdict:
    """Conclude.

    Args:
        others: look-alikes in the place of what was found.
        burst: share of the residual's energy above the quiet level that lies in its loudest tenths of a second.
    """
    ready, found, nominal = s.ready, s.found, s.ready.nominal
    rng = np.random.default_rng(o.seed)
    o.progress("untouched samples: gap before and after")
    states = session_states(ready.final, found.fit.model)
    gaps, judged = _gaps(s, states, rng)
    whole = replace(ready.problem, end=1.0, weights=None)
    fit, *others_as_deep = _last(whole, s, rng)
    spans = spans_of(whole, fit, others_as_deep)
    ends = [(float(r.position.min()), float(r.position.max())) for r in ready.problem.session.records]
    travel = max(high for _, high in ends) - min(low for low, _ in ends)
    told = describe(ready.findings, fit, found, s.searcher, others, spans, rng)
    named, terms = formulas(*told, travel / nominal.pitch, {n for force in ready.timed for n in force.beside})
    terms += [force.term for force in ready.timed]
    open_rivals = [r for r in others if r.open]
    ratio = found.fit.ratio
    disturbance = ratio > QUIET and burst > BURSTS and s.share < UNEXPLAINED and not rattles(found.fit.model)
    odd = ratio > AXIS.odd and s.share > UNEXPLAINED
    leaning = [e for e in named if e.name not in s.searcher.frozen and leans(fit.model, e.name)]
    beyond = ratio > (LARGE if named or terms or ready.points else LOUD)
    if runs_away(found.fit.model):
        judged = replace(judged, refusals=(*judged.refusals, _of_inertia(nominal, found.fit.model)))
    if ready.strays:
        judged = replace(judged, refusals=(*judged.refusals, ready.strays))
    missing = bool(terms) or bool(leaning) or disturbance or beyond or odd or bool(judged.refusals)
    # what makes the force is a part of the model, too: with none of its mechanics missing it is not right
    missing = missing or (not named and foreign(searched(ready.problem.session), nominal))
    blindly = ready.blind and any(e.name == PAYLOAD for e in named)
    wave = locked(ready.problem, found.fit)
    missing = missing or (wave is not None and wave.share > (MOSTLY_LOCKED if named else LOCKED))
    changing = [] if missing else _changing(s, named)
    missing = missing or bool(changing)
    drives = [f.effect for f in ready.findings if f.doubted]
    said = outcome(bool(named), missing, bool(open_rivals) or blindly or bool(drives))
    gaps = tuple(_told(g, said is Outcome.UNEXPLAINED) for g in gaps)
    notes = [*ready.notes, *judged.notes, *judged.refusals]
    notes += [f"{e.title} leans on the end of what it can be: it stands for something else" for e in leaning]
    if ready.held and any(e.name in TIMES for e in named):
        notes.append(HELD.format(0.5e3 * fit.model.sample_time_s))
    if wave is not None:
        notes.append(wave.text)
    if disturbance:
        notes.append(_of_bursts(ready.problem, found.fit, burst))
    elif beyond or (ratio > LOUD and not (ready.points or rattles(found.fit.model))):
        notes.append(_of_much(ratio, s.share))
    if not judged.refusals:
        notes += likened(s.searcher, found)
        if any(e.name in OPPOSING for e in terms):
            notes += [text for text in (friction_told(whole, fit),) if text]
            named = [_at_rest(e, whole, fit, notes) for e in named]
    notes += [_of_change(known()[c.effect].title, c, ratio) for c in changing]
    if ready.blind:
        notes.insert(0, remark(nominal))
    tried = refused(named, leaning, bool(judged.refusals), beyond)
    tried += another_law(named, changing)
    if judged.refusals:
        tried += tuple(Candidate(e.name, e.title, REFUSED_FREE) for e in terms if e.name in fit.model.effects)
    elif said is Outcome.UNEXPLAINED and not rattles(fit.model):
        tried += _idle(s, (*named, *terms), tried)
        small = [e for e in named if e.name not in s.searcher.frozen and dwarfed(e, terms)]
        gone = {c.name for c in tried}
        tried += tuple(Candidate(e.name, e.title, REFUSED_SMALL) for e in small if e.name not in gone)
    terms = [e for e in terms if e.name not in {c.name for c in tried}]
    found_here = [e for e in named if e.name not in {c.name for c in tried}]
    others_said = _alternatives(fit.model, found_here, open_rivals, blindly) if said is Outcome.AMBIGUOUS else ()
    if drives and said is Outcome.AMBIGUOUS:
        others_said = (*others_said, tuple(OTHER_LAW if e.name in drives else e.name for e in found_here))
        notes.append(OF_DRIVE.format(" and ".join(e.title for e in found_here if e.name in drives)))
    if blindly:
        found_here = [_rated(e, nominal, fit.model) for e in found_here]
    open_now = open_rivals if said is Outcome.AMBIGUOUS else []
    if nominal.imposed:  # no command is designed for a rig
        notes += [
            TO_TELL.format(*(known()[n].title for n in (r.effect, r.rival)), known()[r.rival].separate)
            for r in open_now
        ]
    searched_for = [e for e in found_here if e.name not in s.searcher.frozen]
    # beside a gap the remainder is of bounces, which no other effect can be
    doubtful = [] if rattles(found.fit.model) else [e.name for e in searched_for if doubted(e, ratio)]
    if doubtful and said in (Outcome.NAMED, Outcome.AMBIGUOUS):
        said = Outcome.AMBIGUOUS
        others_said = (*others_said, tuple(e.name for e in found_here if e.name not in doubtful))
        notes.append(_of_doubts([e.title for e in found_here if e.name in doubtful]))
    places, spectrum, traces = _pictures(ready, nominal, found.fit.model, o, rng)
    return AxisVerdict(
        outcome=said,
        nominal=nominal,
        model=as_stated(fit.model, nominal) if judged.refusals else fit.model,
        effects=tuple(found_here),
        candidates=tried,
        alternatives=others_said,
        symbolic=tuple(terms),
        gaps=gaps,
        ladder=found.ladder,
        rungs=rungs(ready.final, [step.model for step in found.ladder]),
        findings=ready.findings,
        missing=s.excited.missing,
        pairs=s.excited.pairs,
        places=places,
        spectra=spectrum,
        decisive=_plan(ready, o, fit.model, open_now) if open_now else None,
        ratio=ratio,
        smoother_share=s.share,
        burst_share=burst,
        effective_samples=effective_samples(found.fit.residual),
        samples=len(found.fit.residual),
        notes=tuple(notes),
        traces=traces,
        states=tuple((r.name, q) for r, q in zip(ready.final.session.records, states, strict=True)),
        rejected=s.rejected,
        others=tuple(q.fit.model.effects for q in open_now),
    )


def _changing(s: Searched, named: Sequence[NamedEffect]) -> list[Uneven]:
    """Return what is named whose numbers are not the same everywhere; beside a gap the remainder is of bounces."""
    fit = s.found.fit
    if s.searcher.done(fit) or rattles(fit.model):
        return []
    return uneven(s.ready.problem, fit, [e.name for e in named if e.name not in s.searcher.frozen])


def another_law(named: Sequence[NamedEffect], changing: Sequence[Uneven]) -> tuple[Candidate, ...]:
    """Refuse the names whose numbers change, and those that look like them."""
    why = {c.effect: REFUSED_UNEVEN.format(c.variable) for c in changing}
    alike = {other for name in why for other in lookalikes(name)}
    return tuple(
        Candidate(e.name, e.title, why.get(e.name, REFUSED_ALIKE)) for e in named if e.name in alike.union(why)
    )


def _of_change(title: str, change: Uneven, ratio: float) -> str:
    return (
        f"{title}: what remains is {ratio:.2g} times what noise would leave, and {100 * change.share:.0f} % of it are "
        f"explained where its numbers change with {change.variable}; its law is another one"
    )


def doubted(effect: NamedEffect, ratio: float) -> bool:
    """Say whether an effect explains less than what remains above the noise: it may have taken a part of that.

    Args:
        ratio: of what remains to the noise.
    """
    explained = ratio**2 * effect.saved / max(1.0 - effect.saved, 1e-300)
    return ratio > AXIS.floor and explained < REMAINS * (ratio**2 - 1.0)


def dwarfed(effect: NamedEffect, terms: Sequence[NamedEffect]) -> bool:
    """Say whether an effect explains so much less than a nameless term beside it that it may be an error of its form.

    Both in units of what remains.
    """
    explained, most = (
        max((e.saved / max(1.0 - e.saved, 1e-300) for e in group), default=0.0) for group in ([effect], terms)
    )
    return explained < DWARFED * most


def _of_doubts(titles: Sequence[str]) -> str:
    return (
        f"{' and '.join(titles)}: less is explained by it than remains above the noise, so it may be a part of what "
        "remains; the model without it is as likely"
    )


def formulas(
    named: Sequence[NamedEffect], terms: Sequence[NamedEffect], pitches: float = 0.0, changing: Collection[str] = ()
) -> tuple[list[NamedEffect], list[NamedEffect]]:
    """Take its name from an effect beside which a nameless term of the same variable stands: together they are one law
    of that variable, of which nobody can tell how much the effect is; so are a constant and a law without a zero of its
    own, and a force that repeats along the travel, but so seldom that a law could be what makes it.

    Args:
        pitches: travel of the records.
        changing: what may be a part of a number that changes in time.

    Returns:
        What is named, and the formulas without a name.
    """
    beside = {t.name for t in terms}
    laws = [law for law in LAWS if beside & {law.name, *law.replaces}]
    within = {n for law in laws for n in (*law.replaces, CONSTANT.get(law.name, ""))} | set(changing)
    if any(law.over is Over.PLACE for law in laws):
        within |= {e.name for e in named if _seldom(e, pitches)}
    parts = [replace(e, title=e.equation) for e in named if e.name in within]
    return [e for e in named if e.name not in within], [*terms, *parts]


def _seldom(effect: NamedEffect, pitches: float) -> bool:
    """Say whether a force repeats along the travel, but with a period no shorter than what a smooth law shows."""
    orders = [q.symbol for q in known()[effect.name].parameters if q.fixed and q.unit == "1/pitch"]
    periods = [pitches * value.value for value in effect.parameters if value.symbol in orders]
    return bool(periods) and 2.0 * SIDE / max(periods[0], 1e-300) >= PLACES_A_PERIOD


def refused(
    named: Sequence[NamedEffect], leaning: Sequence[NamedEffect], freely_refused: bool, beyond: bool
) -> tuple[Candidate, ...]:
    """Return what is in the model without being found: all of it where the model is refused, else what leans."""
    if freely_refused:
        return tuple(Candidate(e.name, e.title, REFUSED_FREE) for e in named)
    if beyond:
        return tuple(Candidate(e.name, e.title, REFUSED_BEYOND) for e in named)
    return tuple(Candidate(e.name, e.title, REFUSED_BOUND) for e in leaning)


def _idle(s: Searched, every: Sequence[NamedEffect], tried: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return what the untouched samples do not need: beside a remainder it may have taken a part of that."""
    model, frozen = s.found.fit.model, s.searcher.frozen
    kept = {*frozen, *(c.name for c in tried)}
    looked = [e for e in every if e.name in model.effects and e.name not in kept]
    both = s.ready.problem, s.ready.final
    return tuple(Candidate(e.name, e.title, REFUSED_IDLE) for e in looked if not needed(both, model, e.name, frozen))


def needed(problems: tuple[Problem, Problem], model: AxisModel, name: str, frozen: Sequence[str] = ()) -> bool:
    """Say whether untouched samples are met worse without an effect.

    Args:
        problems: the samples that were searched, to which what is left is fitted again, and the untouched ones.
    """
    bare = refit(problems[0], varied(model.without_effect(name)), frozen, 4).model
    left, more = (float(np.sum(problems[1].residual(m) ** 2)) for m in (model, bare))
    return more > (1.0 + MISSED) * left


def as_stated(model: AxisModel, nominal: AxisModel) -> AxisModel:
    """Give the numbers back that were refined: those of a refused model are no findings either."""
    return replace(model, **{symbol: getattr(nominal, symbol) for symbol in nominal.refine})


def _of_inertia(nominal: AxisModel, model: AxisModel) -> str:
    return (
        f"the inertia, refined, comes to {model.inertia / nominal.inertia:.3g} times the stated one, the end of what "
        "is tried: with it the model hardly listens to its force, and stands for something else"
    )


def _alternatives(
    model: AxisModel, found: Sequence[NamedEffect], rivals: Sequence[Rival], blindly: bool
) -> tuple[tuple[str, ...], ...]:
    """Return the sets of names that explain as well; a payload may be another sample time where nothing tells that."""
    sets = [alternative(r, model.effects) for r in rivals]
    if blindly:
        sets.append(tuple(SAMPLE_TIME if e.name == PAYLOAD else e.name for e in found))
    return tuple(sets)


def _at_rest(e: NamedEffect, whole: Problem, fit: Fit, notes: list[str]) -> NamedEffect:
    """Give Coulomb friction beside a law without a name the level that friction has when extrapolated to rest: how much
    of it the law takes is a convention.
    """
    if e.name != "coulomb" or (told := at_rest(whole, fit)) is None:
        return e
    (level, *rest), (value, half) = e.parameters, told
    level = replace(level, value=value, low=value - half, high=value + half)
    notes.append(AT_REST)
    return replace(e, parameters=(level, *rest))


def _rated(e: NamedEffect, nominal: AxisModel, model: AxisModel) -> NamedEffect:
    """Tell beside a payload which sample time would do the same."""
    if e.name != PAYLOAD:
        return e
    return replace(e, evidence=(*e.evidence, instead(nominal, model.effects[PAYLOAD]["J_extra"])))


def _gaps(s: Searched, states: Sequence[State], rng: np.random.Generator) -> tuple[tuple[Gap, ...], Judgement]:
    """Measure the gaps, and judge the model by its free run; before, nothing was known of a force in time."""
    ready, nominal, model = s.ready, s.ready.nominal, s.found.fit.model
    noise = disturbance(ready.problem, model, s.share)
    floor = closed_floor(ready.final, model, noise, rng)
    plain = ready.final if ready.apart else as_recorded(ready.final, ready.timed)
    gaps = measure(ready.final, nominal, model, floor, states)
    if ready.timed and not ready.apart:
        before = measure(plain, nominal, nominal, floor)
        gaps = tuple(replace(g, before=p.before) for g, p in zip(gaps, before, strict=True))
    free = freely((plain, ready.final), (nominal, model), noise, rng)
    if nominal.imposed:  # small forces that are wrong add up in a motion that they do not make
        free = tuple(f for f in free if np.isfinite(f.horizon_s))
        return gaps, judge(ready.final, model, free, gaps, noise.size)
    judged = judge(ready.final, model, free, gaps, noise.size)
    return (*gaps, *free_gaps(free, nominal.position_unit)), judged


def _told(gap: Gap, missing: bool) -> Gap:
    """Take no floor for known that is refuted by what is left, or that holds what is missing."""
    read_off = gap.floor_from == ON_MODEL
    refuted = gap.after < REFUTED * gap.floor if read_off and not missing else missing and gap.after <= gap.floor
    return replace(gap, floor=np.nan) if refuted or (read_off and missing) else gap


def _last(problem: Problem, s: Searched, rng: np.random.Generator) -> tuple[Fit, ...]:
    """Fit once more to all samples; beside a gap the fits from elsewhere come after it."""
    model = s.found.fit.model
    if rattles(model):
        return deepest(problem, model, s.searcher.frozen, rng)
    fit = refit(problem, model, s.searcher.frozen, LAST)
    worse = fit.cost > float(np.sum(problem.residual(model) ** 2))
    return (replace(fit, model=model) if worse else fit,)


def _pictures(
    ready: Prepared, nominal: AxisModel, model: AxisModel, o: Options, rng: np.random.Generator
) -> tuple[tuple[Place, ...], tuple[Spectrum, Spectrum] | None, tuple[Trace, ...]]:
    """Localise the disagreement, and keep curves, if pictures are wanted.

    The places are of the samples on which the search was made; the curves show the records on which the gap is
    measured, by the
    models that it is measured of: those to which the untouched samples have contributed nothing.
    """
    if not o.pictures:
        return (), None, ()
    o.progress("locating the disagreement")
    plain = as_recorded(ready.problem, ready.timed)
    places = tuple(locate(plain, nominal, rng))
    before = ready.final if ready.apart else as_recorded(ready.final, ready.timed)
    return places, spectra(plain, nominal), _traces((before, ready.final), (nominal, model))


def _of_much(ratio: float, share: float) -> str:
    ordered = (
        f"the state of the axis orders {100 * share:.0f} % of it, in no form that is known"
        if share > UNEXPLAINED
        else "no state of the axis orders it"
    )
    return f"what remains is {ratio:.1f} times what noise would leave; {ordered}"


def _of_bursts(problem: Problem, fit: Fit, burst: float) -> str:
    """Say what bursts of the residual are, as far as that shows."""
    text = f"the residual comes in bursts ({100 * burst:.0f} % of its energy in a tenth of the time)"
    turning, loud, usual = loud_turns(problem, fit)
    if turning > MOSTLY * loud and binom.sf(turning - 1, loud, usual) < CHANCE:
        return (
            f"{text}, {turning} of {loud} where the motion turns, starts or stops (which is {100 * usual:.0f} % of the "
            "time): play, presliding or stick-slip in a form that no effect of the library has, rather than a "
            "disturbance from outside"
        )
    return f"{text} that no state of the axis orders: a disturbance from outside, not an effect"


def _plan(ready: Prepared, o: Options, model: AxisModel, open_rivals: Sequence[Rival]) -> Experiment | None:
    """Choose the experiment that separates the model from its open rivals."""
    envelope = o.envelope or _seen(ready.problem.session, model)
    return separate([model, *(q.fit.model for q in open_rivals)], envelope, ready.problem.noise.drive)


def _seen(session: Session, model: AxisModel) -> Envelope:
    """Take the travel that the records show, on a rotary axis a little more than a pitch to either side at least."""
    centre = float(session.records[0].position[0])
    reach = max(float(np.max(np.abs(r.position - centre))) for r in session.records)
    return Envelope.of(model, centre, max(reach, 1.1 * model.pitch) if model.rotary else reach)


def _traces(problems: tuple[Problem, Problem], models: tuple[AxisModel, AxisModel]) -> tuple[Trace, ...]:
    """Keep force curves for the pictures, before and after: in closed loop where it can be, else what short windows
    leave.
    """
    curves: list[list[Array]] = []
    for problem, model in zip(problems, models, strict=True):
        unit, heat = problem.noise.drive / problem.noise.innovation, 0.0
        own: list[Array] = []
        for r, tracked in zip(problem.session.records, problem.runs(model), strict=True):
            if model.controller is None or r.command is None:
                left = r.force + tracked.innovation * unit
                left[: problem.skip] = np.nan  # in which the observer finds the state
                own.append(left)
                continue
            run = replay(model, r, heat)
            heat = run.end_temperature
            own.append(run.force)
        curves.append(own)
    dt = models[0].sample_time_s
    return tuple(
        Trace(
            r.name,
            np.arange(len(r), dtype=np.float64) * dt,
            r.force,
            before,
            after,
            int(problems[0].begin * len(r)) * dt,
        )
        for r, before, after in zip(problems[0].session.records, *curves, strict=True)
    )
