"""Addresses of gateways, ``zmq://HOST:PORT`` and ``zenoh://HOST:PORT``, and whether somebody listens there."""

from __future__ import annotations

import errno
import socket

from sioms.protocol.text import printable

SCHEMES = ("zmq", "zenoh")


def place_of(address: str) -> tuple[str, str, int]:
    """Return scheme, host and port of the address of a gateway.

    Raises:
        OSError: EINVAL, it is none.
    """
    scheme, _, place = address.partition("://")
    host, colon, port = place.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if scheme not in SCHEMES or not colon or not host or not port.isdecimal() or not 0 < int(port) < 65535:
        raise OSError(
            errno.EINVAL,
            f"connect to {printable(address)}: want zmq://HOST:PORT or zenoh://HOST:PORT, as zmq://lab2:5770, or the "
            "path of a socket",
        )
    return scheme, host, int(port)


def probe(what: str, host: str, port: int, timeout_s: float) -> str:
    """Return the address at which somebody listens; the libraries would go on trying without a word.

    Raises:
        OSError: nobody does, with a sentence that begins with ``what``.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        raise OSError(
            errno.EHOSTUNREACH, f"{what}: host {printable(host)} is not known ({error.strerror}); is it spelt right?"
        ) from None
    last = OSError(errno.EHOSTUNREACH, "no address")
    for family, kind, protocol, _, where in found:
        with socket.socket(family, kind, protocol) as sock:
            sock.settimeout(timeout_s)
            try:
                sock.connect(where)
            except OSError as error:
                last = error
                continue
            return f"[{where[0]}]" if family == socket.AF_INET6 else str(where[0])
    number = errno.ETIMEDOUT if isinstance(last, TimeoutError) else last.errno or errno.EIO
    hint = {
        errno.ECONNREFUSED: "nobody listens there; start `sioms serve` on that machine, or correct the port",
        errno.ETIMEDOUT: "no answer; is the machine on, and does its firewall let this port and the next one through?",
    }.get(number, (last.strerror or str(last)).lower())
    raise OSError(number, f"{what}: {hint}") from None
