"""The link over Zenoh: one connection under TLS with certificates of both ends; stops overtake by their priority.

Concurrency: the thread of the session; frames come on threads of Zenoh, and are queued.
"""

from __future__ import annotations

import atexit
import ctypes
import errno
import os
import secrets
import socket
import ssl
import threading
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from typing import Any
from weakref import WeakSet

import zenoh
from zenoh.handlers import Callback

from sioms.prompt import Hurry
from sioms.protocol import link
from sioms.protocol.link import Up

from .certificates import AUTHORITY, CERTIFICATE, CERTIFICATE_KEY, own
from .keys import Folder
from .places import probe
from .zenoh_keys import ALIVE, DOWN, GATEWAY, STOP, UP, config, endpoint, open_session

BLOCKED_US = 1_000_000
"""How long a frame may wait for a connection that takes none before that is given up [us]."""
OPENED_S = 10.0
"""How long the end of a program waits for sessions that are being opened [s]; opening one takes no longer."""
MOST_QUEUED = 64 << 20
"""Bytes that a gateway may send ahead of this session; more ends it."""


class ZenohLink:
    """See ``remote.Link``.

    Args:
        what: what is attempted, for messages.
        address, host, port: of the gateway.
        timeout_s: how long connecting may take [s].

    Raises:
        OSError: no such host, nobody there, no certificate, or one that either end does not take.
    """

    def __init__(self, what: str, address: str, host: str, port: int, timeout_s: float) -> None:
        if _users - {os.getpid()}:
            text = "this process was forked from one that had used Zenoh, whose threads are not in it"
            raise OSError(errno.ENOTSUP, f"{what}: {text}; start it by multiprocessing's spawn")
        folder = Folder()
        mine = own(folder, what)
        probe(what, host, port, timeout_s)
        self._frames: deque[bytes] = deque()
        self._bytes, self._lost = 0, ""
        self._came = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.fds: tuple[int, ...] = (self._came,)
        connect = {"endpoints": [endpoint(host, port)], "timeout_ms": int(1e3 * timeout_s), "exit_on_failure": True}
        _users.add(os.getpid())
        try:
            self._session = _opening.open(config(folder, "connect", BLOCKED_US, mode="client", connect=connect))
        except zenoh.ZError as error:
            os.close(self._came)
            raise _reason(what, host, port, folder, error) from None
        except OSError as error:
            os.close(self._came)
            raise OSError(error.errno, f"{what}: {error.strerror}") from None
        name = f"{mine.number}/{secrets.token_hex(8)}"
        self._closing, self._waking = threading.Lock(), threading.Lock()
        self._declared: list[Any] = []
        _open.add(self)
        atexit.register(self._end)  # or threads of Zenoh would call an interpreter that has ended
        try:
            self._declare(name)
        except zenoh.ZError as error:  # the connection has ended meanwhile
            self.close()
            raise OSError(errno.EIO, f"{what}: the connection has ended at once: {error}") from None
        self._send_stop(link.pack(Up.HELLO))

    def _declare(self, name: str) -> None:
        """Say what is sent and taken under a name."""
        session, live = self._session, self._session.liveliness()
        self._declared += (
            session.declare_subscriber(f"{DOWN}/{name}", Callback(self._take, indirect=False)),
            live.declare_subscriber(GATEWAY, Callback(self._gateway, indirect=False), history=True),
            live.declare_token(f"{ALIVE}/{name}"),
        )
        self._up = self._publisher(f"{UP}/{name}", zenoh.Priority.INTERACTIVE_HIGH)
        self._stop = self._publisher(f"{STOP}/{name}", zenoh.Priority.REAL_TIME)
        self._declared += self._up, self._stop

    def _publisher(self, key: str, priority: zenoh.Priority) -> zenoh.Publisher:
        block = zenoh.CongestionControl.BLOCK
        return self._session.declare_publisher(key, congestion_control=block, priority=priority, express=True)

    # --- threads of Zenoh ------------------------------------------------------------------------

    def _wake(self) -> None:
        with self._waking:
            if self._came >= 0:  # closed, its number may be another file's
                os.eventfd_write(self._came, 1)

    def _take(self, sample: zenoh.Sample) -> None:
        _hurry.meet()
        frame = sample.payload.to_bytes()
        self._bytes += len(frame)
        self._frames.append(frame)
        if self._bytes > MOST_QUEUED:
            self._lost = f"more than {MOST_QUEUED} bytes wait to be taken"
        self._wake()

    def _gateway(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._lost = "the connection has ended"
            self._wake()

    # --- the thread of the session ---------------------------------------------------------------

    def send(self, frame: bytes) -> None:
        """Send a frame; raises OSError."""
        try:
            self._up.put(frame)
        except zenoh.ZError as error:
            raise OSError(errno.EIO, str(error)) from None

    def stop(self, frame: bytes) -> None:
        """Send a stop ahead of all other frames."""
        _hurry.begin()
        self._send_stop(frame)

    def _send_stop(self, frame: bytes) -> None:
        with suppress(zenoh.ZError):  # it goes the other way then
            self._stop.put(frame)

    @property
    def pending(self) -> bool:
        """Whether frames wait."""
        return bool(self._frames)

    def frames(self, ready: Collection[int] = ()) -> Iterator[bytes]:
        """Take what has come."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._came)
        while self._frames:
            frame = self._frames.popleft()
            self._bytes -= len(frame)
            yield frame

    def lost(self, ready: Collection[int] | None = None) -> str:
        """Return why the connection has ended, '' if it has not."""
        _hurry.look()
        return self._lost

    def close(self) -> None:
        """Let go of everything."""
        self._end()
        atexit.unregister(self._end)
        with self._waking:
            if self._came >= 0:
                os.close(self._came)
                self._came = -1

    def leave(self) -> None:
        """Leave the session to the parent of this process, in which its threads are: here nothing of it ever ends."""
        atexit.unregister(self._end)
        for each in (self._session, *self._declared):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(each))

    def _end(self) -> None:
        """End Zenoh's session; a second call waits for the first."""
        with self._closing:
            end_session(self._session, self._declared)


def end_session(session: zenoh.Session, declared: Iterable[Any]) -> None:
    """End a session of Zenoh that has not ended yet, and first take back what it has declared: what is not, Zenoh keeps
    as long as the process runs, 8 KiB a publisher.
    """
    if not session.is_closed():
        for each in declared:
            with suppress(zenoh.ZError):
                each.undeclare()
        session.close()  # type: ignore[no-untyped-call]


class Opening:
    """Sessions that threads are opening: the program's end waits for them, and there are no more after it. A thread
    that came out of Zenoh into an interpreter that has ended would be cut off in the midst of its work.

    Concurrency: any threads.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._count = 0
        self._is_over = False

    def open(self, how: zenoh.Config) -> zenoh.Session:
        """Open a session; raises OSError: ESHUTDOWN, the program ends; and zenoh.ZError."""
        with self._changed:
            self._go_on()
            self._count += 1
        try:
            session = open_session(how)
            if self._is_over:
                session.close()  # type: ignore[no-untyped-call]
                self._go_on()
            return session
        finally:
            with self._changed:
                self._count -= 1
                self._changed.notify_all()

    def _go_on(self) -> None:
        if self._is_over:
            raise OSError(errno.ESHUTDOWN, "the program is ending")

    def end(self) -> None:
        """Wait until none is being opened."""
        with self._changed:
            self._is_over = True
            self._changed.wait_for(lambda: not self._count, OPENED_S)


_hurry = Hurry()
"""The threads of Zenoh in this process, which all sessions share: on the way of a stop they are prompt."""
_opening = Opening()
atexit.register(lambda: _opening.end())
_open: WeakSet[ZenohLink] = WeakSet()
_users: set[int] = set()
"""Processes that have opened a session of Zenoh: this one, and those that it was forked from."""


def _leave_all() -> None:
    """Leave the links of the parent to it, in a forked child: what ends one would wait for threads of the parent."""
    global _opening
    _opening = Opening()
    for each in list(_open):
        each.leave()


os.register_at_fork(after_in_child=_leave_all)


def _reason(what: str, host: str, port: int, folder: Folder, error: zenoh.ZError) -> OSError:
    """Return why a connection was not made, which Zenoh does not tell: by a handshake with the same certificates."""
    try:
        context = ssl.create_default_context(cafile=folder.file(AUTHORITY))
        context.load_cert_chain(folder.file(CERTIFICATE), folder.file(CERTIFICATE_KEY))
        with (
            socket.create_connection((host, port), 2.0) as plain,
            context.wrap_socket(plain, server_hostname=host) as sock,
        ):
            sock.settimeout(0.5)
            sock.recv(1)
    except ssl.SSLCertVerificationError as wrong:
        text = f"{what}: the certificate of whoever listens there is not taken: {wrong.verify_message}"
        return OSError(errno.EACCES, f"{text}; it must be signed by the authority of {folder.path} for {host}")
    except ssl.SSLError as wrong:
        reason = (wrong.reason or str(wrong)).lower().replace("_", " ")
        hint = "is it of the same authority as the gateway's, and does it still hold?"
        return OSError(errno.EACCES, f"{what}: the gateway does not take your certificate ({reason}); {hint}")
    except OSError:
        pass
    return OSError(errno.EIO, f"{what}: whoever listens there does not answer as a gateway over Zenoh does: {error}")
