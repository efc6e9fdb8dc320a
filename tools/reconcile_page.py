"""What the reports on an axis and on a sensor share: the terminal's ten lines, the keys of verdict.json, parts of the page."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Gap, NamedEffect, Outcome, Verdict

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
code{background:#eef2f5;padding:0 .3em} img{max-width:100%} .small{font-size:.85rem;color:#52606d}
"""
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


def summary(v: AnyVerdict, gap: Gap, out: str) -> list[str]:
    """Say the verdict in at most ten lines; ``gap`` is the one that speaks for all."""
    lines = [f"verdict: {v.outcome.value} - {headline(v)}"]
    lines += ["  " + in_words(e) for e in v.effects[:4]]
    lines += [f"  unexplained part looks like {in_words(e)}" for e in v.symbolic[:2]]
    if v.alternatives:
        sets = [[e.name for e in v.effects], *v.alternatives]
        lines.append("  not told apart: " + " or ".join(" + ".join(s) or "nothing" for s in sets))
    if v.experiment is not None:
        apart = f"rivals differ by {v.experiment.separation:.0f} times the noise"
        lines.append(f"  decide by: {v.experiment.text} ({apart})")
    lines.append(
        f"gap on untouched data, {gap.channel}: {number(gap.before)} before, {number(gap.after)} after, floor "
        f"{number(gap.floor)} {gap.unit}"
    )
    if v.notes:
        lines.append(f"note: {v.notes[-1]}")
    lines.append(f"report: {out}")
    return lines[:10]


def in_words(e: NamedEffect) -> str:
    """Name an effect with its values; of a number for every element, the spread."""
    parts = [
        _with_unit(f"{p.symbol} = {number(p.value)}", p.unit) + f" [{number(p.low)}, {number(p.high)}]"
        for p in e.parameters
        if "[" not in p.symbol
    ]
    each = [p for p in e.parameters if "[" in p.symbol]
    if each:
        values = np.array([p.value for p in each])
        span = f"from {number(float(values.min()))} to {number(float(values.max()))}"
        name = each[0].symbol.split("[")[0]
        parts.insert(0, _with_unit(f"{name} {span}", each[0].unit) + f", mean {number(float(values.mean()))}")
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
        "floor": g.floor, "closed": g.closed,
    }  # fmt: skip


def opening(v: AnyVerdict) -> str:
    """Begin the page: its head, and the verdict."""
    name = html.escape(v.nominal.name)
    found = html.escape("; ".join(e.title for e in v.effects))
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{name}: reconcile</title><style>{STYLE}</style>"
        f"<h1>{name}: simulation against measurement</h1>"
        f"<p class='verdict {v.outcome.value}'><b>{v.outcome.value}</b> - {headline(v)}"
        f"{'<br>' if found else ''}<b>{found}</b></p>"
    )


def why(effects: Sequence[NamedEffect], title: Titles) -> str:
    """Tell why each effect is believed, and what else it could have been."""
    return "".join(_why(e, title) for e in effects) or "<p>There is nothing to believe in.</p>"


def _why(e: NamedEffect, title: Titles) -> str:
    items = [html.escape(text) for text in e.evidence]
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
    figure.savefig(buffer, format="png", dpi=80)
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"
