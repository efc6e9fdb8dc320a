"""Messages on the SOCK_SEQPACKET sockets: one msgpack array a packet.

Request  [verb, id, arguments...]        id > 0, unique among the sender's unanswered requests
Reply    [0, id, errno, value or text, zipped, as_of_ns]
                                         errno 0: value, when zipped its msgpack compressed by zlib;
                                         else text, one sentence without full stop
Notice   [verb, 0, arguments...]         draws no reply

``as_of_ns`` is the instant at which what was asked for had taken effect [ns, CLOCK_MONOTONIC]: a reader
that has the reply takes no snapshot of an earlier ``as_of_ns`` (see page.py). 0: nothing to wait for; the last
two may then be left out.

Packets are bounded by MAX_PACKET; a larger write sends the beginning of its records ahead, in notices
that carry its number. No client passes a descriptor to anybody: closing what a stranger opened may block.
Whoever receives something else ends that connection, and nothing else.

Everything that a process receives goes through ``decode``, which knows bounds of size, nesting and kinds of values
before it builds any; ``verbs`` adds what each verb takes.
"""

from __future__ import annotations

import sys

from . import wire
from .text import printable

TYPE_CHECKING = False
if TYPE_CHECKING:
    from enum import IntEnum
    from typing import Any
else:
    from .enumeration import IntEnum

MAX_PACKET = 65536
MAX_INLINE = 49152
"""Bytes of records that one packet carries."""
MAX_WRITE = 1 << 24
"""Bytes of records in one write at most."""
MAX_UNPACKED = 1 << 24
"""Bytes that a compressed value unpacks to at most."""
MAX_VALUES = 8192
"""Values in the arrays and maps of a request at most: more than a packet holds floating-point numbers."""
EMSGSIZE = 90
_SHORT, _SHORT_HEAD = 64, b"\x96\x00"
"""Bytes of a short reply at most, and how it begins: an array of six, the first of them 0."""

if "site" in sys.modules:
    from msgpack import Packer, unpackb

    _packers: list[Packer] = []
    """Those that nobody uses now: making one takes as long as packing with it."""

    def _pack(value: object) -> bytes:
        try:
            packer = _packers.pop()
        except IndexError:
            packer = Packer(use_bin_type=True)
        packed: bytes = packer.pack(value)
        if len(packed) <= MAX_PACKET:  # it keeps as much memory as it has needed
            _packers.append(packer)
        return packed

    def _unpack(data: bytes, most: int = MAX_UNPACKED) -> Any:
        wire.check(data, most)
        return unpackb(data, raw=False, use_list=True, strict_map_key=True, max_ext_len=0, ext_hook=_no_extension)

    def _no_extension(kind: int, data: bytes) -> None:
        raise ValueError(f"extension type {kind}; messages do not contain this type")

else:
    # A shell tool, started with -S to be quick (docs/decisions/0002-start-of-pipe-tools.md).
    _pack = wire.pack

    def _unpack(data: bytes, most: int = MAX_UNPACKED) -> Any:
        return wire.unpack(data)


class ClientVerb(IntEnum):
    """From a client to the daemon."""

    HELLO = 1
    OPEN = 2
    CLOSE = 3
    LIST = 4
    INFO = 5
    STATUS = 6
    REPRESENT = 7
    JOURNAL = 8
    REPORT = 9
    RESERVE_MARKER = 10
    FREE_MARKER = 11
    SIGNAL_MARKER = 12
    WAIT_MARKER = 13
    EMERGENCY_STOP = 20
    RESET = 21
    RELOAD = 22
    ALARMS = 23
    ACKNOWLEDGE = 24
    SUPERVISE = 25
    TELL_ALARM = 26
    SAID = 27
    CANCEL = 30


class HandleVerb(IntEnum):
    """From a client to a driver, on the socket of a handle."""

    WRITE = 1
    IOCTL = 2
    SUBSCRIBE = 3
    KEEPALIVE = 4
    CANCEL = 5
    PART = 6
    HEARD = 7
    PASSED = 8


class MalformedMessage(Exception):
    """A packet that is no message: too long, no msgpack, not the promised shape."""


def encode(*parts: object) -> bytes:
    """Pack a message."""
    return _pack(parts)


def decode(packet: bytes, most: int = MAX_PACKET, values: int = MAX_UNPACKED) -> list[Any]:
    """Unpack a message and check its head.

    Args:
        packet: as it was received.
        most: bytes that a packet may have here.
        values: values that its arrays and maps may hold.

    Returns:
        The list [verb, id, ...], both integers within range.

    Raises:
        MalformedMessage: anything else.
    """
    if len(packet) > most:
        raise MalformedMessage(f"packet longer than {most} bytes")
    try:
        message = _unpack(packet, values)
    except Exception as error:  # msgpack raises a wide family for bad input, all of them meaning just this
        raise MalformedMessage(
            f"decode packet of {len(packet)} bytes: {type(error).__name__}: {printable(str(error), 200)}"
        ) from None
    if not isinstance(message, list) or len(message) < 2:
        raise MalformedMessage("decode packet: not an array of verb, id and arguments")
    verb, number = message[0], message[1]
    if type(verb) is not int or type(number) is not int:
        raise MalformedMessage(
            f"decode packet: {type(verb).__name__} as verb, {type(number).__name__} as id; want integers"
        )
    if not (0 <= verb < 256 and 0 <= number < 1 << 53):
        raise MalformedMessage(f"decode packet: verb {verb}, id {number}; want integers from 0")
    return message


def decode_payload(data: bytes) -> Any:
    """Unpack what ``encode`` has packed, without judging its shape.

    Raises:
        MalformedMessage: it is no msgpack, or more than a message may be.
    """
    try:
        return _unpack(data)
    except Exception as error:
        raise MalformedMessage(f"decode payload: {type(error).__name__}: {printable(str(error), 200)}") from None


def decode_reply(packet: bytes, most: int = MAX_PACKET) -> list[Any]:
    """Unpack a reply and check its shape.

    Returns:
        The list [0, id, errno, value or text, zipped, as_of_ns], its texts fit to be shown.

    Raises:
        MalformedMessage: anything else.
    """
    message = decode(packet, most)
    if 4 <= len(message) <= 6 and message[0] == 0 and type(message[2]) is int and (message[1] or message[2]):
        message += (False, 0)[len(message) - 4 :]
        if message[2] and type(message[3]) is str:
            message[3] = printable(message[3])
        if type(message[4]) is bool and type(message[5]) is int and (not message[2] or type(message[3]) is str):
            return message
    raise MalformedMessage("decode reply: not an array of 0, id, errno and value or text; id 0 is for errors only")


def short_reply(packet: bytes, number: int) -> list[Any] | None:
    """Unpack a short reply to a request of a number that was done and says when; None for any other packet.

    A reply that this returns is one that ``decode_reply`` returns, and the same.
    """
    if len(packet) > _SHORT or packet[:2] != _SHORT_HEAD:
        return None
    try:
        message = _unpack(packet)
    except Exception:  # whatever it is, decode_reply says it
        return None
    if (
        len(message) == 6 and message[1] == number and type(message[1]) is type(message[2]) is type(message[5]) is int
        and not message[2] and message[4] is False
    ):  # fmt: skip
        whole: list[Any] = message
        return whole
    return None


def pack_compressed(value: object, level: int = -1) -> bytes:
    """Pack a value of many parts that are much alike: thousands of nodes or channels."""
    from zlib import compress

    return compress(_pack(value), level)


def unpack_compressed(data: object) -> Any:
    """Unpack what ``pack_compressed`` has packed.

    Raises:
        MalformedMessage: it is something else, or more than MAX_UNPACKED bytes.
    """
    from zlib import decompressobj

    try:
        zipped = decompressobj()
        plain = zipped.decompress(data, MAX_UNPACKED + 1)  # type: ignore[arg-type]
        if len(plain) > MAX_UNPACKED or not zipped.eof or zipped.unused_data:
            raise ValueError(f"not one whole stream of at most {MAX_UNPACKED} bytes")
        return _unpack(plain)
    except Exception as error:
        raise MalformedMessage(f"decompress answer: {type(error).__name__}: {printable(str(error), 200)}") from None


def reply(number: int, value: object = None, as_of_ns: int = 0) -> bytes:
    """Pack a successful reply; a long one is compressed, one that is still too long becomes a refusal."""
    packet = encode(0, number, 0, value, False, as_of_ns) if as_of_ns else encode(0, number, 0, value)
    if len(packet) <= MAX_PACKET:
        return packet
    packet = encode(0, number, 0, pack_compressed(value), True, as_of_ns)
    if len(packet) <= MAX_PACKET:
        return packet
    text = f"the answer takes {len(packet)} bytes; at most {MAX_PACKET} fit"
    return refusal(number, EMSGSIZE, text, as_of_ns)


def value_of(message: list[Any]) -> Any:
    """Return the value of a successful reply.

    Raises:
        MalformedMessage: it says that it is compressed, and is not.
    """
    return unpack_compressed(message[3]) if message[4] else message[3]


def refusal(number: int, errno_: int, text: str, as_of_ns: int = 0) -> bytes:
    """Pack a refusal with its errno and its sentence; number 0 tells why a connection ends."""
    text = printable(text)
    return encode(0, number, errno_, text, False, as_of_ns) if as_of_ns else encode(0, number, errno_, text)
