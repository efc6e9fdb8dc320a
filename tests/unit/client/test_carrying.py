"""Threads of the program move a link's frames while they wait, and leave it whole whatever happens to them."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from typing import Any

import pytest

from sioms.client.carrying import NOBODY, Carrier, Led
from sioms.client.channel import Call, Channel
from sioms.client.remote import _Bridge
from sioms.protocol import link, verbs
from sioms.protocol.link import Down, Up
from sioms.protocol.messages import decode, refusal, reply


class Link:
    """A link that answers requests by their number, but for those that it is told to keep."""

    def __init__(self) -> None:
        self.came = os.eventfd(0, os.EFD_NONBLOCK)
        self.fds: tuple[int, ...] = (self.came,)
        self.sent: list[tuple[int, int]] = []
        self.by: list[int] = []
        self.taken_by: list[int] = []
        self.why = ""
        self.keeps = False
        self.during: Callable[[], None] = lambda: None
        self.while_taken: Callable[[], None] = lambda: None
        self._frames: deque[bytes] = deque()

    def send(self, frame: bytes) -> None:
        kind, _, number, _, body = link.unpack(frame, link.MAX_TO_GATEWAY)
        self.sent.append((kind, number))
        if kind == Up.PACKET:
            self.by.append(threading.get_ident())
            self.during()
            if not self.keeps:
                self.bring(decode(body)[1])

    def bring(self, number: int) -> None:
        self._frames.append(link.pack(Down.PACKET, body=reply(number, f"answer {number}")))
        os.eventfd_write(self.came, 1)

    def lose(self, why: str) -> None:
        self.why = why
        os.eventfd_write(self.came, 1)

    def stop(self, frame: bytes) -> None:
        self.send(frame)

    @property
    def pending(self) -> bool:
        return bool(self._frames)

    def frames(self, ready: Collection[int] = ()) -> Iterator[bytes]:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.came)
        while self._frames:
            self.taken_by.append(threading.get_ident())
            self.while_taken()
            yield self._frames.popleft()

    def lost(self, ready: Collection[int] | None = None) -> str:
        return self.why

    def close(self) -> None:
        os.close(self.came)


class Rig:
    """A session of a link, its thread, and the program's channel."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link = Link()
        self.bridge = _Bridge("zmq://lab2:5770", self.link, ours)
        self.bridge._heard_ns = self.bridge._pinged_ns = time.monotonic_ns()
        self.bridge.start()
        self.thread = self.bridge._thread
        carrier = Carrier(self.bridge.carrying, 0, theirs)
        self.channel = Channel(theirs, "the gateway", carrier=carrier)

    def ask(self, limit_s: float = 0.0) -> Any:
        return self.channel.call(Call("list", verbs.List(), limit_s=limit_s)).value


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.channel.close()
    made.thread.join(5.0)
    assert not made.thread.is_alive(), "the session's thread ends with the session"


class Interrupted(Exception):
    """What a handler of a signal raises."""


@pytest.fixture
def interrupts() -> Iterator[None]:
    def handler(*_: object) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGALRM, handler)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_who_waits_sends_and_takes_without_another_thread(rig: Rig) -> None:
    assert [rig.ask() for _ in range(20)] == [f"answer {number}" for number in range(1, 21)]
    assert set(rig.link.by) == {threading.get_ident()}
    assert rig.link.taken_by.count(threading.get_ident()) > 10, "the session's thread looks now and then"
    assert [number for kind, number in rig.link.sent if kind == Up.PACKET] == list(range(1, 21)), "none is missing"


def test_what_comes_while_nobody_waits_is_taken_by_the_sessions_thread(rig: Rig) -> None:
    rig.ask()
    rig.link.bring(99)
    deadline = time.monotonic() + 5.0
    while rig.link.taken_by[-1] != rig.thread.ident and time.monotonic() < deadline:
        time.sleep(0.001)
    assert rig.link.taken_by[-1] == rig.thread.ident


def test_of_many_threads_one_moves_frames_and_all_are_answered(rig: Rig) -> None:
    answers: list[str] = []
    threads = [
        threading.Thread(target=lambda: answers.extend(rig.ask(5.0) for _ in range(50)), daemon=True) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20.0)
    assert sorted(answers) == sorted(f"answer {number}" for number in range(1, 201))


def test_one_thread_moves_the_frames_of_several_sessions_until_each_is_answered(rig: Rig) -> None:
    rigs = [rig, Rig(), Rig()]
    carriers = [carrier for each in rigs if (carrier := each.channel.carrier)]
    for each in rigs:
        each.ask()
        each.link.keeps = True
    with Led(carriers) as led:
        numbers = [each.channel.send(Call("list", verbs.List())) for each in rigs]
        led.wait(0.01)
        assert all(each.bridge.carrying.leading.is_taken for each in rigs)
        for each, number in zip(rigs, numbers, strict=True):
            threading.Timer(0.03, each.link.bring, [number]).start()
        led.wait(20.0)
        for each in rigs:
            assert each.channel.take() is not None
    assert threading.get_ident() in [each.link.taken_by[-1] for each in rigs]
    assert not any(each.bridge.carrying.leading.is_taken for each in rigs), "each has its thread again"
    for each in rigs[1:]:
        each.channel.close()


@pytest.mark.usefixtures("interrupts")
def test_a_signal_ends_the_wait_and_not_the_session(rig: Rig) -> None:
    rig.link.keeps = True
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    with pytest.raises(Interrupted):
        rig.ask(5.0)
    rig.link.keeps = False
    assert rig.ask() == "answer 2"


@pytest.mark.usefixtures("interrupts")
def test_a_signal_behind_an_answer_that_has_come_loses_no_answer(rig: Rig) -> None:
    """It is given to who moves frames, without a socket, and may be another thread's."""
    rig.ask()
    rig.link.keeps = True
    number = rig.channel.send(Call("list", verbs.List()))
    rig.link.while_taken = lambda: signal.raise_signal(signal.SIGALRM)
    threading.Timer(0.05, rig.link.bring, [number]).start()
    with pytest.raises(Interrupted):
        rig.ask(5.0)
    rig.link.while_taken = lambda: None
    assert rig.channel.wait(number, Call("list", verbs.List(), limit_s=0.2)).value == f"answer {number}"


def test_a_signal_behind_any_call_of_a_wait_leaves_the_link_to_the_sessions_thread(rig: Rig) -> None:
    carrier, leading = rig.channel.carrier, rig.bridge.carrying.leading
    assert carrier is not None
    watched: list[bool] = []
    rig.bridge.watch = watched.append  # type: ignore[method-assign]
    for place in range(100):
        left = place

        def tell(frame: Any, event: str, _: object) -> None:
            nonlocal left
            if frame.f_code.co_filename.endswith("carrying.py") and event in ("call", "c_return"):
                left -= 1
                if left < 0:
                    sys.setprofile(None)
                    raise Interrupted

        sys.setprofile(tell)
        try:
            carrier.wait(1e-3)
        except Interrupted:
            assert not leading.is_taken and watched[-1:] != [False], f"behind call {place}"
        else:
            break
        finally:
            sys.setprofile(None)
    assert 10 < place < 99


def test_who_moves_frames_has_an_answer_without_a_socket_and_a_last_word_behind_all(rig: Rig) -> None:
    rig.ask()
    taken: list[bytes] = []
    rig.bridge._waits = 0
    for packet in (refusal(0, errno.EIO, "it ends"), reply(7, "one"), reply(8, "two")):
        rig.bridge._hand_over(0, rig.bridge.ours, packet)
    rig.bridge._waits = NOBODY
    taken = [rig.channel._sock.recv(1000, socket.MSG_DONTWAIT) for _ in range(2)]
    assert rig.bridge._answer == reply(7, "one") and taken == [refusal(0, errno.EIO, "it ends"), reply(8, "two")]


@pytest.mark.usefixtures("interrupts")
def test_a_signal_while_a_frame_is_moved_comes_after_that(rig: Rig) -> None:
    moved: list[str] = []

    def during() -> None:
        signal.raise_signal(signal.SIGALRM)
        moved.append("whole")

    rig.link.during = during
    with pytest.raises(Interrupted):
        rig.ask()
    assert moved == ["whole"], "the frame has been sent before the handler ran"
    rig.link.during = lambda: None
    assert rig.ask() == "answer 2"
    assert [number for kind, number in rig.link.sent if kind == Up.PACKET] == [1, 2]


def test_no_signal_is_for_the_sessions_thread_but_those_of_a_crash(rig: Rig) -> None:
    rig.ask()
    with open(f"/proc/self/task/{rig.thread.native_id}/status") as file:
        blocked = int(next(line.split()[1] for line in file if line.startswith("SigBlk")), 16)
    held = {number for number in range(1, 32) if blocked >> (number - 1) & 1}
    assert {signal.SIGINT, signal.SIGTERM, signal.SIGALRM, signal.SIGUSR1} <= held
    assert not held & {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS}


def test_what_raises_while_a_frame_is_moved_all_the_same_ends_the_session(rig: Rig) -> None:
    def during() -> None:
        raise Interrupted

    rig.ask()
    rig.link.during = during
    with pytest.raises(Interrupted):
        rig.ask()
    with pytest.raises(OSError, match="link to zmq://lab2:5770 lost: Interrupted while a frame was moved") as told:
        rig.ask()
    assert told.value.errno == errno.EIO


@pytest.mark.parametrize("waits", [True, False])
def test_a_lost_link_is_told_to_who_waits_and_to_who_asks_next(rig: Rig, waits: bool) -> None:
    rig.link.keeps = waits
    threading.Timer(0.05, rig.link.lose, ["it is cut"]).start()
    if not waits:
        rig.thread.join(5.0)
    with pytest.raises(OSError, match="link to zmq://lab2:5770 lost: it is cut"):
        rig.ask(5.0)


def test_a_program_that_drops_its_session_ends_it(rig: Rig) -> None:
    made = Rig()
    made.ask()
    thread, sent = made.thread, made.link.sent
    del made
    thread.join(5.0)
    assert not thread.is_alive() and sent[-1][0] == Up.BYE


def test_a_program_that_ends_ends_its_session_first(rig: Rig) -> None:
    rig.ask()
    rig.bridge.leave()
    assert not rig.thread.is_alive() and rig.link.sent[-1][0] == Up.BYE
    rig.bridge.leave()  # again does nothing


def test_a_forked_child_is_refused_and_harms_nothing(rig: Rig) -> None:
    rig.ask()
    child = os.fork()
    if not child:
        try:
            rig.ask()
        except OSError as error:
            os._exit(0 if "forked child" in str(error) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert rig.ask() == "answer 2"
