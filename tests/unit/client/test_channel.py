"""A channel used by many threads: each gets its own answer, and none waits for ever."""

from __future__ import annotations

import _socket
import contextlib
import errno
import os
import socket
import threading
import time
from _thread import allocate_lock
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from interrupt_rig import interrupted_everywhere

from sioms.client.channel import KEEPALIVE, Call, Channel
from sioms.client.connecting import connect
from sioms.client.overdue import GRACE_S
from sioms.protocol.messages import ClientVerb, decode, encode, refusal, reply
from sioms.protocol.verbs import Ioctl, Subscribe, Write


class Peer:
    """The other end of a channel."""

    def __init__(self) -> None:
        ours, self.sock = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.sock.settimeout(10.0)
        self.channel = Channel(_socket.socket(fileno=ours.detach()), "peer")
        self.results: dict[object, object] = {}
        self.threads: list[threading.Thread] = []

    def ask(self, word: object, limit_s: float | None = None) -> int:
        """Let a thread ask; return the number of its request when it has come."""

        return self.start(word, lambda: self.channel.call(Call("ask", Ioctl(1, word, None), limit_s=limit_s)).value)

    def write(self, word: object, limit_s: float = 0.0) -> int:
        """Let a thread write, in few steps if it can."""
        call = Call("write", Write(1, limit_s, b"data"), limit_s=limit_s)
        return self.start(word, lambda: self.channel.short_call((1, 1, limit_s, b"data"), lambda: call))

    def start(self, word: object, ask: Callable[[], object]) -> int:
        """Let a thread ask for something; return the number of its request when it has come."""

        def run() -> None:
            try:
                self.results[word] = ask()
            except OSError as error:
                self.results[word] = error

        self.threads.append(threading.Thread(target=run, daemon=True))
        self.threads[-1].start()
        return int(decode(self.sock.recv(65536))[1])

    def join(self) -> dict[object, object]:
        for thread in self.threads:
            thread.join(10.0)
            assert not thread.is_alive(), "a thread waits for ever"
        return self.results


@pytest.fixture
def peer() -> Iterator[Peer]:
    one = Peer()
    yield one
    one.channel.close()
    one.sock.close()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0), (2, 0, 3, 1)])
def test_answers_in_any_order_find_their_threads(peer: Peer, order: tuple[int, ...]) -> None:
    numbers = [peer.ask(word) for word in range(4)]
    for i in order:
        peer.sock.send(reply(numbers[i], i * 10))
    assert peer.join() == {i: i * 10 for i in range(4)}


@pytest.mark.parametrize("end", ["close", "peer", "reason"])
def test_the_end_wakes_all_threads(peer: Peer, end: str) -> None:
    for word in range(5):
        peer.ask(word)
    if end == "close":
        peer.channel.close()
    elif end == "peer":
        peer.sock.close()
    else:
        peer.sock.send(encode(0, 0, errno.ETIMEDOUT, "the lease"))
    expected = {"close": errno.EBADF, "peer": errno.EIO, "reason": errno.ETIMEDOUT}[end]
    assert [error.errno for error in peer.join().values()] == [expected] * 5  # type: ignore[attr-defined]


def test_a_late_one_passes_the_reading_on(peer: Peer) -> None:
    """The first reads, the second would be next and is late, the third waits without limit."""
    first = peer.ask("first")
    peer.ask("second", 0.05 - GRACE_S)
    third = peer.ask("third")
    peer.sock.send(reply(first, 1))
    peer.threads[1].join(10.0)
    peer.sock.send(reply(third, 3))
    results = peer.join()
    assert (results["first"], results["third"]) == (1, 3)
    assert isinstance(results["second"], OSError) and results["second"].errno == errno.ETIMEDOUT


def test_a_thread_whose_turn_comes_too_late_lets_the_next_one_read(peer: Peer) -> None:
    """The reading is passed to a thread in the very moment in which its time is over."""
    channel = peer.channel
    channel._reading = True  # by a thread that is not there
    late = peer.ask("late", 0.2 - GRACE_S)
    last = peer.ask("last")
    while len(channel._waiting) < 2:
        threading.Event().wait(0.001)
    with channel._mutex:  # nobody can go on ...
        threading.Event().wait(0.3)  # ... when the time of the first is over ...
        channel._waiting.pop(late, allocate_lock()).release()  # type: ignore[attr-defined]
        channel._reading = False  # ... and it is told to read
    peer.sock.send(reply(last, "in time"))
    results = peer.join()
    assert results["last"] == "in time" and isinstance(results["late"], OSError)


def test_the_reason_of_the_end_is_told_to_who_sends_next(peer: Peer) -> None:
    peer.sock.send(encode(0, 0, errno.ECANCELED, "stopped by eva"))
    peer.sock.close()
    for _ in range(2):
        with pytest.raises(OSError, match="stopped by eva") as refused:
            peer.channel.call(Call("ask", Subscribe(1)))
        assert refused.value.errno == errno.ECANCELED


def test_answers_before_the_end_are_kept(peer: Peer) -> None:
    call = Call("ask", Subscribe(1))
    first, second = peer.channel.send(call), peer.channel.send(call)
    peer.sock.send(reply(first, "taken"))
    peer.sock.send(refusal(second, errno.EAGAIN, "no room"))
    peer.sock.close()  # with requests unread: a reset comes first
    with pytest.raises(OSError, match="peer"):
        peer.channel.send(call)
    assert peer.channel.wait(first, call).value == "taken"
    with pytest.raises(OSError, match="no room"):
        peer.channel.wait(second, call)


def test_a_message_too_long_is_refused_before_it_is_sent(peer: Peer) -> None:
    with pytest.raises(OSError, match="at most 65536") as refused:
        peer.channel.call(Call("ask", Ioctl(1, b"x" * 70000, None)))
    assert refused.value.errno == errno.EMSGSIZE
    number = peer.ask("still works")
    peer.sock.send(reply(number, 1))
    assert peer.join() == {"still works": 1}


def test_a_peer_that_talks_nonsense_ends_the_channel(peer: Peer) -> None:
    peer.ask("x")
    peer.sock.send(b"\xc1nonsense")
    error = peer.join()["x"]
    assert isinstance(error, OSError) and error.errno == errno.EPROTO


def test_an_answer_that_comes_too_late_is_cancelled_and_leaves_nothing_behind(peer: Peer) -> None:
    number = peer.ask("late", -GRACE_S)
    assert isinstance(peer.join()["late"], OSError)
    verb, cancelling, *what = decode(peer.sock.recv(65536))
    assert (verb, what) == (ClientVerb.CANCEL, [number])
    read_end, write_end = os.pipe()
    socket.send_fds(peer.sock, [reply(number, "a node")], [write_end])
    os.close(write_end)
    peer.sock.send(reply(int(cancelling), None))
    last = peer.ask("next")
    peer.sock.send(reply(last, 1))
    assert peer.join()["next"] == 1
    assert os.read(read_end, 1) == b"", "its descriptor is closed, and who sent it sees that"
    os.close(read_end)
    assert not peer.channel._answers and not peer.channel._abandoned


def test_a_daemon_that_lets_nobody_in_is_not_waited_for_long(short_folder: Path) -> None:
    path = str(short_folder / "s")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listening:
        listening.bind(path)
        listening.listen(0)
        waiting = [connect(path)]
        with pytest.raises(OSError, match="accepts nobody") as refused:
            while len(waiting) < 10:
                waiting.append(connect(path, 0.05))
        assert refused.value.errno == errno.ETIMEDOUT
        for sock in waiting:
            sock.close()


@pytest.mark.parametrize(
    ("name", "number", "told"),
    [
        ("x" * 120, errno.ENAMETOOLONG, "at most 107 bytes"), ("no socket", errno.ECONNREFUSED, "that is not a socket"),
        ("nothing", errno.ENOENT, "no daemon listens there"),
    ],
)  # fmt: skip
def test_what_is_no_daemons_socket_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, number: int, told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("no socket").write_text("")
    with pytest.raises(OSError, match=told) as refused:
        connect(name)
    assert refused.value.errno == number


def test_take_does_not_wait(peer: Peer) -> None:
    assert peer.channel.take() is None
    number = peer.channel.send(Call("ask", Subscribe(1)))
    peer.sock.send(reply(number, 5))
    packet = peer.channel.take()
    assert packet is not None and peer.channel.result(packet).value == 5


@pytest.mark.parametrize("short", [False, True])
def test_a_request_renews_what_is_kept_alive_with_its_channel_however_soon_it_is_answered(*, short: bool) -> None:
    peers = [Peer() for _ in range(3)]
    channels = [peer.channel for peer in peers]
    for channel in channels:
        channel.fellows, channel.keepalive_s = channels[1:], 0.01
    peers[2].sock.close()  # who has gone disturbs nobody
    if short:
        acquainted(peers[0])
        channels[0]._others_due_s = 0.0
        while peers[1].sock.recv(100) != KEEPALIVE:
            pass

    def ask() -> None:
        if not short:
            channels[0].send(Call("ask", Ioctl(1, None, None)))
            return
        peers[0].sock.send(reply(channels[0]._number + 1, 1, 1))
        channels[0].short_call((1, 1, 0.5, b"data"), lambda: pytest.fail("another way"))

    for _ in range(2):
        ask()
        assert peers[1].sock.recv(100) == KEEPALIVE
        time.sleep(0.02)
    channels[0].keepalive_s = 3600.0
    for _ in range(3):  # and no more often than the shortest lease asks for
        ask()
    peers[1].sock.settimeout(0.05)
    assert peers[1].sock.recv(100) == KEEPALIVE
    with pytest.raises(TimeoutError):
        peers[1].sock.recv(100)
    for peer in peers:
        peer.channel.close()
        peer.sock.close()


def acquainted(peer: Peer) -> list[int]:
    """Let the channel have asked something before; return the instants that are acknowledged to it."""
    told: list[int] = []
    peer.channel.acknowledged = told.append
    peer.sock.send(reply(peer.ask("first"), 1))
    peer.join()
    return told


def test_a_short_call_is_the_same_packet_and_tells_the_same(peer: Peer) -> None:
    told = acquainted(peer)
    peer.start("write", lambda: peer.channel.short_call((1, 1, 0.5, b"data"), lambda: pytest.fail("another way")))
    peer.sock.send(reply(2, 4711, 99))
    assert peer.join()["write"] == 4711 and told == [99]
    number = peer.write("packet", 0.5)
    assert number == 3 and not peer.channel._answers
    peer.sock.send(reply(number, 1, 100))
    assert peer.join()["packet"] == 1 and told == [99, 100]


@pytest.mark.parametrize("how", ["refused", "without an instant", "another first", "ended", "gone", "nonsense", "long"])
def test_what_is_not_the_usual_answer_to_a_short_call_is_told_as_ever(peer: Peer, how: str) -> None:
    told = acquainted(peer)
    number = peer.write("write")
    match how:
        case "refused":
            peer.sock.send(refusal(number, errno.ERANGE, "too far", 77))
        case "without an instant":
            peer.sock.send(reply(number, 5))
        case "another first":
            peer.sock.send(reply(number + 100, 1, 66))
            peer.sock.send(reply(number, 5, 77))
        case "ended":
            peer.sock.send(refusal(0, errno.ETIMEDOUT, "the lease"))
        case "gone":
            peer.sock.close()
        case "nonsense":
            peer.sock.send(b"\x96\x00nonsense")
        case _:
            peer.sock.send(reply(number, "x" * 100, 77))
    found = peer.join()["write"]
    if how in ("without an instant", "another first", "long"):
        assert found == ("x" * 100 if how == "long" else 5)
    else:
        known = {"refused": errno.ERANGE, "ended": errno.ETIMEDOUT, "gone": errno.EIO, "nonsense": errno.EPROTO}
        assert isinstance(found, OSError) and found.errno == known[how]
    assert told == ([77] if how in ("refused", "another first", "long") else [])
    assert set(peer.channel._answers) == ({number + 100} if how == "another first" else set())


def test_a_short_call_that_is_late_is_told_in_time_and_cancelled(peer: Peer) -> None:
    acquainted(peer)
    began_s = time.monotonic()
    number = peer.write("late", 0.1 - GRACE_S)
    assert isinstance(peer.join()["late"], OSError) and time.monotonic() - began_s < 8.0
    verb, _, *what = decode(peer.sock.recv(65536))
    assert (verb, what) == (ClientVerb.CANCEL, [number])


def test_no_short_call_waits_for_longer_than_a_lease_that_has_come_since(peer: Peer) -> None:
    def write(word: str) -> int:
        def call() -> Call:
            others.append(word)
            return Call("write", Write(1, 30.0, b"data"), limit_s=30.0)

        return peer.start(word, lambda: peer.channel.short_call((1, 1, 30.0, b"data"), call))

    others: list[str] = []  # went the way that tells meanwhile that it lives
    acquainted(peer)
    peer.channel.keepalive_s = 0.05
    number = write("first")
    assert others == ["first"], "the socket would wait for a second"
    assert peer.sock.recv(65536) == KEEPALIVE
    peer.sock.send(reply(number, 7, 1))
    assert peer.join()["first"] == 7
    peer.sock.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while peer.sock.recv(65536) == KEEPALIVE:
            pass
    peer.sock.settimeout(10.0)
    assert write("second") == number + 1
    peer.sock.send(reply(number + 1, 8, 2))
    assert peer.join()["second"] == 8 and others == ["first"]


def test_short_calls_of_many_threads_each_get_their_own_answer(peer: Peer) -> None:
    acquainted(peer)
    numbers = [peer.write(word) for word in range(4)]
    for i in (2, 0, 3, 1):
        peer.sock.send(reply(numbers[i], i * 10, 1000 + i))
    found = peer.join()
    assert [found[i] for i in range(4)] == [0, 10, 20, 30]


def test_the_time_out_of_the_socket_is_set_once_for_all_writes(peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    acquainted(peer)
    call, timeouts = Call("write", Write(1, 0.0, b"data")), []
    for _ in range(5):
        peer.sock.send(reply(peer.channel.send(call), 1))
        peer.channel.wait(peer.channel._number, call)
        timeouts.append(peer.channel._timeout)
    assert set(timeouts) == {1.0}


class Late:
    """Answers requests, all but those that are cancelled, a moment after they have come."""

    def __init__(self, peer: Peer) -> None:
        self.sock, self.asked, self.told, self.cancelled = peer.sock, list[int](), set[int](), set[int]()
        threading.Thread(target=self.run, daemon=True).start()

    def run(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                waiting = [n for n in self.asked if n not in self.told | self.cancelled]
                self.sock.settimeout(0.02 if waiting else 10.0)
                try:
                    packet = self.sock.recv(65536)
                except TimeoutError:
                    for number in waiting:
                        self.told.add(number)
                        self.sock.send(reply(number, "late"))
                    continue
                if not packet:
                    return
                verb, number, *arguments = decode(packet)
                if verb == ClientVerb.CANCEL:
                    self.sock.send(refusal(arguments[0], errno.ECANCELED, "cancelled"))
                    self.cancelled.add(arguments[0])
                    self.sock.send(reply(number, True))
                else:
                    self.asked.append(number)


@pytest.mark.parametrize("short", [False, True])
def test_an_interrupt_between_any_two_steps_leaves_nothing_behind(peer: Peer, *, short: bool) -> None:
    """The channel goes on, and what nobody waits for is cancelled."""
    call = lambda: Call("write", Write(1, 5.0, b"data"), limit_s=5.0)  # noqa: E731 - a new one for each request
    late = Late(peer)
    assert peer.channel.call(call()).value == "late"
    before, places = 1, 0

    def ask() -> None:
        peer.channel.short_call((1, 1, 5.0, b"data"), call) if short else peer.channel.call(call())

    for at in interrupted_everywhere(ask, ("sioms.client.channel",)):
        assert peer.channel.call(call()).value == "late", f"interrupted at place {at}"
        assert set(late.asked[before:-1]) <= late.cancelled | late.told, f"interrupted at place {at}"
        before, places = len(late.asked), at
    assert places > 10 and late.cancelled


def test_descriptors_that_nobody_takes_are_closed(peer: Peer) -> None:
    """However it comes that nobody does: a node that was opened for who is interrupted is free again."""
    asked = peer.ask("open")
    ours, theirs = os.pipe()
    socket.send_fds(peer.sock, [reply(asked, "opened")], [theirs])
    os.close(theirs)
    peer.join()
    assert os.read(ours, 1) == b"", "the end of file: nobody has the other end any more"
    os.close(ours)
