"""Who may do what: grants of the configuration against the credentials of the peer. Pure.

The owner of the daemon and root may do everything. Without any ``[[grant]]`` everybody who can
connect (the socket has an owner, a group and a mode, a gateway its list of keys) may read, write and stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from sioms.protocol.flags import Right

from .config import GrantTable
from .users import Users

RIGHTS = {"read": Right.READ, "write": Right.WRITE, "stop": Right.STOP, "administer": Right.ADMINISTER}


def in_words(rights: Right, between: str) -> str:
    """Return rights by their names in a configuration.

    Example:
        >>> in_words(Right.READ | Right.STOP, " and ")
        'read and stop'
    """
    return between.join(name for name, right in RIGHTS.items() if right & rights)


@dataclass(frozen=True, slots=True)
class Peer:
    """Credentials of a connected process, as the kernel vouches for them; ``user`` is for messages.

    Attributes:
        key: of a session through a gateway, the name of the key that its client has proved to hold; its ``uid`` is then
            a number of that key alone, which no user of this machine has, and ``gids`` is empty.
        host: where that client is.
        groups: those of the key.
    """

    pid: int
    uid: int
    user: str
    gids: frozenset[int]
    key: str = ""
    host: str = ""
    groups: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return f"{self.key}@{self.host} through sioms serve" if self.key else f"pid {self.pid} ({self.user})"


@dataclass(frozen=True, slots=True)
class Grant:
    """A ``[[grant]]`` by numbers.

    Attributes:
        everybody: whether it is for all users.
        uids, gids: whom it is for.
        nodes: patterns of node names.
        rights: what it allows.
        keys, groups: which keys it is for, ``*`` for all, and the keys of which groups.
    """

    everybody: bool
    uids: frozenset[int]
    gids: frozenset[int]
    nodes: tuple[str, ...]
    rights: Right
    keys: frozenset[str] = frozenset()
    groups: frozenset[str] = frozenset()

    def concerns(self, peer: Peer) -> bool:
        """Tell whether it is for this peer; users and keys are told apart."""
        if peer.key:
            return not self.keys.isdisjoint(("*", peer.key)) or not self.groups.isdisjoint(peer.groups)
        return self.everybody or peer.uid in self.uids or not self.gids.isdisjoint(peer.gids)


@dataclass(frozen=True, slots=True)
class Entitled:
    """Who has a right, besides the daemon's owner and root.

    Attributes:
        everybody: all who can connect.
        uids, gids: users and groups, when it is not everybody.
    """

    everybody: bool
    uids: frozenset[int]
    gids: frozenset[int]


class Rights:
    """The grants of a workcell.

    Args:
        grants: of the configuration, empty for the default.
        owner_uid: who runs the daemon.
        users: turns names into numbers.

    Attributes:
        unknown: users and groups in the grants that this machine does not know; the grants hold for the others.
    """

    def __init__(self, grants: Sequence[GrantTable], owner_uid: int, users: Users) -> None:
        self.unknown: list[str] = []
        self._grants = [self._resolved(grant, users) for grant in grants]
        self._owner = owner_uid

    def _resolved(self, grant: GrantTable, users: Users) -> Grant:
        uids = {name: users.uid(name) for name in grant.users if name != "*"}
        gids = {name: users.gid(name) for name in grant.groups}
        self.unknown += [f"user {name}" for name, uid in uids.items() if uid is None]
        self.unknown += [f"group {name}" for name, gid in gids.items() if gid is None]
        rights = Right(0)
        for name in grant.rights:
            rights |= RIGHTS[name]
        return Grant(
            "*" in grant.users,
            frozenset(uid for uid in uids.values() if uid is not None),
            frozenset(gid for gid in gids.values() if gid is not None),
            tuple(grant.nodes),
            rights,
            frozenset(grant.keys),
            frozenset(grant.groups),
        )

    def on_node(self, peer: Peer, node: str) -> Right:
        """Return what the peer may do with a node."""
        if peer.uid in (0, self._owner):
            return Right.ALL
        if not self._grants:
            return Right.READ | Right.WRITE | Right.STOP
        rights = Right(0)
        for grant in self._grants:
            if grant.concerns(peer) and any(fnmatchcase(node, pattern) for pattern in grant.nodes):
                rights |= grant.rights
        return rights

    def on_workcell(self, peer: Peer) -> Right:
        """Return what the peer may do with the workcell: stop with any grant of stop, the rest with one for ``*``."""
        if peer.uid in (0, self._owner) or not self._grants:
            return self.on_node(peer, "*")
        rights = Right(0)
        for grant in self._grants:
            if grant.concerns(peer):
                rights |= grant.rights if "*" in grant.nodes else grant.rights & Right.STOP
        return rights

    def anywhere(self, peer: Peer) -> Right:
        """Return what the peer may do with at least one node."""
        if peer.uid in (0, self._owner) or not self._grants:
            return self.on_node(peer, "*")
        rights = Right(0)
        for grant in self._grants:
            if grant.concerns(peer):
                rights |= grant.rights
        return rights

    def who_may_stop(self) -> Entitled:
        """Return who may stop the workcell; see ``on_workcell``."""
        grants = [grant for grant in self._grants if grant.rights & Right.STOP]
        return Entitled(
            not self._grants or any(grant.everybody for grant in grants),
            frozenset(uid for grant in grants for uid in grant.uids),
            frozenset(gid for grant in grants for gid in grant.gids),
        )
