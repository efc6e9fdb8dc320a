"""devout: write a stream of numbers to devices (dissertation, section F.4.2).

Decisions where the text leaves a choice are in docs/pipe-tools.md.
"""

from __future__ import annotations

import errno
from select import POLLIN, poll
from time import monotonic

from sioms.client.stream import Stream, keep_together
from sioms.client.workcell import Workcell

from .columns import Columns
from .options import Line, UsageError, fold
from .pipe import complain, open_node, read_input, run
from .tokens import Tokens

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

DEFAULT_COUNT = 100
FROZEN_S = 2.0
"""A devout that is silent for so long is stopped, frozen or swapped out, and its axes halt [s]; it does not depend on
rows.
"""


class BadInput(Exception):
    """The input is not what the command line says it is; one sentence with the line."""


def main(words: Sequence[str] | None = None) -> int:
    """Run devout; return the exit status."""
    return run("devout", _work, words)


def _work(words: Sequence[str]) -> None:
    line = fold("devout", words)
    if not line.targets:
        raise UsageError("no device given; try --help")
    if line.trailing:
        raise UsageError(f"-{next(iter(line.trailing))} applies to the device that follows it, and none follows")
    if "H" in line.common and "lease" in line.common:
        raise UsageError("-H and --lease exclude each other: -H holds when no rows arrive, --lease halts")
    tokens = Tokens("skip-bad-lines" in line.common)
    if line.numbers:
        tokens.feed((" ".join(line.numbers) + " ").encode())
    if tokens.bad:
        raise UsageError(tokens.bad.partition(": ")[2])
    cell = Workcell(name="devout")
    lease_s = line.common.get("lease", FROZEN_S)
    nodes = [open_node(cell, t.name, "rw", lease_s=lease_s, first=not i) for i, t in enumerate(line.targets)]
    keep_together(nodes)
    columns = [Columns(t, n.info) for t, n in zip(line.targets, nodes, strict=True)]
    repeats = "r" in line.common or "L" in line.common
    count = int(line.common.get("L", DEFAULT_COUNT)) if repeats else 1
    width = sum(c.count for c in columns)
    if 0 <= count * width < len(line.numbers):
        for node in nodes:
            node.close()
        raise UsageError(
            f"{len(line.numbers)} numbers; {'an iteration takes' if count == 1 else f'{count} iterations take'} "
            f"{count * width}, and more would be lost; -r writes several one after the other"
        )
    beat_s = 0.0 if "lease" in line.common else FROZEN_S / 4
    writer = Writer(cell, [Stream(node) for node in nodes], columns, tokens, beat_s)
    try:
        _iterate(line, writer, count)
        if "H" in line.common:
            writer.hold()
    except BadInput as bad:
        raise OSError(errno.EINVAL, f"{bad}; stopped after {writer.iterations} complete iterations") from None
    finally:
        # Each close answers when the axes of the node are halting and it is free for the next.
        for node in nodes:
            node.close()
    outputs = [t.name for t, c in zip(line.targets, columns, strict=True) if not c.is_axis]
    if outputs and line.numbers and count == 1 and "H" not in line.common:
        complain(
            "devout",
            f"{', '.join(outputs)}: safe again now that devout ends; -H holds what was written",
            0,
        )


def _iterate(line: Line, writer: Writer, count: int) -> None:
    wait = "w" in line.common
    if wait and not all(c.has_end for c in writer.columns if c.is_axis):
        raise UsageError(
            "-w waits for the end of a motion, and a velocity, acceleration, jerk or force without a time has none; "
            "add -t"
        )
    while writer.iterations != count and writer.fill():
        writer.write()
        if wait:
            writer.wait_until_idle()
    writer.drain()
    if "W" not in line.common and writer.iterations:
        writer.wait_until_idle()


class Writer:
    """Takes the numbers of each iteration from the input and writes them to the devices.

    Args:
        cell: the connection to the daemon; its end is noticed also while the input is silent.
        streams: one per device, in the order of the command line.
        columns: their columns.
        tokens: the numbers, those of the command line first.
        beat_s: how often to tell the drivers that this program lives while there is no input [s]; 0: not at all.

    Attributes:
        iterations: how many have been written.
    """

    def __init__(
        self,
        cell: Workcell,
        streams: list[Stream],
        columns: list[Columns],
        tokens: Tokens,
        beat_s: float = 0.0,
    ) -> None:
        self.columns = columns
        self._beat_s = beat_s
        self._next_beat_s = 0.0
        self.iterations = 0
        self._streams = streams
        self._cell = cell
        self._tokens = tokens
        self._at = 0
        self._width = sum(c.count for c in columns)
        self._ended = False
        self._open_ended = [False] * len(columns)
        self._poller = poll()
        for fd in (0, cell.fileno(), *[stream.fileno() for stream in streams]):
            self._poller.register(fd, POLLIN)

    def fill(self) -> bool:
        """Read until there are numbers enough for an iteration; False at the end of the input.

        Raises:
            BadInput: the input is wrong, or ends within an iteration.
            OSError: the daemon or a driver has gone, or has refused something.
        """
        while self._at + self._width > len(self._tokens.numbers):
            if self._tokens.bad:
                raise BadInput(self._tokens.bad)
            if self._ended:
                return self._end()
            self._tokens.numbers = self._tokens.numbers[self._at :]
            self._at = 0
            self._await_input()
        return True

    def write(self) -> None:
        """Write one iteration to the devices.

        Raises:
            BadInput: a number that must be whole is not.
            OSError: something was refused.
        """
        for i, (stream, columns) in enumerate(zip(self._streams, self.columns, strict=True)):
            taken = self._tokens.numbers[self._at : self._at + columns.count]
            values = [value for value, _ in taken]
            try:
                records = columns.records(values)
            except ValueError as error:
                raise BadInput(f"line {taken[0][1]}: {error}") from None
            stream.write(records, replace=columns.replace)
            if columns.is_axis:
                self._open_ended[i] = columns.open_ended(values)
            self._at += columns.count
        self.iterations += 1

    def drain(self) -> None:
        """Wait until everything written is acknowledged."""
        for stream in self._streams:
            stream.drain()

    def hold(self) -> None:
        """Keep the devices, and with them outputs and motions, until a signal ends us, or until one of them is lost."""
        self.drain()
        poller = poll()
        for fd in (self._cell.fileno(), *[stream.fileno() for stream in self._streams]):
            poller.register(fd, POLLIN)
        while True:
            if self._wait_on(poller):
                self._cell.status()  # raises what ended it
            for stream in self._streams:
                stream.settle()

    def wait_until_idle(self) -> None:
        """Wait until the axes stand still, except those whose motion has no end."""
        self.drain()
        for stream, columns, open_ended in zip(self._streams, self.columns, self._open_ended, strict=True):
            if columns.is_axis and not open_ended:
                stream.node.wait_until_idle()  # type: ignore[attr-defined]

    def _wait_on(self, poller: Any) -> list[tuple[int, int]]:
        """Wait until something is readable, or until the drivers have to be told that this program lives; tell them."""
        ready: list[tuple[int, int]] = poller.poll(1e3 * self._beat_s if self._beat_s else None)
        if self._beat_s and (now_s := monotonic()) >= self._next_beat_s:
            self._next_beat_s = now_s + self._beat_s
            if self._streams:
                self._streams[0].node.keepalive()  # and with it the others
        return ready

    def _await_input(self) -> None:
        for fd, _ in self._wait_on(self._poller):
            if fd == 0:
                data = read_input()
                self._ended = not data
                self._tokens.feed(data)
                for text in self._tokens.skipped:
                    complain("devout", text, 0)
                self._tokens.skipped.clear()
            elif fd == self._cell.fileno():
                self._cell.status()  # nothing comes unasked but the end: this raises what it was
        for stream in self._streams:
            stream.settle()

    def _end(self) -> bool:
        left = len(self._tokens.numbers) - self._at
        if left:
            raise BadInput(
                f"line {self._tokens.numbers[-1][1]}: the input ends after {left} of the {self._width} numbers "
                "of an iteration"
            )
        if not self.iterations:
            raise BadInput(f"the input is empty; want {self._width} number{'s' * (self._width > 1)} for an iteration")
        return False
