"""The transport to a gateway on another machine: ZeroMQ on one side, on the other the same sockets, pages and pipes as
of a daemon on this machine.

A thread moves frames between both and writes what it is told into pages; sessions, nodes and channels do not know that
it is there. It says nothing of its own that would renew a lease: what does is what the program's own calls put
into the sockets. A session is one connection: when that is lost the session ends, with a last word that says why.

Concurrency: one thread a session, which owns everything but the sockets' other ends. A forked child has no such thread.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import threading
import time
from contextlib import suppress
from mmap import mmap
from typing import Any

import zmq
from zmq.utils.monitor import parse_monitor_message

from sioms.protocol import link
from sioms.protocol.clock import Clock, Offset, Wall
from sioms.protocol.flags import PageState
from sioms.protocol.link import Down, MalformedFrame, PageShape, Up, Update
from sioms.protocol.messages import MAX_PACKET, ClientVerb, refusal
from sioms.protocol.page import REASON_SIZE, PageCopy, page_size
from sioms.protocol.text import printable

from .keys import Folder

SCHEME = "zmq://"
STALE_S = 0.2
"""How much older than its driver's lease a reading may get on its way [s]; then it is none."""
FIRST_PINGS = 8
STOP_AGAIN_S = 0.3
"""A stop that has not been answered on its own way goes the other one, too, after so long [s]."""
_WAYS_S = 2.0
_BUFFER = 1 << 19
_context: zmq.Context[zmq.Socket[bytes]] | None = None


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


def place_of(address: str) -> tuple[str, int]:
    """Return host and port of ``zmq://HOST:PORT``.

    Raises:
        OSError: EINVAL, it is none.
    """
    host, colon, port = address.removeprefix(SCHEME).rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not address.startswith(SCHEME) or not colon or not host or not port.isdecimal() or not 0 < int(port) < 65535:
        raise OSError(
            errno.EINVAL,
            f"connect to {printable(address)}: want zmq://HOST:PORT, as zmq://lab2:5770, or the path of a socket",
        )
    return host, int(port)


def connect(address: str, timeout_s: float) -> tuple[Any, LinkClock]:
    """Open a session of the link.

    Args:
        address: ``zmq://HOST:PORT`` of the gateway.
        timeout_s: how long that may take [s].

    Returns:
        A socket as one that is connected to a daemon, and the cell's clock.

    Raises:
        OSError: with a sentence: no such host, nobody there, a key that is not known, another release.
    """
    host, port = place_of(address)
    what = f"connect to {printable(address)}"
    folder = Folder()
    own = folder.own()
    if own is None:
        raise OSError(errno.EACCES, f"{what}: you have no key in {folder.path}; make one with: sioms key new")
    server = folder.trusted().get(f"{host}:{port}")
    if server is None:
        raise OSError(
            errno.EACCES,
            f"{what}: the key of that gateway is not known here; look it up there with `sioms key list`, and run: "
            f"sioms key trust {address} KEY",
        )
    numeric = _probe(what, host, port, timeout_s)
    bridge = _Bridge(address, numeric, port, own.public, own.secret, server)
    try:
        bridge.begin(what, timeout_s)
    except BaseException:
        bridge.release()
        raise
    threading.Thread(target=bridge.run, name=f"sioms {address}", daemon=True).start()
    return bridge.theirs, bridge.clock


def _probe(what: str, host: str, port: int, timeout_s: float) -> str:
    """Return the address at which somebody listens; ZeroMQ itself would go on trying without a word."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise OSError(
            errno.EHOSTUNREACH, f"{what}: host {printable(host)} is not known ({error.strerror}); is it spelt right?"
        ) from None
    last = OSError(errno.EHOSTUNREACH, "no address")
    for family, kind, protocol, _, where in found:
        with socket.socket(family, kind, protocol) as probe:
            probe.settimeout(timeout_s)
            try:
                probe.connect(where)
            except OSError as error:
                last = error
                continue
            return f"[{where[0]}]" if family == socket.AF_INET6 else str(where[0])
    number = errno.ETIMEDOUT if isinstance(last, TimeoutError) else last.errno or errno.EIO
    hint = {
        errno.ECONNREFUSED: "nobody listens there; start `sioms serve` on that machine, or correct the port",
        errno.ETIMEDOUT: "no answer; is the machine on, and does its firewall let this port and the next one through?",
    }.get(number, (last.strerror or str(last)).lower())
    raise OSError(number, f"{what}: {hint}") from None


class _Far:
    """A node at the other end: its page here, and our ends of its sockets."""

    def __init__(self, shape: PageShape) -> None:
        size = page_size(shape.node_class, shape.channels, shape.slots)
        self.page_fd = os.memfd_create("sioms-page", os.MFD_CLOEXEC)
        os.ftruncate(self.page_fd, size)
        self._map = mmap(self.page_fd, size)
        lease_ns = shape.lease_ns + int(STALE_S * 1e9)
        self.shape = shape
        self.page = PageCopy(
            memoryview(self._map), shape.node_class, shape.channels, shape.slots, lease_ns, shape.generation,
            shape.device,
        )  # fmt: skip
        self.wake_read, self.wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.setblocking(False)
        self.theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self.answer = b""

    def hand_over(self, session: socket.socket) -> None:
        """Pass the program's ends along with the answer to its open."""
        fds = [self.page_fd, self.wake_read, self.theirs.fileno()]
        try:
            socket.send_fds(session, [self.answer], fds)
        finally:
            self.answer = b""
            os.close(self.page_fd)
            os.close(self.wake_read)
            self.page_fd = self.wake_read = -1
            self.theirs.close()

    def wake_up(self) -> None:
        """Make the program's end of the pipe readable."""
        with suppress(OSError):  # full, or closed
            os.write(self.wake, b"\1")

    def close(self) -> None:
        """Let go of everything; what the program has goes on being there."""
        self.ours.close()
        self.theirs.close()
        for fd in (self.wake, self.page_fd, self.wake_read):
            if fd >= 0:
                os.close(fd)
        self.page.release()
        self._map.close()


class _Bridge:
    """What the thread does."""

    def __init__(self, address: str, host: str, port: int, public: str, secret: str, server: str) -> None:
        self._address, self._public = address, public
        self.clock = LinkClock()
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.setblocking(False)
        self._number = 0
        self._told_ns = 0
        self._heard_ns = self._pinged_ns = 0
        self._nodes: dict[int, _Far] = {}
        self._by_fd: dict[int, int] = {}
        self._stop: tuple[float, bytes] | None = None
        self._last_word: tuple[int, str] | None = None
        self._epoll = select.epoll()
        self._requests = self._socket(public, secret, server)
        self._stops = self._socket(public, secret, server)
        self._monitor = self._requests.get_monitor_socket(
            zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH
            | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
        )  # fmt: skip
        self._requests.connect(f"tcp://{host}:{port}")
        self._stops.connect(f"tcp://{host}:{port + 1}")

    def _socket(self, public: str, secret: str, server: str) -> zmq.Socket[bytes]:
        global _context
        if _context is None or _context.closed:
            _context = zmq.Context(1)
        sock = _context.socket(zmq.DEALER)
        sock.curve_publickey, sock.curve_secretkey = public.encode(), secret.encode()
        sock.curve_serverkey = server.encode()
        for option, value in (
            (zmq.LINGER, 200), (zmq.RECONNECT_IVL, -1), (zmq.MAXMSGSIZE, link.MAX_FROM_GATEWAY), (zmq.IPV6, 1),
            (zmq.HANDSHAKE_IVL, 2000),
        ):  # fmt: skip
            sock.setsockopt(option, value)
        return sock

    # --- beginning -------------------------------------------------------------------------------

    def begin(self, what: str, timeout_s: float) -> None:
        """Wait until the gateway has let us in, and compare clocks.

        Raises:
            OSError: why not.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            if not self._monitor.poll(max(0, int(1e3 * (deadline - time.monotonic())))):
                raise OSError(errno.ETIMEDOUT, f"{what}: whoever listens there does not answer as a gateway does")
            happened: Any = parse_monitor_message(self._monitor.recv_multipart())
            if happened["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                break
            if happened["event"] == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                raise OSError(
                    errno.EACCES,
                    f"{what}: the gateway does not let your key in; on its machine run `sioms key allow NAME "
                    f"{self._public}`",
                )
            raise OSError(
                errno.EACCES,
                f"{what}: whoever listens there has another key than the one that is trusted here, or is no gateway; "
                "compare `sioms key list` of both machines",
            )
        self._send(Up.HELLO, link.VERSION)
        with suppress(zmq.ZMQError):
            self._stops.send(link.pack(Up.HELLO), zmq.DONTWAIT)
            self._stops.getsockopt(zmq.EVENTS)  # from now on its descriptor tells
        while not self._told_ns:
            self._wait_frame(what, deadline)
        for _ in range(FIRST_PINGS):
            self._ping()
            exchanged_ns = self._pinged_ns
            while self._pinged_ns == exchanged_ns:
                self._wait_frame(what, deadline)

    def _wait_frame(self, what: str, deadline: float) -> None:
        if not self._requests.poll(max(0, int(1e3 * (deadline - time.monotonic())))):
            raise OSError(errno.ETIMEDOUT, f"{what}: the gateway does not answer; is it hung?")
        self._take(self._requests.recv())
        if self._last_word is not None:
            raise OSError(self._last_word[0], f"{what}: {self._last_word[1]}")

    def _ping(self) -> None:
        self._send(Up.PING, body=link.ping(time.monotonic_ns()))

    # --- the thread ------------------------------------------------------------------------------

    def run(self) -> None:
        """Move frames until either side ends the session."""
        try:
            self._run()
        except (OSError, zmq.ZMQError, MalformedFrame) as error:
            self._last_word = self._last_word or (errno.EIO, f"link to {self._address} lost: {error}")
        self._finish()

    def _run(self) -> None:
        requests = int(self._requests.getsockopt(zmq.FD))
        stops = int(self._stops.getsockopt(zmq.FD))
        monitor = int(self._monitor.getsockopt(zmq.FD))
        session = self.ours.fileno()
        for fd in (requests, stops, monitor, session):
            self._epoll.register(fd, select.EPOLLIN)
        due_ns = 0
        while self._last_word is None:
            ready = [fd for fd, _ in self._epoll.poll(link.PING_S / 2)]
            for fd in ready:
                if fd == session:
                    if not self._from_program():
                        return
                elif fd in self._by_fd:
                    self._from_node(fd)
            if stops in ready:
                self._take_from(self._stops)
            now_ns = time.monotonic_ns()
            if monitor in ready or now_ns >= due_ns or self._stop is not None:
                self._look(now_ns)
                due_ns = now_ns + int(link.PING_S * 1e9 / 4)
            # Last: sending takes the edge off the descriptor of what has come.
            self._take_from(self._requests)

    def _look(self, now_ns: int) -> None:
        """Do what is due by time."""
        while int(self._monitor.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            happened: Any = parse_monitor_message(self._monitor.recv_multipart())
            if happened["event"] == zmq.EVENT_DISCONNECTED:
                self._take_from(self._requests)  # the gateway may have said why
                text = f"link to {self._address} lost: the connection has ended"
                self._last_word = self._last_word or (errno.EIO, text)
        if now_ns - self._pinged_ns > link.PING_S * 1e9:
            self._pinged_ns = now_ns
            self._ping()
        if now_ns - self._heard_ns > link.GONE_S * 1e9:
            self._last_word = (
                errno.ETIMEDOUT, f"link to {self._address} lost: nothing came for {link.GONE_S:g} s"
            )  # fmt: skip
        if self._stop is not None and time.monotonic() > self._stop[0]:
            packet, self._stop = self._stop[1], None
            self._send(Up.PACKET, body=packet)

    def _take_from(self, sock: zmq.Socket[bytes]) -> None:
        """Take what has come."""
        while int(sock.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            self._take(sock.recv(zmq.DONTWAIT))

    def _send(self, kind: int, channel: int = 0, body: bytes = b"") -> None:
        self._number += 1
        self._requests.send(link.pack(kind, channel, self._number, self._told_ns, body), zmq.DONTWAIT)

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
        if len(packet) > 1 and packet[1] == ClientVerb.EMERGENCY_STOP:
            self._stop = (time.monotonic() + STOP_AGAIN_S, packet)
            with suppress(zmq.ZMQError):  # it goes the other way then
                self._stops.send(link.pack(Up.PACKET, body=packet), zmq.DONTWAIT)
                self._take_from(self._stops)
            return True
        self._send(Up.PACKET, 0, packet)
        return True

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
                self._send(Up.CREDIT, channel)
                self._publish(far, Update.take(body, far.shape.slot_size))
            case Down.PACKET if channel and far is not None:
                if body:
                    far.ours.send(body)  # a program that does not read its answers ends its session
                else:
                    self._end_of(far, channel)
            case Down.PACKET if not channel:
                self._stop = None
                self.ours.send(body)
            case Down.OPENED:
                shape, packet = link.take_opened(body)
                far = self._nodes[channel] = _Far(shape)
                far.answer = packet
                self._by_fd[far.ours.fileno()] = channel
                self._epoll.register(far.ours.fileno(), select.EPOLLIN)
            case Down.PONG:
                self._compare(stamp_ns, body)
            case Down.END:
                self._last_word = (channel or errno.EIO, printable(body.decode("utf-8", "replace"), 1024))

    def _end_of(self, far: _Far, handle: int) -> None:
        """Let the program find a node's connection ended; its page goes on telling how the device is."""
        fd = far.ours.fileno()
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

    def _publish(self, far: _Far, update: Update) -> None:
        """Write what has been told into the page, the state first: nobody shall take old for good."""
        alive_ns = self.clock.here(update.alive_ns)
        far.page.set_condition(alive_ns, update.driver, update.daemon, update.reason)
        for raw in update.snapshots:
            far.page.put(raw)
        if far.answer:
            far.hand_over(self.ours)
        elif update.wake:
            far.wake_up()

    # --- the end ---------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Tell both sides, and let go of everything."""
        if self._last_word is None:
            with suppress(zmq.ZMQError):
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
        self.release()

    def release(self) -> None:
        """Let go of everything."""
        for far in self._nodes.values():
            far.close()
        self._nodes.clear()
        self.ours.close()
        self._requests.disable_monitor()
        for sock in (self._monitor, self._requests, self._stops):
            sock.close()
        self._epoll.close()
