"""A session of a link to a gateway on another machine: its frames on one side, on the other the same sockets, pages and
pipes as of a daemon on this machine.

A thread moves frames between both and writes what it is told into pages; sessions, nodes and event loops do not know
that it is there. A thread of the program that waits for an answer does its work meanwhile (``carrying``). Neither says
anything of its own that would renew a lease: what does is what the program's own calls send. A session is one
connection: when that is lost the session ends, with a last word that says why. What carries the frames is a ``Link``:
``zeromq`` or ``zenoh_link``.

Concurrency: one thread a session, and one of the program's at a time, under a lock. A forked child has no such thread.
"""

from __future__ import annotations

import atexit
import errno
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from typing import Any, Protocol

from sioms.prompt import Briefly
from sioms.protocol import link
from sioms.protocol.clock import Clock, Offset, Wall
from sioms.protocol.flags import PageState
from sioms.protocol.link import Down, MalformedFrame, Up, Update
from sioms.protocol.messages import MAX_PACKET, ClientVerb, refusal
from sioms.protocol.page import REASON_SIZE
from sioms.protocol.text import printable

from .carrying import ALL, NOBODY, Carrier, Carrying
from .far import Far, FarJournal
from .places import place_of

FIRST_PINGS = 8
STOP_AGAIN_S = 0.3
"""A stop that has not been answered on its own way goes the other one, too, after so long [s]."""
BUSY_S = 6.0
"""How long a gateway may take to begin a session, at least [s]: its machine, or this one, may have too much to do."""
LEAVE_S = 10.0
"""How long a program that ends waits for the end of a session [s]. It takes milliseconds, or a second where the link
takes nothing; a thread that outlived the interpreter would be cut off in the midst of a library's work.
"""
HELLO_AGAIN_S = 0.1
"""How often a greeting is repeated [s]: a transport may not have made our end of the link known yet."""


class LinkClock(Clock):
    """The clock of a cell behind a link."""

    def __init__(self) -> None:
        self.offset = Offset()

    @property
    def offset_ns(self) -> int:
        """What the cell's clock shows more than that of this machine."""
        return self.offset.ns

    @property
    def error_ns(self) -> int:
        """How wrong that is at most [ns]."""
        return self.offset.error_ns(time.monotonic_ns())


class Link(Protocol):
    """What carries frames to a gateway and back, in order, each once, until it is lost.

    Attributes:
        fds: descriptors that are readable when something has come, or happened.
    """

    fds: tuple[int, ...]

    def send(self, frame: bytes) -> None:
        """Send a frame; raises OSError."""

    def stop(self, frame: bytes) -> None:
        """Send a stop, which overtakes all other frames."""

    @property
    def pending(self) -> bool:
        """Whether frames wait of which no descriptor tells, since one was sent."""

    def frames(self, ready: Collection[int] = ()) -> Iterator[bytes]:
        """Take what has come.

        Args:
            ready: descriptors that tell of something, the others do not; none: look for all.
        """

    def lost(self, ready: Collection[int] | None = None) -> str:
        """Return why the link has ended, '' if it has not.

        Args:
            ready: as of ``frames``; None: look, whatever descriptors tell.
        """

    def close(self) -> None:
        """Let go of everything."""


def connect(address: str, timeout_s: float) -> tuple[Any, LinkClock, Carrier]:
    """Open a session of the link.

    Args:
        address: ``zmq://HOST:PORT`` or ``zenoh://HOST:PORT`` of the gateway.
        timeout_s: how long that may take [s].

    Returns:
        A socket as one that is connected to a daemon, the cell's clock, and what threads that wait can send by.

    Raises:
        OSError: with a sentence: no such host, nobody there, a key that is not known, another release.
    """
    scheme, host, port = place_of(address)
    what = f"connect to {printable(address)}"
    deadline = time.monotonic() + max(timeout_s, BUSY_S)
    carrier: Link
    if scheme == "zmq":
        from .zeromq import ZmqLink

        carrier = ZmqLink(what, address, host, port, timeout_s)
    else:
        try:
            from .zenoh_link import ZenohLink
        except ModuleNotFoundError as error:
            text = f"{what}: {error.name} is not installed; run: pip install 'sioms[net]'"
            raise OSError(errno.ENOPKG, text) from None
        carrier = ZenohLink(what, address, host, port, timeout_s)
    ours, theirs = socket.socketpair(
        socket.AF_UNIX, socket.SOCK_SEQPACKET
    )  # theirs is the program's alone: it closes it
    bridge = _Bridge(address, carrier, ours)
    try:
        bridge.begin(what, deadline)
    except BaseException:
        bridge.release()
        raise
    bridge.start()
    return theirs, bridge.clock, Carrier(bridge.carrying, 0, theirs)


class _Bridge:
    """What the thread does."""

    def __init__(self, address: str, carrier: Link, ours: socket.socket) -> None:
        self._address, self._link = address, carrier
        self.clock = LinkClock()
        self.ours = ours
        self.ours.setblocking(False)
        self._number = 0
        self._told_ns = 0
        self._heard_ns = self._pinged_ns = 0
        self._nodes: dict[int, Far] = {}
        self._journals: dict[int, FarJournal] = {}
        self._by_fd: dict[int, int] = {}
        self._stop: tuple[float, bytes] | None = None
        self._last_word: tuple[int, str] | None = None
        self._leaves = False
        self._thread = threading.Thread(target=self.run, name=f"sioms {address}", daemon=True)
        self._due_ns = 0
        self.carrying = Carrying(self)
        self._is_over = False
        self._waits, self._answer = NOBODY, b""
        self._links, self._epoll = select.epoll(), select.epoll()
        for fd in carrier.fds:
            self._links.register(fd, select.EPOLLIN)
        self.link_fd = self._links.fileno()
        self._spoilt = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        for fd in (self.link_fd, self._spoilt, self.ours.fileno()):
            self._epoll.register(fd, select.EPOLLIN)

    # --- beginning -------------------------------------------------------------------------------

    def begin(self, what: str, deadline: float) -> None:
        """Log in at the gateway, and compare clocks.

        Args:
            what: what is attempted, for messages.
            deadline: until when [s, time.monotonic].

        Raises:
            OSError: why not.
        """
        self._send(Up.HELLO, link.VERSION)
        while not self._told_ns:
            if not self._wait_frame(what, deadline, HELLO_AGAIN_S):
                self._link.send(link.pack(Up.HELLO, link.VERSION, 1))
        for _ in range(FIRST_PINGS):
            self._ping()
            exchanged_ns = self._pinged_ns
            while self._pinged_ns == exchanged_ns:
                self._wait_frame(what, deadline, 1.0)

    def _wait_frame(self, what: str, deadline: float, at_most_s: float) -> bool:
        """Wait for frames, and take them; return whether some came."""
        left_s = deadline - time.monotonic()
        if left_s <= 0:
            raise OSError(errno.ETIMEDOUT, f"{what}: the gateway does not answer; is it hung?")
        came = self._take_all()  # first: sending may have taken the edge off a descriptor of what has come
        if not came:
            self._epoll.poll(min(left_s, at_most_s))
        came = self._take_all() or came
        if self._last_word is None and (why := self._link.lost()):
            came = self._take_all() or came  # the gateway may have said why
            self._last_word = self._last_word or (errno.EIO, why)
        if self._last_word is not None:
            raise OSError(self._last_word[0], f"{what}: {self._last_word[1]}")
        return came

    def _ping(self) -> None:
        self._send(Up.PING, body=link.ping(time.monotonic_ns()))

    # --- the thread ------------------------------------------------------------------------------

    def start(self) -> None:
        """Have the session's own thread move frames from now on."""
        self._thread.start()
        atexit.register(self.leave)

    def leave(self) -> None:
        """End the session with the program, before its thread would be cut off in the midst of a library's work."""
        if self.carrying.is_a_childs:
            return
        with self.carrying.lock:
            if self._is_over:
                return
            self._leaves = True
            os.eventfd_write(self._spoilt, 1)
        self._thread.join(LEAVE_S)

    def run(self) -> None:
        """Move frames until either side ends the session."""
        signal.pthread_sigmask(signal.SIG_BLOCK, ALL)  # they are for threads of the program
        goes_on = True
        while goes_on and self._last_word is None:
            ready = [fd for fd, _ in self._epoll.poll(link.PING_S / 2)]
            with self.carrying.lock:
                try:
                    goes_on = self._turn(ready)
                except (OSError, MalformedFrame) as error:
                    self._lose(str(error))
        self._finish()

    def _turn(self, ready: list[int]) -> bool:
        """Do what descriptors that are ready, and the time, ask for; return whether the session goes on."""
        if self._leaves:
            return False
        for fd in ready:
            if fd == self.ours.fileno():
                if not self._from_program():
                    return False
            elif fd in self._by_fd:
                self._from_node(fd)
        now_ns = time.monotonic_ns()
        due = now_ns >= self._due_ns or self._stop is not None
        if due or self.link_fd in ready:
            self._look_for_loss(None if due else self._ready())
        if due:
            self._look(now_ns)
            self._due_ns = now_ns + int(link.PING_S * 1e9 / 4)
        # Last: sending takes the edge off a descriptor of what has come.
        self._take_all()
        return True

    def _ready(self) -> list[int]:
        """Return the descriptors of the link that are ready."""
        return [fd for fd, _ in self._links.poll(0)]

    def _look_for_loss(self, ready: Collection[int] | None = None) -> None:
        if why := self._link.lost(ready):
            self._take_all()  # the gateway may have said why
            self._lose(why)

    def _lose(self, why: str) -> None:
        self._last_word = self._last_word or (errno.EIO, f"link to {self._address} lost: {why}")

    # --- threads of the program ------------------------------------------------------------------

    def watch(self, whether: bool) -> None:
        """Have the session's own thread watch the link, or not."""
        self._epoll.modify(self.link_fd, select.EPOLLIN if whether else 0)

    def spoil(self, why: str) -> None:
        """Have the session end."""
        if not self._is_over:
            self._lose(why)
            os.eventfd_write(self._spoilt, 1)

    def say(self, channel: int, packet: bytes) -> None:
        """Send a packet of the program, 0 = to the daemon; raises OSError: EPIPE, that channel has ended."""
        far = self._nodes.get(channel)
        if self._is_over or self._last_word or (channel and (far is None or far.ended)):
            raise BrokenPipeError(errno.EPIPE, "it has ended")
        try:
            if channel:
                self._send(Up.PACKET, channel, packet)
            else:
                self._to_daemon(packet)
            if self._link.pending:
                self._take_all()
        except (OSError, MalformedFrame) as error:
            self.spoil(str(error))
            raise BrokenPipeError(errno.EPIPE, str(error)) from None

    def serve(self, channel: int) -> bytes:
        """Move what has come; return an answer for who waits on a channel, b"": what is for it lies in its socket."""
        if self._is_over or self._last_word:
            return b""
        self._waits, self._answer = channel, b""
        try:
            if ready := self._ready():
                self._look_for_loss(ready)
                self._take_all(ready)
        except (OSError, MalformedFrame) as error:
            self.spoil(str(error))
        finally:
            self._waits = NOBODY
        if self._last_word:
            os.eventfd_write(self._spoilt, 1)
        return self._answer

    # --- the session's thread --------------------------------------------------------------------

    def _look(self, now_ns: int) -> None:
        """Do what is due by time."""
        if now_ns - self._pinged_ns > link.PING_S * 1e9:
            self._pinged_ns = now_ns
            self._ping()
        if now_ns - self._heard_ns > link.GONE_S * 1e9:
            self._last_word = self._last_word or (
                errno.ETIMEDOUT, f"link to {self._address} lost: nothing came for {link.GONE_S:g} s"
            )  # fmt: skip
        if self._stop is not None and time.monotonic() > self._stop[0]:
            packet, self._stop = self._stop[1], None
            self._send(Up.PACKET, body=packet)

    def _take_all(self, ready: Collection[int] = ()) -> bool:
        """Take what has come; return whether something has."""
        came = False
        for frame in self._link.frames(ready):
            self._take(frame)
            came = True
        return came

    def _send(self, kind: int, channel: int = 0, body: bytes = b"") -> None:
        self._number += 1
        self._link.send(link.pack(kind, channel, self._number, self._told_ns, body))

    # --- from the program ------------------------------------------------------------------------

    def _from_program(self) -> bool:
        """Take a packet of the session; return whether it goes on."""
        try:
            packet = self.ours.recv(MAX_PACKET + 1)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if not packet:
            return False
        self._to_daemon(packet)
        return True

    def _to_daemon(self, packet: bytes) -> None:
        if len(packet) > 1 and packet[1] == ClientVerb.EMERGENCY_STOP:
            self._stop = (time.monotonic() + STOP_AGAIN_S, packet)
            with Briefly():
                self._link.stop(link.pack(Up.PACKET, body=packet))
        else:
            self._send(Up.PACKET, 0, packet)

    def _from_node(self, fd: int) -> None:
        handle = self._by_fd[fd]
        far = self._nodes[handle]
        try:
            packet = far.ours.recv(MAX_PACKET + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if packet:
            self._send(Up.PACKET, handle, packet)
            return
        self._epoll.unregister(fd)
        del self._by_fd[fd]
        del self._nodes[handle]
        far.close()
        self._send(Up.CLOSED, handle)

    # --- from the gateway ------------------------------------------------------------------------

    def _take(self, frame: bytes) -> None:
        kind, channel, _, stamp_ns, body = link.unpack(frame, link.MAX_FROM_GATEWAY)
        self._told_ns = max(self._told_ns, stamp_ns)
        self._heard_ns = time.monotonic_ns()
        far = self._nodes.get(channel)
        match kind:
            case Down.UPDATE if far is not None:
                self._confirm(far, channel)
                self._publish(far, Update.take(body, far.shape.slot_size))
            case Down.PACKET if channel and far is not None:
                if body:
                    self._hand_over(channel, far.ours, body)
                else:
                    self._end_of(far, channel)
            case Down.PACKET if not channel:
                self._stop = None
                self._hand_over(channel, self.ours, body)
            case Down.OPENED:
                shape, packet = link.take_opened(body)
                far = self._nodes[channel] = Far(shape)
                far.answer = packet
                self._by_fd[far.ours.fileno()] = channel
                self._epoll.register(far.ours.fileno(), select.EPOLLIN)
            case Down.FOLLOWED:
                packet, events = link.take_followed(body)
                journal = self._journals[channel] = FarJournal()
                journal.put(events)
                journal.hand_over(self.ours, packet)
            case Down.EVENTS if channel in self._journals:
                self._send(Up.CREDIT, channel)
                self._journals[channel].put(body)
            case Down.UNFOLLOWED:
                self._drop_journals()
            case Down.PONG:
                self._compare(stamp_ns, body)
            case Down.END:
                word = channel or errno.EIO, printable(body.decode("utf-8", "replace"), 1024)
                self._last_word = self._last_word or word  # the first says why; what came in between gets another one

    def _hand_over(self, channel: int, ours: socket.socket, packet: bytes) -> None:
        """Give a packet to the program: the first answer to who waits for one, and now moves frames, without a socket.
        A last word comes behind what lies there.
        """
        if channel == self._waits and not self._answer and packet[1:3] != b"\0\0":
            self._answer = packet
        else:
            ours.send(packet)  # a program that does not read its answers ends its session

    def _confirm(self, far: Far, handle: int) -> None:
        """Confirm sets of snapshots: half a window at a time, which spares the gateway every second frame."""
        far.unconfirmed += 1
        if far.unconfirmed >= link.WINDOW // 2:
            self._send(Up.CREDIT, handle, bytes((far.unconfirmed,)))
            far.unconfirmed = 0

    def _drop_journals(self) -> None:
        for journal in self._journals.values():
            journal.close()
        self._journals.clear()

    def _end_of(self, far: Far, handle: int) -> None:
        """Let the program find a node's connection ended; its page goes on telling how the device is."""
        fd, far.ended = far.ours.fileno(), True
        if self._by_fd.pop(fd, None) is not None:
            self._epoll.unregister(fd)
            far.ours.shutdown(socket.SHUT_RDWR)
            self._by_fd[far.wake] = handle  # an error on it says that the program has closed its end
            self._epoll.register(far.wake, 0)

    def _compare(self, answered_ns: int, body: bytes) -> None:
        sent_ns, got_ns, ahead_ns, error_ns, source = link.take_pong(body)
        self._pinged_ns = self._heard_ns
        self.clock.wall = Wall(ahead_ns, error_ns, source if source < 3 else 0)
        with suppress(ValueError):
            self.clock.offset.exchange(sent_ns, got_ns, answered_ns, self._heard_ns)

    def _publish(self, far: Far, update: Update) -> None:
        """Write what has been told into the page, the state first: nobody shall take old for good."""
        alive_ns = self.clock.here(update.alive_ns)
        far.page.set_condition(alive_ns, update.driver, update.daemon, update.reason)
        far.page.put_all(update.snapshots)
        if far.answer:
            far.hand_over(self.ours)
        elif update.wake:
            far.wake_up()

    # --- the end ---------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Tell both sides, and let go of everything."""
        with self.carrying.lock:
            self._is_over = True
            self._tell_end()
        self.carrying.end(self.release)
        atexit.unregister(self.leave)

    def _tell_end(self) -> None:
        """Tell both sides: a thread of the program that moves frames finds it in the socket that it waits for."""
        if self._last_word is None:
            with suppress(OSError):
                self._send(Up.BYE)
        else:
            word = refusal(0, *self._last_word)
            reason = self._last_word[1].encode()[: REASON_SIZE - 1]
            for far in self._nodes.values():
                far.page.set_condition(0, PageState.LINK_LOST, PageState.GOOD, reason)
                with suppress(OSError):
                    far.ours.send(word)
                far.wake_up()
            with suppress(OSError):
                self.ours.send(word)
        for sock in (self.ours, *(far.ours for far in self._nodes.values())):
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def release(self) -> None:
        """Let go of everything."""
        for far in self._nodes.values():
            far.close()
        self._nodes.clear()
        self._drop_journals()
        self.ours.close()
        self._link.close()
        self._links.close()
        self._epoll.close()
        os.close(self._spoilt)
