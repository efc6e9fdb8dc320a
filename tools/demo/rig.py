"""What the demo prints and runs: headings, and pipe tools with what they print."""

from __future__ import annotations

import os
import subprocess
import sys

from sioms.children import PATIENCE_S, ends_with_us


def bold(text: str) -> str:
    """Return a heading: bold on a terminal, plain elsewhere."""
    return f"\033[1m{text}\033[0m" if sys.stdout.isatty() else text


def tool(name: str, *arguments: str, input_text: str | None = None) -> str:
    """Run a pipe tool and return what it prints."""
    beside = os.path.join(os.path.dirname(sys.executable), name)
    done = subprocess.run(
        [beside if os.path.exists(beside) else name, *arguments],
        input=input_text, text=True, capture_output=True, timeout=4 * PATIENCE_S, check=False,
        preexec_fn=ends_with_us(),
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{name} {' '.join(arguments)}: {done.stderr.strip()}")
    return done.stdout
