"""What an open node is, without any waiting: reading out of shared memory, and requests as values.

Concurrency: that of the faces, ``node`` and ``sioms.aio``; the verbs of both are in ``node_verbs``.
"""

from __future__ import annotations

import errno
from time import monotonic_ns, sleep

from sioms.protocol import text
from sioms.protocol.flags import NodeClass, PageState, Request, WriteFlag
from sioms.protocol.messages import MAX_INLINE, MAX_WRITE
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.page import AS_OF, NotReadable, as_of_ns
from sioms.protocol.records import ANALOG_WRITE, BINARY_WRITE
from sioms.protocol.verbs import Ioctl, Write

from . import shown
from .arguments import integer, number, numbers
from .channel import Call, Channel
from .marks import Generic
from .snapshot import SNAPSHOT, BinarySnapshot, Layout

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from typing import Any, TypeAlias

    from typing_extensions import TypeVar

    from .snapshot import Snapshot
    from .transport import Readings

    Records: TypeAlias = bytes | bytearray | memoryview | Iterable[bytes]
    S = TypeVar("S", bound=Snapshot, default=Any)
else:
    S = None

UNREADABLE = {
    PageState.STALE: "its driver is gone or hung",
    PageState.STARTING: "its device is starting",
    PageState.LINK_LOST: "the link to its device is lost",
    PageState.CLOSED: "its driver has ended",
}
"""What is wrong with a page, by its state, where the name of that does not say it."""
_SHOWN = 8
"""Channels that the representation of a node names."""
_JUDGED_S = 0.1
"""What a driver may take to judge a packet of records, in pieces between its ticks [s]."""


class Event:
    """An edge on a binary node: the states before and after, and when.

    Attributes:
        initial, final: data when waiting began, and after the edge.
        stamp_ns: time of the edge as the device gave it [ns, CLOCK_MONOTONIC].
        number: snapshot that showed it; pass the event to the next wait and none is lost unnoticed.
        edges: count of the port's edges, this one included.
    """

    __slots__ = ("edges", "final", "initial", "number", "stamp_ns")

    def __init__(self, initial: int, final: int, stamp_ns: int, number: int, edges: int) -> None:
        self.initial = initial
        self.final = final
        self.stamp_ns = stamp_ns
        self.number = number
        self.edges = edges

    def __repr__(self) -> str:
        return f"Event(initial={self.initial:#x}, final={self.final:#x}, stamp_ns={self.stamp_ns})"


class EdgesLost(OSError):
    """EOVERFLOW: edges went by that nobody can tell any more: too many since the last look, or for the device.

    Attributes:
        lost: how many edges of the port.
        event: the last edge; pass it to the next wait to go on from there.
    """

    def __init__(self, text: str, lost: int, event: Event) -> None:
        super().__init__(errno.EOVERFLOW, text)
        self.lost = lost
        self.event = event


class Edges:
    """The edges of a binary node, one after the other, out of its page.

    The port's own count of edges tells whether one is missing between two snapshots.

    Args:
        node: of one binary channel.
        mask: bits to watch.
        last: the event or snapshot seen last; None: the present state.

    Raises:
        OSError: EINVAL, a node of another kind.
    """

    def __init__(self, node: NodeCore[BinarySnapshot], mask: int, last: Event | BinarySnapshot | None) -> None:
        if node.info.node_class is not NodeClass.BINARY or len(node.info.channels) != 1:
            raise OSError(errno.EINVAL, f"wait for an event on {node.name}: want a node of one binary channel")
        self._node = node
        self._mask = integer(f"wait for an event on {node.name}: mask", mask)
        if not (last is None or isinstance(last, Event | BinarySnapshot)):
            raise TypeError(
                f"wait for an event on {node.name}: last {text.shown(last)}; want an event or a snapshot of the node"
            )
        if isinstance(last, Event):
            self._state, self._number, self._edges = last.final, last.number, last.edges
        else:
            start: BinarySnapshot = last if last is not None else node.read()
            self._state, self._number, self._edges = start.data[0], start.number, start.edges[0]

    def look(self) -> Event | None:
        """Return the next edge of the watched bits, None while there is none.

        Raises:
            EdgesLost: the port had more edges than can be told.
        """
        newest: BinarySnapshot = self._node.read()
        if newest.edges[0] != self._edges:
            for snapshot in self._node.kept(self._number, newest.number):
                event = self._judge(snapshot)
                if event is not None:
                    return event
        self._number = max(self._number, newest.number)
        return None

    def _judge(self, snapshot: BinarySnapshot) -> Event | None:
        edges, final = snapshot.edges[0], snapshot.data[0]
        lost = edges - self._edges - 1
        if lost < 0:
            return None
        event = Event(self._state, final, snapshot.changed_ns[0], snapshot.number, edges)
        self._edges, self._number = edges, snapshot.number
        if lost:
            kept, name = self._node.slots, self._node.name
            text = (
                f"wait for an event on {name}: {lost} edges of its port came between two looks and cannot be told "
                f"any more; {kept} publications are kept: read more often, or give the device a longer history"
            )
            raise EdgesLost(text, lost, event)
        return event if (final ^ self._state) & self._mask else None


class NodeCore(Generic[S]):
    """What the blocking and the asyncio face of an open node share; no waiting in it.

    Attributes:
        info: what the node is (GET_IO_STRUCT_INFO).
        name: node name.
        owed_ns: what took effect before this instant must be in what is read next; it only grows.
        clock: of the cell, which both are in, where that is another machine's; None: it is ours.
    """

    def __init__(
        self, info: NodeInfo, handle: int, readings: Readings, channels: list[int], bit: int, channel: Channel
    ) -> None:
        self.info = info
        self.name = info.name
        self.handle = handle
        self._channel = channel
        self._page = readings
        self._event = readings.fileno()
        self.clock = channel.clock
        names = [channel.name for channel in info.channels]
        self._layout = Layout(info.node_class, self._page.channels, channels, bit, names, channel.clock)
        self._snapshot: Any = SNAPSHOT[info.node_class]
        self._latest = self._page.latest
        self._subscribed = 0
        self.owed_ns = self._shown_ns = 0
        device = self._page.device
        channel.acknowledged = lambda instant_ns: shown.acknowledged(device, instant_ns)

    def _owe(self) -> None:
        """Owe what has been acknowledged so far, and from now on, until it is released."""
        shown.join(self, self._page.device)

    @property
    def readings(self) -> Readings:
        """Where its snapshots come from, for who takes all of them."""
        return self._page

    @property
    def layout(self) -> Layout:
        """Where its channels lie in them."""
        return self._layout

    @property
    def closed(self) -> bool:
        """Whether it has been closed."""
        return self._page.closed

    def read(self) -> S:
        """Return the newest snapshot of all channels: a copy of memory, no system call.

        Everything that was acknowledged before, to this process and about this device, shows in it. Right after
        an acknowledgement that may take until the driver has published again: a tick, or the next poll.

        Raises:
            OSError: EIO, the device is starting, lost, hung or in fault, with the reason; never old
                data as new. EBADF, the node is closed.
        """
        try:
            raw = self._latest(monotonic_ns())
            if self.owed_ns > self._shown_ns:
                # As _is_paid does, in fewer steps: a loop that reads behind each write finds their code in no cache,
                # but that of structures, which it is about to ask for a column.
                (instant_ns,) = AS_OF(raw)
                if instant_ns >= self.owed_ns:
                    self._shown_ns = instant_ns
                else:
                    raw = self._wait_shown(raw)
        except (NotReadable, ValueError) as error:
            raise self._unreadable(error) from None
        if self._subscribed:
            self._page.drain()
        snapshot: S = self._snapshot(raw, self._layout)
        return snapshot

    def is_shown(self) -> bool:
        """Whether ``read`` need not wait: the newest snapshot shows all that has been acknowledged.

        Raises:
            OSError: as ``read``.
        """
        try:
            return self.owed_ns <= self._shown_ns or self._is_paid(self._latest(monotonic_ns()))
        except (NotReadable, ValueError) as error:
            raise self._unreadable(error) from None

    def _is_paid(self, raw: bytes) -> bool:
        """Whether a snapshot shows all that is owed; later ones do, too, and what is owed up to its instant."""
        instant_ns = as_of_ns(raw)
        if instant_ns < self.owed_ns:
            return False
        self._shown_ns = instant_ns
        return True

    def _wait_shown(self, raw: bytes) -> bytes:
        """Wait for the publication that shows what has been acknowledged; its end is that of a good page, too."""
        heard_ns = monotonic_ns()
        while not self._is_paid(raw):
            sleep(self.look_s)
            now_ns = monotonic_ns()
            if self._channel.keepalive_s and now_ns - heard_ns > self._channel.keepalive_s * 1e9:
                heard_ns = now_ns
                self.keepalive()
            raw = self._latest(now_ns)
        return raw

    @property
    def look_s(self) -> float:
        """How often to look for a publication that must come [s]: ten times a tick, within reason."""
        return min(max(0.1 / self.info.tick_hz, 50e-6), 1e-3)

    def history(self, after: int, *, gone: bool = False) -> list[S]:
        """Return the snapshots after a given number that the page still holds, oldest first.

        Args:
            after: number of the last snapshot seen; 0 for all.
            gone: also of a device that is lost, hung or gone, to look at what happened to it.
        """
        if not gone:
            self.read()
        return list(self.kept(after, self._page.head))

    def kept(self, after: int, last: int) -> Iterator[S]:
        """Yield the snapshots after a number, up to a last one, that the page still holds, as they are looked at."""
        page = self._page
        what = f"get the history of {self.name}"
        first = integer(what, after, "the number of a snapshot") + 1
        for at in range(max(first, page.head - page.slots + 2, 1), integer(what, last) + 1):
            raw = page.numbered(at)  # one by one: who is far behind pays for one edge at a time
            if raw is not None:
                yield self._snapshot(raw, self._layout)

    @property
    def slots(self) -> int:
        """How many snapshots the page keeps."""
        return self._page.slots

    def fileno(self) -> int:
        """Return a descriptor that is readable when there is new data, for selectors and asyncio.

        The node must be subscribed to, which the blocking face sees to. ``read`` makes the descriptor unreadable until
        the next publication.

        Raises:
            OSError: EINVAL, it is not subscribed to.
        """
        if not self._subscribed:
            raise OSError(errno.EINVAL, f"wait for new data of {self.name}: not subscribed; await subscribe(1)")
        return self._event

    def keepalive(self) -> None:
        """Tell the driver that this client is alive, for nodes opened with a lease; any request does, too."""
        self._channel.keepalive()

    def channel(self, which: int | str) -> int:
        """Return the index of a channel.

        Args:
            which: its index, or its name, e.g. ``"xaxis"``.

        Raises:
            OSError: EINVAL, the node has no such channel; the sentence lists those that it has.
        """
        names = [channel.name for channel in self.info.channels]
        if isinstance(which, str):
            if which in names:
                return names.index(which)
        elif (
            -len(names)
            <= (number := integer(f"choose channel of {self.name}", which, "its index or name"))
            < len(names)
        ):
            return number % len(names)
        raise OSError(
            errno.EINVAL,
            f"choose channel {which!r} of {self.name}: it has {', '.join(names)} (0 to {len(names) - 1})",
        )

    def index_of(self, axis: int | str) -> int:
        """Return the index of an axis that is named; one that is numbered is the driver's to judge."""
        if isinstance(axis, str):
            return self.channel(axis)
        return integer(f"choose axis of {self.name}", axis, "its index or name")

    def __repr__(self) -> str:
        what = f"<{type(self).__name__} {self.name}"
        if self.closed:
            return f"{what}, closed>"
        channels = ", ".join(f"{c.name} [{c.unit}]" if c.unit else c.name for c in self.info.channels[:_SHOWN])
        more = len(self.info.channels) - _SHOWN
        return f"{what}: {channels}{f' and {more} more' if more > 0 else ''}>"

    # --- requests as values ----------------------------------------------------------------------

    def _ioctl(self, request: Request, argument: object = None, timeout: float | None = 0.0) -> Call:
        if not isinstance(request, Request):
            raise TypeError(f"ioctl on {self.name}: {text.shown(request)} is not a request; want one of sioms.Request")
        what = f"{request.name} on {self.name}"
        return Call(what, Ioctl(int(request), argument, timeout), limit_s=timeout)

    def _write(self, records: Records, timeout: float | None, replace: bool) -> Call:
        data = records if isinstance(records, bytes) else _join(records, self.name)
        flags = WriteFlag.REPLACE if replace else WriteFlag.APPEND
        what = f"write {self.name}"
        if len(data) <= MAX_INLINE:
            return Call(what, Write(int(flags), timeout, data), limit_s=timeout)
        if len(data) > MAX_WRITE:
            raise OSError(errno.EMSGSIZE, f"{what}: {len(data)} bytes of records; at most {MAX_WRITE}")
        parts = [data[i : i + MAX_INLINE] for i in range(0, len(data), MAX_INLINE)]
        limit_s = None if timeout is None else number(what, timeout, "seconds") + _JUDGED_S * len(parts)
        ahead = tuple(parts[:-1])
        return Call(what, Write(int(flags), timeout, parts[-1]), ahead=ahead, limit_s=limit_s)

    def _outputs(self, values: Sequence[float]) -> bytes:
        count = len(self.info.channels)
        if len(values) != count:
            raise OSError(errno.EINVAL, f"write {self.name}: {len(values)} values; want {count}")
        if self.info.node_class is NodeClass.BINARY:
            what, words = f"write {self.name}", "an integer of at most 63 bits"
            data = [integer(what, value, words, flags=True) for value in values]
            if any(value >= 1 << 63 for value in data):
                raise ValueError(f"{what}: {data}; want {words}")
            return b"".join([BINARY_WRITE.pack(i, 0, value, 0) for i, value in enumerate(data)])
        return b"".join([ANALOG_WRITE.pack(i, 0, v) for i, v in enumerate(numbers(f"write {self.name}", values))])

    def _unreadable(self, error: Exception) -> OSError:
        if self.closed:
            return OSError(errno.EBADF, f"read {self.name}: it is closed")
        if isinstance(error, NotReadable):
            why = error.reason.removeprefix(f"{self.info.device}: ") or "no reason given"
            what = UNREADABLE.get(error.state, f"its device is in {error.state.name.lower().replace('_', ' ')}")
            return OSError(errno.EIO, f"read {self.name}: {what}: {why}")
        raise error

    def release(self) -> None:
        """Let go of memory and descriptors; the driver ends the handle at the end of file."""
        if not self.closed:
            shown.leave(self, self._page.device)
            self._channel.close()
            self._page.release()


def _join(records: Any, name: str) -> bytes:
    if hasattr(records, "tobytes"):
        return bytes(records.tobytes())
    try:
        return bytes(records) if isinstance(records, bytearray) else b"".join(records)
    except TypeError as error:
        raise TypeError(
            f"write {name}: {text.shown(records)}: {error}; want packed records, see sioms.command, or an array of them"
        ) from None
