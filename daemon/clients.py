"""The daemon's clients: their sessions, what they may, their requests that wait, and the way to answer them.

What they ask for is no matter of this module: requests.py and the verbs stand upon it.

Concurrency: everything runs in the daemon's loop. A session that takes no answers is ended with a line in the log, and
nothing else.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable

from sioms.protocol.flags import Right
from sioms.protocol.messages import refusal

from .cell import Cell
from .rights import Peer, Rights
from .sessions import Refused, Session, Wait, peer_of, pidfd_of
from .users import Users

FIRST_KEY = 1 << 32
"""Number of the first key that a gateway has spoken for."""
LONGEST_WAIT_S = 7 * 24 * 3600.0


class Clients:
    """All sessions of a daemon.

    Args:
        cell: the workcell.

    Attributes:
        rights: what users may, by the configuration in force.
        sessions: those that are there.
        changes: counts what is asked for, answered, and ended: what is worked out of that is good for one count.
        at_end: takes from a session that has just ended what it had: waits, markers, handles.
    """

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._keys: dict[str, int] = {}
        self.users = Users()
        self.rights = Rights([], os.getuid(), self.users)
        self.sessions: set[Session] = set()
        self.changes = 0
        self.at_end: Callable[[Session], None] = lambda session: None

    # --- sessions ----------------------------------------------------------------------------------

    def peer_of(self, sock: socket.socket) -> Peer:
        """Return who is at the other end of a connection, as the kernel says."""
        return peer_of(sock, self.users)

    def begin(self, sock: socket.socket, peer: Peer) -> Session:
        """Take a connection for a session."""
        session = Session(sock, peer, pidfd_of(sock, peer.pid))
        self.sessions.add(session)
        self.changes += 1
        return session

    def end(self, session: Session, why: str) -> None:
        """End a session, and all that it had; '' = its client has left."""
        self.sessions.discard(session)
        self.changes += 1
        if session.greeting is not None:
            session.greeting.cancel()
        if why:
            self._cell.log("warning", "session ended", peer=session, why=why)
        self._cell.loop.turns.remove(session.sock.fileno())
        session.sock.close()
        self.at_end(session)
        session.cut()
        if session.pidfd >= 0:
            self._cell.loop.unwatch(session.pidfd)
            os.close(session.pidfd)

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
                self.end(session, f"reply could not be sent: {error.strerror}")

    # --- who they are, and how much they have --------------------------------------------------------

    def may_represent(self, peer: Peer) -> bool:
        """Tell whether a user may speak for the holders of keys: a gateway's, who has no say beyond that, the daemon's
        own and root, who have every right themselves.
        """
        name = self._cell.bounds.gateway_user
        return not peer.key and (peer.uid in (0, os.getuid()) or (name != "" and peer.uid == self.users.uid(name)))

    def number_of(self, key: str) -> int:
        """Return the number that a key has instead of a user's: beyond those of all users."""
        return self._keys.setdefault(key, FIRST_KEY + len(self._keys))

    def handles_of(self, peer: Peer) -> int:
        """Return how many handles a user has open."""
        return self._has(peer, lambda session: len(session.handles))

    def _has(self, peer: Peer, what: Callable[[Session], int]) -> int:
        """Return how much of something a user has over all his sessions."""
        return sum(what(session) for session in self.sessions if session.peer.uid == peer.uid)

    def take_up_rights(self, rights: Rights) -> None:
        """Let new grants hold, and end the sessions of gateways that are none any more.

        Who has left a group has its rights no longer.
        """
        self.rights = rights
        for session in list(self.sessions):
            if session not in self.sessions:
                continue  # the end of another one has ended it
            peer = self.peer_of(session.sock)
            if session.peer.key and not self.may_represent(peer):
                self.end(session, f"user {peer.user} is no longer a gateway")
                continue
            session.peer = session.peer if session.peer.key else peer
            if not rights.on_workcell(session.peer) & Right.ADMINISTER:
                session.cut()

    # --- waiting requests ----------------------------------------------------------------------------

    def wait(self, session: Session, number: int, timeout_s: float | None, what: str) -> Wait:
        """Keep a request to be answered later, or refused when its time is over [s; None = never]."""
        waiting = self._has(session.peer, lambda other: len(other.waits))
        if why := self._cell.quotas.over(session.peer, "waits", waiting, "requests that wait"):
            raise Refused(errno.EAGAIN, f"{what}: {why}")
        wait = Wait(number, session, None, what)
        if timeout_s is not None:
            limit = min(max(float(timeout_s), 0.0), LONGEST_WAIT_S)
            wait.timer = self._cell.loop.after(limit, lambda: self._timed_out(wait, limit))
        session.waits[number] = wait
        return wait

    def answer(self, wait: Wait, packet: bytes, fds: list[int] | None = None) -> None:
        """Answer a request that was kept, unless it has ended in another way."""
        self.changes += 1
        if self.drop(wait):
            self.send(wait.session, packet, fds)

    def drop(self, wait: Wait) -> bool:
        """Forget a request that was kept; return whether it was still waiting."""
        if wait.timer is not None:
            wait.timer.cancel()
        wait.forget()
        return wait.session.waits.pop(wait.number, None) is not None

    def cancel(self, session: Session, number: int) -> bool:
        """Refuse a request that waits; return whether there is one of that number."""
        wait = session.waits.get(number)
        if wait is None:
            return False
        self.answer(wait, refusal(wait.number, errno.ECANCELED, f"{wait.what}: cancelled"))
        return True

    def _timed_out(self, wait: Wait, limit_s: float) -> None:
        why = f": {wait.why()}" if wait.why is not None else ""
        self.answer(wait, refusal(wait.number, errno.ETIMEDOUT, f"{wait.what}: not within {limit_s:g} s{why}"))
