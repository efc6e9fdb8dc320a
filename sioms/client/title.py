"""What a session calls itself where its program gives no name."""

from __future__ import annotations

import os
import sys

from sioms.protocol.text import printable

MOST = 48
"""Characters of code that are shown."""


def title() -> str:
    """Return what runs in this process, as it was typed: a script's name, ``python -c "..."``, ``python -m ...``."""
    first = sys.argv[0] if getattr(sys, "argv", None) else ""
    if first == "-c":
        at = len(sys.orig_argv) - len(sys.argv)  # what is behind the code is the program's own
        code = sys.orig_argv[at].removeprefix("-c") if 0 < at < len(sys.orig_argv) else "..."
        quotes = [code.find(quote) for quote in "'\"" if quote in code]
        before = code[: min(quotes, default=None)]  # lists, logs and recordings show no literal: it may be a secret
        shown = " ".join(before.split()) + ("…" if before != code else "")
        return f'python -c "{printable(shown, MOST)}"'
    if first in ("", "-"):
        return f"python {first}".rstrip()
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if os.path.basename(first) == "__main__.py" and spec is not None:
        return f"python -m {spec.name.removesuffix('.__main__')}"
    return os.path.basename(first)
