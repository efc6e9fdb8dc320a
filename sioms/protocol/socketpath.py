"""Where the daemon listens when nobody says otherwise."""

import os

SYSTEM_PATH = "/run/sioms/siomsd.sock"
VARIABLE = "SIOMS_SOCKET"


def socket_path() -> str:
    """Return $SIOMS_SOCKET, else the system's socket if it is there, else one of the user's own.

    The user's own path is in $XDG_RUNTIME_DIR, or in /tmp under the user's number.
    """
    named = os.environ.get(VARIABLE)
    if named:
        return named
    if os.path.exists(SYSTEM_PATH):
        return SYSTEM_PATH
    runtime = os.environ.get("XDG_RUNTIME_DIR") or f"/tmp/sioms-{os.getuid()}"
    return f"{runtime}/sioms/siomsd.sock"
