"""Who may put something through a bridge whose protocol has no passwords: users of this machine, by the kernel's word.

What a client of PV Access says of itself, account and host, proves nothing. Of a connection within this machine the
kernel knows who has made it (sock_diag(7)); of one from another machine nobody does:
docs/decisions/0710
"""

from __future__ import annotations

import errno
import ipaddress
import os
import pwd
import socket
import struct
from collections.abc import Collection

_SOCK_DIAG_BY_FAMILY, _REQUEST, _NETLINK_SOCK_DIAG = 20, 1, 4
_HEADER, _ASKED, _ADDRESSES = struct.Struct("=IHHII"), struct.Struct("=BBBBI"), struct.Struct(">HH16s16sI8s")
_STATE, _OWNER = struct.Struct("=BB"), struct.Struct("=II")
_ESTABLISHED = 1
_PATIENCE_S = 1.0


def user_of(peer: tuple[str, int], here: tuple[str, int]) -> int | None:
    """Return the number of the user of this machine who has made a TCP connection and still has it open.

    Args:
        peer: address and port of its end.
        here: those of ours.

    Returns:
        None where the kernel of this machine knows no such end, or its owner has closed it.
    """
    family = socket.AF_INET6 if ":" in peer[0] else socket.AF_INET
    try:
        ends = [socket.inet_pton(family, address) for address, _ in (peer, here)]
        asked = _ASKED.pack(family, socket.IPPROTO_TCP, 0, 0, 0xFFFFFFFF)
        asked += _ADDRESSES.pack(peer[1], here[1], *ends, 0, b"\xff" * 8)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_DGRAM, _NETLINK_SOCK_DIAG) as kernel:
            kernel.settimeout(_PATIENCE_S)
            kernel.send(_HEADER.pack(_HEADER.size + len(asked), _SOCK_DIAG_BY_FAMILY, _REQUEST, 1, 0) + asked)
            answer = kernel.recv(4096)
    except (OSError, struct.error):
        return None
    if _HEADER.unpack_from(answer)[1] != _SOCK_DIAG_BY_FAMILY:
        return None
    _, state = _STATE.unpack_from(answer, _HEADER.size)
    uid, inode = _OWNER.unpack_from(answer, _HEADER.size + 4 + _ADDRESSES.size + 12)
    return int(uid) if state == _ESTABLISHED and inode else None  # of one that is closing it says 0, as of root


def place_of(text: str) -> tuple[str, int]:
    """Return address and port of ``ADDRESS:PORT``; raises ValueError.

    Example:
        >>> place_of("[::1]:5075"), place_of("[::ffff:10.0.0.1]:7")
        (('::1', 5075), ('10.0.0.1', 7))
    """
    address, _, port = text.rpartition(":")
    return address.strip("[]").removeprefix("::ffff:"), int(port)


class Putters:
    """Judges puts by who has made the connection.

    Args:
        users: names of those who may put, beside root and the user of this process.
        anybody_stops: whether a stop is taken from everybody, on other machines, too.

    Attributes:
        here: our address, ``*`` for any, and port.

    Raises:
        OSError: EINVAL, there is no such user.
    """

    def __init__(self, users: Collection[str] = (), *, anybody_stops: bool = False) -> None:
        self._uids = {0, os.geteuid(), *map(_uid, users)}
        self._anybody_stops = anybody_stops
        self.here = ("", 0)

    def judge(self, peer: str, *, stops: bool) -> None:
        """Refuse a put of somebody who may not.

        Args:
            peer: address and port of his end of the connection, as we see it.
            stops: whether all that it does is to stop.

        Raises:
            OSError: EACCES; who he is, and what would be right.
        """
        if stops and self._anybody_stops:
            return
        try:
            client = place_of(peer)
        except ValueError:
            client = (peer, 0)
        uid = user_of(client, (self._address(client[0]), self.here[1]))
        if uid in self._uids:
            return
        who = f"{peer} is not a connection of a user of this machine" if uid is None else _named(uid)
        more = "; --anybody-stops takes stops from all" if stops else ""
        raise OSError(
            errno.EACCES, f"{who}; want one of {', '.join(map(_named, sorted(self._uids)))} on this machine{more}"
        )

    def _address(self, client: str) -> str:
        """Return our address in a connection of a client; who calls his own machine does so from where he calls."""
        try:
            ipaddress.ip_address(self.here[0])
        except ValueError:
            return client
        return self.here[0]


def _uid(name: str) -> int:
    try:
        return pwd.getpwnam(name).pw_uid
    except KeyError:
        raise OSError(errno.EINVAL, f"allow {name} to put: no such user on this machine") from None


def _named(uid: int) -> str:
    try:
        return f"user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"user {uid}"
