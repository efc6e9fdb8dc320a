"""What each verb takes: the one place where the kinds of arguments of a message are checked.

``take`` decodes a packet of a peer, looks its verb up in the table of that socket, and checks number and kinds of its
arguments. Whoever serves a verb can rely on them, so that a TypeError in its code is its own mistake and not the peer's.
What a value means (a channel that is none, a limit out of range) is judged, and refused, by who serves it.
"""

from __future__ import annotations

from .messages import (
    MAX_PACKET,
    MAX_VALUES,
    ClientVerb,
    DriverVerb,
    HandleVerb,
    MalformedMessage,
    NurseryVerb,
    decode,
)

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any


class Kind:
    """A kind of argument.

    Attributes:
        types: what it may be, exactly.
        words: the same for messages.
        most: characters or bytes that it may have, 0 = as many as a packet holds.
    """

    __slots__ = ("most", "types", "words")

    def __init__(self, types: tuple[type, ...], words: str, most: int = 0) -> None:
        self.types, self.words, self.most = types, words, most


INTEGER = Kind((int,), "an integer")
NUMBER = Kind((float, int), "a number")
SECONDS = Kind((float, int, type(None)), "seconds as a number, or none for ever")
FLAG = Kind((bool,), "true or false")
NAME = Kind((str,), "a name", 255)
TEXT = Kind((str,), "text")
RECORDS = Kind((bytes,), "bytes")
LIST = Kind((list,), "an array")
TABLE = Kind((dict,), "a map")
ANYTHING = Kind((), "anything")

FROM_CLIENT: Mapping[int, tuple[Kind, ...]] = {
    ClientVerb.HELLO: (INTEGER, TEXT),
    ClientVerb.OPEN: (NAME, INTEGER, SECONDS, NUMBER),
    ClientVerb.CLOSE: (INTEGER,),
    ClientVerb.LIST: (),
    ClientVerb.INFO: (NAME,),
    ClientVerb.STATUS: (),
    ClientVerb.RESERVE_MARKER: (INTEGER, FLAG),
    ClientVerb.FREE_MARKER: (INTEGER,),
    ClientVerb.SIGNAL_MARKER: (INTEGER,),
    ClientVerb.WAIT_MARKER: (INTEGER, SECONDS),
    ClientVerb.EMERGENCY_STOP: (NAME, TEXT),
    ClientVerb.RESET: (NAME,),
    ClientVerb.RELOAD: (),
    ClientVerb.CANCEL: (INTEGER,),
}
ON_HANDLE: Mapping[int, tuple[Kind, ...]] = {
    HandleVerb.WRITE: (INTEGER, SECONDS, RECORDS),
    HandleVerb.IOCTL: (INTEGER, ANYTHING, SECONDS),
    HandleVerb.SUBSCRIBE: (INTEGER,),
    HandleVerb.KEEPALIVE: (),
    HandleVerb.CANCEL: (INTEGER,),
    HandleVerb.PART: (INTEGER, RECORDS),
}
TO_DRIVER: Mapping[int, tuple[Kind, ...]] = {
    DriverVerb.ATTACH: (
        INTEGER,
        INTEGER,
        LIST,
        INTEGER,
        INTEGER,
        FLAG,
        INTEGER,
        INTEGER,
        TEXT,
        INTEGER,
        LIST,
        TEXT,
    ),
    DriverVerb.DETACH: (INTEGER, INTEGER, TEXT),
    DriverVerb.STOP_CHANGED: (),
    DriverVerb.SHUTDOWN: (),
    DriverVerb.INPUT: (TEXT, LIST, INTEGER),
    DriverVerb.NODE_STOP: (INTEGER, LIST, INTEGER, TEXT, INTEGER),
    DriverVerb.NODE_RESET: (INTEGER, LIST, INTEGER, TEXT, INTEGER),
}
FROM_DRIVER: Mapping[int, tuple[Kind, ...]] = {
    DriverVerb.READY: (INTEGER,),
    DriverVerb.DETACHED: (INTEGER,),
    DriverVerb.MARKER_SIGNALLED: (INTEGER,),
    DriverVerb.STOPPED: (TEXT,),
    DriverVerb.LINK: (INTEGER, TEXT),
    DriverVerb.LOG: (TEXT, TEXT),
}
TO_NURSERY: Mapping[int, tuple[Kind, ...]] = {
    NurseryVerb.DESCRIBE: (TEXT, TEXT, TABLE, TEXT),
    NurseryVerb.SPAWN: (TEXT, TEXT, TABLE, INTEGER, TABLE),
}


def take(
    packet: bytes, verbs: Mapping[int, tuple[Kind, ...]], most: int = MAX_PACKET, values: int = MAX_VALUES
) -> tuple[int, int, list[Any]]:
    """Decode a request or notice of a peer.

    Args:
        packet: as it was received.
        verbs: the verbs of that socket.
        most: bytes that a packet may have.
        values: values that its arrays and maps may hold.

    Returns:
        Verb, message number, and as many arguments as the verb takes, each of its kind; none that must be seconds or a number is NaN.

    Raises:
        MalformedMessage: anything else.
    """
    message = decode(packet, most, values)
    kinds, arguments = verbs.get(message[0]), message[2:]
    if kinds is None:
        raise MalformedMessage(f"verb {message[0]} is none")
    if len(arguments) != len(kinds):
        raise MalformedMessage(f"verb {message[0]} with {len(arguments)} arguments; want {len(kinds)}")
    for value, kind in zip(arguments, kinds, strict=True):
        if type(value) not in kind.types and kind.types:
            raise MalformedMessage(
                f"verb {message[0]} with {type(value).__name__} as an argument; want {kind.words}"
            )
        if value != value and kind.types:
            raise MalformedMessage(f"verb {message[0]} with NaN as an argument; want {kind.words}")
        if kind.most and len(value) > kind.most:
            raise MalformedMessage(
                f"verb {message[0]} with {len(value)} characters; want {kind.words} of at most {kind.most}"
            )
    return message[0], message[1], arguments
