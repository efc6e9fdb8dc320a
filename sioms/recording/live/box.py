"""The black box: the last minute of everything in bounded memory, written to a file when something has gone wrong."""

from __future__ import annotations

import os
import sys
import time
import zlib
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from sioms.recording import mcap
from sioms.recording.messages import Event
from sioms.recording.rewrite import LIBRARY, PACKING, rewrite
from sioms.recording.story import weight

KEPT_S, PIECE_S = 60.0, 1.0
"""How much is kept, and in what pieces [s]."""
AFTER_S, REST_S = 2.0, 10.0
"""How long after its cause a box is written, and how long after that the next one at the earliest [s]."""
FILES = 50
"""Boxes that are kept in a folder."""
PART = ".part"
"""Suffix of a box that is not whole yet."""


def clear_up(folder: Path) -> None:
    """Make boxes of what a keeper left that ended while it wrote; raises OSError.

    Args:
        folder: no keeper is at work there.
    """
    for left in folder.glob(f"*{PART}"):
        os.replace(left, left.with_suffix(".mcap"))  # reading it tells what is missing
    for left in folder.glob(f"*.mcap{PACKING}"):
        left.unlink()


class Box:
    """A sink that keeps what is newest.

    Args:
        folder: where boxes are written.
        most_bytes: of packed messages that are kept in memory.
        seconds: that are kept.
        clock: the time [s], monotonic.

    Attributes:
        dropped: pieces younger than ``seconds`` that had no room.
    """

    def __init__(
        self, folder: Path, most_bytes: int, seconds: float = KEPT_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.dropped = 0
        self._folder, self._most_bytes, self._seconds, self._clock = folder, most_bytes, seconds, clock
        self._definitions = b""
        self._now: list[bytes] = []
        self._began_s = clock()
        self._pieces: deque[tuple[float, bytes]] = deque()
        self._bytes = 0
        self._due_s: float | None = None
        self._why = ""
        self._rest_until_s = 0.0
        self._writers: list[int] = []

    @property
    def size(self) -> int:
        """Bytes of messages in memory, those of the present second apart."""
        return self._bytes

    def define(self, records: bytes) -> None:
        """Take schemas, channels or metadata."""
        self._definitions += records

    def append(self, records: bytes) -> None:
        """Keep messages for a while."""
        self._now.append(records)

    def seen(self, event: Event) -> None:
        """Look whether something has gone wrong."""
        if weight(event) and self._due_s is None:
            self.ask(event.kind if event.kind != "log" else event.text, AFTER_S)

    def ask(self, why: str, after_s: float = 0.0) -> None:
        """Have the box written, soon."""
        if self._due_s is None or after_s == 0.0:
            self._due_s, self._why = self._clock() + after_s, why

    def look(self) -> None:
        """Pack the last second, drop what is old, write when it is time to."""
        now_s = self._clock()
        if now_s - self._began_s >= PIECE_S:
            self._fold(now_s)
        if self._due_s is not None and now_s >= max(self._due_s, self._rest_until_s):
            self._fold(now_s)
            self._due_s, self._rest_until_s = None, now_s + (REST_S if self._why != "request" else 0.0)
            self._write()
        for pid in list(self._writers):
            with suppress(ChildProcessError):
                if os.waitpid(pid, os.WNOHANG)[0]:
                    self._writers.remove(pid)

    def _fold(self, now_s: float) -> None:
        if self._now:
            piece = _packed(b"".join(self._now))
            self._pieces.append((now_s, piece))
            self._bytes += len(piece)
        self._now, self._began_s = [], now_s
        while self._pieces and self._pieces[0][0] < now_s - self._seconds:
            self._bytes -= len(self._pieces.popleft()[1])
        while self._bytes > self._most_bytes and len(self._pieces) > 1:
            self._bytes -= len(self._pieces.popleft()[1])
            self.dropped += 1

    def path(self) -> Path:
        """Return the name of a box that is written now."""
        name = "".join(c if c.isalnum() else "-" for c in self._why)
        return self._folder / f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}-{name}.mcap"

    def _write(self) -> None:
        """Write in another process, which shares the memory: recording goes on meanwhile."""
        path = self.path()
        pid = os.fork()
        if pid:
            self._writers.append(pid)
            return
        status = 1
        try:
            self.save(path)
            for old in sorted(self._folder.glob("*.mcap"))[:-FILES]:
                old.unlink()
            status = 0
            os.nice(19)
            rewrite([str(path)], str(path))  # in no hurry, and without it the box is whole
        except OSError as error:
            if status:
                print(
                    f"sioms blackbox: write {path}: {error.strerror or error}; it is lost", file=sys.stderr, flush=True
                )
        finally:
            os._exit(status)

    def save(self, path: Path) -> None:
        """Write what is kept to a file, as a live recording; it appears when it is whole and on the disk.

        Raises:
            OSError: it cannot be written.
        """
        live = path.with_suffix(PART)
        try:
            with open(live, "wb") as file:
                file.write(mcap.header(LIBRARY) + mcap.metadata("blackbox", {"why": self._why}) + self._definitions)
                for _, piece in self._pieces:
                    file.write(_unpacked(piece))
                file.flush()
                os.fsync(file.fileno())
            os.replace(live, path)
        finally:
            live.unlink(missing_ok=True)

    def close(self) -> None:
        """Wait for boxes that are being written."""
        if self._due_s is not None:
            self._fold(self._clock())
            self._write()
        for pid in self._writers:
            with suppress(ChildProcessError):
                os.waitpid(pid, 0)


def _packed(data: bytes) -> bytes:
    try:
        import zstandard
    except ModuleNotFoundError:
        return b"d" + zlib.compress(data, 1)
    return b"z" + zstandard.ZstdCompressor(level=1).compress(data)


def _unpacked(piece: bytes) -> bytes:
    if piece[:1] == b"d":
        return zlib.decompress(piece[1:])
    import zstandard

    return zstandard.ZstdDecompressor().decompress(piece[1:])
