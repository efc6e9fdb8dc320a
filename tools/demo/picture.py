"""The picture of the demo: position, velocity, force and events over time."""

from __future__ import annotations

from collections.abc import Sequence

from .recorder import Channel

_COLOURS = ("#1f6feb", "#d1641f", "#2d8a4e", "#8250df", "#bf3989", "#57606a")
_LETTER = 0.007
"""Width of a letter of a title, of that of the picture."""


def draw(
    path: str,
    rows: Sequence[tuple[str, Sequence[Channel]]],
    events: Sequence[tuple[float, str]],
    chapters: Sequence[tuple[float, str]],
) -> None:
    """Draw channels over time, one row a quantity, with chapters shaded and events numbered.

    Args:
        path: of the PNG.
        rows: (axis label, channels) from top to bottom.
        events: (time [s], text).
        chapters: (begin [s], title), in order.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    events = sorted(events)
    figure = Figure(figsize=(14, 2.1 * len(rows) + 2.2), layout="constrained")
    FigureCanvasAgg(figure)
    ratios = [1.0] * len(rows) + [0.16 + 0.115 * ((len(events) + 1) // 2)]
    *axes, legend = figure.subplots(len(rows) + 1, 1, gridspec_kw={"height_ratios": ratios})
    end_s = max((c.times_s[-1] for _, channels in rows for c in channels if c.times_s), default=1.0)
    for axis, (label, channels) in zip(axes, rows, strict=True):
        axis.sharex(axes[0])
        for colour, channel in zip(_COLOURS, channels, strict=False):
            axis.plot(channel.times_s, channel.values, color=colour, linewidth=1.1, label=channel.label)
        axis.set_ylabel(label)
        axis.grid(alpha=0.25)
        axis.legend(loc="upper right", fontsize=8, ncols=3, framealpha=0.85)
        for number, ((begin_s, _), nxt) in enumerate(zip(chapters, [*chapters[1:], (end_s, "")], strict=True)):
            axis.axvspan(begin_s, nxt[0], color="#eef2f6" if number % 2 else "#ffffff", zorder=0)
        for at_s, _ in events:
            axis.axvline(at_s, color="#cf222e", linewidth=0.7, alpha=0.6)
        if axis is not axes[-1]:
            axis.tick_params(labelbottom=False)
    axes[0].set_xlim(0, end_s)
    axes[-1].set_xlabel("time [s]")
    _number_events(axes[0], events, end_s)
    free_s = [0.0, 0.0]  # from where on a line of titles is free
    for begin_s, title in chapters:
        line = 0 if begin_s >= free_s[0] else 1
        free_s[line] = begin_s + len(title) * _LETTER * end_s
        axes[0].annotate(
            title, (begin_s, 1.16 + 0.14 * line), xycoords=("data", "axes fraction"), fontsize=9, fontweight="bold",
            annotation_clip=False,
        )  # fmt: skip
    legend.axis("off")
    half = (len(events) + 1) // 2
    for column, part in enumerate((events[:half], events[half:])):
        lines = [f"{column * half + i:2d}  {at_s:6.3f} s   {text}" for i, (at_s, text) in enumerate(part, 1)]
        legend.text(0.5 * column, 1.0, "\n".join(lines), va="top", fontsize=8.5, family="monospace")
    figure.savefig(path, dpi=110)


def _number_events(axis, events: Sequence[tuple[float, str]], end_s: float) -> None:  # type: ignore[no-untyped-def]
    """Write the numbers of the events above the top row, those too close to each other joined."""
    groups: list[tuple[float, list[int]]] = []
    for number, (at_s, _) in enumerate(events, 1):
        if groups and at_s - groups[-1][0] < end_s * 0.018:
            groups[-1][1].append(number)
        else:
            groups.append((at_s, [number]))
    for at_s, numbers in groups:
        text = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]}-{numbers[-1]}"
        axis.annotate(
            text, (at_s, 1.02), xycoords=("data", "axes fraction"), ha="center", fontsize=8, color="#cf222e",
            annotation_clip=False,
        )  # fmt: skip
