"""What a verdict says in words and as JSON: the terminal's ten lines and verdict.json, alike for all subjects."""

from __future__ import annotations

import json
import math
from typing import Any

from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.session import knobs
from sioms.reconcile.thresholds import NOISE
from sioms.reconcile.verdict import Estimate, Gap, NamedEffect, Outcome, Verdict

HEAD = {
    Outcome.NONE: "Nothing is missing: model and measurement agree to within the noise.",
    Outcome.NAMED: "What the model lacks has been identified.",
    Outcome.UNEXPLAINED: "Something is missing, and no effect of the library explains it.",
    Outcome.AMBIGUOUS: "Something is missing, but these records cannot distinguish between the candidates.",
}
LINES = 10
#: Said of a formula's numbers that make up for each other.
TOGETHER = "its numbers are told together only, not one by one (model.toml has them)"
#: Permutations do as well no oftener than this: a variable orders a disagreement.
CHANCE = 0.05


HELD_ALREADY = {
    Outcome.NAMED: "Nothing is missing beside what the model holds already, which these records confirm.",
    Outcome.AMBIGUOUS: "Nothing is missing, but these records cannot tell what the model holds already from others.",
}
#: The model as given is as good as the corrected one up to this multiple of its error.
AS_GOOD = 1.1


def held_already(v: Verdict) -> bool:
    """Say whether all that was found stood in the nominal model already, whose error is as small as that of the
    corrected one.
    """
    found = {e.name for e in v.effects}
    as_good = v.speaking.before <= AS_GOOD * v.speaking.after
    return bool(found) and v.outcome in HELD_ALREADY and found <= set(v.nominal.effects) and as_good


def headline(v: Verdict) -> str:
    """One sentence."""
    if held_already(v):
        return HELD_ALREADY[v.outcome]
    if v.outcome is Outcome.UNEXPLAINED and v.effects:
        return "Part of what the model lacks has been identified; no effect of the library explains the rest."
    if v.candidates:
        return "Something is missing, and no model that was tried holds: nothing is named."
    return HEAD[v.outcome]


def sureness(v: Verdict) -> str:
    """Say how far the verdict can be relied on, and on what that rests."""
    left = f"on held-out data {remains(v.speaking)}{_above(v)}"
    match v.outcome:
        case Outcome.NONE:
            untried = ", ".join(t for n in v.missing if (t := v.title(n)))
            return f"How sure: {left}." + (
                f" Not tested, as these records do not excite it: {untried}." if untried else ""
            )
        case Outcome.NAMED:
            still = ", ".join(t for e in v.effects for n in e.open if (t := v.title(n)))
            rest = f"not ruled out: {still}" if still else "what could stand in its place is ruled out"
            return f"How sure: {left}; {rest}."
        case Outcome.AMBIGUOUS if held_already(v):
            return f"How sure: {left}; each of the candidates explains it."
        case Outcome.AMBIGUOUS:
            return f"How sure: something is missing, and each of the candidates explains it; {left}."
    known = "what has a name is sure as far as its evidence goes; the rest" if v.effects else "what it is"
    return f"How sure: something is missing; {known} is not known. Do not rely on the numbers of a formula for it."


def _above(v: Verdict) -> str:
    """Say where most is left beside the row that speaks for all, if that is more than noise."""
    others = [(g.after / g.floor, g) for g in v.gaps if g is not v.speaking and g.known and g.floor > 0.0]
    times, most = max(others, key=lambda o: o[0], default=(0.0, v.speaking))
    return f", but {times:.2g} times as much in the row '{most.channel}'" if times > NOISE else ""


def remains(gap: Gap) -> str:
    """Say how what remains compares with what noise alone leaves, whose estimate is right within a third."""
    if not gap.known:
        return "how much of what remains is noise is not known"
    times = gap.after / gap.floor if gap.floor > 0.0 else math.inf
    return "only noise remains" if times <= NOISE else f"{times:.2g} times the noise remains"


def number(value: float) -> str:
    """Four significant digits."""
    return "unknown" if math.isnan(value) else f"{value:.4g}"


def span(p: Estimate) -> tuple[str, str, str]:
    """Value and interval of a number, with as many digits as tell the ends apart, four at least."""
    width = abs(p.high - p.low)
    size = max(abs(p.low), abs(p.high))
    digits = 4 if not 0.0 < width < size < math.inf else min(max(4, 2 + math.ceil(math.log10(size / width))), 9)
    return f"{p.value:.{digits}g}", f"{p.low:.{digits}g}", f"{p.high:.{digits}g}"


def summary(v: Verdict, out: str) -> list[str]:
    """Say the verdict in at most ten lines."""
    lines = [f"verdict: {v.outcome.value} - {headline(v)}"]
    lines += ["  " + in_words(e) for e in v.effects[:4]]
    lines += [f"  the unexplained part, without a name, follows {in_words(e)}" for e in v.symbolic[:2]]
    more = []
    if v.alternatives:
        sets = [[e.name for e in v.effects], *v.alternatives]
        more.append("  candidates: " + " or ".join(" + ".join(s) or "nothing" for s in sets))
    if v.experiment is not None:
        apart = f"there the candidates differ by {v.experiment.separation:.0f} times the noise"
        more.append(f"  to decide: {v.experiment.text} ({apart})")
    if where := places(v, 3):
        more.append(f"where: {where}")
    if v.effects:
        ruled = ", ".join(v.effects[0].ruled_out)
        more.append(f"why: {v.effects[0].evidence[-1]}" + (f"; ruled out: {ruled}" if ruled else ""))
    if v.candidates:
        more.append(f"tried and refused: {', '.join(c.title for c in v.candidates)}")
    more += [f"note: {note}" for note in reversed(v.notes)]
    of = "model error on held-out data"
    of += ", refused model" if v.candidates and not v.effects else ""
    last = [f"{of}, {shrunk(v.speaking)}", f"report: {out}"]
    return [*lines, *more[: LINES - len(lines) - len(last)], *last]


def shrunk(gap: Gap) -> str:
    """Say how far a gap shrank."""
    before, after = (f"{number(x)} {gap.unit} {when}" for x, when in ((gap.before, "before"), (gap.after, "after")))
    return f"{gap.channel}: {before}, {after}, floor {f'{number(gap.floor)} {gap.unit}' if gap.known else 'unknown'}"


def places(v: Verdict, most: int) -> str:
    """Say on which variables the disagreement depends, the strongest first; empty where on none."""
    shown = [p for p in v.places if p.p <= CHANCE][:most]
    parts = ", ".join(f"{p.variable} ({100 * p.explained:.0f} %)" for p in shown)
    return f"the disagreement depends on {parts}; permutation p <= {max(p.p for p in shown):.2f}" if shown else ""


def told(e: NamedEffect) -> bool:
    """Say whether the numbers of an effect are told one by one: of a formula without a name most of them to better than
    their own size; else they make up for each other, or for what has a name, and only their sum is told.
    """
    free = [p for p in e.parameters if p.high > p.low]
    sure = sum(p.high - p.low < 2.0 * abs(p.value) for p in free)
    return not e.name.startswith(TERM_PREFIX) or 2 * sure >= len(free)


def in_words(e: NamedEffect) -> str:
    """Name an effect with its values; of a number for every element, the spread; of a formula whose numbers are not
    told one by one, none.
    """
    if not told(e):
        return f"{e.title}: {e.equation}; {TOGETHER}"
    parts = []
    for p in e.parameters:
        if "[" not in p.symbol:
            value, low, high = span(p)
            parts.append(_with_unit(f"{p.symbol} = {value}", p.unit) + f" [{low}, {high}]")
    for mine in (mine for mine in groups(e).values() if "[" in mine[0].symbol):
        least, largest = (pick(mine, key=lambda p: p.value) for pick in (min, max))
        ends = " to ".join(f"{p.symbol} = {number(p.value)}" for p in (least, largest))
        parts.insert(0, _with_unit(ends, mine[0].unit))
    return f"{e.title}: {', '.join(parts[:4])}"


def _with_unit(text: str, unit: str) -> str:
    return text if unit in ("", "1") else f"{text} {unit}"


def groups(e: NamedEffect) -> dict[str, list[Estimate]]:
    """Return the estimates by quantity; one that every element has of its own comes with all its numbers, a matrix as
    one.
    """
    out: dict[str, list[Estimate]] = {}
    for p in e.parameters:
        name, each, _ = p.symbol.partition("[")
        out.setdefault(name.split("_")[0] if each else name, []).append(p)
    return out


def columns(mine: list[Estimate]) -> dict[str, list[Estimate]]:
    """Return the columns of a matrix by their symbols; one for what is no matrix."""
    out: dict[str, list[Estimate]] = {}
    for p in mine:
        out.setdefault(p.symbol.split("[")[0], []).append(p)
    return out


def as_json(v: Verdict, seconds: float) -> str:
    """Return everything a program wants from the verdict."""
    table = {
        "verdict": v.outcome.value,
        "effects": [e.name for e in v.effects],
        "parameters": {e.name: {p.symbol: p.value for p in e.parameters} for e in v.effects},
        "alternatives": [list(a) for a in v.alternatives],
        "separating_experiment": v.experiment.text if v.experiment else "",
        "separation_in_noise": v.experiment.separation if v.experiment else None,
        "details": [_effect(e) for e in v.effects],
        "symbolic": [_effect(e) for e in v.symbolic],
        "refused_candidates": [{"name": c.name, "title": c.title, "why": c.why} for c in v.candidates],
        "located": [{"variable": p.variable, "explained": p.explained, "p": p.p} for p in v.places],
        "smoother_share": v.smoother_share,
        "burst_share": v.burst_share,
        "effective_samples": v.effective_samples,
        "samples": v.samples,
        "gaps": [_gap(g, isinstance(v, AxisVerdict)) for g in v.gaps],
        "ladder": [
            {"action": s.action, "effect": s.effect, "ratio": s.ratio, "saved": s.saved, "rivals": s.rivals}
            for s in v.path
        ],
        "not_excited": v.missing,
        "same_in_these_records": [list(p) for p in v.pairs],
        **_more(v),
        "notes": list(v.notes),
        "seconds": seconds,
    }
    return json.dumps(table, indent=1, default=float) + "\n"


def _effect(e: NamedEffect) -> dict[str, Any]:
    return {
        "name": e.name,
        "title": e.title,
        "equation": e.equation,
        "channel": e.channel,
        "saved": e.saved,
        "standard_errors": min(e.errors, 1e6),
        "selection_frequency": e.frequency,
        "evidence": list(e.evidence),
        "ruled_out": e.ruled_out,
        "not_ruled_out": e.open,
        "parameters": {
            p.symbol: {"value": p.value, "low": p.low, "high": p.high, "unit": p.unit} for p in e.parameters
        },
    }


def _gap(g: Gap, of_axis: bool) -> dict[str, Any]:
    table: dict[str, Any] = {
        "channel": g.channel, "unit": g.unit, "before": g.before, "after": g.after,
        "floor": g.floor if g.known else None, "floor_from": g.floor_from, "closed": g.closed if g.known else None,
    }  # fmt: skip
    return table | ({"frozen_later_half": g.frozen, "session_later_half": g.session} if of_axis else {})


def _more(v: Verdict) -> dict[str, Any]:
    """Return what only this kind of subject has."""
    if isinstance(v, SensorVerdict):
        return {"residual_over_floor": v.floors, "rejected": list(v.rejected)}
    if not isinstance(v, AxisVerdict):
        return {}
    return {
        "ladder": [
            {
                "action": s.action,
                "effect": s.effect,
                "ratio": s.ratio,
                "saved": s.saved,
                "rivals": s.rivals,
                "untouched_force_error": e,
            }
            for s, e in zip(v.path, v.rungs, strict=True)
        ],
        "alternative_parameters": [{name: dict(values) for name, values in m.items()} for m in v.others],
        "residual_over_floor": v.ratio,
        "session": {name: {k: getattr(s, k) for k in knobs(v.model)} for name, s in v.states},
    }
