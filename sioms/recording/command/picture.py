"""The picture of a recording: a panel for each node and unit; what does not change is a line of text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import NodeClass
from sioms.recording.reader import Recording
from sioms.recording.story import sentence
from sioms.recording.tables import head_of, main_column

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TOLD = 12
"""Stops and faults that are told in words; all of them are drawn."""
MOST_DRAWN = 40
"""Panels of a picture: of more it takes minutes, and of hundreds it would be higher than pictures may be."""


@dataclass
class Panel:
    """Curves of a node in one unit.

    Attributes:
        title: the node.
        unit: of its curves, "" for none.
        curves: label, stamps [ns], values.
        steps: whether values hold until the next one.
    """

    title: str
    unit: str
    steps: bool
    curves: list[tuple[str, NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=list)


def panels(
    recording: Recording, nodes: Sequence[str], column: str | None, start_ns: int, end_ns: int
) -> tuple[list[Panel], list[str]]:
    """Return what there is to draw, and each curve that does not change, with its value.

    Args:
        nodes: names of those that are drawn in any case; none: all nodes, as far as they change.
        column: of axes and of other nodes, None = the usual one of each class.
        start_ns, end_ns: log times [ns].
    """
    drawn: list[Panel] = []
    still: list[str] = []
    for name in nodes or recording.nodes:
        info = recording.node(name).info
        read = column or main_column(info)
        table = recording.table(name, [read], start_ns, end_ns)
        by_unit: dict[str, Panel] = {}
        for channel in range(len(info.channels)):
            label, _, unit = head_of(info, channel, read).removesuffix("]").partition(" [")
            values = table.values[read][:, channel].astype(float)
            if not nodes and len(values) and (values == values[0]).all():
                still.append(f"{name} {label} {values[0]:g} {unit}".rstrip())
                continue
            panel = by_unit.setdefault(unit, Panel(name, unit, info.node_class is NodeClass.BINARY))
            panel.curves.append((label, table.stamps_ns, values))
        drawn += by_unit.values()
    return drawn, still


def draw(recording: Recording, nodes: Sequence[str], column: str | None, start_ns: int, end_ns: int) -> Figure:
    """Return a picture over time; see ``panels``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn, still = panels(recording, nodes, column, start_ns, end_ns)
    left = dict.fromkeys(panel.title for panel in drawn[MOST_DRAWN:])
    drawn = drawn[:MOST_DRAWN]
    zero = min((int(stamps[0]) for panel in drawn for _, stamps, _ in panel.curves if len(stamps)), default=0)
    marks = [e for e in recording.events() if e.kind in ("stop", "fault") and start_ns <= e.stamp_ns < end_ns]
    told = [f"{(e.stamp_ns - zero) / 1e9:.3f} s  {sentence(e)}" for e in marks[:MOST_TOLD]] if drawn else []
    text = told + [f"not drawn, name them to see them: {', '.join(left)}"] * bool(left)
    text += [f"unchanged: {', '.join(still)}"] * bool(still)
    figure = Figure(figsize=(10, 1.2 + 2.0 * len(drawn) + 0.2 * len(text)), layout="constrained")
    FigureCanvasAgg(figure)
    rows: Any = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0] if drawn else []
    for axes, panel in zip(rows, drawn, strict=True):
        for label, stamps, values in panel.curves:
            style = "steps-post" if panel.steps else "default"
            axes.plot((stamps - zero) / 1e9, values, label=label, lw=0.8, drawstyle=style)
        for event in marks:
            axes.axvline((event.stamp_ns - zero) / 1e9, color="red", lw=0.6)
        axes.set_title(panel.title, loc="left", fontsize=10)
        axes.set_ylabel(f"[{panel.unit}]" if panel.unit else "")
        columns = 1 + len(panel.curves) // 9
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, ncols=columns, frameon=False)
        axes.margins(x=0.01)
    figure.supxlabel(
        "\n".join(["time [s]"] * bool(drawn) + [_wrapped(each) for each in text]), fontsize=8, x=0.01, ha="left"
    )
    return figure


def _wrapped(text: str) -> str:
    from textwrap import fill

    return fill(text, 150, subsequent_indent="    ", break_long_words=False)
