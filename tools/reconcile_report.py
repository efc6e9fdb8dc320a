"""The report of one reconciliation: a self-contained page, verdict.json and the terminal's ten lines."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.reconcile.effects import library
from sioms.reconcile.session import knobs
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


def headline(v: Verdict) -> str:
    """One sentence."""
    if v.outcome is Outcome.UNEXPLAINED and v.effects:
        return "Found part of what the model lacks; something remains that no effect of the library explains."
    return HEAD[v.outcome]


def number(value: float) -> str:
    """Four significant digits."""
    return f"{value:.4g}"


def summary(v: Verdict, out: str) -> list[str]:
    """Say the verdict in at most ten lines."""
    lines = [f"verdict: {v.outcome.value} - {headline(v)}"]
    for e in v.effects[:3]:
        lines.append("  " + _line(e))
    lines += [f"  unexplained part looks like {_line(e)}" for e in v.symbolic[:2]]
    if v.alternatives:
        lines.append(
            "  not told apart: "
            + " or ".join([_names(e.name for e in v.effects), *map(_names, v.alternatives)])
        )
    if v.experiment is not None:
        lines.append(
            f"  decide by: {v.experiment.text} (rivals differ by {v.experiment.separation:.0f} times the noise)"
        )
    gap = v.gaps[min(1, len(v.gaps) - 1)]
    lines.append(
        f"gap on untouched samples, {gap.channel}: {number(gap.before)} before, {number(gap.after)} after, "
        f"floor {number(gap.floor)} {gap.unit}"
    )
    if v.notes:
        lines.append(f"note: {v.notes[-1]}")
    lines.append(f"report: {out}")
    return lines[:10]


def _names(names: Any) -> str:
    return " + ".join(names) or "nothing"


def _line(e: NamedEffect) -> str:
    values = ", ".join(
        f"{p.symbol} = {number(p.value)} {p.unit}".rstrip(" 1") + f" [{number(p.low)}, {number(p.high)}]"
        for p in e.parameters[:3]
    )
    return f"{e.title}: {values}"


def as_json(v: Verdict, seconds: float) -> str:
    """Everything a program wants from the verdict."""

    def effect(e: NamedEffect) -> dict[str, Any]:
        return {
            "name": e.name,
            "title": e.title,
            "equation": e.equation,
            "channel": e.channel,
            "saved": e.saved,
            "standard_errors": e.errors,
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
                "frozen_later_half": g.frozen,
                "session_later_half": g.session,
                "closed": g.closed,
            }
            for g in v.gaps
        ],
        "ladder": [
            {
                "action": s.action,
                "effect": s.effect,
                "ratio": s.ratio,
                "saved": s.saved,
                "rivals": s.rivals,
                "untouched_force_error": e,
            }
            for s, e in zip(v.ladder, v.rungs, strict=True)
        ],
        "not_excited": v.gate.missing,
        "same_in_these_records": [list(p) for p in v.gate.pairs],
        "located": [{"variable": p.variable, "explained": p.explained, "p": p.p} for p in v.places],
        "residual_over_floor": v.ratio,
        "smoother_share": v.smoother_share,
        "burst_share": v.burst_share,
        "session": {name: {k: getattr(s, k) for k in knobs(v.model)} for name, s in v.states},
        "effective_samples": v.effective_samples,
        "samples": v.samples,
        "notes": list(v.notes),
        "seconds": seconds,
    }
    return json.dumps(table, indent=1, default=float) + "\n"


def page(v: Verdict, seconds: float) -> str:
    """Make the self-contained HTML page."""
    pictures = _pictures(v)
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(v.nominal.name)}: reconcile</title>"
        f"<style>{STYLE}</style><h1>{html.escape(v.nominal.name)}: simulation against measurement</h1>",
        f"<p class='verdict {v.outcome.value}'><b>{v.outcome.value}</b> - {headline(v)}</p>",
    ]
    parts.append(_what(v))
    parts.append(
        "<h2>How far the gap shrank</h2><p>Root mean square on samples that took no part in any choice.</p>"
        + _gaps(v.gaps)
    )
    parts.append(_session(v))
    parts.append(pictures.get("gap", ""))
    parts.append(
        "<h2>Where it disagreed</h2>" + _where(v) + pictures.get("places", "") + pictures.get("spectra", "")
    )
    parts.append(
        "<h2>Why we believe it, and what else it could have been</h2>"
        + "".join(map(_why, (*v.effects, *v.symbolic)))
    )
    parts.append(_next(v))
    parts.append("<h2>How it was found</h2>" + _ladder(v))
    parts.append(
        f"<p class=small>{v.samples} samples count as {v.effective_samples:.0f} independent ones; the residual of the final "
        f"model is {v.ratio:.2f} of the expected innovation; a generic smoother over the state explains "
        f"{100 * v.smoother_share:.0f} % more; {100 * v.burst_share:.0f} % of the residual lies in the loudest tenth. "
        f"{seconds:.1f} s.</p></html>"
    )
    return "".join(parts)


def _what(v: Verdict) -> str:
    if not v.effects and not v.symbolic:
        return ""
    rows = []
    for e in (*v.effects, *v.symbolic):
        label = html.escape(e.title) if e in v.effects else "nameless term"
        for i, p in enumerate(e.parameters):
            first = (
                (
                    f"<td rowspan={len(e.parameters)}><b>{label}</b><td rowspan={len(e.parameters)}><code>"
                    f"{html.escape(e.equation)}</code>"
                )
                if i == 0
                else ""
            )
            rows.append(
                f"<tr>{first}<td>{p.symbol}<td class=n>{number(p.value)}<td class=n>{number(p.low)} to {number(p.high)}"
                f"<td>{html.escape(p.unit)}<td>{html.escape(p.text)}"
            )
    return (
        "<h2>What was missing</h2><table><tr><th>effect<th>equation<th>parameter<th>value<th>95 % interval<th>unit<th>"
        + "".join(rows)
        + "</table>"
    )


def _gaps(gaps: Sequence[Gap]) -> str:
    rows = "".join(
        f"<tr><td>{g.channel}<td class=n>{number(g.before)}<td class=n>{number(g.after)}<td class=n>"
        f"{number(g.floor)}<td>{g.unit}<td class=n>{100 * g.closed:.1f} %<td class=n>{_maybe(g.frozen)}"
        f"<td class=n>{_maybe(g.session)}"
        for g in gaps
    )
    return (
        "<table><tr><th>channel<th>before<th>after<th>noise floor<th>unit<th>closed<th>later half, frozen"
        f"<th>later half, session re-estimated{rows}</table>"
    )


def _maybe(value: float | None) -> str:
    return "-" if value is None else number(value)


def _session(v: Verdict) -> str:
    """Say what the session parameters came to, where they matter."""
    shown = knobs(v.model)
    units = {
        "offset": v.model.force_unit,
        "dry": "",
        "viscous": "",
        "zero": v.model.position_unit,
        "heat": "",
    }
    said = {
        "offset": "force offset",
        "dry": "dry friction, factor",
        "viscous": "viscous friction, factor",
        "zero": "encoder zero",
        "heat": "heat state at the start",
    }
    rows = "".join(
        f"<tr><td>{html.escape(name)}"
        + "".join(f"<td class=n>{number(getattr(s, k))} {units[k]}" for k in shown)
        for name, s in v.states
    )
    head = "".join(f"<th>{said[k]}" for k in shown)
    return (
        (
            f"<p>Session parameters, estimated on the first half of what is untouched of each record (no property of the axis, "
            f"and no part of the model):</p><table><tr><th>record{head}{rows}</table>"
        )
        if v.states
        else ""
    )


def _where(v: Verdict) -> str:
    shown = [p for p in v.places if p.p <= 0.05][:4]
    if not shown:
        return "<p>No variable of the state orders the force residual of the old model (permutation p &gt; 0.05).</p>"
    text = "; ".join(
        f"<b>{p.variable}</b> orders {100 * p.explained:.0f} % of it (p = {p.p:.2f})" for p in shown
    )
    return f"<p>Force residual of the old model with measured motion: {text}.</p>"


def _why(e: NamedEffect) -> str:
    items = [*e.evidence, f"it earns its place in {100 * e.frequency:.0f} % of block bootstrap replicates"]
    items += [f"{library()[n].title}: ruled out, {t}" for n, t in e.ruled_out.items() if n in library()]
    items += [
        f"<b>{library()[n].title}: not ruled out</b>, it {t}" for n, t in e.open.items() if n in library()
    ]
    return f"<h3>{html.escape(e.title)}</h3><ul>" + "".join(f"<li>{i}" for i in items) + "</ul>"


def _next(v: Verdict) -> str:
    parts = []
    if v.experiment is not None:
        parts.append(
            f"<p>To decide between the look-alikes: <b>{html.escape(v.experiment.text)}</b>; their forces then differ by "
            f"{v.experiment.separation:.0f} times the drive noise.</p>"
        )
    if v.gate.missing:
        rows = "".join(
            f"<li>{library()[n].title}: {html.escape(t)}" for n, t in v.gate.missing.items() if n in library()
        )
        parts.append(
            f"<p>Not excited by these records, and so not judged (with the record that would show it):</p><ul>{rows}</ul>"
        )
    if v.gate.pairs:
        pairs = "; ".join(f"{a} and {b} ({100 * c:.0f} % in common)" for a, b, c in v.gate.pairs)
        parts.append(f"<p>Look the same in these records: {pairs}.</p>")
    parts += [f"<p>{html.escape(n)}</p>" for n in v.notes]
    return "<h2>Next</h2>" + "".join(parts) if parts else ""


def _ladder(v: Verdict) -> str:
    rows = [f"<tr><td>channel<td>{f.effect}<td colspan=3>{html.escape(f.evidence)}" for f in v.findings]
    rows += [
        f"<tr><td>{s.action}<td>{s.effect}<td class=n>{s.ratio:.2f}<td class=n>{number(e)}<td>"
        + ", ".join(f"{n} {100 * g:.0f} %" for n, g in sorted(s.rivals.items(), key=lambda q: -q[1]))
        for s, e in zip(v.ladder, v.rungs, strict=True)
    ]
    return (
        f"<table><tr><th>step<th>effect<th>residual over expected<th>force error, untouched, {v.nominal.force_unit}"
        "<th>what its rivals saved on held-out blocks" + "".join(rows) + "</table>"
    )


def _pictures(v: Verdict) -> dict[str, str]:
    """Draw the pictures; without matplotlib the page says so."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return {"gap": "<p class=small>Pictures need matplotlib (the extra <code>report</code>).</p>"}
    out = {}
    if v.traces:
        out["gap"] = _image(
            _gap_picture(Figure(figsize=(11, 1.9 * min(len(v.traces), 4) + 1), layout="constrained"), v)
        )
    if v.places:
        out["places"] = _image(_place_picture(Figure(figsize=(11, 3.2), layout="constrained"), v))
    if v.spectra is not None:
        out["spectra"] = _image(_spectrum_picture(Figure(figsize=(11, 2.6), layout="constrained"), v))
    return out


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=80)
    return f"<img alt='' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"


def _gap_picture(figure: Figure, v: Verdict) -> Figure:
    shown = v.traces[:4]
    rows = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for ax, t in zip(rows, shown, strict=True):
        step = max(len(t.time_s) // 3000, 1)
        ax.axvspan(0.8 * t.time_s[-1], t.time_s[-1], color="#e8eef3", lw=0)
        ax.plot(
            t.time_s[::step],
            (t.before - t.measured)[::step],
            color="#c50",
            lw=0.7,
            label="simulated - measured, before",
        )
        ax.plot(t.time_s[::step], (t.after - t.measured)[::step], color="#08a", lw=0.7, label="after")
        reach = float(np.quantile(np.abs(t.before - t.measured), 0.998)) * 1.4 or 1.0
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(f"force, {v.nominal.force_unit}")
        ax.set_title(f"{t.name} (shaded: untouched)", fontsize=9, loc="left")
    rows[0].legend(loc="upper right", fontsize=8, ncols=2)
    rows[-1].set_xlabel("time, s")
    return figure


def _place_picture(figure: Figure, v: Verdict) -> Figure:
    shown = v.places[:4]
    for ax, p in zip(figure.subplots(1, len(shown), sharey=True, squeeze=False)[0], shown, strict=True):
        order = np.argsort(p.centres)
        ax.errorbar(
            p.centres[order], p.means[order], p.spread[order], fmt=".-", color="#c50", ecolor="#e9c5ae", lw=1
        )
        ax.axhline(0.0, color="#888", lw=0.6)
        ax.set_xlabel(f"{p.variable}, {p.unit}")
        ax.set_title(f"orders {100 * p.explained:.0f} %", fontsize=9)
    figure.axes[0].set_ylabel(f"missing force, {v.nominal.force_unit}")
    return figure


def _spectrum_picture(figure: Figure, v: Verdict) -> Figure:
    if v.spectra is None:
        return figure
    a, b = figure.subplots(1, 2)
    time, space = v.spectra
    a.loglog(time.axis[1:], time.density[1:], color="#c50", lw=0.8)
    a.set_xlabel("frequency, Hz")
    a.set_ylabel(f"{v.nominal.force_unit}/sqrt(Hz)")
    b.stem(space.axis, space.density, linefmt="#c50", markerfmt=".", basefmt=" ")
    b.set_xlabel("order, periods in a pitch")
    b.set_ylabel(v.nominal.force_unit)
    return figure
