"""Quotas: how much of what all share one user may have, whatever he does over how many connections."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from .config import QuotaTable

if TYPE_CHECKING:
    from .rights import Peer

MORE = 4
"""How many times as much root and the daemon's own user may have."""
KEPT_SHARE = 16
"""One in so many sessions is kept for users who may stop and have next to none."""
FEW = 2
"""So many sessions of a user are next to none."""


class Quotas:
    """The quotas in force. Pure.

    Args:
        table: ``[quota]`` of the configuration.
        owner: number of the daemon's own user.
    """

    def __init__(self, table: QuotaTable, owner: int | None = None) -> None:
        self.greeting_s = table.greeting_s
        self._table = table
        self._owner = os.getuid() if owner is None else owner

    def most(self, uid: int, name: str) -> int:
        """Return how much a user may have of what the key ``name`` of ``[quota]`` bounds."""
        allowed: int = getattr(self._table, name)
        return allowed * MORE if uid in (0, self._owner) else allowed

    def over(self, peer: Peer, name: str, has: int, what: str, more: int = 1) -> str:
        """Return the sentence for a user who has too much of something for ``more`` of it, empty when he has not."""
        most = self.most(peer.uid, name)
        if has + more <= most:
            return ""
        allowed = "" if most == getattr(self._table, name) else f", {MORE} times as many for this user"
        return f"user {peer.user} has {has} {what}, and at most {most} are allowed ({name} of [quota]{allowed})"

    def of_device(self, uid: int) -> list[int]:
        """Return what a driver has to know of a user: how many requests may wait, and how many subscriptions."""
        return [self.most(uid, "waits"), self.most(uid, "subscriptions")]


def why_full(sessions: int, own: int, most: int, may_stop: bool) -> str:
    """Return why no more sessions are taken, empty when there is room.

    Args:
        sessions: of all users.
        own: of the user who asks.
        most: ``max_sessions``.
        may_stop: whether he may stop the workcell.
    """
    kept = 0 if may_stop and own < FEW else most // KEPT_SHARE
    if sessions < most - kept:
        return ""
    places = f", and {kept} places are reserved for users who may stop and have no session" if kept else ""
    return f"{sessions} sessions are open{places}; max_sessions of [workcell] allows {most}: close one, or allow more"
