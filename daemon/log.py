"""Structured log on stderr: one logfmt line an event, with the wall clock."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping

from sioms.protocol.journal import Note
from sioms.protocol.text import printable

_SYSTEMD = {"debug": 7, "info": 6, "warning": 4, "error": 3}


BURST, SPAN_S = 20, 10.0
"""So many lines of one event from one source (a device, else a user) are written within a span; the others are counted.
"""
MOST = 1000
"""Sources and events that are told apart; in a flood of these, too, all further ones are one."""


class _Span:
    """Lines of one event from one source.

    Attributes:
        began_s: when the first came.
        count: how many came since.
        level, values: those of the last.
    """

    __slots__ = ("began_s", "count", "level", "values")

    def __init__(self, began_s: float) -> None:
        self.began_s = began_s
        self.count = 0
        self.level = "info"
        self.values: Mapping[str, object] = {}


class Log:
    """Writes lines ``time=... level=... event=... key=value``, a flood of one kind from one source only in part.

    Args:
        journal: prefix lines with the level number that journald reads, and leave out the time.
        level: least level written: debug, info, warning, error.
        clock: returns the time [s], monotonic.

    Attributes:
        note: where each line is noted, too: that of a journal.
    """

    def __init__(self, journal: bool = False, level: str = "info", clock: Callable[[], float] = time.monotonic) -> None:
        self.note: Callable[..., None] | None = None
        self._journal = journal
        self._clock = clock
        self._spans: dict[tuple[str, str], _Span] = {}
        self._threshold = _SYSTEMD[level]

    def __call__(self, level: str, event: str, **values: object) -> None:
        """Write one event; ``device`` or the user of ``peer`` is its source."""
        level = level if level in _SYSTEMD else "info"
        number = _SYSTEMD[level]
        if number > self._threshold:
            return
        kind = (event, str(values.get("device") or getattr(values.get("peer"), "user", "")))
        if kind not in self._spans and len(self._spans) >= MOST:
            kind = (event, "")
        now_s = self._clock()
        span = self._spans.get(kind)
        if span is not None and now_s - span.began_s > SPAN_S:
            self._end(event, self._spans.pop(kind))
            span = None
        if span is None:
            span = self._spans[kind] = _Span(now_s)
        span.count += 1
        span.level, span.values = level, values
        if span.count <= BURST:
            self._write(number, level, event, values)

    def tell_suppressed(self) -> None:
        """Tell how many lines were left out of the spans that are over; call now and then."""
        now_s = self._clock()
        for kind, span in list(self._spans.items()):
            if now_s - span.began_s > SPAN_S:
                self._end(kind[0], self._spans.pop(kind))

    def _end(self, event: str, span: _Span) -> None:
        left_out = span.count - BURST
        if left_out > 0:
            told = f"{left_out} lines suppressed, this is the last of them"
            self._write(_SYSTEMD[span.level], span.level, event, {**span.values, "more": told})

    def _write(self, number: int, level: str, event: str, values: Mapping[str, object]) -> None:
        if self.note is not None:
            self.note(
                Note.LOG, time.monotonic_ns(), level, event, {key: str(value)[:2000] for key, value in values.items()}
            )
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
