"""The report on a sensor: a self-contained page, verdict.json and the terminal's ten lines, in the form of the axis's."""

from __future__ import annotations

import html
import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, NamedEffect, Outcome
from sioms.tools.reconcile_report import HEAD, STYLE, number
from sioms.tools.reconcile_sensor_pictures import columns, groups, pictures


def headline(v: SensorVerdict) -> str:
    """One sentence."""
    if v.outcome is Outcome.UNEXPLAINED and v.effects:
        return "Found part of what the model lacks; something remains that no effect of the library explains."
    return HEAD[v.outcome]


def summary(v: SensorVerdict, out: str) -> list[str]:
    """Say the verdict in at most ten lines."""
    lines = [f"verdict: {v.outcome.value} - {headline(v)}"]
    lines += ["  " + _line(e) for e in v.effects[:4]]
    lines += [f"  unexplained part looks like {_line(e)}" for e in v.symbolic[:2]]
    if v.alternatives:
        sets = [[e.name for e in v.effects], *v.alternatives]
        lines.append("  not told apart: " + " or ".join(" + ".join(s) or "nothing" for s in sets))
    if v.experiment is not None:
        lines.append(
            f"  decide by: {v.experiment.text} (rivals differ by {v.experiment.separation:.0f} times the noise)"
        )
    gap = max(v.gaps, key=lambda g: g.before / g.floor)
    lines.append(
        f"gap on what took no part, {gap.channel}: {number(gap.before)} before, {number(gap.after)} after, floor "
        f"{number(gap.floor)} {gap.unit}"
    )
    if v.notes:
        lines.append(f"note: {v.notes[-1]}")
    lines.append(f"report: {out}")
    return lines[:10]


def _line(e: NamedEffect) -> str:
    """Name an effect with its values; of a number for every element, the spread."""
    parts = [
        f"{p.symbol} = {number(p.value)} {p.unit}".removesuffix(" 1")
        + f" [{number(p.low)}, {number(p.high)}]"
        for p in e.parameters
        if "[" not in p.symbol
    ]
    each = [p for p in e.parameters if "[" in p.symbol]
    if each:
        values = np.array([p.value for p in each])
        name, unit = each[0].symbol.split("[")[0], each[0].unit
        parts.insert(
            0,
            f"{name} from {number(float(values.min()))} to {number(float(values.max()))} {unit}".removesuffix(
                " 1"
            )
            + f", mean {number(float(values.mean()))}",
        )
    return f"{e.title}: {', '.join(parts[:4])}"


def as_json(v: SensorVerdict, seconds: float) -> str:
    """Everything a program wants from the verdict; the keys are those of the axis."""

    def effect(e: NamedEffect) -> dict[str, Any]:
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
                p.symbol: {"value": p.value, "low": p.low, "high": p.high, "unit": p.unit}
                for p in e.parameters
            },
        }

    table = {
        "verdict": v.outcome.value,
        "effects": [e.name for e in v.effects],
        "parameters": {e.name: {p.symbol: p.value for p in e.parameters} for e in v.effects},
        "alternatives": [list(a) for a in v.alternatives],
        "separating_experiment": v.experiment.text if v.experiment else "",
        "separation_in_noise": v.experiment.separation if v.experiment else None,
        "details": [effect(e) for e in v.effects],
        "symbolic": [effect(e) for e in v.symbolic],
        "gaps": [
            {
                "channel": g.channel,
                "unit": g.unit,
                "before": g.before,
                "after": g.after,
                "floor": g.floor,
                "closed": g.closed,
            }
            for g in v.gaps
        ],
        "ladder": [
            {"action": s.action, "effect": s.effect, "ratio": s.ratio, "saved": s.saved, "rivals": s.rivals}
            for s in v.ladder
        ],
        "not_excited": v.missing,
        "same_in_these_records": [list(p) for p in v.pairs],
        "residual_over_floor": v.floors,
        "located": [{"variable": p.variable, "explained": p.explained, "p": p.p} for p in v.places],
        "smoother_share": v.smoother_share,
        "burst_share": v.burst_share,
        "rejected": list(v.rejected),
        "effective_samples": v.effective_samples,
        "samples": v.samples,
        "notes": list(v.notes),
        "seconds": seconds,
    }
    return json.dumps(table, indent=1, default=float) + "\n"


def page(v: SensorVerdict, seconds: float) -> str:
    """Make the self-contained HTML page."""
    drawn = pictures(v)
    name = html.escape(v.nominal.name)
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{name}: reconcile</title><style>{STYLE}</style>"
        f"<h1>{name}: simulation against measurement</h1>",
        f"<p class='verdict {v.outcome.value}'><b>{v.outcome.value}</b> - {headline(v)}</p>",
        _what(v),
        drawn.get("each", ""),
        "<h2>How far the gap shrank</h2><p>Root mean square on touches or loads that took no part in any choice (every fifth). The "
        "numbers of the model are frozen; zero, true load of a touch and level of a ramp are the session's own and are free in "
        "all columns.</p>",
        _gaps(v),
        drawn.get("gap", ""),
        drawn.get("curves", ""),
        "<h2>Where it disagreed</h2>",
        _where(v),
        drawn.get("places", ""),
        "<h2>Why we believe it, and what else it could have been</h2>",
        "".join(_why(e, v.nominal) for e in (*v.effects, *v.symbolic))
        or "<p>There is nothing to believe in.</p>",
        _next(v),
        "<h2>How it was found</h2>",
        _ladder(v),
    ]
    floors = ", ".join(f"{n} {r:.2f}" for n, r in v.floors.items() if r > 0.0)
    parts.append(
        f"<p class=small>{v.samples} numbers (the main view's count as {v.effective_samples:.0f} independent ones); residual of "
        f"the final model in units of the floor: {floors}; a generic smoother over the state explains "
        f"{100 * v.smoother_share:.0f} % more. {seconds:.1f} s.</p></html>"
    )
    return "".join(parts)


def _what(v: SensorVerdict) -> str:
    if not v.effects and not v.symbolic:
        return ""
    rows, lists = [], []
    for e in (*v.effects, *v.symbolic):
        label = html.escape(e.title) if e in v.effects else "nameless term"
        parts = groups(e)
        for i, mine in enumerate(parts.values()):
            span = f"<td rowspan={len(parts)}>"
            first = f"{span}<b>{label}</b>{span}<code>{html.escape(e.equation)}</code>" if i == 0 else ""
            rows.append(f"<tr>{first}{_row(mine)}")
        lists += [p for mine in parts.values() if len(mine) > 1 for p in mine]
    head = "<table><tr><th>effect<th>equation<th>parameter<th>value<th>95 % interval<th>unit<th>"
    every = "".join(
        f"<tr><td>{p.symbol}<td class=n>{number(p.value)}<td class=n>{number(p.low)} to {number(p.high)}<td>{html.escape(p.unit)}"
        for p in lists
    )
    more = (
        f"<details><summary>every one of the numbers</summary><table><tr><th>parameter<th>value<th>95 % interval<th>unit"
        f"{every}</table></details>"
        if lists
        else ""
    )
    return f"<h2>What was missing</h2>{head}{''.join(rows)}</table>{more}"


def _row(mine: list[Estimate]) -> str:
    """Lay one quantity out: its value, or from where to where the values of the elements go."""
    p = mine[0]
    if len(mine) == 1:
        value, interval, symbol = number(p.value), f"{number(p.low)} to {number(p.high)}", p.symbol
    else:
        values = [q.value for q in mine]
        value = f"{number(min(values))} to {number(max(values))}"
        interval = f"each within {number(float(np.median([0.5 * (q.high - q.low) for q in mine])))}"
        names = list(columns(mine))
        symbol = f"{len(mine)} of {names[0]}" + (f" to {names[-1]}" if len(names) > 1 else "")
    text = html.escape(p.text if len(columns(mine)) < 2 else p.text.rsplit(" ", 1)[0] + " each of the others")
    return f"<td>{symbol}<td class=n>{value}<td class=n>{interval}<td>{html.escape(p.unit)}<td>{text}"


def _gaps(v: SensorVerdict) -> str:
    rows = "".join(
        f"<tr><td>{html.escape(g.channel)}<td class=n>{number(g.before)}<td class=n>{number(g.after)}<td class=n>"
        f"{number(g.floor)}<td>{g.unit}<td class=n>{_closed(g.before, g.floor, g.closed)}"
        for g in v.gaps
    )
    return f"<table><tr><th>channel<th>before<th>after<th>noise floor<th>unit<th>closed{rows}</table>"


def _closed(before: float, floor: float, closed: float) -> str:
    return f"{100 * min(closed, 1.0):.1f} %" if before > 1.15 * floor else "no gap"


def _where(v: SensorVerdict) -> str:
    shown = [p for p in v.places if p.p <= 0.05][:4]
    if not shown:
        return "<p>No variable orders the residual of the old model (permutation p &gt; 0.05).</p>"
    text = "; ".join(
        f"<b>{html.escape(p.variable)}</b> {100 * p.explained:.0f} % (p = {p.p:.2f})" for p in shown
    )
    return (
        "<p>What the residual of the old model goes with, as the share of its squares that lies in its means over the values "
        f"of one variable (bars: spread about them; p: how often chance does as well): {text}.</p>"
    )


def _why(e: NamedEffect, model: SensorModel) -> str:
    items = [
        *map(html.escape, e.evidence),
        f"it earns its place in {100 * e.frequency:.0f} % of block bootstrap replicates",
    ]
    items += [f"{_title(model, n)}: ruled out, {t}" for n, t in e.ruled_out.items()]
    items += [f"<b>{_title(model, n)}: not ruled out</b>, it {t}" for n, t in e.open.items()]
    return f"<h3>{html.escape(e.title)}</h3><ul>" + "".join(f"<li>{i}" for i in items) + "</ul>"


def _title(model: SensorModel, name: str) -> str:
    return html.escape(model.library[name].title)


def _next(v: SensorVerdict) -> str:
    parts = []
    if v.experiment is not None:
        parts.append(
            f"<p>To decide between the look-alikes: <b>{html.escape(v.experiment.text)}</b>; they then differ by "
            f"{v.experiment.separation:.0f} times the noise.</p>"
        )
    if v.missing:
        rows = "".join(f"<li>{_title(v.nominal, n)}: {html.escape(t)}" for n, t in v.missing.items())
        parts.append(
            f"<p>Not excited by these records, and so not judged (with the record that would show it):</p><ul>{rows}</ul>"
        )
    if v.pairs:
        pairs = "; ".join(f"{a} and {b} ({100 * c:.0f} % in common)" for a, b, c in v.pairs)
        parts.append(f"<p>Look the same in these records: {pairs}.</p>")
    parts += [f"<p>{html.escape(n)}</p>" for n in v.notes]
    return "<h2>Next</h2>" + "".join(parts) if parts else ""


def _ladder(v: SensorVerdict) -> str:
    rows = [
        f"<tr><td>{s.action}<td>{_titles(v.nominal, s.effect)}<td class=n>{s.ratio:.2f}<td>"
        + _rivals(s.rivals.items())
        for s in v.ladder
    ]
    return (
        "<table><tr><th>step<th>effect<th>residual over floor<th>what its rivals saved on held-out blocks"
        + "".join(rows)
        + "</table>"
    )


def _titles(model: SensorModel, effect: str) -> str:
    """Return what the effects of a step ("one to other") are called, with their names."""
    parts = [
        f"{_title(model, n)} ({n})" if n in model.library else html.escape(n) for n in effect.split(" to ")
    ]
    return " to ".join(parts)


def _rivals(rivals: Iterable[tuple[str, float]]) -> str:
    return ", ".join(
        f"{n} {100 * g:.0f} %" if g > -1.0 else f"{n} worse" for n, g in sorted(rivals, key=lambda q: -q[1])
    )
