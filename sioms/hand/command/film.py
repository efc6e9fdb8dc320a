"""The picture and the animation of a demonstration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from sioms.hand.command.canvas import outline_at
from sioms.hand.command.frames import Frame, Point
from sioms.hand.contacts import FINGER_M

COLOURS = {
    "open": "#dddddd", "close": "#cfe3f5", "sense": "#fff2c9", "classify": "#fff2c9", "regrasp": "#e4d4f0",
    "roll": "#d4efd9", "hold": "#c3ebc3", "fault": "#f6c9c9", "idle": "#eeeeee",
}  # fmt: skip
FINGERS = ("#1f6fb4", "#c8501e")
OBJECT = "#6b5b4b"
_CORE_M = 9.6e-3
_ARROW_M = 0.018
"""Length of a newton."""


def scene(axes: Axes, frame: Frame, outline: Sequence[Point], half_m: float = 0.075) -> None:
    """Draw what is on the platen at an instant, in millimetres."""
    axes.add_patch(
        Polygon(1e3 * np.array(outline_at(outline, frame.pose)), facecolor="#e8dfd2", edgecolor=OBJECT, lw=1.4)
    )
    mark = outline_at([(0.0, 0.0), (0.45 * max(math.hypot(*p) for p in outline), 0.0)], frame.pose)
    axes.plot([1e3 * p[0] for p in mark], [1e3 * p[1] for p in mark], "-", color=OBJECT, lw=0.9)
    for side, colour in zip(frame.sides, FINGERS, strict=True):
        axes.plot(
            [1e3 * side.axis[0], 1e3 * side.centre[0]], [1e3 * side.axis[1], 1e3 * side.centre[1]],
            "-", color=colour, lw=3.2, alpha=0.35, solid_capstyle="round",
        )  # fmt: skip
        x, y = 1e3 * side.centre[0], 1e3 * side.centre[1]
        axes.add_patch(Circle((x, y), 1e3 * FINGER_M, facecolor="white", edgecolor=colour, lw=1.6))
        axes.add_patch(Circle((x, y), 1e3 * _CORE_M, facecolor=colour, alpha=0.25, lw=0))
        if side.contact is not None:
            _press(axes, side.contact, side.centre, side.force, colour)
    axes.set(xlim=(-1e3 * half_m, 1e3 * half_m), ylim=(-60, 60), aspect="equal", xticks=[], yticks=[])


def _press(axes: Axes, contact: Point, centre: Point, force: float, colour: str) -> None:
    nx, ny = contact[0] - centre[0], contact[1] - centre[1]
    long = _ARROW_M * force / max(math.hypot(nx, ny), 1e-9)
    start, end = (1e3 * contact[0], 1e3 * contact[1]), (1e3 * (contact[0] + long * nx), 1e3 * (contact[1] + long * ny))
    axes.annotate("", xy=end, xytext=start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})


def picture(path: Path, frames: Sequence[Frame], outline: Sequence[Point], marks: Sequence[tuple[float, str]]) -> None:
    """Write the picture: the hand at the marks, and forces and friction angles over time.

    Args:
        path: of the file; its ending says the format.
        frames: of the whole demonstration.
        outline: of the object [m].
        marks: instants [s] and what they show.
    """
    figure = Figure(figsize=(11.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, len(marks), height_ratios=(1.5, 1.0, 1.0))
    for column, (time_s, text) in enumerate(marks):
        axes = figure.add_subplot(grid[0, column])
        frame = min(frames, key=lambda one: abs(one.time_s - time_s))
        scene(axes, frame, outline)
        axes.set_title(f"{text}\n{frame.time_s:.1f} s", fontsize=9)
    top, bottom = figure.add_subplot(grid[1, :]), figure.add_subplot(grid[2, :])
    time = [frame.time_s for frame in frames]
    for i, colour in enumerate(FINGERS):
        top.plot(time, [frame.sides[i].force for frame in frames], color=colour, lw=1.0, label=f"finger {i + 1}, true")
        felt = [frame.sides[i].felt for frame in frames]
        top.plot(time, felt, ".", color=colour, ms=2.2, alpha=0.5, label=f"finger {i + 1}, felt")
        eta = [math.degrees(frame.eta[i]) for frame in frames]
        bottom.plot(time, eta, color=colour, lw=1.4, label=f"friction angle {i + 1}, true")
    bottom.axhline(0.0, color="0.5", lw=0.6)
    top.set(ylabel="force, N", xticklabels=[])
    bottom.set(ylabel="friction angle, deg", xlabel="time, s")
    for axes in (top, bottom):
        _shade(axes, frames)
        axes.set_xlim(time[0], time[-1])
    top.legend(loc="upper left", fontsize=7, ncols=2, framealpha=0.85)
    bottom.legend(loc="upper right", fontsize=7, ncols=2, framealpha=0.85)
    for time_s, _ in marks:
        for axes in (top, bottom):
            axes.axvline(time_s, color="0.3", lw=0.6, ls=":")
    _name_states(top, frames)
    figure.savefig(path, dpi=110)


def _spans(frames: Sequence[Frame]) -> list[tuple[float, float, str]]:
    spans: list[tuple[float, float, str]] = []
    for frame in frames:
        if spans and spans[-1][2] == frame.state:
            spans[-1] = (spans[-1][0], frame.time_s, frame.state)
        else:
            spans.append((spans[-1][1] if spans else frame.time_s, frame.time_s, frame.state))
    return spans


def _shade(axes: Axes, frames: Sequence[Frame]) -> None:
    for begin, end, state in _spans(frames):
        axes.axvspan(begin, end, color=COLOURS.get(state, "white"), lw=0, zorder=0)


def _name_states(axes: Axes, frames: Sequence[Frame]) -> None:
    least = 0.035 * (frames[-1].time_s - frames[0].time_s)
    for begin, end, state in _spans(frames):
        if end - begin > least:
            axes.text(
                0.5 * (begin + end), 1.02, state, transform=axes.get_xaxis_transform(), ha="center", fontsize=7.5,
                color="0.25",
            )  # fmt: skip


def animation(path: Path, frames: Sequence[Frame], outline: Sequence[Point], rate_hz: float) -> None:
    """Write the animation (gif) at the pace of the simulated time."""
    figure = Figure(figsize=(5.6, 4.9), layout="constrained")
    axes = figure.subplots()
    writer = PillowWriter(fps=round(rate_hz))
    with writer.saving(figure, str(path), dpi=80):
        for frame in frames:
            axes.clear()
            scene(axes, frame, outline)
            axes.set_facecolor(COLOURS.get(frame.state, "white"))
            eta = [f"{math.degrees(e):+.1f}" for e in frame.eta if math.isfinite(e)]
            axes.set_title(f"{frame.time_s:5.1f} s   {frame.state}", loc="left", fontsize=10)
            axes.set_title(f"friction angles {' and '.join(eta)} deg" if eta else "", loc="right", fontsize=9)
            axes.set_xlabel(frame.told[:78], fontsize=7.5)
            writer.grab_frame()
