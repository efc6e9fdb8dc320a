"""The verb table: every message of every socket, with its arguments, who may send it, in which state, and by which
right.

A class is a message, its fields are the arguments in the order of the wire, and an instance is one that is sent or has
been received. ``take`` decodes a packet of a peer and checks number and kinds of the arguments, the message number and
the state, so that a TypeError of whoever serves it is its own mistake and not the peer's. What a value means (a channel
that is none, a limit out of range) is judged, and refused, by who serves it. Messages between daemon, drivers and fork
server: ``driver_verbs``.

docs/protocol.md is generated from this table.
"""

from __future__ import annotations

from _operator import itemgetter

from .flags import Right
from .messages import MAX_PACKET, MAX_VALUES, ClientVerb, HandleVerb, MalformedMessage, decode, encode

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence
    from typing import Any, ClassVar, Self, TypeAlias, dataclass_transform

    Integer: TypeAlias = int
    Number: TypeAlias = float
    Seconds: TypeAlias = float | None
    Flag: TypeAlias = bool
    Name: TypeAlias = str
    Text: TypeAlias = str
    Records: TypeAlias = bytes
    Array: TypeAlias = Sequence[Any]
    Table: TypeAlias = dict[str, Any]
    Anything: TypeAlias = Any
else:

    def dataclass_transform(**_):
        return lambda cls: cls


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
SECONDS = Kind((float, int, type(None)), "seconds as a number, or nil for no limit")
FLAG = Kind((bool,), "true or false")
ANYTHING = Kind((), "anything")
KINDS = {
    "Integer": INTEGER,
    "Number": NUMBER,
    "Seconds": SECONDS,
    "Flag": FLAG,
    "Name": Kind((str,), "a name", 255),
    "Text": Kind((str,), "text"),
    "Records": Kind((bytes,), "bytes"),
    "Array": Kind((list,), "an array"),
    "Table": Kind((dict,), "a map"),
    "Anything": ANYTHING,
}
"""Kinds by the annotations of fields."""


class Socket(dict[int, "type[Message]"]):
    """The messages that one side of a socket may send, by verb.

    Attributes:
        sender, receiver: the two ends, in words.
        states: of the connection, as the receiver sees it, in the order in which they are gone through.
        decoders: of some verbs: they return the parts of a packet whose arguments are of their kinds, and None of any
            other; empty but in a process that has called ``compiled.add_decoders``.
    """

    def __init__(self, sender: str, receiver: str, states: tuple[str, ...]) -> None:
        super().__init__()
        self.decoders: dict[int, Callable[[bytes], Sequence[Any] | None]] = {}
        self.sender, self.receiver, self.states = sender, receiver, states


@dataclass_transform(frozen_default=True)
class Message(tuple):  # type: ignore[type-arg]
    """A message: the tuple of its arguments.

    Attributes:
        verb: its number on the wire.
        fields: names and kinds of its arguments.
        notice: it draws no reply, and its message number says nothing.
        states: in which the receiver takes it; elsewhere it is malformed.
        then: the state after it, unless that has been passed; '' = the same.
        right: any of these is asked for, on the node that it names, else on every node; 0: none is.
        somewhere: in words what is done, where a right on any node will do.
        shown: readings show its effect: who has the answer shall read nothing older.
        query: nothing changes by it.
    """

    verb: ClassVar[int]
    fields: ClassVar[dict[str, Kind]]
    notice: ClassVar[bool] = False
    states: ClassVar[tuple[str, ...]]
    then: ClassVar[str] = ""
    right: ClassVar[Right] = Right(0)
    somewhere: ClassVar[str] = ""
    shown: ClassVar[bool] = False
    query: ClassVar[bool] = False

    if not TYPE_CHECKING:

        def __new__(cls, *arguments):
            return tuple.__new__(cls, arguments)

    def __init_subclass__(cls, on: Socket, verb: int, **rules: Any) -> None:
        cls.verb = verb
        for name, value in {"states": on.states, **rules}.items():
            setattr(cls, name, value)
        names = cls.__dict__.get("__annotations__", {})  # noqa: RUF063  # as light as it is
        cls.fields = {name: KINDS[kind] for name, kind in names.items()}
        cls.__match_args__ = tuple(names)  # type: ignore[attr-defined, misc]
        for at, name in enumerate(names):
            setattr(cls, name, property(itemgetter(at)))
        on[int(verb)] = cls

    @classmethod
    def of(cls, arguments: Sequence[Any]) -> Self:
        """Make a message of arguments that have been checked."""
        return tuple.__new__(cls, arguments)

    def packed(self, number: int = 0) -> bytes:
        """Return the packet, with its message number."""
        return encode(self.verb, number, *self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}{tuple(self)!r}"


def take(
    packet: bytes,
    socket: Socket,
    most: int = MAX_PACKET,
    values: int = MAX_VALUES,
    *,
    pending: Container[int] = (),
    state: str = "",
) -> tuple[int, Message]:
    """Decode a message of a peer.

    Args:
        packet: as it was received.
        socket: what may come on that socket.
        most: bytes that a packet may have.
        values: values that its arrays and maps may hold.
        pending: numbers of requests that are not answered yet.
        state: of the connection; '' where every message is taken in every state.

    Returns:
        Message number, and the message: each argument is of its kind, and none that must be seconds or a number is NaN.

    Raises:
        MalformedMessage: anything else.
    """
    parts: Sequence[Any] | None = None
    if socket.decoders and 1 < len(packet) <= most and (decoder := socket.decoders.get(packet[1])):
        parts = decoder(packet)
    if parts is None:
        parts = _checked(decode(packet, most, values), socket)
    kind_of, number = socket[parts[0]], parts[1]
    if state and state not in kind_of.states:
        raise MalformedMessage(f"{kind_of.__name__} while {state}; want it while {' or '.join(kind_of.states)}")
    if not kind_of.notice and (number == 0 or number in pending):
        raise MalformedMessage(f"message number {number} is zero or in use")
    return number, kind_of.of(parts[2:])


def _checked(parts: list[Any], socket: Socket) -> list[Any]:
    """Return the parts of a message whose verb and arguments are those of a socket."""
    kind_of, arguments = socket.get(parts[0]), parts[2:]
    if kind_of is None:
        raise MalformedMessage(f"verb {parts[0]} does not exist")
    fields = kind_of.fields
    if len(arguments) != len(fields):
        raise MalformedMessage(f"verb {parts[0]} with {len(arguments)} arguments; want {len(fields)}")
    for value, kind in zip(arguments, fields.values(), strict=True):
        if type(value) not in kind.types and kind.types:
            raise MalformedMessage(f"verb {parts[0]} with {type(value).__name__} as an argument; want {kind.words}")
        if value != value and kind.types:
            raise MalformedMessage(f"verb {parts[0]} with NaN as an argument; want {kind.words}")
        if kind.most and len(value) > kind.most:
            raise MalformedMessage(
                f"verb {parts[0]} with {len(value)} characters; want {kind.words} of at most {kind.most}"
            )
    return parts


# --- from a client to the daemon -----------------------------------------------------------------

FROM_CLIENT = Socket("client", "daemon", ("starting", "serving"))
"""While the daemon is starting, every request is refused with EAGAIN."""


class Hello(Message, on=FROM_CLIENT, verb=ClientVerb.HELLO, query=True):
    """Introduce the client. Answer: [protocol version, workcell, rights]; descriptors of the stop-request file if it
    may stop.
    """

    version: Integer
    name: Text


class Represent(Message, on=FROM_CLIENT, verb=ClientVerb.REPRESENT, query=True):
    """Say on whose behalf this session is, once and before Hello: the holder of a key, on a host, in groups. From a
    gateway's user only. From then on the session has the rights and the quotas of the key, and no others.
    """

    key: Name
    host: Name
    groups: Array


class Open(Message, on=FROM_CLIENT, verb=ClientVerb.OPEN, right=Right.READ):
    """Open a node; for writing it needs the right to write, too.

    Answer: [handle, node, channels, bit, [process that made the socket, process behind it]]; descriptors of page, wake
    pipe and the handle's socket.
    """

    node: Name
    access: Integer
    timeout_s: Seconds
    lease_s: Number


class Close(Message, on=FROM_CLIENT, verb=ClientVerb.CLOSE, shown=True):
    """Close a handle; answered when its axes are being halted and its channels are free."""

    handle: Integer


class List(Message, on=FROM_CLIENT, verb=ClientVerb.LIST, query=True):
    """List the nodes that the user may read."""


class Info(Message, on=FROM_CLIENT, verb=ClientVerb.INFO, right=Right.READ, query=True):
    """Describe a node."""

    node: Name


class Status(Message, on=FROM_CLIENT, verb=ClientVerb.STATUS, query=True):
    """Return the state of devices, sessions, owners and stops."""


class Journal(Message, on=FROM_CLIENT, verb=ClientVerb.JOURNAL, query=True):
    """Open the journal of a device's driver processes, '' = of the daemon; takes the right to administer
    every node, because commands name the keys of markers.

    Answer: number of the driver's generation, 0 for the daemon; descriptors: the journal, to be read only, and a
    pipe that ends when the right to it does.
    """

    device: Name


class Report(Message, on=FROM_CLIENT, verb=ClientVerb.REPORT, somewhere="report"):
    """Write a line to the daemon's log; one of level "error" or "warning" stands in the status until a program of
    that name and user reports again, at most an hour.
    """

    level: Name
    text: Text


class ReserveMarker(Message, on=FROM_CLIENT, verb=ClientVerb.RESERVE_MARKER, somewhere="reserve markers"):
    """Reserve markers, all or none; they end with the session or persist. Answer: their tokens."""

    how_many: Integer
    persist: Flag


class FreeMarker(Message, on=FROM_CLIENT, verb=ClientVerb.FREE_MARKER, shown=True):
    """Free a marker; waits for it fail with EPIPE."""

    token: Integer


class SignalMarker(Message, on=FROM_CLIENT, verb=ClientVerb.SIGNAL_MARKER, somewhere="signal a marker", shown=True):
    """Signal a marker."""

    token: Integer


class WaitMarker(Message, on=FROM_CLIENT, verb=ClientVerb.WAIT_MARKER, somewhere="wait for a marker", shown=True):
    """Wait until a marker, by number or token, is signalled. Answer: the time of the signal [ns]."""

    marker: Integer
    timeout_s: Seconds


class EmergencyStop(
    Message, on=FROM_CLIENT, verb=ClientVerb.EMERGENCY_STOP, right=Right.STOP, shown=True
):  # fmt: skip
    """Stop a node, '' = the workcell, until it is reset. For the workcell, the right on any one node is sufficient.
    `or_all`: if there is no such node, the workcell is stopped, and the request is then refused. `word`: of the same
    request in the stop-request file, which this process has written; 0: it has written none.
    """

    node: Name
    why: Text
    or_all: Flag
    word: Integer


class Supervise(Message, on=FROM_CLIENT, verb=ClientVerb.SUPERVISE, right=Right.STOP):
    """Supervise the workcell for a while; the right on any one node is sufficient. Answer: how long a supervisor may be
    silent before the workcell is stopped [s], 0 = it asks for none.
    """

    lease_s: Number


class Reset(
    Message, on=FROM_CLIENT, verb=ClientVerb.RESET, right=Right.WRITE | Right.ADMINISTER, shown=True
):  # fmt: skip
    """Clear the stop of a node, '' = of the workcell, and faults. Refused (EAGAIN) if anybody else has stopped
    something of it since it was sent, or something has come into fault: nothing is cleared then.
    """

    node: Name


class Said(Message, on=FROM_CLIENT, verb=ClientVerb.SAID, notice=True, query=True):
    """The reset that follows was sent at this instant at the earliest [ns, CLOCK_MONOTONIC]: what was stopped since
    then stays stopped. A gateway says so, and nobody else: what it passes on may be old.
    """

    at_ns: Integer


class Reload(Message, on=FROM_CLIENT, verb=ClientVerb.RELOAD, right=Right.ADMINISTER):
    """Reload the configuration. Answer: all errors; if there are any, nothing has changed."""


class Alarms(Message, on=FROM_CLIENT, verb=ClientVerb.ALARMS, query=True):
    """List the alarms on the nodes that the user may read. Answer: a map each."""


class Acknowledge(
    Message, on=FROM_CLIENT, verb=ClientVerb.ACKNOWLEDGE, right=Right.WRITE | Right.ADMINISTER
):  # fmt: skip
    """Acknowledge the alarms of a node or a device, '' = all on which the user has the right. Answer: a map for each
    that has been acknowledged by this.
    """

    node: Name
    note: Text


class TellAlarm(
    Message, on=FROM_CLIENT, verb=ClientVerb.TELL_ALARM, right=Right.WRITE | Right.ADMINISTER
):  # fmt: skip
    """Tell how bad a condition is that a client watches on a node of one channel; severity 0: it is over. It stops
    nothing, and stands until a client says otherwise.
    """

    node: Name
    what: Name
    severity: Integer
    text: Text


class Cancel(Message, on=FROM_CLIENT, verb=ClientVerb.CANCEL):
    """Cancel a waiting request of this session. Answer: whether there was one."""

    number: Integer


# --- from a client to a driver, on the socket of a handle ----------------------------------------

ON_HANDLE = Socket("client", "driver", ("open",))


class Write(Message, on=ON_HANDLE, verb=HandleVerb.WRITE, right=Right.WRITE, shown=True):
    """Write records, all or none, beginning with those sent in parts; needs a handle that is open for writing. Answer:
    the tick.
    """

    flags: Integer
    timeout_s: Seconds
    records: Records


class Ioctl(Message, on=ON_HANDLE, verb=HandleVerb.IOCTL, shown=True):
    """Carry out a request of the table below."""

    request: Integer
    argument: Anything
    timeout_s: Seconds


class Subscribe(Message, on=ON_HANDLE, verb=HandleVerb.SUBSCRIBE, query=True):
    """Wake the client through its pipe at every n-th publication; -1: at edges only; 0: never."""

    every: Integer


class Keepalive(Message, on=ON_HANDLE, verb=HandleVerb.KEEPALIVE, notice=True, query=True):
    """Renew the lease, as every message does but where Heard tells more."""


class Heard(Message, on=ON_HANDLE, verb=HandleVerb.HEARD, notice=True, query=True):
    """Renew the lease from an instant on [ns, CLOCK_MONOTONIC]; from then on nothing else does. A gateway or a bridge
    says so: what it passes on may be old.
    """

    at_ns: Integer


class Passed(Message, on=ON_HANDLE, verb=HandleVerb.PASSED, notice=True, query=True):
    """A packet of a client, as this socket takes it, which said it at this instant at the earliest
    [ns, CLOCK_MONOTONIC]: as Heard, and then that packet.
    """

    at_ns: Integer
    packet: Records


class CancelOnHandle(Message, on=ON_HANDLE, verb=HandleVerb.CANCEL, query=True):
    """Cancel a waiting request of this handle. Answer: whether there was one."""

    number: Integer


class Part(Message, on=ON_HANDLE, verb=HandleVerb.PART, notice=True):
    """The first part of the records of the write with this message number, which follows."""

    write: Integer
    records: Records
