"""The workflow for a motor axis: locate, name, add, show, refuse.

``analyse`` takes records and a nominal model and returns a ``Verdict``. It is deterministic by ``seed`` and
reads and writes nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sioms.reconcile.ambiguity import rivals, settle
from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.blocks import better
from sioms.reconcile.bounces import has_impacts
from sioms.reconcile.changes import change, settled
from sioms.reconcile.channels import with_resolution
from sioms.reconcile.conclude import Searched, conclude
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import LAWS
from sioms.reconcile.effects.terms import TERMS
from sioms.reconcile.excitation import Gate, gate
from sioms.reconcile.fit import refit
from sioms.reconcile.form import of_any_form
from sioms.reconcile.halves import on_halves
from sioms.reconcile.locked import INTERPOLATION, locked
from sioms.reconcile.model import AxisModel
from sioms.reconcile.plausible import leans
from sioms.reconcile.prepare import Options, Prepared, noise_read, prepare, reread, searched
from sioms.reconcile.records import Session
from sioms.reconcile.refine import ahead, loops, nearest
from sioms.reconcile.refine import settled as settled_numbers
from sioms.reconcile.refuse import bursts, smoother_share
from sioms.reconcile.search import Found, Searcher, Step
from sioms.reconcile.second import TWO_MASSES, second
from sioms.reconcile.thresholds import (
    ABOUT,
    AXIS,
    FELL,
    HALF,
    HALVED,
    HOPELESS,
    LARGE,
    LOUD,
    ROUGHLY,
    SPECIFIC,
    SURE,
    UNEXPLAINED,
)
from sioms.reconcile.timed import Timed, known_beside
from sioms.reconcile.tones import as_timed, hum
from sioms.reconcile.variation import named as varied

#: A force of any period, and its first guess over the rated one.
WAVY, GUESS = "cogging", 0.01
AGAIN = 2  # times that the noise is taken again at most


@np.errstate(over="ignore", invalid="ignore")  # a model that leaves is told by its error, not by a warning
def analyse(session: Session, nominal: AxisModel, options: Options | None = None) -> AxisVerdict:
    """Find what the nominal model of a motor axis lacks.

    Takes five seconds to a minute of one core; ``options.mapper`` may share the work out.

    Args:
        session: recordings of one axis, in order; m or rad, N or N m, s.
        nominal: the model to be corrected; effects already in it may be re-estimated and may leave. A resolution of
            zero is the smallest step of the recorded position.
        options: seed, pictures, resampling; None takes the defaults.

    Returns:
        The verdict with its evidence: ``model`` is the corrected model, ``effects`` what was named, with 95 %
        intervals, ``gaps`` the disagreement on samples that took no part in any choice.

    Raises:
        BadInputError: the data cannot be used: too short, no motion, saturated, wrong units or signs.
    """
    o = options or Options()
    ready = prepare(session, with_resolution(nominal, searched(session)), o)
    s = _explained(ready, o)
    if (other := reread(s.ready, s.found.fit.model, s.searcher.frozen, o)) is not None:
        o.progress("the force is not held from row to row: searching anew")
        s = _explained(other, o)
    for _ in range(AGAIN):
        if (force := _changed(s)) is None:
            break
        o.progress(f"{force.text}: searching anew beside it")
        s = _explained(s.ready.beside(force), o)
    s = _foreseen(_plain(_upright(s)), o)
    burst = bursts(s.ready.problem, s.found.fit)
    o.progress("identifiability: confounders in the place of each effect")
    found, others = settle(s.searcher, s.found, s.excited.pairs)
    if found is not s.found:
        s = replace(s, found=found, share=smoother_share(s.ready.problem, found.fit))
        burst = bursts(s.ready.problem, found.fit)
    if (formed := of_any_form(s.searcher, s.found)) is not s.found:
        o.progress("a smooth law does better than what is named of its variable")
        s = replace(s, found=formed, share=smoother_share(s.ready.problem, formed.fit))
        burst, others = bursts(s.ready.problem, formed.fit), rivals(s.searcher, formed, s.excited.pairs)
    verdict = on_halves(conclude(s, o, others, burst), s)
    # a log whose rows the controller has not made one by one is of an axis that has it nevertheless
    model = replace(verdict.model, controller=nominal.controller, refine=nominal.refine, within={}, swings_hz=0.0)
    if nominal.imposed:
        model = replace(model, inertia=nominal.inertia)
    return replace(verdict, model=model)


def _foreseen(s: Searched, o: Options) -> Searched:
    """Go back to where a model that runs free came nearer, and settle the refined numbers there."""
    found, searcher, problem, nominal = s.found, s.searcher, s.ready.problem, s.ready.nominal
    if has_impacts(found.fit.model) or (loops(problem, nominal) and not nominal.refine):
        return s
    o.progress("what the model predicts by itself")
    fit = settled_numbers(problem, nominal, found.fit, searcher.frozen)
    earlier = [step.model for step in found.path if not has_impacts(step.model)]
    if not loops(problem, nominal) and (plain := nearest(problem, fit.model, earlier)) is not None:
        back = settled_numbers(problem, nominal, refit(problem, plain, searcher.frozen), searcher.frozen)
        fit = back if ahead(problem, back.model) < ahead(problem, fit.model) else fit
    if not loops(problem, nominal) and TWO_MASSES in searcher.names:
        fit = second(problem, fit, s.ready.model, searcher.frozen) or fit
    if fit is found.fit:
        return s
    gone = [n for n in found.fit.model.effects if n not in fit.model.effects]
    what = ("leave", " and ".join(gone)) if gone else ("refine", " and ".join(nominal.refine))
    step = Step(*what, fit.ratio, 1.0 - fit.cost / found.fit.cost, fit.model)
    found = Found(fit, searcher.loss(fit), (*found.path, step))
    return replace(s, found=found, share=smoother_share(problem, fit), rejected=(*s.rejected, *gone))


def _upright(s: Searched) -> Searched:
    """Let effects leave that have come to lean on the end of what they can be: they stood for something else."""
    found, searcher = s.found, s.searcher
    for name in [n for n in found.fit.model.effects if n not in searcher.frozen]:
        if name in found.fit.model.effects and leans(found.fit.model, name):
            fit = searcher.fit(varied(found.fit.model.without_effect(name)), 6)
            step = Step("leave", name, fit.ratio, 1.0 - fit.cost / found.fit.cost, fit.model)
            found = Found(fit, searcher.loss(fit), (*found.path, step))
    return replace(s, found=found, share=smoother_share(s.ready.problem, found.fit)) if found is not s.found else s


def _plain(s: Searched) -> Searched:
    """Where much is unexplained take back what a searched order enriched; where nearly all is, all names."""
    ratio, searcher = s.found.fit.ratio, s.searcher
    if ratio > LARGE or (ratio > AXIS.odd and s.share > UNEXPLAINED):
        s = replace(s, found=searcher.plainly(s.found))
    ratio, bare = s.found.fit.ratio, searcher.fit(s.ready.model)
    if ratio <= HOPELESS or s.found.fit.cost <= HALF * bare.cost:
        return s
    # Names given to half of nothing mislead: the model, or a column, belongs to something else.
    note = (
        f"whatever is added, {bare.ratio:.0f} times what noise would leave remains: the nominal model does not match "
        "these data; are model, force and position of the same axis?"
    )
    found = replace(s.found, fit=bare, losses=searcher.loss(bare))
    return replace(s, ready=replace(s.ready, notes=(*s.ready.notes, note)), found=found)


def _explained(ready: Prepared, o: Options) -> Searched:
    """Search among what has a name, then, where more remains than noise leaves, with nameless terms beside it."""
    ready, excited, searcher, found = _search(ready, o)
    share = smoother_share(ready.problem, found.fit)
    rejected: tuple[str, ...] = ()
    odd = found.fit.ratio > AXIS.odd and share > UNEXPLAINED
    if odd:
        o.progress(f"a smoother explains {100 * share:.0f} % of what remains: searching for a term")
        before = found
        found = _run_with_terms(searcher, ready.model)
        share = smoother_share(ready.problem, found.fit)
        if found.fit.ratio > AXIS.odd and share > UNEXPLAINED:
            found, share = _by_laws(searcher, ready, found, share, o)
        rejected = tuple(n for n in before.fit.model.effects if n not in found.fit.model.effects)
    elif (
        found.fit.ratio > LOUD
        and not has_impacts(found.fit.model)
        and (found.fit.ratio > LARGE or _promising(searcher, ready.model, found))
    ):
        o.progress(f"{found.fit.ratio:.1f} times what is expected remains: searching for a term")
        other = _run_with_terms(searcher, ready.model)
        gain, sure = better(other.losses, searcher.loss(searcher.fit(found.fit.model)))
        if gain > SPECIFIC and sure > SURE:
            found, share = other, smoother_share(ready.problem, other.fit)
    return Searched(ready, excited, searcher, found, share, rejected)


def _changed(s: Searched) -> Timed | None:
    """Return the change in time that leaves far less than everything that was named, and than any function of the state
    could.

    What warms up may stand for it, or a gap: it is looked for beside models without. Beside what warms up by how much
    the noise is exceeded does not count.
    """
    model = s.found.fit.model
    odd = s.found.fit.ratio > AXIS.odd
    if s.ready.points or not (odd or warm(model)):  # between rows that are points, anything would pass for a change
        return None
    problem, frozen = s.ready.problem, s.searcher.frozen
    models = [m for m in (*(step.model for step in s.found.path), model) if not (warm(m) or has_impacts(m))]
    # beside a gap the searcher's fits are of residuals that are bent
    fits = [refit(problem, m, frozen) if has_impacts(model) else s.searcher.fit(m) for m in models]
    found = [(fit, course) for fit in fits if (course := change(problem, fit)) is not None]
    least = min((course.left for _, course in found), default=np.inf)
    near = [(f, settled(problem, f, c, frozen)) for f, c in found if c.left <= ROUGHLY * least]
    least = min((course.left for _, course in near), default=np.inf)
    quiet = len(s.found.fit.residual) if odd else 0
    else_left = (1.0 - s.share) * float(np.sum(problem.residual(model) ** 2))
    most = quiet + HALVED * max(else_left - quiet, 0.0)
    if least > most:
        return None
    enough = max(ABOUT * least, len(s.found.fit.residual))
    good = [(fit, course) for fit, course in near if course.left <= enough]
    fit, course = min(good, key=lambda g: len(g[0].free) + g[1].count)
    # what the windows promise the axis must keep
    kept = refit(known_beside(problem, course.forces), fit.model, frozen).cost <= most
    return course.timed(1.0 - course.left / fit.cost) if kept else None


def warm(model: AxisModel) -> bool:
    """Say whether a number changes by what the axis did before."""
    return any(known()[n].mechanism.warms for n in model.effects)


def _by_laws(searcher: Searcher, ready: Prepared, found: Found, share: float, o: Options) -> tuple[Found, float]:
    """Search with smooth laws too, where no formula is enough; they stand where they clearly save more."""
    o.progress(f"a smoother explains {100 * share:.0f} % of what the best formula leaves: searching for a law")
    other = _run_with_terms(searcher, ready.model, _laws(ready.model))
    gain, sure = better(other.losses, searcher.loss(searcher.fit(found.fit.model)))
    if gain > SPECIFIC and sure > SURE:
        return other, smoother_share(ready.problem, other.fit)
    return found, share


def _laws(model: AxisModel) -> tuple[str, ...]:
    return tuple(t.name for t in LAWS if model.applicable(t))


def _terms(model: AxisModel) -> tuple[str, ...]:
    return tuple(t.name for t in TERMS if model.applicable(t))


def _promising(searcher: Searcher, model: AxisModel, found: Found) -> bool:
    """Say whether a nameless term, beside what was found or in the place of one of it, could save enough to be worth a
    search.
    """
    named = [n for n in found.fit.model.effects if n not in searcher.frozen]
    bare = [found.fit, *(searcher.fit(found.fit.model.without_effect(n), 6) for n in named)]
    left = [(1.0 - s.gain) * fit.cost for fit in bare for s in searcher.screen(fit, _terms(model))]
    return min(left, default=np.inf) < (1.0 - 0.5 * SPECIFIC) * found.fit.cost


def _run_with_terms(searcher: Searcher, model: AxisModel, laws: tuple[str, ...] = ()) -> Found:
    """Search anew with nameless terms, and smooth laws, beside the library."""
    names = searcher.names
    searcher.names = names + _terms(model) + laws
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
        searcher = Searcher(ready.problem, tuple(f.effect for f in ready.findings), names, progress=o.progress)
        found, excited = _larger(searcher, searcher.run(start), excited)
        if earlier:
            found = replace(
                found,
                path=(*earlier, replace(found.path[0], action="noise read again"), *found.path[1:]),
            )
        if turn < AGAIN and (beside := _beside(ready, searcher, found)) is not None:
            o.progress(f"{beside.text}: searching anew beside it")
            ready = ready.beside(beside)
            start, earlier = ready.model, ()
            continue
        misread = _misread(ready, searcher, found) if turn < AGAIN else None
        start = misread or found.fit.model
        anew = noise_read(ready.problem, start)
        fell = anew.noise.drive <= FELL * ready.problem.noise.drive
        if turn == AGAIN or not (misread or fell):
            break
        what = "what is taken for noise" if misread else "the noise"
        o.progress(f"{what} is {anew.noise.drive / ready.problem.noise.drive:.2f} of what it seemed: searching on")
        earlier = found.path
        final = replace(anew, weights=None, session=ready.final.session, begin=ready.final.begin, end=ready.final.end)
        ready = replace(ready, problem=anew, final=final)
    return ready, excited, searcher, found


def _misread(ready: Prepared, searcher: Searcher, found: Found) -> AxisModel | None:
    """Return the model with an encoder that errs within its signal period, where a wave of what is taken for noise is
    surely that and no force of the same period; None where there is none.
    """
    fit = found.fit
    if INTERPOLATION not in ready.names or INTERPOLATION in fit.model.effects:
        return None
    wave = locked(searcher.problem, fit)
    starts = searcher.screen(fit, (INTERPOLATION,)) if wave is not None else []
    if not starts or wave is None:
        return None
    erring = searcher.fit(fit.model.with_effect(INTERPOLATION, starts[0].values))
    pull = fit.model.effects.get(WAVY, {"amp2": 0.0, "phase2": 0.0})
    size = GUESS * fit.model.rated_force
    forces = [
        searcher.fit(fit.model.with_effect(WAVY, {**pull, "amp": size, "phase": phase, "n": float(wave.order)}))
        for phase in (0.0, 0.5 * np.pi)
    ]
    gain, sure = better(searcher.loss(erring), searcher.loss(min(forces, key=lambda f: f.cost)))
    return erring.model if gain > 0.5 * wave.share and sure > SURE else None


def _larger(searcher: Searcher, found: Found, excited: Gate) -> tuple[Found, Gate]:
    """Search on, above the floor, among effects that would not show at their typical size: they may be larger.

    They come after all others, so that what is typical has precedence, and count by the same evidence.
    """
    if searcher.done(found.fit) or not excited.faint:
        return found, excited
    searcher.progress("what would only show if it were larger than usual")
    names = searcher.names
    searcher.names = names + excited.faint
    further = searcher.run(found.fit.model)
    new = [n for n in excited.faint if n in further.fit.model.effects]
    if not new:
        searcher.names = names
        return found, excited
    missing = {n: why for n, why in excited.missing.items() if n not in new}
    return replace(further, path=(*found.path, *further.path[1:])), replace(excited, missing=missing)


def _beside(ready: Prepared, searcher: Searcher, found: Found) -> Timed | None:
    """Return the force of one frequency that most of what remains is, or that explains more than all that was named."""
    if found.fit.ratio < AXIS.odd:
        return None
    fits = [found.fit, *(searcher.fit(step.model) for step in found.path)]
    lines = [as_timed(line, f) for f in fits if (line := hum(ready.problem, f)) is not None]
    best = min(lines, key=lambda line: line.left, default=None)
    return best if best is not None and best.left < found.fit.cost else None
