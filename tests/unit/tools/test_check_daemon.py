"""The start of a daemon for checks and benches on a machine that keeps it waiting."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.check import daemon
from sioms.check.held_up import tree_waited_ns


def start(waited: float, ready_after_s: float) -> None:
    """Wait half a second for a daemon that is ready after a time, a part of which it waits for a processor."""
    one: Any = daemon.Daemon.__new__(daemon.Daemon)
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    here.settimeout(0.02)
    one._ready_s, one.start_ns = 0.5, time.monotonic_ns()
    one.process = SimpleNamespace(pid=os.getpid(), poll=lambda: None)
    one.log = lambda: "what it said"
    tell = threading.Timer(ready_after_s, lambda: there.send(b"READY=1"))
    with pytest.MonkeyPatch.context() as patch, here, there:
        patch.setattr(daemon, "tree_waited_ns", lambda pid: waited * (time.monotonic_ns() - one.start_ns))
        tell.start()
        try:
            one._wait_ready(here)
        finally:
            tell.cancel()


def test_a_daemon_that_the_machine_holds_up_is_waited_for_and_no_other() -> None:
    start(waited=0.9, ready_after_s=1.0)
    with pytest.raises(RuntimeError, match="not ready"):
        start(waited=0.1, ready_after_s=1.0)
    with pytest.raises(RuntimeError, match="not ready"):
        start(waited=1.0, ready_after_s=30.0)


def test_descendants_that_wait_are_seen() -> None:
    """Of two busy processes on one core each waits."""
    code = (
        "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); os.fork(); print(flush=True)\nwhile 1: 0"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True) as busy:
        try:
            assert busy.stdout is not None and busy.stdout.readline()
            time.sleep(0.5)
            assert tree_waited_ns(busy.pid) > 0.1e9
            assert tree_waited_ns(os.getpid()) >= tree_waited_ns(busy.pid) - 0.1e9
        finally:
            os.killpg(busy.pid, 9)
