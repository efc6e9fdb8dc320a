"""The process that forks drivers, when it does not answer."""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator

import pytest

from sioms.daemon.loop import Loop
from sioms.daemon.nursery import DIED, Nursery
from sioms.daemon.nursery_process import NurseryProcess
from sioms.daemon.patience import LIMIT_S, _state


@pytest.fixture
def silent() -> Iterator[NurseryProcess]:
    """A process that never answers."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    with subprocess.Popen(["sleep", "100"]) as process, theirs:
        while _state(process.pid) != "S":
            time.sleep(0.01)
        yield NurseryProcess(ours, process.pid)
        process.kill()


def test_one_that_owes_an_answer_and_is_stuck_is_killed_and_whoever_asked_is_told(
    silent: NurseryProcess,
) -> None:
    loop, died, answers = Loop(), list[Nursery](), list[int]()
    nursery = Nursery(loop, died.append, silent)
    now_s = time.monotonic()
    assert nursery.check(now_s + 2 * LIMIT_S) == "", "it owes nothing"
    nursery.spawn("x", "y", {}, 1, {}, [], lambda _value, errno_, _text, _fds: answers.append(errno_))
    assert nursery.check(now_s + 1.0) == ""
    assert "waited for something else" in nursery.check(now_s + 1.0 + 2 * LIMIT_S)
    while not died:
        loop.step()
    assert answers == [DIED] and died == [nursery]
    loop.close()
