"""Structured log on stderr: one logfmt line an event, with the wall clock."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

from sioms.protocol.text import printable

_SYSTEMD = {"debug": 7, "info": 6, "warning": 4, "error": 3}


BURST, SPAN_S = 20, 10.0
"""So many lines of one event (of one device) are written within a span; how many more there were is told after it."""


class Log:
    """Writes lines ``time=... level=... event=... key=value``, a flood of one kind only in part.

    Args:
        journal: prefix lines with the level number that journald reads, and leave out the time.
        level: least level written: debug, info, warning, error.
        clock: returns the time [s], monotonic.
    """

    def __init__(
        self, journal: bool = False, level: str = "info", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._journal = journal
        self._clock = clock
        self._spans: dict[tuple[str, str], tuple[float, int]] = {}
        self._threshold = _SYSTEMD[level]

    def __call__(self, level: str, event: str, **values: object) -> None:
        """Write one event."""
        number = _SYSTEMD.get(level, 6)
        if number > self._threshold:
            return
        kind = (event, str(values.get("device", "")))
        now_s = self._clock()
        began_s, count = self._spans.get(kind, (now_s, 0))
        if now_s - began_s > SPAN_S:
            if count > BURST + 1:
                self._write(number, level, event, {**values, "left_out": count - BURST - 1})
                self._spans[kind] = (now_s, 1)
                return
            began_s, count = now_s, 0
        self._spans[kind] = (began_s, count + 1)
        if count < BURST:
            self._write(number, level, event, values)
        elif count == BURST:
            self._write(
                number, level, event, {**values, "more": f"of these are counted only, for {SPAN_S:g} s"}
            )

    def _write(self, number: int, level: str, event: str, values: Mapping[str, object]) -> None:
        now = time.time()
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(now)) + f".{int(now % 1 * 1000):03d}Z"
        head = f"<{number}>" if self._journal else f"time={stamp} "
        parts = [f"level={level}", f"event={_quote(event)}"]
        parts += [f"{key}={_quote(str(value))}" for key, value in values.items() if value not in ("", None)]
        try:
            sys.stderr.write(head + " ".join(parts) + "\n")
            sys.stderr.flush()
        except OSError:
            return  # nobody reads our log; that must not stop the daemon


def _quote(text: str) -> str:
    text = printable(text.replace("\n", " "), 8000)
    if text and all(c not in ' "=' for c in text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
