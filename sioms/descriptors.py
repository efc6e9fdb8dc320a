"""Descriptors that come over a socket, as what they are: ours, and of no program that we start."""

from __future__ import annotations

import socket
from array import array


def receive(sock: socket.socket, most_bytes: int, most_fds: int) -> tuple[bytes, list[int]]:
    """Receive a packet and its descriptors, which are closed on exec.

    ``socket.recv_fds`` leaves them open in every program that is started later, and has no way to be told otherwise.

    Raises:
        OSError: nothing could be received.
    """
    fds = array("i")
    space = socket.CMSG_LEN(most_fds * fds.itemsize)
    packet, ancillary, _, _ = sock.recvmsg(most_bytes, space, socket.MSG_CMSG_CLOEXEC)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
    return packet, list(fds)


def has_ended(sock: socket.socket) -> bool:
    """Tell whether the other end of a socket has gone, and nothing that it has sent is left to take."""
    try:
        return not sock.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True
