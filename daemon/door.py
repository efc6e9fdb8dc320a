"""The door of the daemon: takes up connections, refuses those that are too many, ends those that say nothing.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Callable

from sioms.descriptors import enable_timestamps
from sioms.protocol.flags import Right
from sioms.protocol.messages import refusal
from sioms.timestamps import pending_bytes

from .cell import Cell
from .clients import Clients
from .quotas import why_full
from .rights import Peer
from .sessions import Session


class Door:
    """Where clients come in.

    Args:
        cell: the workcell.
        clients: those who are there.
        listener: the listening SOCK_SEQPACKET socket.
        receive: takes what has come from a session.
    """

    def __init__(
        self, cell: Cell, clients: Clients, listener: socket.socket, receive: Callable[[Session], None]
    ) -> None:
        self._cell = cell
        self._clients = clients
        self._listener = listener
        self._receive = receive
        self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        listener.setblocking(False)

    def welcome(self) -> None:
        """Begin to accept clients; while the first configuration is loading they hear that, and nothing else."""
        self._cell.loop.turns.add(self._listener.fileno(), "door", 0, self._accept)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                self._cannot_accept(error)
            return
        sock.setblocking(False)
        peer = self._clients.peer_of(sock)
        if why := self._why_not(peer):
            self._refuse(sock, peer, why)
            return
        enable_timestamps(sock)
        loop, session = self._cell.loop, self._clients.begin(sock, peer)
        session.early_bytes = pending_bytes(sock)
        loop.turns.add(sock.fileno(), peer.uid, 0, lambda: self._receive(session))
        session.greeting = loop.after(self._cell.quotas.greeting_s, lambda: self._was_silent(session))
        if session.pidfd >= 0:
            # A child that it forked may hold the socket open after its death.
            loop.watch(session.pidfd, lambda: self._clients.end(session, ""))

    def _cannot_accept(self, error: OSError) -> None:
        """Tell a client that the daemon has no descriptor for it, by way of one that is kept for that."""
        if self._spare >= 0:
            os.close(self._spare)
            self._spare = -1
            with contextlib.suppress(OSError):
                sock, _ = self._listener.accept()
                why = f"{(error.strerror or '').lower()} in the daemon; raise LimitNOFILE of its service, or ulimit -n"
                self._refuse(sock, self._clients.peer_of(sock), why)
        else:
            self._cell.log("error", "session refused", why=error.strerror)
        with contextlib.suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        if self._spare < 0:  # the listener stays readable: no spinning
            self._cell.loop.turns.remove(self._listener.fileno())
            self._cell.loop.after(0.2, self.welcome)

    def _why_not(self, peer: Peer) -> str:
        """Return why a client is not taken, empty when it is."""
        sessions, quotas = self._clients.sessions, self._cell.quotas
        own = [session for session in sessions if session.peer.uid == peer.uid]
        silent = sum(session.greeting is not None for session in own)
        may_stop = bool(self._clients.rights.on_workcell(peer) & Right.STOP)
        return (
            quotas.over(peer, "silent", silent, "connections without a Hello")
            or quotas.over(peer, "sessions", len(own), "sessions")
            or why_full(len(sessions), len(own), self._cell.bounds.max_sessions, may_stop)
        )

    def _refuse(self, sock: socket.socket, peer: Peer, why: str) -> None:
        """Tell one client too many why it is not taken."""
        self._cell.log("warning", "session refused", peer=peer, why=why)
        with contextlib.suppress(OSError):
            sock.send(refusal(0, errno.EUSERS, f"connect: {why}"))
        sock.close()

    def _was_silent(self, session: Session) -> None:
        """End a connection on which nothing has been said: it takes the place of others."""
        if session in self._clients.sessions:
            why = f"no Hello within {self._cell.quotas.greeting_s:g} s of connecting (greeting_s of [quota])"
            self._clients.send(session, refusal(0, errno.ETIMEDOUT, f"connect: {why}"))
            if session in self._clients.sessions:
                self._clients.end(session, why)
