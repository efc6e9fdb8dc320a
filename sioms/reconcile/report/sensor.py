"""The report on a sensor: a self-contained page, verdict.json and the terminal's ten lines, in the form of the axis's."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np

from sioms.reconcile.report import page as common
from sioms.reconcile.report.page import gap_of, number
from sioms.reconcile.report.sensor_pictures import columns, groups, pictures
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, Gap


def summary(v: SensorVerdict, out: str) -> list[str]:
    """Say the verdict in at most ten lines; the largest gap before."""
    return common.summary(v, _speaking(v), out)


def _speaking(v: SensorVerdict) -> Gap:
    return max(v.gaps, key=lambda g: g.before / g.floor)


def as_json(v: SensorVerdict, seconds: float) -> str:
    """Everything a program wants from the verdict; the keys are those of the axis."""
    more = {
        "gaps": [gap_of(g) for g in v.gaps],
        "ladder": [
            {"action": s.action, "effect": s.effect, "ratio": s.ratio, "saved": s.saved, "rivals": s.rivals}
            for s in v.ladder
        ],
        "not_excited": v.missing,
        "same_in_these_records": [list(p) for p in v.pairs],
        "residual_over_floor": v.floors,
        "rejected": list(v.rejected),
    }
    return common.as_json(v, more, seconds)


def page(v: SensorVerdict, seconds: float) -> str:
    """Make the self-contained HTML page."""
    drawn = pictures(v)

    def title(name: str) -> str | None:
        return v.nominal.library[name].title if name in v.nominal.library else None

    parts = [
        common.opening(v, _speaking(v), title),
        "<h2>Where it disagreed</h2>",
        _where(v),
        drawn.get("places", ""),
        _what(v),
        drawn.get("each", ""),
        "<h2>How far the gap shrank</h2><p>Root mean square on touches or loads that took no part in any choice (every fifth). The "
        "numbers of the model are frozen; zero, true load of a touch and level of a ramp are the session's own and are free in "
        "all columns.</p>",
        _gaps(v),
        drawn.get("gap", ""),
        drawn.get("curves", ""),
        "<h2>Why we believe it, and what else it could have been</h2>",
        common.why((*v.effects, *v.symbolic), title),
        common.what_next(v, "they then differ", v.missing, v.pairs, title),
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
        value, low, high = common.span(p)
        interval, symbol = f"{low} to {high}", p.symbol
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
    shown = [p for p in v.places if p.p <= common.CHANCE][:4]
    if not shown:
        return "<p>No variable orders the residual of the old model (permutation p &gt; 0.05).</p>"
    text = "; ".join(
        f"<b>{html.escape(p.variable)}</b> {100 * p.explained:.0f} % (p = {p.p:.2f})" for p in shown
    )
    return (
        "<p>What the residual of the old model goes with, as the share of its squares that lies in its means over the values "
        f"of one variable (bars: spread about them; p: how often chance does as well): {text}.</p>"
    )


def _title(model: SensorModel, name: str) -> str:
    return html.escape(model.library[name].title)


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
