"""The G-code parser of a simulated Grbl controller: words in, a straight line or the number of an error out.

Lengths leave in mm, feeds in mm/min.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

WORDS = re.compile(r"([A-Z])(-?\d+(?:\.\d*)?|-?\.\d+)")
RAPID = 1e9


@dataclass(frozen=True)
class Straight:
    """A line to be driven."""

    target: list[float]
    feed: float


class Parser:
    """Modal state, and what lines make of it.

    Args:
        letters: of the axes.

    Attributes:
        offset: work coordinate offset of each axis [mm].
    """

    def __init__(self, letters: str) -> None:
        self._letters = letters
        self.offset = [0.0] * len(letters)
        self.reset()

    def reset(self) -> None:
        """Take the modal state of a fresh start; the offsets stay."""
        self._absolute, self._scale, self._motion, self._feed = True, 1.0, 0, 0.0

    def modes(self) -> str:
        """Return the modal state in words."""
        return f"G{self._motion} G{20 if self._scale > 1 else 21} G{90 if self._absolute else 91}"

    def jog(self, text: str, start: Sequence[float]) -> Straight | int:
        """Return what a jog asks for, or an error; the modal state is untouched."""
        words = _words(text)
        if isinstance(words, int):
            return words
        absolute, scale, machine, feed = self._absolute, self._scale, False, 0.0
        axes = {letter: value for letter, value in words if letter in self._letters}
        for letter, value in words:
            if letter == "G":
                if value not in (20, 21, 53, 90, 91):
                    return 16
                absolute = value == 90 if value in (90, 91) else absolute
                scale = {20: 25.4, 21: 1.0}.get(int(value), scale)
                machine = machine or value == 53
            elif letter == "F":
                feed = value * scale
            elif letter not in self._letters:
                return 16
        if not axes:
            return 26
        if feed <= 0:
            return 22
        return Straight(self._target(start, axes, scale, absolute, machine), feed)

    def line(self, text: str, start: Sequence[float]) -> Straight | int:
        """Return what a line of G-code moves, 0 when it moves nothing, or an error."""
        words = _words(text)
        if isinstance(words, int):
            return words
        machine = False
        axes = {letter: value for letter, value in words if letter in self._letters}
        for letter, value in words:
            if letter == "G":
                machine = machine or value == 53
                if not self._takes(value):
                    return 20
            elif letter == "F":
                self._feed = value * self._scale
            elif letter not in self._letters and letter not in "PMST":
                return 20
        if not axes:
            return 0
        if self._motion == 1 and self._feed <= 0:
            return 22
        target = self._target(start, axes, self._scale, self._absolute, machine)
        return Straight(target, self._feed if self._motion == 1 else RAPID)

    def _takes(self, code: float) -> bool:
        """Take a G word into the modal state; return whether it is known."""
        if code in (0, 1):
            self._motion = int(code)
        elif code in (20, 21):
            self._scale = 25.4 if code == 20 else 1.0
        elif code in (90, 91):
            self._absolute = code == 90
        return code in (0, 1, 4, 17, 20, 21, 53, 54, 90, 91, 94)

    def _target(
        self, start: Sequence[float], axes: Mapping[str, float], scale: float, absolute: bool, machine: bool
    ) -> list[float]:
        target = list(start)
        for i, letter in enumerate(self._letters):
            if letter in axes:
                value = axes[letter] * scale
                offset = 0.0 if machine else self.offset[i]
                target[i] = value + offset if absolute or machine else start[i] + value
        return target


def _words(text: str) -> list[tuple[str, float]] | int:
    """Return the words of a line, or an error: 1 no letter, 2 a bad number, 25 a word twice."""
    found = WORDS.findall(text)
    if "".join(letter + value for letter, value in found) != text:
        return 1 if not text[:1].isalpha() else 2
    values = [letter for letter, _ in found if letter not in "G"]
    return 25 if len(set(values)) < len(values) else [(letter, float(value)) for letter, value in found]
