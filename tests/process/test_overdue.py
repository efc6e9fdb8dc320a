"""A request to a process that is starved is waited for; one to a process that is stopped or idle is told as hung."""

from __future__ import annotations

import _socket
import asyncio
import contextlib
import dataclasses
import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from sioms.aio import _Requests
from sioms.client.channel import Call, Channel
from sioms.client.overdue import GRACE_S, MOST_S
from sioms.protocol.messages import decode, reply
from sioms.protocol.verbs import CancelOnHandle, Keepalive

ANSWERED_S = 2.0 * GRACE_S
"""When the one that is starved answers in the end [s]."""
WORK = {
    "stopped": "import os, signal; os.kill(os.getpid(), signal.SIGSTOP)",
    "asleep": "import signal; signal.pause()",
    "starved": "import os; os.nice(19)\nwhile True: pass",
}


@dataclasses.dataclass
class Case:
    """A process, and how many ask it at once; 0 is a session of asyncio."""

    does: str
    threads: int
    outcomes: list[tuple[object, float]] = dataclasses.field(default_factory=list)

    def run(self) -> None:
        """Ask, and keep what came of it and after how long [s]."""
        process = subprocess.Popen([sys.executable, "-c", WORK[self.does]])
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel = Channel(_socket.socket(fileno=ours.detach()), "peer", False, behind=(os.getpid(), process.pid))
        try:
            time.sleep(0.5)  # until it does what it is to do
            answering = [threading.Thread(target=_answer, args=(theirs,)) for _ in range(self.threads or 1)]
            asking = [threading.Thread(target=self._ask, args=(channel,)) for _ in range(self.threads)]
            for thread in answering + asking:
                thread.start()
            if not self.threads:
                asyncio.run(self._await(channel))
            for thread in answering + asking:
                thread.join()
        finally:
            channel.close()
            theirs.close()
            process.send_signal(signal.SIGKILL)
            process.wait()

    def _ask(self, channel: Channel) -> None:
        began = time.monotonic()
        try:
            outcome: object = channel.call(Call("ask", Keepalive())).value
        except OSError as error:
            outcome = error
        self.outcomes.append((outcome, time.monotonic() - began))

    async def _await(self, channel: Channel) -> None:
        requests = _Requests(channel, CancelOnHandle)
        began = time.monotonic()
        try:
            outcome: object = (await requests.call(Call("ask", Keepalive()))).value
        except OSError as error:
            outcome = error
        self.outcomes.append((outcome, time.monotonic() - began))
        requests.close()


def _answer(sock: socket.socket) -> None:
    number = int(decode(sock.recv(65536))[1])
    time.sleep(ANSWERED_S)
    with contextlib.suppress(BrokenPipeError):  # it was given up meanwhile
        sock.send(reply(number, "late but right"))


@pytest.fixture(scope="module")
def cases() -> dict[tuple[str, int], Case]:
    """All cases, waited for side by side."""
    found = [Case(does, threads) for does in WORK for threads in (0, 1, 3)]
    running = [threading.Thread(target=case.run) for case in found]
    for thread in running:
        thread.start()
    for thread in running:
        thread.join()
    return {(case.does, case.threads): case for case in found}


@pytest.mark.parametrize("threads", [1, 3, 0], ids=["one thread", "three threads", "asyncio"])
@pytest.mark.parametrize("does", WORK)
def test_who_is_late_is_waited_for_and_who_hangs_is_told(
    cases: dict[tuple[str, int], Case], does: str, threads: int
) -> None:
    outcomes = cases[does, threads].outcomes
    assert len(outcomes) == (threads or 1)
    for outcome, took_s in outcomes:
        if does == "starved":
            assert outcome == "late but right" and ANSWERED_S <= took_s < MOST_S
        else:
            assert isinstance(outcome, OSError) and outcome.errno == errno.ETIMEDOUT and "hung" in str(outcome)
            assert took_s == pytest.approx(GRACE_S, abs=0.7)
