"""Structured log on stderr: one logfmt line an event, with the wall clock."""

from __future__ import annotations

import sys
import time

_SYSTEMD = {"debug": 7, "info": 6, "warning": 4, "error": 3}


class Log:
    """Writes lines ``time=... level=... event=... key=value``.

    Args:
        journal: prefix lines with the level number that journald reads, and leave out the time.
        level: least level written: debug, info, warning, error.
    """

    def __init__(self, journal: bool = False, level: str = "info") -> None:
        self._journal = journal
        self._threshold = _SYSTEMD[level]

    def __call__(self, level: str, event: str, **values: object) -> None:
        """Write one event."""
        number = _SYSTEMD.get(level, 6)
        if number > self._threshold:
            return
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
    text = text.replace("\n", " ")
    if text and all(c not in ' "=' for c in text):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
