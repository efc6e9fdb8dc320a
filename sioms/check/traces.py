"""Traces of lines, and the peer that answers out of one. Pure: bytes and times in, bytes and times out.

The format is described in docs/driver-trace.md. A :class:`Replay` is the device of the trace: to each request it gives
the replies that followed the same request in the trace, looking ahead first, so that requests which a client caused
then and nobody causes now are passed over. A request that the trace does not hold ends the replay, with both sides'
bytes.

    replay = Replay(read_trace(Path("mod0.trace")))
    replay.take(request, now_ns)
    for data in replay.due(now_ns): ...
    assert replay.mismatch is None
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sioms.documents import json_of

VERSION = 1
FAR_NS = 2_000_000_000
"""A reply in the trace later than this after its request came for another reason."""
STREAM_SHARE = 3
"""A trace with so many times more messages from the device than to it is that of a device which pushes."""


class BadTrace(ValueError):
    """A file is no trace; the text says where and why."""


@dataclass(frozen=True, slots=True)
class Message:
    """A message of a trace: time [ns], line, way (``>`` to the device, ``<`` from it), bytes."""

    t_ns: int
    line: int
    way: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Trace:
    """A trace.

    Attributes:
        header: device, driver and table.
        messages: of all lines, in order.
        events: opens and closes: time [ns], line, what, text.
    """

    header: Mapping[str, Any]
    messages: tuple[Message, ...]
    events: tuple[tuple[int, int, str, str], ...] = ()


def read_trace(path: Path) -> Trace:
    """Read a trace; a last line that was cut off is left out.

    Raises:
        BadTrace: not one, or of another version.
        OSError: it cannot be read.
    """
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    header = _entry(lines[0], path, 1)
    if header.get("sioms_trace") != VERSION:
        raise BadTrace(f"read {path}: version {header.get('sioms_trace')} of the format; want {VERSION}")
    messages, events = [], []
    for number, line in enumerate(lines[1:-1], 2):
        entry = _entry(line, path, number)
        try:
            t_ns, on = int(entry["t"]), int(entry["n"])
            if "b" in entry:
                if (way := entry["d"]) not in ("<", ">"):
                    raise ValueError(f"d is {way!r:.40}")
                messages.append(Message(t_ns, on, way, bytes.fromhex(entry["b"])))
            else:
                events.append((t_ns, on, str(entry["e"]), str(entry.get("text", ""))))
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            raise BadTrace(f"read {path}, line {number}: {error!r}; want keys t, n and d, b or e") from None
    return Trace(header, tuple(messages), tuple(events))


def _entry(line: str, path: Path, number: int) -> dict[str, Any]:
    try:
        entry = json_of(line)
    except ValueError:
        entry = None
    if not isinstance(entry, dict):
        raise BadTrace(f"read {path}, line {number}: no JSON object; is this a trace")
    return entry


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A request that the trace does not hold.

    Attributes:
        place: number of the message in the trace that was next, from 0.
        expected: request that was next, b'' at the end.
        got: what was asked.
    """

    place: int
    expected: bytes
    got: bytes

    def __str__(self) -> str:
        pairs = zip(self.expected, self.got, strict=False)
        first = next((i for i, (a, b) in enumerate(pairs) if a != b), min(len(self.expected), len(self.got)))
        return (
            f"message {self.place}: the trace has {self.expected.hex(' ') or 'no further request'}, "
            f"the driver asks {self.got.hex(' ')}; they differ from byte {first} on"
        )


@dataclass
class Replay:
    """The device of a trace.

    Args:
        trace: what it did.
        line: which of the lines.
        ignore: places (first, behind the last) of a request that need not agree, such as running numbers; what stands
            there is put into the reply.
        stream: the device pushes, whatever it is asked; None finds out by the numbers of messages.

    Attributes:
        matched: requests that came in the order of the trace.
        again: requests answered by an earlier message.
        passed: requests of the trace that did not come.
        mismatch: the first request that the trace does not hold.
    """

    trace: Trace
    line: int = 0
    ignore: Sequence[tuple[int, int]] = ()
    stream: bool | None = None
    matched: int = 0
    again: int = 0
    passed: list[bytes] = field(default_factory=list)
    mismatch: Mismatch | None = None

    def __post_init__(self) -> None:
        self._messages = [m for m in self.trace.messages if m.line == self.line]
        asked = sum(m.way == ">" for m in self._messages)
        if self.stream is None:
            self.stream = len(self._messages) - asked > STREAM_SHARE * max(1, asked)
        self._next = 0
        self._streamed = 0
        self._got = b""
        self._queue: list[tuple[int, bytes]] = []

    @property
    def finished(self) -> bool:
        """Whether the whole trace has been gone through."""
        return not self._queue and all(m.way == "<" for m in self._messages[self._next :])

    @property
    def next_ns(self) -> int | None:
        """When ``due`` has something, None when nothing is under way."""
        return self._queue[0][0] if self._queue else None

    def due(self, now_ns: int) -> list[bytes]:
        """Return what the device says until now."""
        said = [data for t_ns, data in self._queue if t_ns <= now_ns]
        self._queue = [item for item in self._queue if item[0] > now_ns]
        return said

    def take(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the driver, cut anywhere."""
        self._got += data
        while self._got and self.mismatch is None:
            found = self._find()
            if found is None:
                return
            at, again = found
            request = self._got[: len(self._messages[at].data)]
            self._got = self._got[len(request) :]
            self._answer(at, request, now_ns)
            if again:
                self.again += 1
            else:
                self.passed += [m.data for m in self._messages[self._next : at] if m.way == ">"]
                self._next = at + 1
                self.matched += 1

    def _find(self) -> tuple[int, bool] | None:
        """Return the message that is asked for and whether it has been before; None when bytes are missing."""
        indices = range(self._next, len(self._messages))
        before = range(self._next - 1, -1, -1)
        for places, again in ((indices, False), (before, True)):
            for i in places:
                message = self._messages[i]
                if message.way == ">" and len(self._got) >= len(message.data) and self._same(message.data, self._got):
                    return i, again
        if any(m.way == ">" and self._same(m.data[: len(self._got)], self._got) for m in self._messages):
            return None
        place = next((i for i in indices if self._messages[i].way == ">"), len(self._messages))
        expected = self._messages[place].data if place < len(self._messages) else b""
        self.mismatch = Mismatch(place, expected, self._got)
        return None

    def _same(self, recorded: bytes, got: bytes) -> bool:
        pairs = zip(recorded, got[: len(recorded)], strict=True)
        return all(a == b or any(low <= i < high for low, high in self.ignore) for i, (a, b) in enumerate(pairs))

    def _answer(self, at: int, request: bytes, now_ns: int) -> None:
        """Put what followed a request under way."""
        asked_ns = self._messages[at].t_ns
        first = at + 1
        if self.stream:
            first = max(first, self._streamed)
        for i, message in enumerate(self._messages[first:], first):
            if not self.stream and (message.way == ">" or message.t_ns - asked_ns > FAR_NS):
                break
            self._streamed = i + 1
            if message.way == "<":
                self._queue.append((now_ns + message.t_ns - asked_ns, self._numbered(message.data, request)))
        self._queue.sort(key=lambda item: item[0])

    def _numbered(self, reply: bytes, request: bytes) -> bytes:
        for low, high in self.ignore:
            reply = reply[:low] + request[low:high] + reply[high:]
        return reply

    def report(self) -> dict[str, Any]:
        """Return what came of it."""
        left = sum(m.way == ">" for m in self._messages[self._next :])
        return {
            "matched": self.matched, "again": self.again, "passed": [data.hex() for data in self.passed[:20]],
            "passed_count": len(self.passed), "left": left, "finished": self.finished,
            "mismatch": None if self.mismatch is None else str(self.mismatch),
        }  # fmt: skip
