"""What a technician reads of the watch: one page with a line an axis, and for each that has drifted what, how much,
since when, what to do, and the course of the numbers. And the same in a few lines for a terminal.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sioms.reconcile.watch.blocks import Block
from sioms.reconcile.watch.causes import BY_NAME
from sioms.reconcile.watch.normal import PLACE, PLAY, Normal, estimate
from sioms.reconcile.watch.propose import Gains, Proposal, propose
from sioms.reconcile.watch.rows import DRY, MASS, VISCOUS
from sioms.report_page import Page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sioms.reconcile.live.watch import Watched

#: Blocks of which one point of a picture is made.
POINT = 3
#: Numbers that a picture shows: where, title, unit.
SHOWN = ((DRY, "dry friction", "{F}"), (VISCOUS, "viscous friction", "{F} s/{x}"), (MASS, "mass", "{m}"),
         (PLACE, "place", "{x}"), (PLAY, "play", "{x}"))  # fmt: skip


def _when(at_s: float, offset_s: float) -> str:
    return datetime.fromtimestamp(at_s + offset_s).strftime("%Y-%m-%d %H:%M")


def line(axis: Watched, offset_s: float) -> tuple[str, str]:
    """Return the state of an axis and what there is to say about it."""
    watch = axis.watch
    if watch.normal is None:
        return "learning", f"{len(watch.blocks)} blocks of motion so far, {watch.motion_s / 60:.0f} min of motion"
    if watch.drift is None:
        told = "" if watch.blocks else "; it has not moved enough since to say anything"
        return "normal", f"as in its commissioning phase, {watch.motion_s / 3600:.1f} h of motion{told}"
    return (
        "drift" if watch.drift.name else "open",
        f"{watch.drift.text(watch.about)}, since {_when(watch.drift.since_s, offset_s)}",
    )


def summary(axes: Mapping[str, Watched], offset_s: float) -> list[str]:
    """Return a few lines for a terminal."""
    wide = max((len(name) for name in axes), default=0)
    out = []
    for name, axis in axes.items():
        state, text = line(axis, offset_s)
        out.append(f"{name:{wide}}  {state:8}  {text}")
    return out


def proposal_of(axis: Watched) -> Proposal | None:
    """Return what would make up for the drift of an axis, None where there is none."""
    watch = axis.watch
    if watch.normal is None or watch.drift is None:
        return None
    latest = list(watch.blocks)[-24:]
    usual = np.diag(watch.normal.per**2)
    gram = np.sum([b.gram for b in latest], axis=0)[:-1, :-1] if latest else usual
    gains = Gains(*axis.gains) if len(axis.gains) == 4 else None
    return propose(watch.about, watch.normal, watch.drift, gram, gains)


def proposal_text(axis: Watched, proposal: Proposal | None) -> str:
    """Return the lines of an axis's table in the configuration, with what they are for as comments."""
    name = axis.watch.about.name
    if proposal is None or axis.watch.drift is None:
        return f"# {name}: nothing has drifted\n"
    lines = [f"# {name}: {axis.watch.drift.text(axis.watch.about)}", *(f"# {todo}" for todo in proposal.todo)]
    if proposal.gains is not None:
        lines += [
            f"# following error against that of the unchanged axis: {proposal.expected_before:.2f} times as it is, "
            f"{proposal.expected:.2f} times expected with these gains",
            f"# distance of the open loop from -1: {proposal.margin_before:.2f}, with these {proposal.margin:.2f}",
        ]
    lines += proposal.keys
    return "\n".join(lines) + "\n"


def write(axes: Mapping[str, Watched], path: Path, offset_s: float) -> None:
    """Write the page."""
    page = Page("Axes in production")
    drifted = {n: a for n, a in axes.items() if a.watch.drift is not None}
    learning = [n for n, a in axes.items() if a.watch.normal is None]
    if drifted:
        page.box("bad", [f"{n}: {line(a, offset_s)[1]}" for n, a in drifted.items()])
    elif learning:
        page.box("warn", [f"Still learning what is normal: {', '.join(learning)}."])
    else:
        page.box("good", ["No axis has changed since its commissioning phase."])
    page.table(("axis", "state", "what"), [(n, *_marked(*line(a, offset_s))) for n, a in axes.items()])
    for name, axis in drifted.items():
        _section(page, name, axis, offset_s)
    page.small(
        "Numbers are learnt from moves in the commissioning phase; later ones are compared with how they varied there. "
        "A cause is named only where all others that are known explain the change far worse."
    )
    page.write(path)


def _marked(state: str, text: str) -> tuple[str, str]:
    mark = {"normal": "ok:", "drift": "no:", "open": "no:"}.get(state, "")
    return f"{mark}{state}", text


def _section(page: Page, name: str, axis: Watched, offset_s: float) -> None:
    watch, proposal = axis.watch, proposal_of(axis)
    if watch.drift is None or watch.normal is None:
        return
    page.head(name)
    page.text(f"{watch.drift.text(watch.about)}. Since {_when(watch.drift.since_s, offset_s)}.")
    if not watch.drift.name and watch.drift.names:
        page.items([f"{n}: {BY_NAME[n].text}" for n in watch.drift.names])
    if proposal is not None:
        page.lesser("What to do")
        page.items(proposal.todo)
        page.lines(proposal_text(axis, proposal).splitlines())
    if watch.blocks:
        page.figure(
            course(axis, watch.normal, offset_s),
            "Course of the numbers. Grey: how far each varied in the commissioning phase; red: when the change began.",
        )


def course(axis: Watched, normal: Normal, offset_s: float) -> Figure:
    """Draw how the numbers of an axis went."""
    from matplotlib.figure import Figure

    watch, about = axis.watch, axis.watch.about
    shown = [s for s in SHOWN if s[0] < PLACE or normal.edges]
    figure = Figure(figsize=(9.0, 1.5 * len(shown) + 0.6), layout="constrained")
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    groups = _groups(list(watch.blocks))
    last = watch.blocks[-1].end_s if watch.blocks else 0.0
    hours = np.array([(g[-1].end_s - last) / 3600.0 for g in groups])
    each = [estimate(g, normal.loads, normal.edges, normal.scatter, normal.noise, about.travel) for g in groups]
    for panel, (at, title, unit) in zip(panels, shown, strict=True):
        value = np.array([e.theta[at] for e in each])
        sure = np.array([np.sqrt(e.noise[at, at]) for e in each])
        good = sure < 1e3 * np.sqrt(normal.own[at, at]) + 1e-12
        middle, half = normal.theta[at], 2.0 * np.sqrt(normal.own[at, at])
        panel.axhspan(middle - half, middle + half, color="0.88")
        panel.errorbar(hours[good], value[good], 2.0 * sure[good], fmt=".", ms=4, lw=0.8, color="#1c5d99")
        panel.set_ylabel(f"{title}\n[{about.unit(unit)}]", fontsize=8)
        panel.grid(alpha=0.3)
        if watch.drift is not None:
            panel.axvline((watch.drift.since_s - last) / 3600.0, color="#a01010", lw=1.2)
    panels[-1].set_xlabel(f"hours before {_when(last, offset_s)}")
    return figure


def _groups(blocks: list[Block]) -> list[list[Block]]:
    return [blocks[i : i + POINT] for i in range(0, len(blocks) - POINT + 1, POINT)] or ([blocks] if blocks else [])
