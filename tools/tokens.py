"""A stream of numbers in text: bytes in, numbers with their line out. Pure."""

from __future__ import annotations

from .options import number

MAX_TOKEN = 400
"""Longest number [characters]; what goes on longer is not a number, and must not fill the memory."""
MAX_LINE = 1 << 20
"""Longest line [characters] when bad lines are left out, for which a line must be read to its end."""


class Tokens:
    """Numbers separated by blanks or newlines, in pieces as they come.

    Args:
        skip_bad_lines: leave out each damaged line instead of ending there. ``nan`` is no damage: what was to be
            measured is not known, so that the command before must not go on.

    Attributes:
        numbers: (number, line) in order, to be taken from the left by the caller.
        bad: why the stream ends after ``numbers``: a sentence that names line and word; '' while it is good.
        skipped: sentences about lines that were left out, to be taken by the caller.
    """

    def __init__(self, skip_bad_lines: bool = False) -> None:
        self.numbers: list[tuple[float, int]] = []
        self.bad = ""
        self.skipped: list[str] = []
        self._skip = skip_bad_lines
        self._rest = b""
        self._line = 1

    def feed(self, data: bytes) -> None:
        """Take the next piece of the input; b'' is its end."""
        if self.bad:
            return
        text = self._rest + (data or b"\n")
        # A word, and with skipping a line, is complete only when its end has come.
        end = 1 + max(text.rfind(b"\n"), -1 if self._skip else max(map(text.rfind, (b" ", b"\t", b"\r"))))
        self._rest = text[end:]
        lines = text[:end].split(b"\n")
        for at, line in enumerate(lines):
            self._take(line)
            if self.bad:
                return
            self._line += at < len(lines) - 1
        if len(self._rest) > (MAX_LINE if self._skip else MAX_TOKEN):
            self.bad = f"line {self._line}: {len(self._rest)} characters without a separator; want numbers"

    def _take(self, line: bytes) -> None:
        found: list[tuple[float, int]] = []
        for word in line.split():
            try:
                found.append((number(word.decode("ascii")), self._line))
            except ValueError:
                shown = word[:40].decode("ascii", "backslashreplace")
                wrong = f"line {self._line}: {shown!r} is not a finite number"
                if self._skip and word.lower().lstrip(b"+-") != b"nan":
                    self.skipped.append(f"{wrong}; line skipped")
                    return
                self.bad = wrong
                break
        self.numbers += found
