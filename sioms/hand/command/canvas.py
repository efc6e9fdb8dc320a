"""Draw a frame in a terminal: braille dots, two by four to a character."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sioms.hand.command.frames import Frame, Point
from sioms.hand.contacts import FINGER_M

WIDTH, HEIGHT = 76, 22
VIEW_M = 0.19
"""Width of what is shown."""
_DOT = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_BAR = "▏▎▍▌▋▊▉█"


class Canvas:
    """Dots in a terminal; the middle is the origin of the plane, x to the right, y up."""

    def __init__(self, width: int = WIDTH, height: int = HEIGHT, view_m: float = VIEW_M) -> None:
        self._width, self._height = width, height
        self._scale = 2.0 * width / view_m
        self._cells = [[0] * width for _ in range(height)]

    def dot(self, x: float, y: float) -> None:
        """Set the dot at a place [m]; outside the canvas nothing is set."""
        column, row = round(self._width + x * self._scale), round(2 * self._height - y * self._scale)
        if 0 <= column < 2 * self._width and 0 <= row < 4 * self._height:
            self._cells[row // 4][column // 2] |= _DOT[row % 4][column % 2]

    def line(self, start: Point, end: Point) -> None:
        """Set the dots between two places [m]."""
        steps = max(1, round(math.dist(start, end) * self._scale))
        for i in range(steps + 1):
            share = i / steps
            self.dot(start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))

    def loop(self, points: Sequence[Point]) -> None:
        """Draw a closed outline."""
        for start, end in zip(points, [*points[1:], points[0]], strict=True):
            self.line(start, end)

    def rows(self) -> list[str]:
        """Return the text."""
        return ["".join(chr(0x2800 + cell) if cell else " " for cell in row) for row in self._cells]


def circle(centre: Point, radius: float, count: int = 48) -> list[Point]:
    """Return points of a circle."""
    turns = [math.tau * i / count for i in range(count)]
    return [(centre[0] + radius * math.cos(t), centre[1] + radius * math.sin(t)) for t in turns]


def outline_at(points: Sequence[Point], pose: Sequence[float]) -> list[Point]:
    """Return an outline's points at a pose x, y [m], angle [rad]."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return [(pose[0] + c * x - s * y, pose[1] + s * x + c * y) for x, y in points]


def drawn(frame: Frame, outline: Sequence[Point]) -> list[str]:
    """Return a frame as lines of text."""
    canvas = Canvas()
    canvas.loop(outline_at(outline, frame.pose))
    for side in frame.sides:
        canvas.loop(circle(side.centre, FINGER_M))
        canvas.line(side.centre, side.axis)
        if side.contact is not None:
            canvas.loop(circle(side.contact, 1.2e-3, 8))
    one, two = frame.sides
    eta = "  ".join("  --  " if math.isnan(e) else f"{math.degrees(e):6.2f}" for e in frame.eta)
    return [
        *canvas.rows(),
        f" {frame.time_s:6.2f} s   {frame.state:9} friction angles {eta} deg",
        f" finger 1 {_bar(one.felt)} {one.felt:4.2f} N    finger 2 {_bar(two.felt)} {two.felt:4.2f} N",
        f" {frame.told[: WIDTH - 2]}",
    ]


def _bar(force: float, most: float = 2.0, width: int = 14) -> str:
    eighths = min(max(round(8 * width * force / most), 0), 8 * width)
    whole, rest = divmod(eighths, 8)
    return (("█" * whole) + (_BAR[rest - 1] if rest else "")).ljust(width, "·")
