"""Where the daemon listens when nobody says otherwise."""

import os

SYSTEM_PATH = "/run/sioms/siomsd.sock"
VARIABLE = "SIOMS_SOCKET"
CELL = "SIOMS_CELL"


def cell_address() -> str:
    """Return where a client finds its workcell: $SIOMS_CELL, the path of a socket or the address of a gateway
    (``zmq://HOST:PORT``, ``zenoh://HOST:PORT``), else ``socket_path``.
    """
    return os.environ.get(CELL) or socket_path()


def socket_path() -> str:
    """Return $SIOMS_SOCKET, else the system's socket if it is there, else one of the user's own.

    The user's own path is in $XDG_RUNTIME_DIR, or in /tmp under the user's number.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return named
    if os.path.exists(SYSTEM_PATH):
        return SYSTEM_PATH
    return own_path()


def own_path() -> str:
    """Return the path of a user's own socket, at which nobody else's daemon has any business."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/sioms-{os.getuid()}"
    return f"{runtime}/sioms/siomsd.sock"


def may_serve(uid: int, path: str) -> bool:
    """Tell whether a user's process can be the daemon at a path: root's, one's own, or that of its folder's owner.

    Anybody can make a socket in a folder like /tmp, take a stop there and say that all is well. The owner of a folder
    is no proof at one's own path, whose folder somebody else may have made first.
    """
    if uid in (0, os.getuid()):
        return True
    return path != own_path() and uid == os.stat(os.path.dirname(path) or ".").st_uid
