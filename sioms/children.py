"""Processes that end with the program that starts them, however that ends.

A program that is told to end (SIGTERM, SIGHUP, Ctrl-C) ends what it has started by itself; for one that is killed the
kernel does so: each child asks it for a SIGKILL on the death of its parent. A SIGTERM would not do: a process that is
stopped (SIGSTOP) does not take it, nor one that is stuck. The drivers of a daemon that is killed stop and end.

The kernel counts the end of the thread that has started a child as its parent's death.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import IO

PATIENCE_S = 300.0
"""Longest wait for a child [s]: under twenty busy loops a second takes a minute at times."""

KEPT = 500
"""Lines of a child that are kept: what it says in days is no memory of ours."""

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None)


def ends_with_us(*, gently: bool = False) -> Callable[[], None]:
    """Return the ``preexec_fn`` of a child that is killed when the thread that starts it ends, by prctl(2).

    Args:
        gently: told to end instead (SIGTERM): a program of others, which may have something to put in order.
    """
    parent, how = os.getpid(), signal.SIGTERM if gently else signal.SIGKILL

    def tie() -> None:
        _libc.prctl(_PR_SET_PDEATHSIG, how, 0, 0, 0)
        if os.getppid() != parent:  # it has died meanwhile
            os._exit(128 + how)

    return tie


class Process:
    """A child process whose ready line has been seen.

    Args:
        arguments: of a Python module: ``["sioms.daemon.main", "--config", ...]``.
        ready: text that the ready line contains.
        errors: whether it comes on stderr instead of stdout.
        told: whether it takes lines (``tell``).
        waits: whether to wait for the ready line at once, else ``wait_ready`` has to be called: others may start
            meanwhile.

    Raises:
        RuntimeError: it ended or stayed mute; with what it said.
    """

    def __init__(
        self, arguments: Sequence[str], ready: str, errors: bool = False, told: bool = False, waits: bool = True
    ) -> None:
        pipe: dict[str, int] = {"stderr" if errors else "stdout": subprocess.PIPE}
        pipe |= {"stdin": subprocess.PIPE} if told else {}
        self._process = subprocess.Popen(  # type: ignore[call-overload]
            [sys.executable, "-P", "-m", *arguments], text=True, preexec_fn=ends_with_us(), **pipe
        )
        stream: IO[str] = self._process.stderr if errors else self._process.stdout
        self.said: deque[str] = deque(maxlen=KEPT)
        self._heard: SimpleQueue[str | None] = SimpleQueue()

        def listen() -> None:
            is_waited_for = True
            for line in stream:
                self.said.append(line.rstrip())
                if is_waited_for:
                    self._heard.put(line)
                is_waited_for = told or (is_waited_for and ready not in line)
            self._heard.put(None)

        threading.Thread(target=listen, daemon=True).start()
        self._name, self._ready = arguments[0], ready
        if waits:
            self.wait_ready()

    def wait_ready(self) -> None:
        """Wait until its ready line has been seen.

        Raises:
            RuntimeError: it ended or stayed mute; with what it said.
        """
        deadline = time.monotonic() + PATIENCE_S
        while (line := self._next(deadline)) is not None and self._ready not in line:
            pass
        if line is None:
            self.kill()
            raise RuntimeError(
                f"start {self._name}: it did not say {self._ready!r}; it said: {' | '.join(list(self.said)[-5:])}"
            )

    def _next(self, deadline: float) -> str | None:
        """Return the next line, None when it has ended or stays mute."""
        try:
            return self._heard.get(timeout=max(deadline - time.monotonic(), 0.0))
        except Empty:
            return None

    def tell(self, line: str) -> None:
        """Write a line to its standard input and wait for its answer, "ok".

        Raises:
            RuntimeError: it refused; with what it said.
        """
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        answer = self._next(time.monotonic() + PATIENCE_S)
        if answer is None or not answer.startswith("ok"):
            raise RuntimeError(f"tell a child {line!r}: it said {answer!r}; 'ok' was expected")

    @property
    def pid(self) -> int:
        """Its process number."""
        return int(self._process.pid)

    @property
    def ready_line(self) -> str:
        """The last line it said until now."""
        return self.said[-1]

    def kill(self) -> int:
        """Kill it at once (SIGKILL); return when [ns, CLOCK_MONOTONIC]."""
        now_ns = time.monotonic_ns()
        self._process.kill()
        self._process.wait()
        return now_ns

    def end(self) -> None:
        """Ask it to end, and see that it does."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self.kill()


def daemon(config: str, socket_path: str) -> Process:
    """Start a daemon; clients of this process and its children will find it."""
    os.environ["SIOMS_SOCKET"] = socket_path
    return Process(["sioms.daemon.main", "--config", config, "--socket", socket_path], "event=ready", errors=True)
