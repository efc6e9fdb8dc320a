"""Baselines: what the bare system does, measured between our own samples."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from typing import Self

from sioms.children import ends_with_us

_ECHO = """
import socket, sys
sock = socket.socket(fileno=int(sys.argv[1]))
sock.send(b"ready")
while packet := sock.recv(65536):
    sock.send(packet)
"""
_WAKE = """
import os, sys, time
event, answer = int(sys.argv[1]), int(sys.argv[2])
os.write(answer, b"ready...")
while True:
    os.read(event, 8)
    os.write(answer, time.monotonic_ns().to_bytes(8, "little"))
"""


class RoundTrip:
    """A bare request and reply on a Unix SOCK_SEQPACKET between two Python processes."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sock = ours
        self._process = subprocess.Popen(
            [sys.executable, "-IS", "-c", _ECHO, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            preexec_fn=ends_with_us(),
        )
        theirs.close()
        ours.recv(16)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._sock.close()
        self._process.wait()

    @property
    def pid(self) -> int:
        """The process that answers."""
        return self._process.pid

    def once(self, size: int) -> None:
        """Do one round trip of a packet of a size."""
        self._sock.send(bytes(size))
        self._sock.recv(65536)

    def samples(self, count: int, size: int = 32) -> list[int]:
        """Return the durations of round trips of packets of a size [ns]."""
        sock, packet, clock = self._sock, bytes(size), time.perf_counter_ns
        result = []
        for _ in range(count):
            begin = clock()
            sock.send(packet)
            sock.recv(65536)
            result.append(clock() - begin)
        return result


class Wake:
    """A bare eventfd: written here, another Python process wakes."""

    def __init__(self) -> None:
        self._event = os.eventfd(0)
        self._answer, theirs = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-IS", "-c", _WAKE, str(self._event), str(theirs)],
            pass_fds=[self._event, theirs],
            preexec_fn=ends_with_us(),
        )
        os.close(theirs)
        os.read(self._answer, 8)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._event)
        os.close(self._answer)

    def samples(self, count: int) -> list[int]:
        """Return the times from a write until the other process, which slept, runs [ns]."""
        result = []
        for _ in range(count):
            time.sleep(0.001)
            begin = time.monotonic_ns()
            os.eventfd_write(self._event, 1)
            result.append(int.from_bytes(os.read(self._answer, 8), "little") - begin)
        return result


def run_ns(command: list[str], environment: dict[str, str] | None = None) -> int:
    """Return how long a command takes from start to exit [ns]; its output is thrown away.

    Raises:
        RuntimeError: it failed.
    """
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    begin = time.perf_counter_ns()
    pid = os.posix_spawnp(command[0], command, environment or dict(os.environ), file_actions=quiet)
    _, status = os.waitpid(pid, 0)
    took = time.perf_counter_ns() - begin
    if status:
        raise RuntimeError(f"run {' '.join(command)}: exit status {os.waitstatus_to_exitcode(status)}; want 0")
    return took


def interpreter_ns() -> int:
    """Return how long a bare interpreter takes: ``python -c pass`` [ns]."""
    return run_ns([sys.executable, "-P", "-c", "pass"])
