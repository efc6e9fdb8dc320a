"""Golden frames: messages out of the vendor's manual, and what a driver makes of them.

A driver names its own in the class method ``golden``; ``sioms driver check`` tries them. A request must be byte for
byte what the manual prints. A reply is fed whole, byte by byte, with trailing bytes, and once with each of its bits
flipped: a damaged reply may be refused or left incomplete, never raise anything else, and never decode to another
value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .exchange import DeviceError, Exchange, LinkError, Send


class Incomplete(Exception):
    """The bytes are not yet a reply."""


@dataclass(frozen=True, slots=True)
class Golden:
    """A message of the manual.

    Args:
        what: in words.
        made: what the driver makes: an exchange, a send, or bytes; None for what only the device says.
        request: what the manual prints for it, in hex; '' when it prints none.
        reply: what the device says, in hex; '' when there is none.
        value: what the reply means.
        read: makes the value out of bytes as they come; the exchange's own decoder unless given.
    """

    what: str
    made: Exchange | Send | bytes | None = None
    request: str = ""
    reply: str = ""
    value: Any = None
    read: Callable[[bytes], Any] | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a golden frame.

    Attributes:
        what, request, reply: of the frame.
        wrong: what is wrong, '' when nothing is.
        flips: single bits flipped in the reply.
        missed: of these, how many decoded to another value.
    """

    what: str
    request: str
    reply: str
    wrong: str
    flips: int
    missed: int


def try_golden(golden: Golden) -> Outcome:
    """Try a golden frame in all ways."""
    wrong, flips, missed = _request_wrong(golden), 0, 0
    if not wrong and golden.reply:
        data = bytes.fromhex(golden.reply)
        wrong = _reply_wrong(golden, data)
        if not wrong:
            flips = 8 * len(data)
            missed, wrong = _flipped(golden, data)
    return Outcome(golden.what, golden.request, golden.reply, wrong, flips, missed)


def _request_wrong(golden: Golden) -> str:
    if not golden.request:
        return ""
    made = golden.made if isinstance(golden.made, bytes) else getattr(golden.made, "data", b"")
    return "" if made == bytes.fromhex(golden.request) else f"the driver makes {made.hex(' ')}"


def _reply_wrong(golden: Golden, data: bytes) -> str:
    tries = {
        "whole": (data, len(data)),
        "byte by byte": (data, 1),
        "with trailing bytes": (data + b"\x55\xaa\x00", len(data) + 3),
    }
    for how, (fed, step) in tries.items():
        try:
            value = read_reply(golden, fed, step)
        except Exception as error:  # whatever a foreign decoder raises is what its author wants to know
            return f"the reply {how}: {type(error).__name__}: {error}"
        if value != golden.value:
            return f"the reply {how} means {value!r}; want {golden.value!r}"
    return ""


def _flipped(golden: Golden, data: bytes) -> tuple[int, str]:
    missed = 0
    for where in range(8 * len(data)):
        byte, bit = divmod(where, 8)
        damaged = data[:byte] + bytes((data[byte] ^ 1 << bit,)) + data[byte + 1 :]
        try:
            missed += read_reply(golden, damaged, len(damaged)) != golden.value
        except (LinkError, DeviceError, Incomplete):
            continue
        except Exception as error:
            return missed, f"the reply with bit {bit} of byte {byte} flipped: {error!r}; LinkError is right"
    return missed, ""


def read_reply(golden: Golden, data: bytes, step: int) -> Any:
    """Do what a line does: gather bytes until the reply is complete, cut it off, decode it."""
    if golden.read is not None:
        return golden.read(data)
    exchange = golden.made
    if not isinstance(exchange, Exchange):
        raise TypeError(f"{golden.what}: a reply wants an exchange that decodes it, or read")
    for end in range(step, len(data) + step, step):
        length = exchange.want(data[:end])
        if length is not None and min(end, len(data)) >= length:
            return exchange.decode(data[:length])
    raise Incomplete("the reply is not complete")
