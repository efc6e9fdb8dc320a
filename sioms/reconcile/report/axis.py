"""The report on an axis: a self-contained page, verdict.json and the terminal's ten lines."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sioms.reconcile.effects import library
from sioms.reconcile.report import page as common
from sioms.reconcile.report.page import CHANCE, NO_PICTURES, gap_of, gap_picture, image, number
from sioms.reconcile.session import knobs
from sioms.reconcile.verdict import Gap, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Of the largest density, below which a spectrum shows the filter that made the residual and not the residual.
SHOWN = 1e-4


def summary(v: Verdict, out: str) -> list[str]:
    """Say the verdict in at most ten lines; the gap in force, or of the one channel there is."""
    return common.summary(v, _speaking(v), out)


def _speaking(v: Verdict) -> Gap:
    return v.gaps[min(1, len(v.gaps) - 1)]


def as_json(v: Verdict, seconds: float) -> str:
    """Everything a program wants from the verdict."""
    more = {
        "gaps": [
            {**gap_of(g), "frozen_later_half": g.frozen, "session_later_half": g.session} for g in v.gaps
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
        "alternative_parameters": [{name: dict(values) for name, values in m.items()} for m in v.others],
        "not_excited": v.gate.missing,
        "same_in_these_records": [list(p) for p in v.gate.pairs],
        "residual_over_floor": v.ratio,
        "session": {name: {k: getattr(s, k) for k in knobs(v.model)} for name, s in v.states},
    }
    return common.as_json(v, more, seconds)


def page(v: Verdict, seconds: float) -> str:
    """Make the self-contained HTML page."""
    pictures = _pictures(v)
    parts = [
        common.opening(v, _speaking(v), _title),
        "<h2>Where it disagreed</h2>" + _where(v) + pictures.get("places", "") + pictures.get("spectra", ""),
        _what(v),
        "<h2>How far the gap shrank</h2><p>Root mean square on samples that took no part in any choice.</p>",
        _gaps(v.gaps) + pictures.get("floors", "") + pictures.get("gap", ""),
        "<h2>Why we believe it, and what else it could have been</h2>",
        common.why((*v.effects, *v.symbolic), _title),
        common.what_next(v, "their forces then differ", v.gate.missing, v.gate.pairs, _title),
    ]
    parts.append("<h2>How it was found</h2>" + _ladder(v) + _session(v))
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
            value, low, high = common.span(p)
            rows.append(
                f"<tr>{first}<td>{p.symbol}<td class=n>{value}<td class=n>{low} to {high}"
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
        f"{number(g.floor)}<td>{g.unit}<td>{g.floor_from}<td class=n>{100 * g.closed:.1f} %<td class=n>{_maybe(g.frozen)}"
        f"<td class=n>{_maybe(g.session)}"
        for g in gaps
    )
    return (
        "<table><tr><th>channel<th>before<th>after<th>noise floor<th>unit<th>floor from<th>closed<th>later half, frozen"
        f"<th>later half, session re-estimated{rows}</table><p>Table and pictures are of the model to which the untouched samples have "
        "contributed nothing. The numbers of the effects and model.toml come from a last fit to all records after that.</p>"
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
    shown = [p for p in v.places if p.p <= CHANCE][:4]
    if not shown:
        return "<p>No variable of the state orders the force residual of the old model (permutation p &gt; 0.05).</p>"
    text = "; ".join(
        f"<b>{p.variable}</b> orders {100 * p.explained:.0f} % of it (p = {p.p:.2f})" for p in shown
    )
    return f"<p>Force residual of the old model with measured motion: {text}.</p>"


def _title(name: str) -> str | None:
    known = library()
    return known[name].title if name in known else None


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
        return NO_PICTURES
    out = {
        "floors": image(
            gap_picture(Figure(figsize=(11, 0.6 + 0.35 * len(v.gaps)), layout="constrained"), v.gaps)
        )
    }
    if v.traces:
        out["gap"] = image(
            _gap_picture(Figure(figsize=(11, 1.9 * min(len(v.traces), 4) + 1), layout="constrained"), v)
        )
    if v.places:
        out["places"] = image(_place_picture(Figure(figsize=(11, 3.2), layout="constrained"), v))
    if v.spectra is not None:
        out["spectra"] = image(_spectrum_picture(Figure(figsize=(11, 2.6), layout="constrained"), v))
    return out


def _gap_picture(figure: Figure, v: Verdict) -> Figure:
    shown, floor = v.traces[:4], _speaking(v).floor
    rows = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for ax, t in zip(rows, shown, strict=True):
        step = max(len(t.time_s) // 3000, 1)
        ax.axvspan(t.untouched_s, t.time_s[-1], color="#e8eef3", lw=0)
        ax.plot(
            t.time_s[::step],
            (t.before - t.measured)[::step],
            color="#c50",
            lw=0.7,
            label="simulated - measured, before",
        )
        ax.plot(t.time_s[::step], (t.after - t.measured)[::step], color="#08a", lw=0.7, label="after")
        for side in (-1.0, 1.0):
            ax.axhline(
                side * floor, color="#1c2733", lw=0.6, ls="--", label="noise floor" if side > 0 else None
            )
        settled = np.abs(t.before - t.measured)[len(t.measured) // 10 :]  # a record may begin in motion
        reach = float(np.quantile(settled, 0.998)) * 1.4 or 1.0
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(f"force, {v.nominal.force_unit}")
        ax.set_title(f"{t.name} (shaded: untouched)", fontsize=9, loc="left")
    rows[0].legend(loc="upper right", fontsize=8, ncols=3)
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
        ax.set_xlabel(f"{p.variable}, {p.unit}".removesuffix(", 1"))
        ax.set_title(f"orders {100 * p.explained:.0f} %", fontsize=9)
    figure.axes[0].set_ylabel(f"missing force, {v.nominal.force_unit}")
    return figure


def _spectrum_picture(figure: Figure, v: Verdict) -> Figure:
    if v.spectra is None:
        return figure
    a, b = figure.subplots(1, 2)
    time, space = v.spectra
    a.loglog(time.axis[1:], time.density[1:], color="#c50", lw=0.8)
    a.set_ylim(SHOWN * float(time.density[1:].max()), 2.0 * float(time.density[1:].max()))
    a.set_title("missing force in time", fontsize=9)
    b.set_title("missing force in place", fontsize=9)
    a.set_xlabel("frequency, Hz")
    a.set_ylabel(f"{v.nominal.force_unit}/sqrt(Hz)")
    b.stem(space.axis, space.density, linefmt="#c50", markerfmt=".", basefmt=" ")
    b.set_xlabel("order, periods in a pitch")
    b.set_ylabel(v.nominal.force_unit)
    return figure
