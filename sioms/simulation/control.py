"""The life of a simulator: one ready line, then commands on standard input until it ends.

Each command is a line of words and is answered by one line: ``ok``, ``ok`` with a JSON value, or ``error`` with a
sentence; ``verbs`` lists them. When standard input is a pipe or a socket its end ends the process, so that a simulator
does not outlive its test; a terminal or /dev/null does not.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import stat
import sys
from collections.abc import Awaitable, Callable, Mapping

Handler = Callable[..., object]


def number(text: str) -> float:
    """Return a decimal or 0x number."""
    return int(text, 16) if text.lower().startswith("0x") else float(text)


def obey(line: str, handlers: Mapping[str, Handler]) -> str:
    """Carry out one command line and return its answer."""
    words = line.split()
    if not words:
        return "ok"
    if words[0] == "verbs":
        return f"ok {json.dumps(sorted(handlers))}"
    handler = handlers.get(words[0])
    if handler is None:
        return f"error unknown command {words[0]}; want one of {', '.join(sorted(handlers))}"
    try:
        value = handler(*words[1:])
    except (TypeError, ValueError, OSError) as error:
        return f"error {words[0]}: {error}"
    return "ok" if value is None else f"ok {json.dumps(value)}"


async def _watch_input(handlers: Mapping[str, Handler], done: asyncio.Event) -> None:
    mode = os.fstat(0).st_mode
    piped = stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)
    if not piped and not os.isatty(0):
        return
    reader = asyncio.StreamReader()
    protocol = asyncio.StreamReaderProtocol(reader)
    await asyncio.get_running_loop().connect_read_pipe(lambda: protocol, sys.stdin)
    while line := await reader.readline():
        print(obey(line.decode("utf-8", "replace"), handlers), flush=True)
    if piped:
        done.set()


async def serve(ready: str, handlers: Mapping[str, Handler], close: Callable[[], Awaitable[None]]) -> None:
    """Say ready, obey commands, and return when input or a signal ends the process."""
    done = asyncio.Event()
    for name in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(name, done.set)
    watcher = asyncio.create_task(_watch_input(handlers, done))
    print(f"ready {ready}", flush=True)
    await done.wait()
    watcher.cancel()
    await close()
