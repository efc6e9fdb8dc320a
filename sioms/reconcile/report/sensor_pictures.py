"""The pictures of a report on a sensor: what was found for every element, the gaps, the curves, where it disagreed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sioms.reconcile.report.page import NO_PICTURES, gap_picture, image
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, NamedEffect

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def groups(e: NamedEffect) -> dict[str, list[Estimate]]:
    """Return the estimates by quantity; one that every element has of its own comes with all its numbers, a matrix as one."""
    out: dict[str, list[Estimate]] = {}
    for p in e.parameters:
        out.setdefault(p.symbol.split("[")[0].split("_")[0], []).append(p)
    return out


def columns(mine: list[Estimate]) -> dict[str, list[Estimate]]:
    """Return the columns of a matrix by their symbols; one for what is no matrix."""
    out: dict[str, list[Estimate]] = {}
    for p in mine:
        out.setdefault(p.symbol.split("[")[0], []).append(p)
    return out


def pictures(v: SensorVerdict) -> dict[str, str]:
    """Draw the pictures; without matplotlib the page says so."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return NO_PICTURES
    out = {
        "gap": image(
            gap_picture(Figure(figsize=(11, 0.6 + 0.35 * len(v.gaps)), layout="constrained"), v.gaps)
        )
    }
    each = [
        (e.title, mine)
        for e in v.effects
        for mine in groups(e).values()
        if len(mine) > 1 and e.name != "dead_element"
    ]
    if each:
        out["each"] = image(_each_picture(Figure(figsize=(11, 2.6), layout="constrained"), each[:3]))
    if v.curves:
        out["curves"] = image(_curve_picture(Figure(figsize=(11, 3.6), layout="constrained"), v))
    if v.places:
        out["places"] = image(_place_picture(Figure(figsize=(11, 3.2), layout="constrained"), v))
    return out


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
        upper.plot(
            c.at[c.apart], c.measured[c.apart], ".", color="#1c2733", ms=5, label="measured, took no part"
        )
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
        ax.errorbar(
            p.centres[order], p.means[order], p.spread[order], fmt=".-", color="#c50", ecolor="#e9c5ae", lw=1
        )
        ax.axhline(0.0, color="#888", lw=0.6)
        name, view = p.variable.removesuffix(")").split(" (")
        ax.set_xlabel(f"{name}, {p.unit}".removesuffix(", 1"), fontsize=8)
        ax.set_title(f"{view}: {100 * p.explained:.0f} %, p = {p.p:.2f}", fontsize=8)
        unit = next((g.unit for g in v.gaps if g.channel == view), "")
        ax.set_ylabel(f"measured - simulated, {unit}", fontsize=8)
    return figure
