"""The daemon's clients: their sessions, requests and waits; what they ask for is done by the verbs.

Concurrency: everything runs in the daemon's loop. A session that sends nonsense, or more than its
bounds allow, is ended with a line in the log, and nothing else.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
import traceback
from typing import TYPE_CHECKING, Any

from sioms.protocol.incoming import FROM_CLIENT, take
from sioms.protocol.messages import MAX_PACKET, ClientVerb, MalformedMessage, refusal, reply

from .config import WorkcellTable
from .marker_owners import MarkerError
from .marker_verbs import MarkerVerbs
from .node_verbs import NodeVerbs
from .rights import Peer, Rights
from .sessions import LATER, Refused, Session, Wait, peer_of, pidfd_of
from .users import Users
from .workcell_verbs import WorkcellVerbs

if TYPE_CHECKING:
    from .server import Server

LONGEST_WAIT_S = 7 * 24 * 3600.0
_SHOWN = frozenset(
    {
        ClientVerb.EMERGENCY_STOP, ClientVerb.RESET, ClientVerb.SIGNAL_MARKER, ClientVerb.FREE_MARKER,
        ClientVerb.WAIT_MARKER, ClientVerb.CLOSE,
    }
)  # fmt: skip
"""What readings of nodes show: who has the answer shall read nothing older."""


_NEEDS_ANY_RIGHT = {
    ClientVerb.RESERVE_MARKER: "reserve markers",
    ClientVerb.SIGNAL_MARKER: "signal a marker",
    ClientVerb.WAIT_MARKER: "wait for a marker",
}
"""Requests on what belongs to no node: of anybody who may do something here."""


class Clients:
    """All sessions of a daemon.

    Args:
        server: the daemon.
        listener: the listening SOCK_SEQPACKET socket.
        address: its path.
    """

    def __init__(self, server: Server, listener: socket.socket, address: str) -> None:
        self.users = Users()
        self.rights = Rights([], os.getuid(), self.users)
        self.address = address
        self._server = server
        self._listener = listener
        self.sessions: set[Session] = set()
        self.nodes = NodeVerbs(server, self)
        self.markers = MarkerVerbs(server.shared.markers, self)
        self._workcell = WorkcellVerbs(server, self)
        listener.setblocking(False)

    @property
    def bounds(self) -> WorkcellTable:
        """The bounds of the configuration."""
        return self._server.config.workcell if self._server.config else WorkcellTable()

    # --- connections -----------------------------------------------------------------------------

    def welcome(self) -> None:
        """Begin to accept clients; while the first configuration is loading they hear that, and nothing else."""
        self._server.loop.watch(self._listener.fileno(), self._accept)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                # The listener stays readable: look away for a while instead of spinning.
                self._server.log("error", "session refused", why=error.strerror)
                self._server.loop.unwatch(self._listener.fileno())
                self._server.loop.after(0.2, self.welcome)
            return
        sock.setblocking(False)
        peer = peer_of(sock, self.users)
        if len(self.sessions) >= self.bounds.max_sessions:
            self._refuse(sock, peer)
            return
        session = Session(sock, peer, pidfd_of(sock, peer.pid))
        self.sessions.add(session)
        self._server.loop.watch(sock.fileno(), lambda: self._receive(session))
        if session.pidfd >= 0:
            # A child that it forked may hold the socket open after its death.
            self._server.loop.watch(session.pidfd, lambda: self._end_session(session, ""))

    def _refuse(self, sock: socket.socket, peer: Peer) -> None:
        """Tell one client too many why it is not taken."""
        most = self.bounds.max_sessions
        self._server.log("warning", "session refused", peer=peer, why=f"max_sessions = {most} are open")
        text = f"connect: {most} sessions are open, as many as max_sessions of [workcell] allows; close one, or allow more"
        with contextlib.suppress(OSError):
            sock.send(refusal(0, errno.EUSERS, text))
        sock.close()

    def _receive(self, session: Session) -> None:
        for _ in range(16):  # a chatty client gets its turn, not the loop
            if session not in self.sessions:
                return
            try:
                packet = session.sock.recv(MAX_PACKET + 1)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._end_session(session, "")
                return
            try:
                self._dispatch(session, *take(packet, FROM_CLIENT))
            except MalformedMessage as error:
                self._end_session(session, str(error))
                return
            except Exception as error:  # our own mistake costs one session, not the workcell
                trace = "".join(traceback.format_exception(error)[-3:])
                self._server.log("error", "internal error", peer=session, trace=trace)
                if session in self.sessions:
                    self._end_session(session, f"internal error: {error!r}")
                return

    def _dispatch(self, session: Session, of_client: int, number: int, arguments: list[Any]) -> None:
        verb = ClientVerb(of_client)
        if starting := self._server.starting:
            text = f"connect: the daemon is starting: {starting}; `sioms wait` waits until it is ready"
            self.send(session, refusal(number, errno.EAGAIN, text))
            return
        if number == 0 or number in session.waits:
            raise MalformedMessage(f"message number {number} is zero or in use")
        try:
            value = self._verb(session, verb, number, arguments)
        except (Refused, MarkerError) as error:
            # Also then: who closes a handle that its driver has ended already shall see the axes halted.
            self.send(session, refusal(number, error.errno, str(error), _as_of_ns(verb)))
        else:
            if value is not LATER:
                self.send(session, reply(number, value, _as_of_ns(verb)))

    def _verb(self, session: Session, verb: ClientVerb, number: int, arguments: list[Any]) -> Any:
        if verb in _NEEDS_ANY_RIGHT and not self.rights.anywhere(session.peer):
            what = f"{_NEEDS_ANY_RIGHT[verb]}: {session.peer.user}"
            raise Refused(errno.EPERM, f"{what} has no right on any node; ask for a [[grant]]")
        match verb:
            case ClientVerb.HELLO:
                return self._workcell.hello(session, number, *arguments)
            case ClientVerb.OPEN:
                return self.nodes.open(session, number, *arguments)
            case ClientVerb.CLOSE:
                return self.nodes.close(session, number, *arguments)
            case ClientVerb.LIST:
                return self.nodes.listing(session)
            case ClientVerb.INFO:
                return self._server.names.pack(self.nodes.find(session, "get information", *arguments))
            case ClientVerb.STATUS:
                return self._workcell.status()
            case ClientVerb.RESERVE_MARKER:
                return self.markers.reserve(session, *arguments)
            case ClientVerb.FREE_MARKER:
                return self.markers.free(*arguments)
            case ClientVerb.SIGNAL_MARKER:
                return self.markers.signal(*arguments)
            case ClientVerb.WAIT_MARKER:
                return self.markers.wait(session, number, *arguments)
            case ClientVerb.EMERGENCY_STOP:
                return self._workcell.emergency_stop(session, *arguments)
            case ClientVerb.RESET:
                return self._workcell.reset(session, *arguments)
            case ClientVerb.RELOAD:
                return self._workcell.reload(session, number)
            case ClientVerb.CANCEL:
                return self._cancel(session, *arguments)

    def send(self, session: Session, packet: bytes, fds: list[int] | None = None) -> None:
        """Send an answer."""
        try:
            if fds:
                socket.send_fds(session.sock, [packet], fds)
            else:
                session.sock.send(packet)
        except OSError as error:
            # Also when its buffer is full: a client that does not read its replies is a dead client.
            if session in self.sessions:
                self._end_session(session, f"reply could not be sent: {error.strerror}")

    def _end_session(self, session: Session, why: str) -> None:
        self.sessions.discard(session)
        if why:
            self._server.log("warning", "session ended", peer=session, why=why)
        self._server.loop.unwatch(session.sock.fileno())
        session.sock.close()
        for wait in list(session.waits.values()):
            self.drop(wait)
        self.markers.end_session(session)
        for handle in list(session.handles.values()):
            self.nodes.detach(handle)
        if session.pidfd >= 0:
            self._server.loop.unwatch(session.pidfd)
            os.close(session.pidfd)

    def take_up_rights(self, rights: Rights) -> None:
        """Let new names and grants hold, also for what is open already, and for who has left a group."""
        self.rights = rights
        for session in list(self.sessions):
            session.peer = peer_of(session.sock, self.users)
            if not rights.anywhere(session.peer):
                self.markers.end_session(session)
        self.nodes.take_up_rights()

    # --- waiting requests ------------------------------------------------------------------------

    def wait(self, session: Session, number: int, timeout_s: float | None, what: str) -> Wait:
        """Keep a request to be answered later, or refused when its time is over [s; None = never]."""
        if len(session.waits) >= self.bounds.max_waits:
            raise Refused(
                errno.EAGAIN,
                f"{what}: {len(session.waits)} requests are waiting already; at most {self.bounds.max_waits}",
            )
        wait = Wait(number, session, None, what)
        if timeout_s is not None:
            limit = min(max(float(timeout_s), 0.0), LONGEST_WAIT_S)
            wait.timer = self._server.loop.after(limit, lambda: self._timed_out(wait, limit))
        session.waits[number] = wait
        return wait

    def answer(self, wait: Wait, packet: bytes, fds: list[int] | None = None) -> None:
        """Answer a request that was kept, unless it has ended in another way."""
        if self.drop(wait):
            self.send(wait.session, packet, fds)

    def drop(self, wait: Wait) -> bool:
        """Forget a request that was kept; return whether it was still waiting."""
        if wait.timer is not None:
            wait.timer.cancel()
        self.nodes.forget_wait(wait)
        self.markers.forget(wait)
        return wait.session.waits.pop(wait.number, None) is not None

    def _timed_out(self, wait: Wait, limit_s: float) -> None:
        why = f": {wait.why()}" if wait.why is not None else ""
        self.answer(
            wait, refusal(wait.number, errno.ETIMEDOUT, f"{wait.what}: not within {limit_s:g} s{why}")
        )

    def _cancel(self, session: Session, number: int) -> bool:
        wait = session.waits.get(int(number))
        if wait is None:
            return False
        self.answer(wait, refusal(wait.number, errno.ECANCELED, f"{wait.what}: cancelled"))
        return True


def _as_of_ns(verb: ClientVerb) -> int:
    """Return the instant at which a request had its effect on what readings show: now, or never."""
    return time.monotonic_ns() if verb in _SHOWN else 0
