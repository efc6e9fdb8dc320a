"""What long work tells while it runs."""

from __future__ import annotations

import sys
import time


class Progress:
    """Tell on stderr what is being done: one rewritten line on a terminal, one line a step elsewhere."""

    def __init__(self, total: int | None = None) -> None:
        self._begin, self._done, self._total = time.monotonic(), 0, total
        self._rewrite = sys.stderr.isatty()
        self._last = ""

    def __call__(self, what: str) -> None:
        """Count a step and say what it was."""
        self._done += 1
        if what == self._last and not self._rewrite:
            return
        self._last = what
        count = f"{self._done}" if self._total is None else f"{self._done}/{self._total}"
        line = f"[{time.monotonic() - self._begin:6.1f} s] {count:>7} {what}"
        print(
            f"\r\033[K{line}" if self._rewrite else line,
            end="" if self._rewrite else "\n",
            file=sys.stderr,
            flush=True,
        )

    def close(self) -> None:
        """End the line."""
        if self._rewrite:
            print(file=sys.stderr)
