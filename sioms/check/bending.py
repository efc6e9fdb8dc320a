"""What a wire does to messages: bytes in, pieces with delays out. Pure but for its random numbers, which have a seed.

A message is what arrived in one read: on the lines of half-duplex devices a request or a reply.
"""

from __future__ import annotations

import itertools
import random
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

PIECE_NS = 250_000
"""Shortest time between two deliveries of a message that is not cut up: what a small adapter does."""
MOST_GARBAGE = 12
STRAY = (b"\x00", b"\xff")
"""Bytes that a cable plugged in or a transceiver switched on adds."""


@dataclass(frozen=True, slots=True)
class Faults:
    """What happens to messages; numbers are shares of the messages, 0 to 1.

    Attributes:
        chop: "bytes" delivers the device's bytes one by one, "cuts" in pieces cut anywhere.
        flip: replies with one flipped bit.
        garbage: replies with random bytes before or after them.
        replace: replies whose bytes are replaced by as many random ones.
        late: replies that come ``late_s`` [s, from, to] late.
        double: replies that come twice.
        lose: replies that are lost: the device has done what it was told.
        deaf: requests that are lost.
        stray: requests with one byte more in front.
        short: requests that lack one of their bytes.
        count: how many messages are hit before the wire is good again; -1 for no end.
    """

    chop: str = ""
    flip: float = 0.0
    garbage: float = 0.0
    replace: float = 0.0
    late: float = 0.0
    late_s: tuple[float, float] = (0.0, 0.0)
    double: float = 0.0
    lose: float = 0.0
    deaf: float = 0.0
    stray: float = 0.0
    short: float = 0.0
    count: int = -1


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes that are delivered so long [ns] after they could be; at once, or as fast as the line carries them."""

    data: bytes
    delay_ns: int = 0
    at_once: bool = False


class Bender:
    """Bends messages by the present faults.

    Args:
        seed: of the random numbers.

    Attributes:
        faults: the present ones.
        hits: messages bent so far.
    """

    def __init__(self, seed: int = 1) -> None:
        self.faults = Faults()
        self.hits = 0
        self.chance = random.Random(seed)
        self._left = -1

    def set(self, faults: Faults) -> None:
        """Bend by these from now on."""
        self.faults, self._left = faults, faults.count

    def requested(self, request: bytes) -> tuple[bytes, str]:
        """Return what reaches the device of a request, and what was done to it."""
        if self._hit(self.faults.deaf):
            return b"", "lost"
        if self._hit(self.faults.stray):
            stray = self.chance.choice(STRAY)
            return stray + request, f"{stray.hex()} before it"
        if request and self._hit(self.faults.short):
            where = self.chance.randrange(len(request))
            return request[:where] + request[where + 1 :], f"byte {where} lost"
        return request, ""

    def bend(self, message: bytes) -> tuple[list[Piece], str]:
        """Return the pieces that are delivered for a message of the device, and what was done to it."""
        faults, notes = self.faults, []
        if self._hit(faults.lose):
            return [], "lost"
        delay_ns = 0
        if self._hit(faults.late):
            delay_s = self.chance.uniform(*faults.late_s)
            delay_ns = int(delay_s * 1e9)
            notes.append(f"{1e3 * delay_s:.1f} ms late")
        data = message
        if self._hit(faults.replace):
            data = self.chance.randbytes(len(data))
            notes.append("replaced by random bytes")
        if self._hit(faults.flip):
            where, bit = self.chance.randrange(len(data)), self.chance.randrange(8)
            data = data[:where] + bytes((data[where] ^ 1 << bit,)) + data[where + 1 :]
            notes.append(f"bit {bit} of byte {where} flipped")
        if self._hit(faults.garbage):
            noise = self.chance.randbytes(self.chance.randint(1, MOST_GARBAGE))
            before = self.chance.random() < 0.5
            data = noise + data if before else data + noise
            notes.append(f"{len(noise)} random bytes {'before' if before else 'after'} it")
        at_once = False
        if self._hit(faults.double):
            data, at_once = data + data, True
            notes.append("twice")
        return self._cut(data, delay_ns, at_once), ", ".join(notes)

    def _hit(self, share: float) -> bool:
        if not share or not self._left or self.chance.random() >= share:
            return False
        self._left -= 1
        self.hits += 1
        return True

    def _cut(self, data: bytes, delay_ns: int, at_once: bool) -> list[Piece]:
        match self.faults.chop:
            case "bytes":
                return [Piece(data[i : i + 1], delay_ns if i == 0 else 150_000) for i in range(len(data))]
            case "cuts":
                places = sorted(self.chance.sample(range(1, len(data)), min(len(data) - 1, self.chance.randint(1, 3))))
                ends = [0, *places, len(data)]
                pieces = [data[a:b] for a, b in itertools.pairwise(ends)]
                return [
                    Piece(piece, delay_ns if i == 0 else self.chance.randrange(1_500_000), at_once=True)
                    for i, piece in enumerate(pieces)
                ]
        return [Piece(data, delay_ns, at_once)]


@dataclass(slots=True)
class Way:
    """One direction of the line: when what bytes arrive.

    Args:
        character_ns: time that a character takes [ns], 0 for no time.
        in_order: later messages wait for earlier ones; not so with datagrams.

    Attributes:
        messages, characters: carried so far.
    """

    character_ns: float = 0.0
    in_order: bool = True
    messages: int = 0
    characters: int = 0
    _free_ns: float = 0.0
    _queue: deque[tuple[int, bytes]] = field(default_factory=deque)

    def send(self, pieces: Sequence[Piece], now_ns: int) -> int:
        """Take pieces of a message; return when its last byte arrives [ns]."""
        at_ns = float(now_ns)
        self.messages += 1
        for piece in pieces:
            self.characters += len(piece.data)
            start_ns = max(at_ns, self._free_ns if self.in_order else 0.0) + piece.delay_ns
            at_ns = start_ns + len(piece.data) * self.character_ns
            self._free_ns = at_ns
            self._put(piece, start_ns, at_ns)
        return int(at_ns)

    def _put(self, piece: Piece, start_ns: float, end_ns: float) -> None:
        step = len(piece.data)
        if self.character_ns and not piece.at_once:
            step = max(1, int(PIECE_NS / self.character_ns))
        for first in range(0, len(piece.data), step):
            part = piece.data[first : first + step]
            due_ns = min(end_ns, start_ns + (first + len(part)) * self.character_ns)
            self._queue.append((int(due_ns), part))
        if not self.in_order:
            self._queue = deque(sorted(self._queue, key=lambda item: item[0]))

    def due(self, now_ns: int) -> list[bytes]:
        """Return what has arrived."""
        arrived = []
        while self._queue and self._queue[0][0] <= now_ns:
            arrived.append(self._queue.popleft()[1])
        return arrived

    @property
    def next_ns(self) -> int | None:
        """When the next bytes arrive, None when none are under way."""
        return self._queue[0][0] if self._queue else None

    def clear(self) -> None:
        """Forget what is under way."""
        self._queue.clear()
        self._free_ns = 0.0
