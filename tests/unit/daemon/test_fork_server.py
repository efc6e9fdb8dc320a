"""The process that forks drivers, when it does not answer."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections.abc import Iterator

import pytest

from sioms.daemon.fork_server import DIED, ForkServer
from sioms.daemon.fork_server_process import ForkServerProcess
from sioms.daemon.loop import Loop
from sioms.daemon.patience import LIMIT_S, _state
from sioms.descriptors import receive
from sioms.protocol.messages import MAX_PACKET, decode, reply


@pytest.fixture
def silent() -> Iterator[ForkServerProcess]:
    """A process that never answers."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    with subprocess.Popen(["sleep", "100"]) as process, theirs:
        while _state(process.pid) != "S":
            time.sleep(0.01)
        yield ForkServerProcess(ours.detach(), process.pid)
        process.kill()


def test_one_that_owes_an_answer_and_is_stuck_is_killed_and_whoever_asked_is_told(
    silent: ForkServerProcess,
) -> None:
    loop, died, answers = Loop(), list[ForkServer](), list[int]()
    fork_server = ForkServer(loop, died.append, silent)
    now_s = time.monotonic()
    assert fork_server.check(now_s + 2 * LIMIT_S) == "", "it owes nothing"
    fork_server.spawn("x", "y", {}, 1, {}, [], lambda _value, errno_, _text, _fds: answers.append(errno_))
    assert fork_server.check(now_s + 1.0) == ""
    assert "waited for something else" in fork_server.check(now_s + 1.0 + 2 * LIMIT_S)
    while not died:
        loop.step()
    assert answers == [DIED] and died == [fork_server]
    loop.close()


def test_more_requests_than_the_socket_holds_wait_for_their_turn() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    with subprocess.Popen(["sleep", "5"]) as process, theirs, open(os.devnull) as null:
        loop, asked, answers = Loop(), [], list[int]()
        fork_server = ForkServer(loop, lambda _: None, ForkServerProcess(ours.detach(), process.pid))
        table = {"text": "x" * 20_000}
        for number in range(100):
            fork_server.spawn(
                "x", "y", table, number, {}, [null.fileno()], lambda _value, errno_, _text, _fds: answers.append(errno_)
            )
        assert not answers, "none is refused"
        for _ in range(100):
            packet, fds = receive(theirs, MAX_PACKET, 8)
            assert len(fds) == 1
            os.close(fds[0])
            number = decode(packet)[1]
            asked.append(number)
            theirs.send(reply(number, 1))
            loop.step()
        assert asked == [*range(1, 101)] and answers == [0] * 100
        fork_server.close()
        process.kill()
        loop.close()
