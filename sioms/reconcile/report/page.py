"""What the reports on an axis and on a sensor share: the terminal's ten lines, the keys of verdict.json, parts of the page."""

from __future__ import annotations

import base64
import html
import io
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, Gap, NamedEffect, Outcome, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEAD = {
    Outcome.NONE: "Nothing is missing: the model agrees with the measurement down to the noise.",
    Outcome.NAMED: "Found what the model lacks.",
    Outcome.UNEXPLAINED: "Something is missing that no effect of the library explains.",
    Outcome.AMBIGUOUS: "Something is missing, but these records cannot tell which of the look-alikes it is.",
}
STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:66rem;margin:2rem auto;padding:0 1rem;color:#1c2733;background:#fff}
h1{font-size:1.5rem;margin-bottom:.2rem} h2{font-size:1.15rem;margin-top:2rem;border-bottom:1px solid #cfd8e0}
.verdict{padding:.8rem 1rem;border-left:6px solid #2a7;background:#eef8f3} .unexplained{border-color:#c50;background:#fdf2ea}
.ambiguous{border-color:#c90;background:#fdf8e6} table{border-collapse:collapse;margin:.6rem 0} td,th{padding:.2rem .7rem;
border-bottom:1px solid #dde4ea;text-align:left} td.n{text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums}
code{background:#eef2f5;padding:0 .3em} img{width:100%} .small{font-size:.85rem;color:#52606d}
"""
LINES = 10
#: Permutations do as well no oftener than this: a variable orders a disagreement.
CHANCE = 0.05
NO_PICTURES = {"gap": "<p class=small>Pictures need matplotlib (the extra <code>report</code>).</p>"}
AnyVerdict = Verdict | SensorVerdict
Titles = Callable[[str], str | None]
"""Name of an effect to what it is called, None when the library has none of that name."""


def headline(v: AnyVerdict) -> str:
    """One sentence."""
    if v.outcome is Outcome.UNEXPLAINED and v.effects:
        return "Found part of what the model lacks; something remains that no effect of the library explains."
    return HEAD[v.outcome]


def number(value: float) -> str:
    """Four significant digits."""
    return f"{value:.4g}"


def span(p: Estimate) -> tuple[str, str, str]:
    """Value and interval of a number, with as many digits as tell the ends apart, four at least."""
    width = abs(p.high - p.low)
    size = max(abs(p.low), abs(p.high))
    digits = (
        4 if not 0.0 < width < size < math.inf else min(max(4, 2 + math.ceil(math.log10(size / width))), 9)
    )
    return f"{p.value:.{digits}g}", f"{p.low:.{digits}g}", f"{p.high:.{digits}g}"


def summary(v: AnyVerdict, gap: Gap, out: str) -> list[str]:
    """Say the verdict in at most ten lines; ``gap`` is the one that speaks for all."""
    lines = [f"verdict: {v.outcome.value} - {headline(v)}"]
    lines += ["  " + in_words(e) for e in v.effects[:4]]
    lines += [f"  unexplained part looks like {in_words(e)}" for e in v.symbolic[:2]]
    more = []
    if v.alternatives:
        sets = [[e.name for e in v.effects], *v.alternatives]
        more.append("  not told apart: " + " or ".join(" + ".join(s) or "nothing" for s in sets))
    if v.experiment is not None:
        apart = f"rivals differ by {v.experiment.separation:.0f} times the noise"
        more.append(f"  decide by: {v.experiment.text} ({apart})")
    if where := places(v, 3):
        more.append(f"where: of the disagreement goes {where}")
    if v.effects:
        ruled = ", ".join(v.effects[0].ruled_out)
        more.append(f"why: {v.effects[0].evidence[-1]}" + (f"; ruled out: {ruled}" if ruled else ""))
    more += [f"note: {note}" for note in reversed(v.notes)]
    last = [f"gap on untouched data, {shrunk(gap)}", f"report: {out}"]
    return [*lines, *more[: LINES - len(lines) - len(last)], *last]


def shrunk(gap: Gap) -> str:
    """Say how far a gap shrank."""
    return f"{gap.channel}: {number(gap.before)} before, {number(gap.after)} after, floor {number(gap.floor)} {gap.unit}"


def places(v: AnyVerdict, most: int) -> str:
    """Say with which variables the disagreement goes, the strongest first; empty where with none."""
    shown = [p for p in v.places if p.p <= CHANCE][:most]
    parts = [f"{100 * p.explained:.0f} % with {p.variable}" for p in shown]
    return f"{', '.join(parts)} (permutation p <= {max(p.p for p in shown):.2f})" if shown else ""


def in_words(e: NamedEffect) -> str:
    """Name an effect with its values; of a number for every element, the spread."""
    parts = []
    for p in e.parameters:
        if "[" not in p.symbol:
            value, low, high = span(p)
            parts.append(_with_unit(f"{p.symbol} = {value}", p.unit) + f" [{low}, {high}]")
    each: dict[str, list[Estimate]] = {}
    for p in e.parameters:
        if "[" in p.symbol:
            each.setdefault(re.split(r"[_\[]", p.symbol)[0], []).append(p)
    for mine in each.values():
        least, largest = (pick(mine, key=lambda p: p.value) for pick in (min, max))
        ends = " to ".join(f"{p.symbol} = {number(p.value)}" for p in (least, largest))
        parts.insert(0, _with_unit(ends, mine[0].unit))
    return f"{e.title}: {', '.join(parts[:4])}"


def _with_unit(text: str, unit: str) -> str:
    return text if unit in ("", "1") else f"{text} {unit}"


def as_json(v: AnyVerdict, more: Mapping[str, Any], seconds: float) -> str:
    """Everything a program wants from the verdict; ``more`` is what only this kind of subject has."""
    table = {
        "verdict": v.outcome.value,
        "effects": [e.name for e in v.effects],
        "parameters": {e.name: {p.symbol: p.value for p in e.parameters} for e in v.effects},
        "alternatives": [list(a) for a in v.alternatives],
        "separating_experiment": v.experiment.text if v.experiment else "",
        "separation_in_noise": v.experiment.separation if v.experiment else None,
        "details": [_effect(e) for e in v.effects],
        "symbolic": [_effect(e) for e in v.symbolic],
        "located": [{"variable": p.variable, "explained": p.explained, "p": p.p} for p in v.places],
        "smoother_share": v.smoother_share,
        "burst_share": v.burst_share,
        "effective_samples": v.effective_samples,
        "samples": v.samples,
        **more,
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


def gap_of(g: Gap) -> dict[str, Any]:
    """Return the keys that every gap has."""
    return {
        "channel": g.channel, "unit": g.unit, "before": g.before, "after": g.after,
        "floor": g.floor, "floor_from": g.floor_from, "closed": g.closed,
    }  # fmt: skip


def opening(v: AnyVerdict, gap: Gap, title: Titles) -> str:
    """Begin the page: its head, and the verdict with where it disagreed and how far the gap shrank."""
    name = html.escape(v.nominal.name)
    sets = [[e.name for e in v.effects], *v.alternatives]
    found = html.escape("; or ".join(" and ".join(title(n) or n for n in s) or "nothing" for s in sets))
    lines = [f"<b>{v.outcome.value}</b> - {headline(v)}"]
    lines += [f"<b>{found}</b>"] if v.effects or v.alternatives else []
    lines += [f"Of the disagreement goes {html.escape(where)}"] if (where := places(v, 2)) else []
    lines.append(f"On data that took no part, {html.escape(shrunk(gap))}")
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{name}: reconcile</title><style>{STYLE}</style>"
        f"<h1>{name}: simulation against measurement</h1>"
        f"<p class='verdict {v.outcome.value}'>{'<br>'.join(lines)}</p>"
    )


def why(effects: Sequence[NamedEffect], title: Titles) -> str:
    """Tell why each effect is believed, and what else it could have been."""
    return "".join(_why(e, title) for e in effects) or "<p>There is nothing to believe in.</p>"


def _why(e: NamedEffect, title: Titles) -> str:
    items = [html.escape(text) for text in e.evidence]
    if e.frequency is not None:
        items.append(f"it earns its place in {100 * e.frequency:.0f} % of block bootstrap replicates")
    items += [
        f"{html.escape(t)}: ruled out, {html.escape(x)}" for n, x in e.ruled_out.items() if (t := title(n))
    ]
    items += [
        f"<b>{html.escape(t)}: not ruled out</b>, it {html.escape(x)}"
        for n, x in e.open.items()
        if (t := title(n))
    ]
    return f"<h3>{html.escape(e.title)}</h3><ul>" + "".join(f"<li>{i}" for i in items) + "</ul>"


def what_next(
    v: AnyVerdict,
    differ: str,
    missing: Mapping[str, str],
    pairs: Sequence[tuple[str, str, float]],
    title: Titles,
) -> str:
    """Tell what to do next: the experiment that decides, what was not excited, what looks alike here, the notes.

    Args:
        differ: what is said of the rivals before "by 7 times the noise".
        missing: effects that were not excited, each with the record that would show it.
        pairs: effects that look alike in these records, with the share they have in common.
    """
    parts = []
    if v.experiment is not None:
        parts.append(
            f"<p>To decide between the look-alikes: <b>{html.escape(v.experiment.text)}</b>; {differ} by "
            f"{v.experiment.separation:.0f} times the noise.</p>"
        )
    if missing:
        rows = "".join(
            f"<li>{html.escape(t)}: {html.escape(x)}" for n, x in missing.items() if (t := title(n))
        )
        parts.append(
            f"<p>Not excited by these records, and so not judged (with the record that would show it):</p><ul>{rows}</ul>"
        )
    if pairs:
        alike = "; ".join(f"{a} and {b} ({100 * c:.0f} % in common)" for a, b, c in pairs)
        parts.append(f"<p>Look the same in these records: {alike}.</p>")
    parts += [f"<p>{html.escape(n)}</p>" for n in v.notes]
    return "<h2>Next</h2>" + "".join(parts) if parts else ""


def image(figure: Figure) -> str:
    """Return a picture as a part of the page."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=96)
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"


def gap_picture(figure: Figure, gaps: Sequence[Gap]) -> Figure:
    """Draw every channel's gap before and after in units of its noise floor."""
    ax = figure.subplots()
    for i, g in enumerate(reversed(gaps)):
        ends = [g.before / g.floor, g.after / g.floor]
        ax.plot(ends, [i, i], color="#cfd8e0", lw=6, solid_capstyle="butt", zorder=1)
        ax.plot(ends[0], i, "o", color="#c50", label="before" if i == 0 else None)
        ax.plot(ends[1], i, "o", color="#08a", label="after" if i == 0 else None)
    ax.axvline(1.0, color="#1c2733", lw=1, ls="--", label="noise floor")
    ax.set_xscale("log")
    sizes = [share / g.floor for g in gaps for share in (g.before, g.after)]
    ax.set_xlim(min(0.5, 0.7 * min(sizes)), 2.0 * max(2.0, *sizes))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_yticks(range(len(gaps)), [g.channel for g in reversed(gaps)], fontsize=8)
    ax.set_ylim(-0.6, len(gaps) - 0.4)
    ax.set_xlabel("simulated - measured over the noise floor, on what took no part", fontsize=8)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure
