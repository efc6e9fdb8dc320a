"""Gets one small page of a device's web server, without I/O: HTTP/1.0, so that no reply is chunked. RFC 1945."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from sioms.sdk.exchange import Exchange, LinkError

MAX_PAGE = 65536
_STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})")
_LENGTH = re.compile(rb"\r?\ncontent-length:[ \t]*(\d{1,9})[ \t]*\r?\n", re.IGNORECASE)
_END_OF_HEAD = re.compile(rb"\r?\n\r?\n")


def get(host: str, path: str, parse: Callable[[str], Any], timeout_s: float) -> Exchange:
    """Return the exchange that gets a page.

    Args:
        host: of the server.
        path: of the page, from the slash on.
        parse: turns its text into the exchange's value; raises LinkError for another page.
        timeout_s: longest time for the whole reply [s].

    The reply ends where Content-Length says, or with the connection.
    """
    what = f"get http://{host}{path}"

    def want(reply: bytes) -> int | None:
        if len(reply) > MAX_PAGE:
            raise LinkError(f"{what}: the page is longer than {MAX_PAGE} bytes")
        head = _END_OF_HEAD.search(reply)
        length = _LENGTH.search(reply, 0, head.end()) if head else None
        return head.end() + int(length[1]) if head and length else None

    def decode(reply: bytes) -> Any:
        status, head = _STATUS.match(reply), _END_OF_HEAD.search(reply)
        if status is None or head is None:
            raise LinkError(f"{what}: {len(reply)} bytes that are not the reply of a web server")
        if status[1] != b"200":
            raise LinkError(f"{what}: the web server answers {status[1].decode()}; is it another device")
        size = want(reply)
        if size is not None and len(reply) < size:
            raise LinkError(f"{what}: the page is cut after {len(reply)} of {size} bytes")
        return parse(reply[head.end() : size].decode("utf-8", "replace"))

    request = f"GET {path} HTTP/1.0\r\nHost: {host}\r\n\r\n".encode("ascii", "replace")
    return Exchange(request, want, decode, timeout_s, True, what)
