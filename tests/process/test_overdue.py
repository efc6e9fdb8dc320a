"""A request to a process that is starved is waited for; one to a process that is stopped or idle is told as hung."""

from __future__ import annotations

import _socket
import asyncio
import contextlib
import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

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


@pytest.fixture(params=WORK)
def peer(request: pytest.FixtureRequest) -> Iterator[tuple[str, Channel, socket.socket]]:
    """What a process does, a channel on which it owes the answers, and the other end of that."""
    process = subprocess.Popen([sys.executable, "-c", WORK[request.param]])
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    behind = (os.getpid(), process.pid)
    channel = Channel(_socket.socket(fileno=ours.detach()), "peer", False, behind=behind)
    time.sleep(0.3)  # until it does what it is to do
    yield request.param, channel, theirs
    channel.close()
    theirs.close()
    process.send_signal(signal.SIGKILL)
    process.wait()


def _judge(does: str, outcome: object, took_s: float) -> None:
    if does == "starved":
        assert outcome == "late but right" and ANSWERED_S <= took_s < MOST_S
    else:
        assert isinstance(outcome, OSError) and outcome.errno == errno.ETIMEDOUT and "hung" in str(outcome)
        assert took_s == pytest.approx(GRACE_S, abs=0.7)


def _answer(sock: socket.socket) -> None:
    number = int(decode(sock.recv(65536))[1])
    time.sleep(ANSWERED_S)
    with contextlib.suppress(BrokenPipeError):  # it was given up meanwhile
        sock.send(reply(number, "late but right"))


@pytest.mark.parametrize("threads", [1, 3])
def test_blocking(peer: tuple[str, Channel, socket.socket], threads: int) -> None:
    does, channel, sock = peer
    outcomes: list[tuple[object, float]] = []

    def ask() -> None:
        began = time.monotonic()
        try:
            outcome: object = channel.call(Call("ask", Keepalive())).value
        except OSError as error:
            outcome = error
        outcomes.append((outcome, time.monotonic() - began))

    asking = [threading.Thread(target=ask) for _ in range(threads)]
    answering = [threading.Thread(target=_answer, args=(sock,)) for _ in range(threads)]
    for thread in asking + answering:
        thread.start()
    for thread in asking + answering:
        thread.join()
    for outcome, took_s in outcomes:
        _judge(does, outcome, took_s)
    assert len(outcomes) == threads


def test_asyncio(peer: tuple[str, Channel, socket.socket]) -> None:
    does, channel, sock = peer

    async def ask() -> tuple[object, float]:
        requests = _Requests(channel, CancelOnHandle)
        began = time.monotonic()
        try:
            outcome: object = (await requests.call(Call("ask", Keepalive()))).value
        except OSError as error:
            outcome = error
        took_s = time.monotonic() - began
        requests.close()
        return outcome, took_s

    answering = threading.Thread(target=_answer, args=(sock,))
    answering.start()
    outcome, took_s = asyncio.run(ask())
    answering.join()
    _judge(does, outcome, took_s)
