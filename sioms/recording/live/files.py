"""The file that is being recorded: appended in one call a look, so that what has been written outlives the recorder."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import Protocol

from sioms.recording import mcap
from sioms.recording.rewrite import LIBRARY, rewrite

_FLAGS = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
"""Appending: what follows a record that was cut off comes in its place."""


class Sink(Protocol):
    """Where records go."""

    def define(self, records: bytes) -> None:
        """Take schemas, channels or metadata, which every file has to hold before what needs them."""

    def append(self, records: bytes) -> None:
        """Take messages; they are safe when this returns."""

    def look(self) -> None:
        """Do what is to be done now and then."""

    def close(self) -> None:
        """End in order."""


class LiveFile:
    """A recording in one file or, by rotation, in several.

    Args:
        path: of the file; by rotation NAME-0001.mcap and so on.
        most_bytes: size at which the next one begins, 0: none.
        most_s: time after which the next one begins [s], 0: none.
        pack: whether files are packed when they are closed.

    Attributes:
        path: of the present file.

    Raises:
        OSError: EEXIST, there is such a file.
    """

    def __init__(self, path: str, most_bytes: int = 0, most_s: float = 0.0, *, pack: bool = True) -> None:
        self._name, self._part = Path(path), 0
        self._rotates = bool(most_bytes or most_s)
        self._most_bytes, self._most_s, self._pack = most_bytes, most_s, pack
        self._definitions = b""
        self._packers: list[subprocess.Popen[bytes]] = []
        self._begin()

    def _begin(self) -> None:
        """Begin the next file; where that fails, the present one is as it was."""
        part, name = self._part + 1, self._name
        path = str(name.with_name(f"{name.stem}-{part:04d}{name.suffix}") if self._rotates else name)
        data = mcap.header(LIBRARY) + self._definitions
        try:
            fd = os.open(path, _FLAGS, 0o644)
        except FileExistsError:
            text = f"record to {path}: it is there already; name another file, or remove it"
            raise OSError(errno.EEXIST, text) from None
        except OSError as error:
            raise _told(path, error) from None
        try:
            _append(fd, data)
        except OSError as error:
            os.close(fd)
            os.unlink(path)
            raise _told(path, error) from None
        self.path, self._part, self._fd = path, part, fd
        self._size, self._began_s = len(data), monotonic()

    def _write(self, data: bytes) -> None:
        """Write whole records, or cut off what did not fit and raise why."""
        try:
            _append(self._fd, data)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._fd, self._size)
            raise _told(self.path, error) from None
        self._size += len(data)

    def define(self, records: bytes) -> None:
        """Take schemas, channels or metadata; every file of a rotation begins with them."""
        self._definitions += records
        self._write(records)

    def append(self, records: bytes) -> None:
        """Write messages; a SIGKILL afterwards does not lose them."""
        self._write(records)

    def look(self) -> None:
        """Begin the next file when it is time to, and let the last one be packed aside."""
        self._packers = [packer for packer in self._packers if packer.poll() is None]
        full = self._most_bytes and self._size >= self._most_bytes
        if full or (self._most_s and monotonic() - self._began_s >= self._most_s):
            path, fd = self.path, self._fd
            self._begin()
            os.close(fd)
            if self._pack:
                command = [sys.executable, "-P", "-m", "sioms.recording.live.packing", path]
                self._packers.append(subprocess.Popen(command, preexec_fn=lambda: os.nice(19)))

    def drop(self) -> None:
        """Remove the file: nothing was recorded."""
        os.close(self._fd)
        os.unlink(self.path)

    def close(self) -> None:
        """End the recording; pack it."""
        os.close(self._fd)
        if self._pack:
            with suppress(OSError):  # a full disk: it stays as it is, and whole
                rewrite([self.path], self.path)
        for packer in self._packers:
            packer.wait()


def _append(fd: int, data: bytes) -> None:
    view, done = memoryview(data), 0
    while done < len(data):
        done += os.write(fd, view[done:])


def _told(path: str, error: OSError) -> OSError:
    return OSError(error.errno, f"record to {path}: {(error.strerror or '').lower()}")
