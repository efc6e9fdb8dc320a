"""The report on any subject: one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.report.pictures import pictures
from sioms.reconcile.report.words import (
    CHANCE,
    TOGETHER,
    columns,
    groups,
    headline,
    held_already,
    in_words,
    number,
    places,
    remains,
    shrunk,
    span,
    sureness,
    told,
)
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.session import knobs
from sioms.reconcile.thresholds import NOISE
from sioms.reconcile.verdict import Estimate, NamedEffect, Outcome, Verdict
from sioms.report_page import Cell, Page

#: How the box with the verdict is coloured.
COLOURS = {Outcome.NONE: "good", Outcome.NAMED: "good", Outcome.UNEXPLAINED: "bad", Outcome.AMBIGUOUS: "warn"}
SESSION = {
    "offset": "force offset",
    "dry": "dry friction, factor",
    "viscous": "viscous friction, factor",
    "zero": "encoder zero",
    "heat": "heat state at the start",
}


OF_AXES = (
    "Root mean square on held-out samples, which were not used for any choice. In closed loop the model and its "
    "controller follow the recorded command; running free, the model gets the recorded force and nothing else, so "
    "small errors add up; in short windows it is corrected by the measurement all along, and its error is given as a "
    "force."
)
OF_RIGS = (
    "Root mean square on held-out samples, which were not used for any choice: of the force that the motion takes, "
    "measured and by the model, over short windows."
)
OF_SENSORS = (
    "Root mean square on held-out touches or loads (every fifth), which were not used for any choice. The parameters "
    "of the model are fixed; the zero, the true load of a touch and the level of a ramp are estimated for the session "
    "in all columns."
)
FLOOR = (
    "The noise floor is what noise alone would leave. It is an estimate of its own, right within a third, so what "
    "remains may come out below it."
)
LATER = (
    "Table and pictures show the model that was fitted without the held-out samples. The last two columns are its "
    "error on their later half: as it is, and with offset and friction of the session estimated again on their "
    "earlier half."
)
FINAL = " The parameters above and model.toml come from a final fit to all records after that."


def page(v: Verdict, seconds: float, *, draw: bool = True) -> Page:
    """Make the page, with pictures if they are to be drawn."""
    p = Page(f"{v.nominal.name}: simulation against measurement")
    try:
        drawn = pictures(v) if draw else {}
    except ImportError:
        drawn = {}
        p.text("Pictures need matplotlib (the extra report).")

    def show(*names: str) -> None:
        for name in names:
            if name in drawn:
                p.figure(drawn[name])

    _opening(p, v)
    if v.effects or v.symbolic:
        _what(p, v)
        show("each")
    if v.candidates:
        p.head("What was tried and refused")
        p.text(
            "These are not findings. The search reached them, but the model with them does not hold, so no numbers are "
            "given; model.toml has them switched off."
        )
        p.items(f"{c.title}: {c.why}" for c in v.candidates)
    _next(p, v)
    p.head("Model error before and after")
    _gaps(p, v)
    show("gaps", "curves")
    if v.effects or v.symbolic:
        p.head("Evidence, and alternatives")
        for e in (*v.effects, *v.symbolic):
            p.lesser(e.title)
            p.items(_why(e, v))
        if len(v.effects) + len(v.symbolic) > 1:
            p.text("Each share is of what remains when this effect alone is left out: they add up to more than 100 %.")
    p.head("Where the nominal model disagreed")
    p.text(_where(v))
    show("places", "spectra")
    p.head("How it was found")
    _selection_path(p, v)
    if isinstance(v, AxisVerdict) and v.states:
        _session(p, v)
    _alike(p, v)
    p.small(f"{_footing(v)} {seconds:.1f} s.")
    return p


def _opening(p: Page, v: Verdict) -> None:
    """Put the verdict first, how sure it is, what to do next, and how far the gap shrank."""
    sets = [[e.name for e in v.effects], *v.alternatives]
    lines = [f"{v.outcome.value} - {headline(v)}"]
    if v.alternatives:
        lines.append("; or ".join(" and ".join(v.title(n) or n for n in s) or "nothing" for s in sets))
    else:
        lines += [in_words(e) for e in v.effects]
    if v.outcome is Outcome.UNEXPLAINED and v.notes:  # the last of them is why
        lines.append(f"{v.notes[-1][0].upper()}{v.notes[-1][1:]}")
    lines.append(sureness(v))
    if v.experiment is not None:
        lines.append(f"Next: {v.experiment.text}; that decides between the candidates.")
    if v.outcome is not Outcome.NONE and (where := places(v, 2)):
        lines.append(f"{where[0].upper()}{where[1:]}")
    by = " of the refused model" if v.candidates and not v.effects else ""
    lines.append(f"Model error{by} on held-out data, {shrunk(v.speaking)}")
    p.box(COLOURS[v.outcome], lines)


def _where(v: Verdict) -> str:
    shown = [q for q in v.places if q.p <= CHANCE][:4]
    if not shown:
        return "The residual of the nominal model depends on no variable (permutation p > 0.05)."
    text = "; ".join(f"{q.variable} {100 * q.explained:.0f} % (p = {q.p:.2f})" for q in shown)
    harmless = " That is too little for an effect." if v.outcome is Outcome.NONE else ""
    return (
        "Share of the squared residual of the nominal model that its mean as a function of one variable explains "
        "(variables go together, so these shares overlap; bars: spread about the mean; p: how often chance does as "
        f"well): {text}.{harmless}"
    )


def _what(p: Page, v: Verdict) -> None:
    """Lay out what is missing: effects by name, candidates for one place, and what only describes the remainder."""
    if v.effects:
        p.head("Candidates" if v.alternatives else "What the model holds" if held_already(v) else "What was missing")
        _numbers(p, v.effects)
    if v.alternatives:
        p.text(
            "These numbers hold if the first candidate is what is missing; their intervals say nothing about which one "
            "it is. In its place:"
        )
        p.items(_instead(v))
    if v.symbolic:
        p.head("A formula for the rest, without a name")
        p.text(
            "It describes the residual, and model.toml predicts with it. It is no property of the machine; where an "
            "interval is wide or contains 0, its terms make up for each other: do not use their numbers one by one."
        )
        _numbers(p, v.symbolic)


def _instead(v: Verdict) -> Iterator[str]:
    """Name the other candidates, with their numbers where there are any."""
    numbers_of = v.others if isinstance(v, AxisVerdict) and len(v.others) == len(v.alternatives) else ()
    for i, names in enumerate(v.alternatives):
        told = []
        for name in names:
            values = numbers_of[i].get(name, {}) if numbers_of else {}
            numbers = ", ".join(f"{symbol} = {number(value)}" for symbol, value in values.items())
            told.append((v.title(name) or name) + (f" ({numbers})" if numbers else ""))
        yield " and ".join(told) or "nothing"


def _numbers(p: Page, effects: Sequence[NamedEffect]) -> None:
    rows: list[Sequence[object]] = []
    every: list[Estimate] = []
    for e in effects:
        label, equation = e.title, e.equation
        if not told(e):
            rows.append((label, equation, f"{len(e.parameters)} numbers", Cell("-"), Cell("-"), "", TOGETHER))
            every += e.parameters
            continue
        for mine in groups(e).values():
            rows.append((label, equation, *_quantity(mine)))
            label = equation = ""
            every += mine if len(mine) > 1 else []
    p.table(("effect", "equation", "parameter", "value", "95 % interval", "unit", ""), rows)
    if every:
        numbers = [
            (q.symbol, Cell(number(q.value)), Cell(f"{number(q.low)} to {number(q.high)}"), q.unit) for q in every
        ]
        p.table(("parameter", "value", "95 % interval", "unit"), numbers, folded="every one of the numbers")


def _quantity(mine: list[Estimate]) -> tuple[object, ...]:
    """Lay one quantity out: its value, or from where to where the values of the elements go."""
    first = mine[0]
    if len(mine) == 1:
        value, low, high = span(first)
        return first.symbol, Cell(value), Cell(f"{low} to {high}"), first.unit, first.text
    values = [q.value for q in mine]
    within = number(float(np.median([0.5 * (q.high - q.low) for q in mine])))
    names = list(columns(mine))
    symbol = f"{len(mine)} of {names[0]}" + (f" to {names[-1]}" if len(names) > 1 else "")
    text = first.text if len(names) < 2 else first.text.rsplit(" ", 1)[0] + " each of the others"
    ends = f"{number(min(values))} to {number(max(values))}"
    return symbol, Cell(ends), Cell(f"each within {within}"), first.unit, text


def _gaps(p: Page, v: Verdict) -> None:
    of_axis = isinstance(v, AxisVerdict)
    p.text(OF_SENSORS if not of_axis else OF_RIGS if v.nominal.imposed else OF_AXES)
    p.text(f"{FLOOR} The verdict rests on the row '{v.speaking.channel}'.")
    head = ["channel", "before", "after", "noise floor", "unit", "what remains", "gap closed", "floor from"]
    rows = []
    for g in v.gaps:
        has_gap = g.known and g.before > NOISE * g.floor
        closed = f"{100 * g.closed:.1f} %" if has_gap else "no gap" if g.known else "unknown"
        ends = [Cell(number(x)) for x in (g.before, g.after, g.floor)]
        row = [g.channel, *ends, g.unit, remains(g) if g.known else "unknown", Cell(closed), g.floor_from]
        later = [Cell("-" if x is None else number(x)) for x in (g.frozen, g.session)]
        rows.append([*row, *later] if of_axis else row)
    p.table([*head, "later half, frozen", "later half, session re-estimated"] if of_axis else head, rows)
    if of_axis:
        p.text(LATER + (FINAL if v.effects else ""))


def _why(e: NamedEffect, v: Verdict) -> Iterator[str]:
    """Tell why an effect is believed, and what else it could have been."""
    yield from e.evidence
    if e.frequency is not None:
        yield f"selected in {100 * e.frequency:.0f} % of block bootstrap replicates"
    yield from (f"ruled out: {t}, which {x}" for n, x in e.ruled_out.items() if (t := v.title(n)))
    yield from (f"not ruled out: {t}, which {x}" for n, x in e.open.items() if (t := v.title(n)))


def _next(p: Page, v: Verdict) -> None:
    """Tell what to do next: the experiment that decides, what was not excited, what looks alike here, the notes."""
    pairs = _pairs(v)
    if v.experiment is None and not v.missing and not pairs and not v.notes:
        return
    p.head("Next")
    if v.experiment is not None:
        differ = "there their forces differ" if isinstance(v, AxisVerdict) else "there they differ"
        apart = f"{differ} by {v.experiment.separation:.0f} times the noise"
        p.text(f"To decide between the candidates: {v.experiment.text}; {apart}.")
    if v.missing:
        p.text("Not judged, because these records do not excite it (with the record that would):")
        p.items(f"{t}: {x}" for n, x in v.missing.items() if (t := v.title(n)))
    if pairs:
        p.text("Would show almost alike in these records:")
        p.items(f"{a} and {b}, {100 * c:.0f} % in common" for a, b, c in pairs)
    for note in v.notes:
        p.text(note)


def _pairs(v: Verdict) -> list[tuple[str, str, float]]:
    """Return the pairs that look alike with one in the verdict and the other not ruled out, by their titles."""
    mine = {e.name for e in v.effects} | {n for names in v.alternatives for n in names}
    ruled = {n for e in v.effects for n in e.ruled_out}
    return [
        (v.title(a) or a, v.title(b) or b, c)
        for a, b, c in v.pairs
        if {a, b} & mine and not {a, b} <= mine and not {a, b} & ruled
    ]


def _alike(p: Page, v: Verdict) -> None:
    """List every pair that looks alike in these records, folded."""
    if v.pairs:
        rows = [(v.title(a) or a, v.title(b) or b, Cell(f"{100 * c:.0f} %")) for a, b, c in v.pairs]
        p.table(("effect", "effect", "in common"), rows, folded="effects that would show alike in these records")


def _selection_path(p: Page, v: Verdict) -> None:
    head, rows = ["step", "effect", "residual / expected noise"], []
    if isinstance(v, AxisVerdict):
        head.append(f"force error, held out, {v.nominal.force_unit}")
        rows += [["channel", f.effect, "", "", f.evidence] for f in v.findings]
    for i, s in enumerate(v.path):
        names = " to ".join(f"{t} ({n})" if (t := v.title(n)) else n for n in s.effect.split(" to "))
        error = [Cell(number(v.rungs[i]))] if isinstance(v, AxisVerdict) else []
        rows.append([s.action, names, Cell(f"{s.ratio:.2f}"), *error, _rivals(s.rivals)])
    p.table([*head, "reduction by alternatives, on blocks held out"], rows)


def _rivals(rivals: Mapping[str, float]) -> str:
    best = sorted(rivals.items(), key=lambda q: -q[1])
    return ", ".join(f"{n} {100 * g:.0f} %" if g > -1.0 else f"{n} worse" for n, g in best)


def _session(p: Page, v: AxisVerdict) -> None:
    """Say what the session parameters came to."""
    units = {"offset": v.model.force_unit, "zero": v.model.position_unit}
    shown = knobs(v.model)
    p.text(
        "Session parameters, estimated on the first half of the held-out part of each record (not properties of the "
        "axis and not part of the model):"
    )
    rows = [
        [name, *(Cell(f"{number(getattr(state, k))} {units.get(k, '')}".rstrip()) for k in shown)]
        for name, state in v.states
    ]
    p.table(["record", *(SESSION[k] for k in shown)], rows)


def _footing(v: Verdict) -> str:
    """Say on how much all this stands."""
    smoother = f"a generic smoother over the state would explain another {100 * v.smoother_share:.0f} %"
    if isinstance(v, SensorVerdict):
        floors = ", ".join(f"{n} {r:.2f}" for n, r in v.floors.items() if r > 0.0)
        return (
            f"{v.samples} readings (those of the main view equal {v.effective_samples:.0f} independent ones); residual "
            f"of the final model relative to the floor: {floors}; {smoother}."
        )
    return (
        f"{v.samples} samples equal {v.effective_samples:.0f} independent ones; the residual of the final model is "
        f"{v.ratio:.2f} times what noise leaves; {smoother}; {100 * v.burst_share:.0f} % of the residual is in bursts."
    )
