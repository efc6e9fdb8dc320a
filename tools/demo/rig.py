"""What the demo prints and runs: headings, what it waits for, and pipe tools with what they print."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from sioms.children import PATIENCE_S, ends_with_us

SLOW_S = 3.0
"""A wait that takes longer is told of [s]."""


@contextmanager
def waiting(what: str) -> Iterator[None]:
    """Say what is waited for where that takes long, and where it fails.

    Raises:
        OSError: what is done within fails, or takes too long.
        BrokenPipeError: nobody reads what is printed.
    """
    told = threading.Timer(SLOW_S, _tell, (what,))
    told.daemon = True
    told.start()
    try:
        yield
    except BrokenPipeError:
        raise
    except (OSError, RuntimeError) as error:
        number, text = getattr(error, "errno", None) or errno.EIO, getattr(error, "strerror", None) or str(error)
        raise OSError(number, f"wait for {what}: {text}") from error
    finally:
        told.cancel()


def _tell(what: str) -> None:
    with suppress(OSError, ValueError):  # nobody reads it: the next step sees that
        print(f"  waiting for {what} ...", flush=True)


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
