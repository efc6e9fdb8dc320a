"""The way to a daemon or a gateway: a connected socket, and the channel on it.

``_socket`` instead of ``socket``: see ``channel``.
"""

from __future__ import annotations

import errno
import os
from _socket import AF_UNIX, SO_PEERCRED, SO_SNDTIMEO, SOCK_SEQPACKET, SOL_SOCKET, socket
from stat import S_ISSOCK
from struct import pack, unpack
from sys import modules

from sioms.protocol.socketpath import may_serve

from .channel import Channel
from .shown import clock_acknowledged

CONNECT_S = 2.0
"""How long a daemon may take to let a client in when many are waiting [s]; one that hangs lets nobody in."""
_FOREVER = pack("ll", 0, 0)


def connect(path: str, timeout_s: float = CONNECT_S) -> socket:
    """Connect to the daemon.

    Raises:
        OSError: nobody listens there, with a sentence that says how to start a daemon; ETIMEDOUT it lets nobody in.
    """
    sock = socket(AF_UNIX, SOCK_SEQPACKET)
    try:
        sock.setsockopt(SOL_SOCKET, SO_SNDTIMEO, pack("ll", int(timeout_s), int(timeout_s % 1 * 1e6)))
        sock.connect(path)
        sock.setsockopt(SOL_SOCKET, SO_SNDTIMEO, _FOREVER)
    except BlockingIOError:
        sock.close()
        raise OSError(
            errno.ETIMEDOUT,
            f"connect to {path}: its queue is full and the daemon accepts nobody; is its process hung?",
        ) from None
    except OSError as error:
        sock.close()
        number = error.errno or errno.ENAMETOOLONG  # Python itself refuses a path that no address holds
        hint = {
            errno.ENOENT: "no daemon listens there; start one with `siomsd --config FILE`, or name its socket in "
            "SIOMS_SOCKET",
            errno.ECONNREFUSED: "the daemon that made this socket has ended; start one with `siomsd --config FILE`",
            errno.EACCES: "no permission; ask to be put into the group of the socket",
            errno.ENAMETOOLONG: "the path of a socket has at most 107 bytes",
        }.get(number, os.strerror(number).lower())
        if number == errno.ECONNREFUSED and not _is_socket(path):
            hint = "that is not a socket; set SIOMS_SOCKET to the daemon's"
        raise OSError(number, f"connect to {path}: {hint}") from None
    uid = unpack("3i", sock.getsockopt(SOL_SOCKET, SO_PEERCRED, 12))[1]
    if not may_serve(uid, path):
        sock.close()
        raise OSError(
            errno.EPERM,
            f"connect to {path}: user {uid} listens there, who is neither you nor root nor the owner of the folder; a "
            "daemon for others has its socket in a folder of its own user, as /run/sioms",
        )
    return sock


def connect_channel(address: str, timeout_s: float = CONNECT_S, *, waits: bool = True) -> Channel:
    """Connect to the daemon at the path of its socket, or to a gateway, as ``zmq://HOST:PORT``.

    Args:
        address: of either.
        timeout_s: how long that may take [s].
        waits: whether threads of the program wait for answers, and not an event loop.

    Raises:
        OSError: with a sentence: nobody there, or one does not get in.
    """
    if "://" not in address:
        return Channel(connect(address, timeout_s), "the daemon")
    if "site" not in modules:  # a shell tool, started without it, needs packages now
        __import__("site").main()
    from .remote import connect as connect_remote

    sock, clock, carrier = connect_remote(address, timeout_s)
    return Channel(
        sock, f"the gateway {address}", acknowledged=clock_acknowledged(clock), clock=clock,
        carrier=carrier if waits else None,
    )  # fmt: skip


def _is_socket(path: str) -> bool:
    try:
        return S_ISSOCK(os.stat(path).st_mode)
    except OSError:
        return True  # it has just gone
