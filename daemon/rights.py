"""Who may do what: grants of the configuration against the credentials of the peer. Pure.

The owner of the daemon and root may do everything. Without any ``[[grant]]`` everybody who can
connect (the socket has an owner, a group and a mode) may read, write and stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from sioms.protocol.flags import Right

from .config import GrantTable

_RIGHT = {"read": Right.READ, "write": Right.WRITE, "stop": Right.STOP, "administer": Right.ADMINISTER}


@dataclass(frozen=True, slots=True)
class Peer:
    """Credentials of a connected process, as the kernel vouches for them."""

    pid: int
    uid: int
    user: str
    groups: frozenset[str]

    def __str__(self) -> str:
        return f"pid {self.pid} ({self.user})"


class Rights:
    """The grants of a workcell.

    Args:
        grants: of the configuration, empty for the default.
        owner_uid: who runs the daemon.
    """

    def __init__(self, grants: Sequence[GrantTable], owner_uid: int) -> None:
        self._grants = grants
        self._owner = owner_uid

    def on_node(self, peer: Peer, node: str) -> Right:
        """Return what the peer may do with a node."""
        if peer.uid in (0, self._owner):
            return Right.ALL
        if not self._grants:
            return Right.READ | Right.WRITE | Right.STOP
        rights = Right(0)
        for grant in self._grants:
            if self._concerns(grant, peer) and any(fnmatchcase(node, pattern) for pattern in grant.nodes):
                for name in grant.rights:
                    rights |= _RIGHT[name]
        return rights

    def on_workcell(self, peer: Peer) -> Right:
        """Return what the peer may do with the workcell: stop with any grant of stop, the rest with one for ``*``."""
        if peer.uid in (0, self._owner) or not self._grants:
            return self.on_node(peer, "*")
        rights = Right(0)
        for grant in self._grants:
            if self._concerns(grant, peer):
                for name in grant.rights:
                    if "*" in grant.nodes or name == "stop":
                        rights |= _RIGHT[name]
        return rights

    @staticmethod
    def _concerns(grant: GrantTable, peer: Peer) -> bool:
        return peer.user in grant.users or "*" in grant.users or not peer.groups.isdisjoint(grant.groups)
