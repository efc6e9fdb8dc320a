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
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sioms.protocol import verbs
from sioms.protocol.flags import Right
from sioms.protocol.journal import Note
from sioms.protocol.messages import MAX_PACKET, MalformedMessage, refusal, reply

from .config import QuotaTable, WorkcellTable
from .marker_owners import MarkerError
from .marker_verbs import MarkerVerbs
from .node_verbs import NodeVerbs
from .quotas import Quotas, why_full
from .rights import Peer, Rights
from .sessions import LATER, Refused, Session, Wait, peer_of, pidfd_of
from .supervision import Supervision
from .users import Users
from .workcell_verbs import WorkcellVerbs

if TYPE_CHECKING:
    from .server import Server

STATUS_NS = 20_000_000
"""How old what STATUS tells may be while nobody asks for anything else."""
FIRST_KEY = 1 << 32
"""Number of the first key that a gateway has spoken for."""
LONGEST_WAIT_S = 7 * 24 * 3600.0


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
        self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        self.sessions: set[Session] = set()
        self._status: tuple[int, dict[str, object]] | None = None
        self._keys: dict[str, int] = {}
        self.nodes = NodeVerbs(server, self)
        self.markers = MarkerVerbs(server.shared.markers, self)
        self._workcell = WorkcellVerbs(server, self)
        self.supervision = Supervision(server.loop, lambda: self.bounds.supervisor_lease_s, server.stop_workcell)
        listener.setblocking(False)

    @property
    def bounds(self) -> WorkcellTable:
        """The bounds of the configuration."""
        return self._server.config.workcell if self._server.config else WorkcellTable()

    @property
    def quotas(self) -> Quotas:
        """The quotas of the configuration."""
        return Quotas(self._server.config.quota if self._server.config else QuotaTable())

    # --- connections -----------------------------------------------------------------------------

    def welcome(self) -> None:
        """Begin to accept clients; while the first configuration is loading they hear that, and nothing else."""
        self._server.loop.turns.add(self._listener.fileno(), "door", 0, self._accept)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                self._cannot_accept(error)
            return
        sock.setblocking(False)
        peer = peer_of(sock, self.users)
        if why := self._why_not(peer):
            self._refuse(sock, peer, why)
            return
        session = Session(sock, peer, pidfd_of(sock, peer.pid))
        self.sessions.add(session)
        self._changed()
        self._server.loop.turns.add(sock.fileno(), peer.uid, 0, lambda: self._receive(session))
        session.greeting = self._server.loop.after(self.quotas.greeting_s, lambda: self._was_silent(session))
        if session.pidfd >= 0:
            # A child that it forked may hold the socket open after its death.
            self._server.loop.watch(session.pidfd, lambda: self._end_session(session, ""))

    def _cannot_accept(self, error: OSError) -> None:
        """Tell a client that the daemon has no descriptor for it, by way of one that is kept for that."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
            with contextlib.suppress(OSError):
                sock, _ = self._listener.accept()
                why = f"{(error.strerror or '').lower()} in the daemon; raise LimitNOFILE of its service, or ulimit -n"
                self._refuse(sock, peer_of(sock, self.users), why)
        else:
            self._server.log("error", "session refused", why=error.strerror)
        with contextlib.suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        if self._spare < 0:  # the listener stays readable: no spinning
            self._server.loop.turns.remove(self._listener.fileno())
            self._server.loop.after(0.2, self.welcome)

    def _why_not(self, peer: Peer) -> str:
        """Return why a client is not taken, empty when it is."""
        own = [session for session in self.sessions if session.peer.uid == peer.uid]
        silent = sum(session.greeting is not None for session in own)
        may_stop = bool(self.rights.on_workcell(peer) & Right.STOP)
        return (
            self.quotas.over(peer, "silent", silent, "connections without a Hello")
            or self.quotas.over(peer, "sessions", len(own), "sessions")
            or why_full(len(self.sessions), len(own), self.bounds.max_sessions, may_stop)
        )

    def _refuse(self, sock: socket.socket, peer: Peer, why: str) -> None:
        """Tell one client too many why it is not taken."""
        self._server.log("warning", "session refused", peer=peer, why=why)
        with contextlib.suppress(OSError):
            sock.send(refusal(0, errno.EUSERS, f"connect: {why}"))
        sock.close()

    def _was_silent(self, session: Session) -> None:
        """End a connection on which nothing has been said: it takes the place of others."""
        if session in self.sessions:
            why = f"no Hello within {self.quotas.greeting_s:g} s of connecting (greeting_s of [quota])"
            self.send(session, refusal(0, errno.ETIMEDOUT, f"connect: {why}"))
            if session in self.sessions:
                self._end_session(session, why)

    def _has(self, peer: Peer, what: Callable[[Session], int]) -> int:
        """Return how much of something a user has over all his sessions."""
        return sum(what(session) for session in self.sessions if session.peer.uid == peer.uid)

    def may_represent(self, peer: Peer) -> bool:
        """Tell whether a user may speak for the holders of keys: a gateway's, who has no say beyond that, the daemon's
        own and root, who have every right themselves.
        """
        name = self.bounds.gateway_user
        return not peer.key and (peer.uid in (0, os.getuid()) or (name != "" and peer.uid == self.users.uid(name)))

    def number_of(self, key: str) -> int:
        """Return the number that a key has instead of a user's: beyond those of all users."""
        return self._keys.setdefault(key, FIRST_KEY + len(self._keys))

    def handles_of(self, peer: Peer) -> int:
        """Return how many handles a user has open."""
        return self._has(peer, lambda session: len(session.handles))

    def _changed(self) -> None:
        """What STATUS tells has changed."""
        self._status = None

    def _receive(self, session: Session) -> None:
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
            self._dispatch(session, *verbs.take(packet, verbs.FROM_CLIENT, pending=session.waits))
        except MalformedMessage as error:
            self._end_session(session, str(error))
        except Exception as error:  # our own mistake costs one session, not the workcell
            trace = "".join(traceback.format_exception(error)[-3:])
            self._server.log("error", "internal error", peer=session, trace=trace)
            if session in self.sessions:
                self._end_session(session, f"internal error: {error!r}")

    def _dispatch(self, session: Session, number: int, message: verbs.Message) -> None:
        if session.greeting is not None:
            session.greeting.cancel()
            session.greeting = None
        if not message.query:
            self._changed()
        if starting := self._server.starting:
            text = f"connect: the daemon is starting: {starting}; `sioms wait` waits until it is ready"
            self.send(session, refusal(number, errno.EAGAIN, text))
            return
        try:
            value = self._serve(session, number, message)
        except (Refused, MarkerError) as error:
            # Also then: who closes a handle that its driver has ended already shall see the axes halted.
            self.send(session, refusal(number, error.errno, str(error), _as_of_ns(message)))
            self._note(session, message, error.errno, str(error))
        else:
            if value is not LATER:
                self.send(session, reply(number, value, _as_of_ns(message)))
            if not message.query:
                self._note(session, message, 0, "")

    def _note(self, session: Session, message: verbs.Message, errno_: int, why: str) -> None:
        """Note a request, after its answer has been sent; keys of markers stay between the daemon and their owners."""
        values = [
            value & 1023 if field in ("token", "marker") else value
            for field, value in zip(message.fields, message, strict=True)
        ]
        self._server.shared.journal.note(
            Note.REQUEST, time.monotonic_ns(), str(session), type(message).__name__, values, errno_, why
        )

    def _serve(self, session: Session, number: int, message: verbs.Message) -> Any:
        if message.somewhere and not self.rights.anywhere(session.peer):
            what = f"{message.somewhere}: {session.peer.user}"
            raise Refused(errno.EPERM, f"{what} has no right on any node; ask for a [[grant]]")
        match message:
            case verbs.Represent():
                self._workcell.represent(session, message)
                turns, fd = self._server.loop.turns, session.sock.fileno()
                if turns.remove(fd):  # what comes from now on is served as the key's, in turn with that of users
                    turns.add(fd, session.peer.uid, 0, lambda: self._receive(session))
                return None
            case verbs.Hello():
                return self._workcell.hello(session, number, message)
            case verbs.Open():
                return self.nodes.open(session, number, message)
            case verbs.Close(handle):
                return self.nodes.close(session, number, handle)
            case verbs.List():
                return self.nodes.listing(session)
            case verbs.Info(node, right=right):
                return self._server.names.pack(self.nodes.find(session, "get information", node, right))
            case verbs.Journal(device):
                return self._workcell.journal(session, number, device)
            case verbs.Report():
                return self._workcell.report(session, message)
            case verbs.Status():
                return self._status_now()
            case verbs.ReserveMarker(how_many, persist):
                return self.markers.reserve(session, how_many, persist)
            case verbs.FreeMarker(token):
                return self.markers.free(token)
            case verbs.SignalMarker(token):
                return self.markers.signal(token)
            case verbs.WaitMarker(marker, timeout_s):
                return self.markers.wait(session, number, marker, timeout_s)
            case verbs.EmergencyStop():
                return self._workcell.emergency_stop(session, message)
            case verbs.Reset():
                return self._workcell.reset(session, message)
            case verbs.Supervise():
                return self._workcell.supervise(session, message)
            case verbs.Alarms():
                return self._workcell.alarms(session)
            case verbs.Acknowledge():
                return self._workcell.acknowledge(session, message)
            case verbs.TellAlarm():
                return self._workcell.tell_alarm(session, message)
            case verbs.Reload():
                return self._workcell.reload(session, number, message)
            case verbs.Cancel(waiting):
                return self._cancel(session, waiting)
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    def _status_now(self) -> dict[str, object]:
        """Return what STATUS tells: worked out anew when something has been asked for, else once in a while."""
        now_ns = time.monotonic_ns()
        if self._status is None or now_ns - self._status[0] > STATUS_NS:
            self._status = (now_ns, self._workcell.status())
        return self._status[1]

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
        self._changed()
        if session.greeting is not None:
            session.greeting.cancel()
        if why:
            self._server.log("warning", "session ended", peer=session, why=why)
        self._server.loop.turns.remove(session.sock.fileno())
        session.sock.close()
        self.supervision.end_session(session)  # first: it may stop the workcell
        for wait in list(session.waits.values()):
            self.drop(wait)
        self.markers.end_session(session)
        for handle in list(session.handles.values()):
            self.nodes.detach(handle)
        _cut(session)
        if session.pidfd >= 0:
            self._server.loop.unwatch(session.pidfd)
            os.close(session.pidfd)

    def take_up_rights(self, rights: Rights) -> None:
        """Let new names and grants hold, also for what is open already, and for who has left a group."""
        self.rights = rights
        for session in list(self.sessions):
            peer = peer_of(session.sock, self.users)
            if session.peer.key and not self.may_represent(peer):
                self._end_session(session, f"user {peer.user} is no gateway any more")
                continue
            session.peer = session.peer if session.peer.key else peer
            if not rights.anywhere(session.peer):
                self.markers.end_session(session)
            if not rights.on_workcell(session.peer) & Right.ADMINISTER:
                _cut(session)
        self.markers.take_up_rights()
        self.nodes.take_up_rights()

    # --- waiting requests ------------------------------------------------------------------------

    def wait(self, session: Session, number: int, timeout_s: float | None, what: str) -> Wait:
        """Keep a request to be answered later, or refused when its time is over [s; None = never]."""
        waiting = self._has(session.peer, lambda other: len(other.waits))
        if why := self.quotas.over(session.peer, "waits", waiting, "requests that wait"):
            raise Refused(errno.EAGAIN, f"{what}: {why}")
        wait = Wait(number, session, None, what)
        if timeout_s is not None:
            limit = min(max(float(timeout_s), 0.0), LONGEST_WAIT_S)
            wait.timer = self._server.loop.after(limit, lambda: self._timed_out(wait, limit))
        session.waits[number] = wait
        return wait

    def answer(self, wait: Wait, packet: bytes, fds: list[int] | None = None) -> None:
        """Answer a request that was kept, unless it has ended in another way."""
        self._changed()
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
        self.answer(wait, refusal(wait.number, errno.ETIMEDOUT, f"{wait.what}: not within {limit_s:g} s{why}"))

    def _cancel(self, session: Session, number: int) -> bool:
        wait = session.waits.get(number)
        if wait is None:
            return False
        self.answer(wait, refusal(wait.number, errno.ECANCELED, f"{wait.what}: cancelled"))
        return True


def _cut(session: Session) -> None:
    """Tell a session that it may read no journals any more."""
    if session.leash is not None:
        session.leash.cut()
        session.leash = None


def _as_of_ns(message: verbs.Message) -> int:
    """Return the instant at which a request had its effect on what readings show: now, or never."""
    return time.monotonic_ns() if message.shown else 0
