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
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from enum import IntEnum
    from typing import Any
else:
    from .enumeration import IntEnum

if "site" in sys.modules:
    from msgpack import packb, unpackb

    def _pack(value: object) -> bytes:
        packed: bytes = packb(value, use_bin_type=True)
        return packed

    def _unpack(data: bytes) -> Any:
        return unpackb(data, raw=False, use_list=True, strict_map_key=True)

else:
    # A shell tool, started with -S to be quick (docs/decisions/0002-start-of-pipe-tools.md).
    from .wire import pack as _pack
    from .wire import unpack as _unpack

MAX_PACKET = 65536
MAX_INLINE = 49152
"""Bytes of records that one packet carries."""
MAX_WRITE = 1 << 24
"""Bytes of records in one write at most."""
MAX_TEXT = 1024
EMSGSIZE = 90


class ClientVerb(IntEnum):
    """From a client to the daemon."""

    HELLO = 1
    OPEN = 2
    CLOSE = 3
    LIST = 4
    INFO = 5
    STATUS = 6
    RESERVE_MARKER = 10
    FREE_MARKER = 11
    SIGNAL_MARKER = 12
    WAIT_MARKER = 13
    EMERGENCY_STOP = 20
    RESET = 21
    RELOAD = 22
    CANCEL = 30


class HandleVerb(IntEnum):
    """From a client to a driver, on the socket of a handle."""

    WRITE = 1
    IOCTL = 2
    SUBSCRIBE = 3
    KEEPALIVE = 4
    CANCEL = 5
    PART = 6
    """[number, records]: the beginning of the records of a write that is to follow; a notice."""


class DriverVerb(IntEnum):
    """Between the daemon and a driver, on its control socket (D: sent by the daemon)."""

    ATTACH = 1
    """D: [handle, block, channels, bit, access, exclusive, rights, lease_ns, who, node]; descriptors: socket,
    writing end of the wake pipe, pidfd if any."""
    DETACH = 2
    """D: [handle], its client has closed it; [handle, errno, reason]: end it, as if its socket had closed, and say why."""
    STOP_CHANGED = 3
    """D: [what]: the latch has changed, look at once."""
    SHUTDOWN = 4
    """D: stop, make outputs safe, exit."""
    INPUT = 5
    """D: [name, channels, bit]; descriptor: the page of a node that the driver reads."""
    NODE_STOP = 6
    """D: [block, channels, bit, source]: emergency stop of some channels, or of one bit of them (-1: all). NODE_RESET likewise."""
    NODE_RESET = 7
    READY = 20
    """[blocks]; descriptors: one page a block, writable until the daemon seals it."""
    DETACHED = 21
    """[handle]: its axes are being halted, the channels are free."""
    MARKER_SIGNALLED = 22
    """[number]."""
    STOPPED = 23
    """[source]: the driver has latched the emergency stop of the workcell."""
    LINK = 24
    """[state, reason]: PageState of the device behind the driver."""
    LOG = 25
    """[level, text]."""


class NurseryVerb(IntEnum):
    """Between the daemon and the nursery, the process that forks the drivers."""

    DESCRIBE = 1
    """[device, driver, table, folder] -> [errors, description], packed and compressed by zlib."""
    SPAWN = 2
    """[device, driver, table, generation, options] -> pid; descriptors: control socket, latch, request page,
    markers -> pidfd."""


class MalformedMessage(Exception):
    """A packet that is no message: too long, no msgpack, not the promised shape."""


def encode(*parts: object) -> bytes:
    """Pack a message."""
    return _pack(parts)


def decode(packet: bytes) -> list[object]:
    """Unpack a message and check its head.

    Returns:
        The list [verb, id, ...], both integers within range.

    Raises:
        MalformedMessage: anything else.
    """
    try:
        message = _unpack(packet)
    except Exception as error:  # msgpack raises a wide family for bad input, all of them meaning just this
        raise MalformedMessage(
            f"decode packet of {len(packet)} bytes: {type(error).__name__}: {error}"
        ) from None
    if not isinstance(message, list) or len(message) < 2:
        raise MalformedMessage("decode packet: not an array of verb, id and arguments")
    verb, number = message[0], message[1]
    if type(verb) is not int or type(number) is not int or not (0 <= verb < 256 and 0 <= number < 1 << 53):
        raise MalformedMessage(f"decode packet: verb {verb!r}, id {number!r}; want integers from 0")
    return message


def reply(number: int, value: object = None, as_of_ns: int = 0) -> bytes:
    """Pack a successful reply; a long one is compressed, one that is still too long becomes a refusal."""
    packet = encode(0, number, 0, value, False, as_of_ns) if as_of_ns else encode(0, number, 0, value)
    if len(packet) <= MAX_PACKET:
        return packet
    from zlib import compress  # thousands of nodes or channels, much alike

    packet = encode(0, number, 0, compress(_pack(value)), True, as_of_ns)
    if len(packet) <= MAX_PACKET:
        return packet
    text = f"the answer takes {len(packet)} bytes; at most {MAX_PACKET} fit"
    return refusal(number, EMSGSIZE, text, as_of_ns)


def value_of(message: list[Any]) -> Any:
    """Return the value of a successful reply.

    Raises:
        MalformedMessage: it says that it is compressed, and is not.
    """
    if len(message) < 5 or not message[4]:
        return message[3]
    from zlib import decompress

    try:
        return _unpack(decompress(message[3]))
    except Exception as error:
        raise MalformedMessage(f"decompress answer: {type(error).__name__}: {error}") from None


def refusal(number: int, errno_: int, text: str, as_of_ns: int = 0) -> bytes:
    """Pack a refusal with its errno and its sentence."""
    text = text[:MAX_TEXT]
    return encode(0, number, errno_, text, False, as_of_ns) if as_of_ns else encode(0, number, errno_, text)
