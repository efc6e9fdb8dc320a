"""The pictures of a report: the gaps, where it disagreed, what was found for every element, the curves before and
after.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.report.words import columns, groups
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, Gap, Verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Of the largest density, below which a spectrum shows the filter that made the residual and not the residual.
SHOWN = 1e-4


def pictures(v: Verdict) -> dict[str, Figure]:
    """Draw the pictures by what they show: "gaps", "places", "spectra", "each", "curves".

    Raises:
        ImportError: matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    def sheet(height: float) -> Figure:
        return Figure(figsize=(11, height), layout="constrained")

    told = [g for g in v.gaps if g.known]
    out = {"gaps": _gap_picture(sheet(0.6 + 0.35 * len(told)), told)} if told else {}
    if isinstance(v, AxisVerdict):
        if v.traces:
            out["curves"] = _trace_picture(sheet(1.9 * min(len(v.traces), 4) + 1), v)
        if v.places:
            out["places"] = _force_place_picture(sheet(3.2), v)
        if v.spectra is not None:
            out["spectra"] = _spectrum_picture(sheet(2.6), v)
    if isinstance(v, SensorVerdict):
        each = [
            (e.title, mine)
            for e in v.effects
            for mine in groups(e).values()
            if len(mine) > 1 and e.name != "dead_element"
        ]
        if each:
            out["each"] = _each_picture(sheet(2.6), each[:3])
        if v.curves:
            out["curves"] = _curve_picture(sheet(3.6), v)
        if v.places:
            out["places"] = _place_picture(sheet(3.2), v)
    return out


def _gap_picture(figure: Figure, gaps: Sequence[Gap]) -> Figure:
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
    ax.set_xlabel("(simulated - measured) / noise floor, held-out data", fontsize=8)
    figure.legend(loc="outside right upper", fontsize=8)
    return figure


def _trace_picture(figure: Figure, v: AxisVerdict) -> Figure:
    shown = v.traces[:4]
    floor = next((g.floor for g in reversed(v.gaps) if g.channel.startswith("force")), np.nan)
    loop = any("closed loop" in g.channel for g in v.gaps)
    what = "simulated - measured" if loop else "what short windows leave, as a force"
    rows = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for ax, t in zip(rows, shown, strict=True):
        step = max(len(t.time_s) // 3000, 1)
        ax.axvspan(t.untouched_s, t.time_s[-1], color="#e8eef3", lw=0)
        ax.plot(
            t.time_s[::step],
            (t.before - t.measured)[::step],
            color="#c50",
            lw=0.7,
            label=f"{what}, before",
        )
        ax.plot(t.time_s[::step], (t.after - t.measured)[::step], color="#08a", lw=0.7, label="after")
        for side in (-1.0, 1.0) if np.isfinite(floor) else ():
            ax.axhline(side * floor, color="#1c2733", lw=0.6, ls="--", label="noise floor" if side > 0 else None)
        settled = np.abs(t.before - t.measured)[len(t.measured) // 10 :]  # a record may begin in motion
        reach = float(np.quantile(settled, 0.998)) * 1.4 or 1.0
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(f"force, {v.nominal.force_unit}")
        ax.set_title(f"{t.name} (shaded: untouched)", fontsize=9, loc="left")
    rows[0].legend(loc="upper right", fontsize=8, ncols=3)
    rows[-1].set_xlabel("time, s")
    return figure


def _force_place_picture(figure: Figure, v: AxisVerdict) -> Figure:
    shown = v.places[:4]
    for ax, p in zip(figure.subplots(1, len(shown), sharey=True, squeeze=False)[0], shown, strict=True):
        order = np.argsort(p.centres)
        ax.errorbar(p.centres[order], p.means[order], p.spread[order], fmt=".-", color="#c50", ecolor="#e9c5ae", lw=1)
        ax.axhline(0.0, color="#888", lw=0.6)
        ax.set_xlabel(f"{p.variable}, {p.unit}".removesuffix(", 1"))
        ax.set_title(f"orders {100 * p.explained:.0f} %", fontsize=9)
    figure.axes[0].set_ylabel(f"missing force, {v.nominal.force_unit}")
    return figure


def _spectrum_picture(figure: Figure, v: AxisVerdict) -> Figure:
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


def _each_picture(figure: Figure, each: list[tuple[str, list[Estimate]]]) -> Figure:
    """Draw the numbers that every element (or component) has of its own, with their intervals."""
    for ax, (title, mine) in zip(figure.subplots(1, len(each), squeeze=False)[0], each, strict=True):
        if len(columns(mine)) > 1:
            _matrix_picture(figure, ax, title, columns(mine))
            continue
        at = np.arange(len(mine))
        value = np.array([p.value for p in mine])
        ax.bar(at, value, color="#9cc9d8")
        ax.errorbar(at, value, [0.5 * (p.high - p.low) for p in mine], fmt="none", ecolor="#1c2733", lw=1)
        ax.axhline(0.0, color="#888", lw=0.6)
        ax.set_title(title, fontsize=9, loc="left")
        ax.set_xlabel("element or component", fontsize=8)
        unit = f", {mine[0].unit}" if mine[0].unit != "1" else ""
        ax.set_ylabel(mine[0].symbol.split("[")[0] + unit, fontsize=8)
    return figure


def _matrix_picture(figure: Figure, ax: Any, title: str, parts: dict[str, list[Estimate]]) -> None:
    values = np.array([[p.value for p in mine] for mine in parts.values()]).T
    most = float(np.abs(values).max())
    shown = ax.imshow(values, cmap="RdBu_r", vmin=-most, vmax=most)
    names = [name.split("_")[-1] for name in parts]
    ax.set_xticks(range(len(names)), names, fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.set_xlabel("load of", fontsize=8)
    ax.set_ylabel("seen in the reading of", fontsize=8)
    ax.set_title(title, fontsize=9, loc="left")
    figure.colorbar(shown, ax=ax)


def _curve_picture(figure: Figure, v: SensorVerdict) -> Figure:
    top, bottom = figure.subplots(2, len(v.curves), squeeze=False, sharex="col", height_ratios=(2, 1))
    for upper, lower, c in zip(top, bottom, v.curves, strict=True):
        upper.plot(c.at, c.before, color="#c50", lw=1, label="simulated, before")
        upper.plot(c.at, c.after, color="#08a", lw=1, label="simulated, after")
        used = ~c.apart
        upper.plot(c.at[used], c.measured[used], ".", color="#9aa6b1", ms=3, label="measured, used")
        upper.plot(c.at[c.apart], c.measured[c.apart], ".", color="#1c2733", ms=5, label="measured, held out")
        upper.set_title(c.title, fontsize=8, loc="left")
        lower.plot(c.at, c.before - c.measured, color="#c50", lw=0.8)
        lower.plot(c.at, c.after - c.measured, color="#08a", lw=0.8)
        lower.axhline(0.0, color="#888", lw=0.6)
        lower.set_xlabel(c.axis)
        upper.set_ylabel(c.unit)
    bottom[0].set_ylabel("sim. - meas.")
    figure.legend(*top[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, fontsize=8)
    return figure


def _place_picture(figure: Figure, v: SensorVerdict) -> Figure:
    shown = v.places[:4]
    for ax, p in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        order = np.argsort(p.centres)
        ax.errorbar(p.centres[order], p.means[order], p.spread[order], fmt=".-", color="#c50", ecolor="#e9c5ae", lw=1)
        ax.axhline(0.0, color="#888", lw=0.6)
        name, view = p.variable.removesuffix(")").split(" (")
        ax.set_xlabel(f"{name}, {p.unit}".removesuffix(", 1"), fontsize=8)
        ax.set_title(f"{view}: {100 * p.explained:.0f} %, p = {p.p:.2f}", fontsize=8)
        unit = next((g.unit for g in v.gaps if g.channel == view), "")
        ax.set_ylabel(f"measured - simulated, {unit}", fontsize=8)
    return figure
