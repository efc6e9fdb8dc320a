"""Marker requests of clients: reserve, free, signal, wait.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from sioms.protocol.markers import MARKERS
from sioms.protocol.messages import refusal, reply

from .cell import Cell
from .clients import Clients
from .marker_owners import MarkerError, MarkerOwners, Reservation
from .rights import Peer
from .sessions import LATER, Refused, Session, Wait


@dataclass(frozen=True, slots=True)
class Persisting:
    """Owner of markers that outlive their sessions: a user."""

    uid: int
    peer: Peer = field(compare=False)

    def __str__(self) -> str:
        return f"{self.peer.user} (markers that persist)"


def _uid_of(owner: object) -> int:
    return owner.peer.uid if isinstance(owner, Session) else owner.uid if isinstance(owner, Persisting) else -1


class MarkerVerbs:
    """Markers on behalf of clients.

    Args:
        cell: the workcell: its marker table, and the bounds.
        clients: who waits and is answered.
    """

    def __init__(self, cell: Cell, clients: Clients) -> None:
        self._cell = cell
        self._table = cell.shared.markers
        self._owners = MarkerOwners(self._table)
        self._clients = clients
        self._waits: list[tuple[Reservation, Wait]] = []

    def count(self, owner: object) -> int:
        """Return how many markers an owner has."""
        return len(self._owners.owned_by(owner))

    def reserve(self, session: Session, count: int, persist: bool) -> list[int]:
        """Reserve markers, all or none; return their tokens."""
        count, peer = int(count), session.peer
        if not 1 <= count < MARKERS:
            raise Refused(errno.EINVAL, f"reserve markers: {count} asked for; want 1 to {MARKERS - 1}")
        has = self._owners.count_where(lambda owner: _uid_of(owner) == peer.uid)
        if why := self._cell.quotas.over(peer, "markers", has, "markers", count):
            raise Refused(errno.EBUSY, f"reserve markers: {why}; free some")
        owner = Persisting(peer.uid, peer) if persist else session
        tokens: list[int] = []
        try:
            for _ in range(count):
                tokens.append(self._owners.reserve(owner))
        except MarkerError:
            for token in tokens:
                self._owners.free(self._owners.entitled(token, "free"))
            raise
        return tokens

    def free(self, token: int) -> None:
        """Free a marker; waits for it fail with EPIPE."""
        self._release(self._owners.entitled(int(token), "free"))

    def signal(self, token: int) -> None:
        """Signal a marker."""
        self._owners.signal(self._owners.entitled(int(token), "signal"), time.monotonic_ns())
        self.signalled()

    def wait(self, session: Session, number: int, token: int, timeout_s: float | None) -> Any:
        """Answer with the time of the signal, at once or when it comes."""
        reservation = self._owners.find(int(token), "wait for")
        if self._owners.is_signalled(reservation):
            return self._table.stamp_ns(reservation.number)
        wait = self._clients.wait(session, number, timeout_s, f"wait for marker {reservation.number}")
        self._waits.append((reservation, wait))
        wait.forget = partial(self._forget, wait)
        return LATER

    def signalled(self) -> None:
        """Answer the waits of markers that have been signalled, by clients or by drivers."""
        for reservation, wait in list(self._waits):
            if self._owners.is_signalled(reservation):
                stamp_ns = self._table.stamp_ns(reservation.number)
                self._clients.answer(wait, reply(wait.number, stamp_ns, time.monotonic_ns()))

    def end_session(self, session: Session) -> None:
        """Free what a session owns, and end its waits: it has ended, or lost its last right."""
        for reservation in self._owners.owned_by(session):
            self._release(reservation)
        gone = f"{session.peer.user} no longer has a right on any node"
        for _, wait in list(self._waits):
            if wait.session is session:
                self._clients.answer(wait, refusal(wait.number, errno.EPERM, f"{wait.what}: {gone}"))

    def take_up_rights(self) -> None:
        """Free the markers that persist for users who have lost their last right."""
        rights, users = self._clients.rights, self._clients.users
        for owner in {each for each in self._owners.owners() if isinstance(each, Persisting)}:
            gids = users.remaining(owner.uid, owner.peer.gids)
            if not rights.anywhere(replace(owner.peer, gids=gids)):
                for reservation in self._owners.owned_by(owner):
                    self._release(reservation)

    def _forget(self, wait: Wait) -> None:
        """Drop a wait that has ended."""
        self._waits = [entry for entry in self._waits if entry[1] is not wait]

    def _release(self, reservation: Reservation) -> None:
        self._owners.free(reservation)
        gone = f"wait for marker {reservation.number}: it was freed, or its owner has gone"
        for reserved, wait in list(self._waits):
            if reserved == reservation:
                self._clients.answer(wait, refusal(wait.number, errno.EPIPE, gone))
