"""sd_notify: tell the service manager that we are ready, alive, reloading or stopping."""

from __future__ import annotations

import os
import socket


class ServiceManager:
    """The datagram socket of systemd; does nothing when not started by it.

    Attributes:
        watchdog_ns: half the watchdog's time-out, 0 when there is none; feed that often.
    """

    def __init__(self, environ: dict[str, str] | os._Environ[str] = os.environ) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        usec = environ.get("WATCHDOG_USEC", "0")
        pid = environ.get("WATCHDOG_PID", "")
        wanted = usec.isdigit() and (not pid or pid == str(os.getpid()))
        self.watchdog_ns = int(usec) * 500 if wanted and self._address else 0

    def tell(self, state: str) -> None:
        """Send a state, e.g. ``READY=1``; a manager that has gone away is ignored."""
        if self._address:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
                sock.settimeout(0.0 if state == "WATCHDOG=1" else 0.1)  # a manager that is late must not stop us
                try:
                    sock.sendto(state.encode(), self._address)
                except OSError:
                    return
