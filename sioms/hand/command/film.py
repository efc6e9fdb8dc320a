"""The picture and the animation of a demonstration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from sioms.hand.command.canvas import outline_at
from sioms.hand.command.frames import Frame, Point
from sioms.hand.contacts import FINGER_M

COLOURS = {
    "open": "#e4e4e4", "close": "#cfe3f5", "sense": "#fff2c9", "classify": "#fff2c9", "feel": "#e8d9f3",
    "regrasp": "#d9cdf0", "roll": "#cdeed6", "hold": "#c3ebc3", "killed": "#f6c9c9", "idle": "#eeeeee",
}  # fmt: skip
FINGERS = ("#1f6fb4", "#c8501e")
OBJECT, KNOWN, PROBER, PAPER, INK = "#6b5b4b", "#7d3c98", "#555555", "#fbfaf7", "#333333"
_CORE_M = 9.6e-3
_ARROW_M = 0.018
"""Length of a newton."""
_PATCH = 40
_FINE = 2
"""Pixels are drawn this many times finer, and then averaged."""
SIZE, SCENE, CHART = (680, 560), (680, 372), (680, 116)
_HEAD = SIZE[1] - SCENE[1] - CHART[1]
_EDGE, _MOST_DEG, _MOST_N = (46, 10), 24.0, 1.6
SWIFT = {"feel": 4, "open": 2, "regrasp": 2, "close": 2}
"""States that the animation shows so many times as fast."""


class _Scene:
    """A drawing of the platen: metres to pixels, x to the right, y up."""

    def __init__(self, size: tuple[int, int], view_m: float, middle: Point = (0.0, 0.0)) -> None:
        self._size, self._middle = size, middle
        self._scale = _FINE * size[0] / view_m
        self.image = Image.new("RGB", (_FINE * size[0], _FINE * size[1]), PAPER)
        self.draw = ImageDraw.Draw(self.image)

    def at(self, point: Point) -> Point:
        x, y = point[0] - self._middle[0], point[1] - self._middle[1]
        return 0.5 * self.image.width + self._scale * x, 0.5 * self.image.height - self._scale * y

    def line(self, points: Sequence[Point], colour: str, width: float) -> None:
        self.draw.line([self.at(point) for point in points], colour, round(_FINE * width), joint="curve")

    def disk(self, centre: Point, radius_m: float, fill: str | None, colour: str | None = None, width: int = 0) -> None:
        (x, y), r = self.at(centre), self._scale * radius_m
        self.draw.ellipse((x - r, y - r, x + r, y + r), fill, colour, _FINE * width)

    def dashed(self, points: Sequence[Point], colour: str, width: float, dash_m: float = 2.2e-3) -> None:
        """Draw a closed dashed line."""
        left, on = dash_m, True
        for start, end in pairwise([*points, points[0]]):
            long, gone = math.dist(start, end), 0.0
            while gone < long:
                by = min(left, long - gone)
                ends = [
                    (start[0] + (end[0] - start[0]) * t / long, start[1] + (end[1] - start[1]) * t / long)
                    for t in (gone, gone + by)
                ]
                if on:
                    self.line(ends, colour, width)
                gone, left = gone + by, left - by
                if left <= 0.0:
                    left, on = dash_m, not on

    def done(self) -> Image.Image:
        return self.image.resize(self._size, Image.Resampling.LANCZOS)


def scene(
    frame: Frame, outline: Sequence[Point], size: tuple[int, int] = SCENE, view_m: float = 0.215, follow: float = 0.0
) -> Image.Image:
    """Draw what is on the platen at an instant.

    Args:
        frame: the instant.
        outline: of the object [m].
        size: of the drawing [pixels].
        view_m: width of what is shown.
        follow: share by which its middle is the fingers', not the platen's.
    """
    one, two = (side.centre for side in frame.sides)
    drawn = _Scene(size, view_m, (0.5 * follow * (one[0] + two[0]), 0.5 * follow * (one[1] + two[1])))
    for k in range(-10, 11):
        for line in ([(0.02 * k, -0.2), (0.02 * k, 0.2)], [(-0.2, 0.02 * k), (0.2, 0.02 * k)]):
            drawn.line(line, "#efebe3", 1)
    true = outline_at(outline, frame.pose)
    drawn.draw.polygon([drawn.at(point) for point in true], "#e6d9c4")
    drawn.line([*true, true[0], true[1]], OBJECT, 1.6)
    drawn.line(outline_at([(0.0, 0.0), (0.45 * max(math.hypot(*p) for p in outline), 0.0)], frame.pose), OBJECT, 1)
    if frame.known.outline:
        drawn.dashed(outline_at(frame.known.outline, frame.pose), KNOWN, 1.8)
    for point in outline_at(frame.known.touches, frame.pose):
        drawn.disk(point, 1.3e-3, KNOWN)
    for side, colour in zip(frame.sides, FINGERS, strict=True):
        drawn.line([side.axis, side.centre], _tint(colour, 0.4), 5)
    for side, colour in zip(frame.sides, FINGERS, strict=True):
        drawn.disk(side.centre, FINGER_M, "white", colour, 2)
        drawn.disk(side.centre, _CORE_M, _tint(colour, 0.25))
    if frame.prober is not None:
        at, push = frame.prober
        drawn.disk(at, FINGER_M, "white", PROBER, 2)
        drawn.disk(at, _CORE_M, _tint(PROBER, 0.25))
        if force := math.hypot(*push):
            edge = FINGER_M / force
            _press(drawn, (at[0] + edge * push[0], at[1] + edge * push[1]), push, PROBER)
    for side, colour in zip(frame.sides, FINGERS, strict=True):
        if side.contact is not None:
            _press(drawn, side.contact, side.push, colour)
    return drawn.done()


def _tint(colour: str, share: float) -> str:
    parts = [round(255 - share * (255 - int(colour[i : i + 2], 16))) for i in (1, 3, 5)]
    return "#{:02x}{:02x}{:02x}".format(*parts)


def _press(drawn: _Scene, contact: Point, push: Point, colour: str) -> None:
    """Draw an arrow of a force, from the contact into the object."""
    force = max(math.hypot(*push), 1e-9)
    u, v = push[0] / force, push[1] / force
    long, head = _ARROW_M * force, min(5e-3, 0.6 * _ARROW_M * force)
    tip = (contact[0] + long * u, contact[1] + long * v)
    neck = (tip[0] - head * u, tip[1] - head * v)
    drawn.line([contact, neck], colour, 2.4)
    wings = [(neck[0] + 0.45 * head * s * v, neck[1] - 0.45 * head * s * u) for s in (-1.0, 1.0)]
    drawn.draw.polygon([drawn.at(point) for point in (tip, *wings)], colour)
    drawn.disk(contact, 1.2e-3, colour)


def picture(path: Path, frames: Sequence[Frame], outline: Sequence[Point], marks: Sequence[tuple[float, str]]) -> None:
    """Write the picture: the hand at the marks, and forces and friction angles over time.

    Args:
        path: of the file; its ending says the format.
        frames: of the whole demonstration.
        outline: of the object [m].
        marks: instants [s] and what they show.
    """
    figure = Figure(figsize=(13.0, 7.2), layout="constrained")
    grid = figure.add_gridspec(3, len(marks), height_ratios=(1.35, 1.0, 1.0))
    for column, (time_s, text) in enumerate(marks):
        axes = figure.add_subplot(grid[0, column])
        frame = min(frames, key=lambda one: abs(one.time_s - time_s))
        axes.imshow(np.asarray(scene(frame, outline, (480, 480), 0.13, 1.0)))
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"{text}\n{frame.time_s:.1f} s", fontsize=9)
    top, bottom = figure.add_subplot(grid[1, :]), figure.add_subplot(grid[2, :])
    time = [frame.time_s for frame in frames]
    for i, colour in enumerate(FINGERS):
        top.plot(time, [frame.sides[i].force for frame in frames], color=colour, lw=1.0, label=f"finger {i + 1}, true")
        felt = [frame.sides[i].felt or math.nan for frame in frames]
        top.plot(time, felt, ".", color=colour, ms=2.2, alpha=0.5, label=f"finger {i + 1}, felt")
        eta = [math.degrees(frame.eta[i]) for frame in frames]
        bottom.plot(time, eta, color=colour, lw=1.4, label=f"finger {i + 1}, true")
    bottom.axhline(0.0, color="0.5", lw=0.6)
    top.set(ylabel="force, N", xticklabels=[])
    bottom.set(ylabel="friction angle, deg", xlabel="time of the hand, s")
    for axes in (top, bottom):
        for begin, end, state in _spans(frames):
            axes.axvspan(begin, end, color=COLOURS.get(state, "white"), lw=0, zorder=0)
        axes.set_xlim(time[0], time[-1])
        axes.legend(loc="lower right", fontsize=7, ncols=2, framealpha=0.85)
        for time_s, _ in marks:
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


def _name_states(axes: Axes, frames: Sequence[Frame]) -> None:
    least = 0.035 * (frames[-1].time_s - frames[0].time_s)
    for begin, end, state in _spans(frames):
        if end - begin > least:
            axes.text(
                0.5 * (begin + end), 1.02, state, transform=axes.get_xaxis_transform(), ha="center", fontsize=7.5,
                color="0.25",
            )  # fmt: skip


def animation(path: Path, frames: Sequence[Frame], outline: Sequence[Point], rate_hz: float) -> None:
    """Write the animation (gif) at the pace of the hand's time; feeling and moving are shown faster."""
    chart = _Chart(frames)
    images, since, shown = list[Image.Image](), 0, ""
    for frame in frames:
        since, shown = (since + 1 if frame.state == shown else 0), frame.state
        if since % SWIFT.get(frame.state, 1):
            continue
        image = Image.new("RGB", SIZE, "white")
        _head(image, frame)
        image.paste(scene(frame, outline), (0, _HEAD))
        image.paste(chart.until(frame.time_s), (0, _HEAD + SCENE[1]))
        images.append(image)
    palette = _palette(images)
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    last = [round(1e3 / rate_hz)] * (len(flat) - 1) + [3000]
    flat[0].save(path, save_all=True, append_images=flat[1:], duration=last, loop=0, optimize=False)


def _palette(images: Sequence[Image.Image]) -> Image.Image:
    """Return the colours of all images: those of areas by some of them, those of thin lines by patches of their own."""
    some = images[:: max(1, len(images) // 16)]
    inks = [_tint(ink, share) for ink in (*FINGERS, OBJECT, KNOWN, PROBER, INK) for share in (1.0, 0.8, 0.6, 0.4, 0.25)]
    wall = Image.new("RGB", (SIZE[0], SIZE[1] * len(some) + _PATCH * len(inks)))
    for row, image in enumerate(some):
        wall.paste(image, (0, SIZE[1] * row))
    for row, ink in enumerate(inks):
        wall.paste(ink, (0, SIZE[1] * len(some) + _PATCH * row, SIZE[0], SIZE[1] * len(some) + _PATCH * (row + 1)))
    return wall.quantize(160)


def _head(image: Image.Image, frame: Frame) -> None:
    draw = ImageDraw.Draw(image)
    swift = SWIFT.get(frame.state, 1)
    draw.rectangle((0, 0, SIZE[0], 40), COLOURS.get(frame.state, "white"))
    draw.text((14, 9), frame.state, INK, _font(20))
    draw.text((SIZE[0] - 14, 11), f"{frame.time_s:.1f} s" + f"   x {swift}" * (swift > 1), INK, _font(17), "ra")
    eta = [f"{math.degrees(e):+.1f}" for e in frame.eta if math.isfinite(e)]
    if eta:
        draw.text((170, 11), f"friction angles {' and '.join(eta)} deg", INK, _font(17))
    draw.text((14, 50), _fitting(frame.told, SIZE[0] - 28), INK, _font(15))


def _fitting(text: str, width: float) -> str:
    """Return a text as far as it fits."""
    if _font(15).getlength(text) <= width:
        return text
    while _font(15).getlength(text + " ...") > width:
        text = text[:-1]
    return text + " ..."


def _font(size: int) -> Any:
    if size not in _FONTS:
        _FONTS[size] = ImageFont.load_default(size)
    return _FONTS[size]


_FONTS: dict[int, Any] = {}


class _Chart:
    """Friction angles and forces over the whole time, drawn once; what is still to come is pale."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._begin, self._end = frames[0].time_s, frames[-1].time_s
        fine = (_FINE * CHART[0], _FINE * CHART[1])
        image = Image.new("RGB", fine, "white")
        draw = ImageDraw.Draw(image)
        half = CHART[1] // 2
        for begin, end, state in _spans(frames):
            a, b = (_FINE * self._x(time_s) for time_s in (begin, end))
            draw.rectangle((a, 0, b, fine[1]), COLOURS.get(state, "white"))
        for low, name, least, most, values in (
            (0, "deg", -_MOST_DEG, _MOST_DEG, lambda frame, i: math.degrees(frame.eta[i])),
            (half, "N", 0.0, _MOST_N, lambda frame, i: frame.sides[i].force),
        ):
            rule = _FINE * (low + half * (0.5 if least else 1.0))
            draw.line((_FINE * _EDGE[0], rule, fine[0] - _FINE * _EDGE[1], rule), "#999999", 1)
            draw.text((_FINE * 8, _FINE * (low + half // 2 - 8)), name, INK, _font(_FINE * 14))
            for i, colour in enumerate(FINGERS):
                run: list[Point] = []
                for frame in [*frames, None]:
                    value = math.nan if frame is None else values(frame, i)
                    if math.isfinite(value) and frame is not None:
                        share = (min(max(value, least), most) - least) / (most - least)
                        run.append((_FINE * self._x(frame.time_s), _FINE * (low + (half - 4) * (1.0 - share) + 2)))
                        continue
                    if len(run) > 1:
                        draw.line(run, colour, 3, joint="curve")
                    run = []
        self._whole = image.resize(CHART, Image.Resampling.LANCZOS)
        self._pale = Image.blend(self._whole, Image.new("RGB", CHART, "white"), 0.7)

    def _x(self, time_s: float) -> float:
        share = (time_s - self._begin) / max(self._end - self._begin, 1e-9)
        return _EDGE[0] + share * (CHART[0] - sum(_EDGE))

    def until(self, time_s: float) -> Image.Image:
        """Return the chart at an instant."""
        image, x = self._pale.copy(), round(self._x(time_s))
        image.paste(self._whole.crop((0, 0, x, CHART[1])), (0, 0))
        ImageDraw.Draw(image).line((x, 0, x, CHART[1]), INK, 2)
        return image
