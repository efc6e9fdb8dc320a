"""Records what goes over a driver's lines, as JSON lines with time stamps; the format is described in
docs/driver-trace.md.

The environment variable ``SIOMS_TRACE=DEVICE=PATH`` switches it on in the driver process of that device. Then its lines
are opened as a class that records; without, nothing of this module is loaded.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from io import TextIOWrapper
from itertools import count
from pathlib import Path
from typing import Any

from . import connection
from .connection import Connection
from .settings import LineSettings

VERSION = 1


class Recorder:
    """Writes a trace.

    Args:
        path: of the file, begun anew.
        about: further keys of the header.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self._file: TextIOWrapper = path.open("w", encoding="utf-8", buffering=1)
        self._numbers = count()
        self._put({"sioms_trace": VERSION, "clock": "CLOCK_MONOTONIC ns", **about})

    def next_line(self) -> int:
        """Return the number of the next line that is opened."""
        return next(self._numbers)

    def message(self, line: int, way: str, data: bytes) -> None:
        """Record bytes: way is ``>`` to the device or ``<`` from it."""
        self._put({"t": time.monotonic_ns(), "n": line, "d": way, "b": data.hex()})

    def event(self, line: int, what: str, text: str = "") -> None:
        """Record that a line was opened or closed."""
        self._put({"t": time.monotonic_ns(), "n": line, "e": what, "text": text})

    def _put(self, entry: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(entry, separators=(",", ":")) + "\n")


class RecordedConnection(Connection):
    """A connection that records what it carries.

    Args:
        settings, stranger: as for Connection.
        recorder: takes it.
    """

    def __init__(
        self, settings: LineSettings, stranger: Callable[[], None] = lambda: None, *, recorder: Recorder
    ) -> None:
        super().__init__(settings, stranger)
        self._recorder, self._number = recorder, recorder.next_line()
        recorder.event(self._number, "open", str(settings))

    def write(self, data: bytes) -> None:
        """Send, and record it."""
        self._recorder.message(self._number, ">", data)
        super().write(data)

    def read(self) -> bytes:
        """Return what has come, and record it."""
        try:
            data = super().read()
        except OSError as error:
            self._recorder.event(self._number, "gone", error.strerror or str(error))
            raise
        if data:
            self._recorder.message(self._number, "<", data)
        return data

    def close(self) -> None:
        """Release the line."""
        self._recorder.event(self._number, "close")
        super().close()


def begin(wanted: str, device: str, driver: str, table: Mapping[str, Any]) -> None:
    """Record the lines of this process from now on, if ``DEVICE=PATH`` names its device.

    Args:
        wanted: value of the environment variable.
        device: name of this process' device.
        driver: as configured.
        table: of the device.
    """
    name, _, path = wanted.partition("=")
    if name != device or not path:
        return
    recorder = Recorder(Path(path), {"device": device, "driver": driver, "table": table})

    def opened(settings: LineSettings, stranger: Callable[[], None] = lambda: None) -> Connection:
        return RecordedConnection(settings, stranger, recorder=recorder)

    connection.opened = opened
