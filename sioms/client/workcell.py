"""The connection to a daemon: names, opens, markers, stops."""

from __future__ import annotations

import errno
import os
import sys
from _socket import socket
from time import monotonic, monotonic_ns, sleep

from sioms.protocol import verbs
from sioms.protocol.flags import PROTOCOL_VERSION, READONLY, Access, NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.socketpath import socket_path
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.text import printable, shown

from .arguments import number as as_number
from .channel import CONNECT_S, ENOUGH_LOOK_S, Answer, Call, Channel, connect
from .node import NODE, SYNCH_LEAD_S, AxisNode, Node
from .shown import acknowledged_by_daemon

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from typing import Any, Self, TypeVar, overload

    N = TypeVar("N", bound=Node)

STARTING_S = 5.0
"""How long a client waits for a daemon that says that it is starting [s]."""
_ACCESS = {"r": Access.READ, "w": Access.WRITE, "rw": Access.READ | Access.WRITE}


class NodeEntry:
    """A line of the node list.

    Attributes:
        name, node_class, channels, read_only, device: what and whose.
        state: state of the device: up, starting, restarting, fault ...
        holder: who has it open for output, '' when it is free.
    """

    __slots__ = ("bit", "channels", "device", "holder", "name", "node_class", "read_only", "state")

    def __init__(self, packed: list) -> None:  # type: ignore[type-arg]
        self.name, cls, self.channels, self.read_only, self.device, self.state, self.holder, self.bit = packed
        self.node_class = NodeClass(cls)

    def __repr__(self) -> str:
        held = f", held by {self.holder}" if self.holder else ""
        return f"<{self.node_class.name.lower()} node {self.name}: device {self.device} {self.state}{held}>"


def is_part(entry: NodeEntry, entries: Iterable[NodeEntry]) -> bool:
    """Tell whether a node is a companion, a channel or a bit of another one in the list."""
    if entry.name.endswith(READONLY):
        return True
    parent = entry.name.rpartition(".")[0]
    return any(
        other.name == parent and other.device == entry.device and other.node_class == entry.node_class
        and (other.channels > entry.channels or entry.bit >= 0)
        for other in entries
    )  # fmt: skip


class Marker:
    """A reserved marker.

    Attributes:
        token: number and key in one integer, below 2**50; needed to signal and to free.
        number: enough to wait.
    """

    __slots__ = ("_cell", "number", "token")

    def __init__(self, cell: Workcell, token: int) -> None:
        self._cell = cell
        self.token = token
        self.number = token & 1023

    def __int__(self) -> int:
        return self.token

    def signal(self) -> None:
        """Signal it; once is enough, more has no effect."""
        self._cell.signal_marker(self.token)

    def wait(self, timeout: float | None = None) -> int:
        """Wait until it is signalled; return when that was [ns, CLOCK_MONOTONIC]."""
        return self._cell.wait_marker(self.token, timeout)

    def free(self) -> None:
        """Free it; who waits for it gets EPIPE."""
        self._cell.free_marker(self.token)

    def __repr__(self) -> str:
        return f"<Marker {self.number}>"


def open_call(name: str, mode: str, timeout: float | None, lease: float) -> Call:
    """Make the request that opens a node."""
    access = _ACCESS.get(mode) if isinstance(mode, str) else None
    if access is None:
        raise OSError(errno.EINVAL, f"open {name}: mode {shown(mode)}; want 'r', 'w' or 'rw'")
    return Call(f"open {name}", verbs.Open(name, int(access), timeout, lease), limit_s=timeout)


def node_parts(value: Any, fds: list[int]) -> tuple[Any, ...]:
    """Turn the answer to an open into the arguments of a node."""
    handle, packed, channels, bit, behind = value
    info = NodeInfo(packed)
    return (
        info,
        handle,
        fds[:2],
        list(channels),
        bit,
        Channel(socket(fileno=fds[2]), f"node {info.name}", False, behind=behind),
    )


def request_stop(request: StopRequest | None, why: str) -> Callable[[], bool] | None:
    """Request a stop of the workcell past the daemon; return what tells whether it has been taken.

    Comes before the request to the daemon: what is written after it may be found after a reset, as a new stop.

    Args:
        request: the stop-request file; None: this client has no right to it, or does not want it.
        why: for the log.
    """
    if request is None:
        return None
    word = request.request(monotonic_ns(), os.getpid(), why)
    return lambda: request.taken(word)


class Workcell:
    """A session with the daemon. Use it in a ``with`` block, or close it; the end of the process does.

    Args:
        path: the daemon's socket; None for $SIOMS_SOCKET or the usual places.
        name: what this client calls itself in messages and lists.
        enough: tells of a daemon that does not answer at once whether the session is not needed any more.

    Raises:
        OSError: no daemon there, or of another protocol version.

    Concurrency: may be used by many threads.
    """

    def __init__(
        self, path: str | None = None, name: str | None = None, *, enough: Callable[[], bool] | None = None
    ) -> None:
        self._path = path or socket_path()
        self._channel = Channel(
            connect(self._path, CONNECT_S if enough is None else ENOUGH_LOOK_S), "the daemon"
        )
        title = os.path.basename(sys.argv[0]) if name is None and sys.argv and sys.argv[0] else name or ""
        answer = self._hello(Call("hello", verbs.Hello(PROTOCOL_VERSION, title), enough=enough))
        _, self.name, self.rights = answer.value
        self._request: StopRequest | None = None
        self._nodes: dict[int, Node] = {}
        if answer.fds:
            self._request = StopRequest(*answer.fds)

    def _hello(self, call: Call) -> Answer:
        """Say hello; to a daemon that is starting again and again, for a while."""
        deadline = monotonic() + STARTING_S
        while True:
            try:
                return self._channel.call(call)
            except OSError as error:
                if error.errno != errno.EAGAIN or monotonic() > deadline:
                    self._channel.close()
                    raise
            sleep(0.02)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        if self._channel.closed:
            return f"<Workcell {self.name}, closed>"
        nodes = ", ".join(sorted(node.name for node in self._nodes.values()))
        return f"<Workcell {self.name} at {self._path}: {nodes or 'no node'} open>"

    def close(self) -> None:
        """End the session: its nodes are closed and its markers freed."""
        nodes, self._nodes = self._nodes, {}
        for node in nodes.values():
            node.release()
        self._channel.close()
        if self._request is not None:
            self._request.close()
            self._request = None

    def fileno(self) -> int:
        """Return the descriptor of the session's socket; it becomes readable when the daemon goes."""
        return self._channel.fileno()

    # --- nodes -----------------------------------------------------------------------------------

    if TYPE_CHECKING:

        @overload
        def open(
            self,
            name: str,
            mode: str = "r",
            timeout: float | None = 0.0,
            *,
            lease: float = 0.0,
            kind: type[N],
        ) -> N: ...

        @overload
        def open(
            self, name: str, mode: str = "r", timeout: float | None = 0.0, *, lease: float = 0.0
        ) -> Any: ...

    def open(
        self,
        name: str,
        mode: str = "r",
        timeout: float | None = 0.0,
        *,
        lease: float = 0.0,
        kind: type[Node] | None = None,
    ) -> Any:
        """Open a node.

        Args:
            name: node name.
            mode: 'r', 'w' or 'rw'. A node that can be written is exclusive in whatever mode; its
                ``.readonly`` companion opens any number of times.
            timeout: how long to wait for it to be free [s]; 0: not; None: for ever. For a device that is
                just starting any open waits 1.5 s.
            lease: longest silence of this client [s] before its axes are halted, for programs that may
                hang; 0: none. Any request of the node renews it, ``keepalive`` does, and a call that
                waits on the node keeps renewing it.
            kind: AxisNode, AnalogNode or BinaryNode: what the node must be, for type checkers and against mistakes;
                None takes any.

        Returns:
            An AxisNode, AnalogNode or BinaryNode.

        Raises:
            OSError: ENOENT no such node; EBUSY held, by whom; EACCES no right; EIO device lost;
                ETIMEDOUT not free in time; EINVAL not of that kind.
        """
        if kind is not None and not (isinstance(kind, type) and issubclass(kind, Node)):
            raise TypeError(f"open {name}: kind {shown(kind)}; want AxisNode, AnalogNode or BinaryNode")
        answer = self._channel.call(open_call(name, mode, timeout, lease))
        core = node_parts(answer.value, answer.fds)
        node = NODE[core[0].node_class](core, self, lease)
        self._nodes[node.handle] = node
        if kind is not None and not isinstance(node, kind):
            node.close()
            raise OSError(
                errno.EINVAL, f"open {name}: it is an {type(node).__name__}; want an {kind.__name__}"
            )
        return node

    def close_handle(self, handle: int) -> None:
        """Tell the daemon that a node was closed, and wait until its channels are free (nodes call this)."""
        self._nodes.pop(handle, None)
        try:
            self._channel.call(Call("close", verbs.Close(handle)))
        except OSError as error:
            # The daemon has gone, or knows no such handle any more: the driver has halted the axes
            # at the end of file of the node's own socket either way.
            if error.errno not in (errno.EIO, errno.EBADF):
                raise

    def nodes(self) -> list[NodeEntry]:
        """Return all nodes that this user may read."""
        value = self._call("list nodes", verbs.List())
        return [NodeEntry(packed) for packed in value]

    def info(self, name: str) -> NodeInfo:
        """Return what a node is, without opening it."""
        return NodeInfo(self._call(f"get information of {name}", verbs.Info(name)))

    def status(self) -> dict[str, Any]:
        """Return devices, sessions, holders and the state of the emergency stop."""
        value: dict[str, Any] = self._call("get status", verbs.Status())
        return value

    def synch(self, *nodes: AxisNode, lead: float = SYNCH_LEAD_S) -> int:
        """Start the waiting commands of several nodes at the same instant.

        Args:
            nodes: open axis nodes, of any number of devices.
            lead: how far ahead the instant lies [s].

        Returns:
            The instant [ns, CLOCK_MONOTONIC].

        Raises:
            OSError: ETIME, a driver heard of it too late; the nodes that had started are stopped.
        """
        start_ns = monotonic_ns() + int(as_number("synch: lead", lead, "seconds") * 1e9)
        told: list[AxisNode] = []
        try:
            for node in nodes:
                node.synch(start_ns)
                told.append(node)
        except OSError:
            for node in told:
                node.stop()
            raise
        return start_ns

    # --- markers ---------------------------------------------------------------------------------

    def reserve_marker(self) -> Marker:
        """Reserve a marker; it is freed with the session."""
        return self.reserve_markers(1)[0]

    def reserve_markers(self, count: int, *, persist: bool = False) -> list[Marker]:
        """Reserve markers, all or none.

        Args:
            count: how many.
            persist: keep them beyond the end of the session.
        """
        tokens = self._call(f"reserve {count} markers", verbs.ReserveMarker(count, persist))
        return [Marker(self, token) for token in tokens]

    def free_marker(self, token: int) -> None:
        """Free a marker; needs its token."""
        self._call("free marker", verbs.FreeMarker(token))

    def signal_marker(self, token: int) -> None:
        """Signal a marker; needs its token."""
        self._call("signal marker", verbs.SignalMarker(token))

    def wait_marker(self, number: int, timeout: float | None = None) -> int:
        """Wait until a marker is signalled; return when that was [ns, CLOCK_MONOTONIC]."""
        return int(self._call("wait for marker", verbs.WaitMarker(number, timeout), limit_s=timeout))

    # --- stops -----------------------------------------------------------------------------------

    def emergency_stop(self, node: str = "", why: str = "") -> None:
        """Stop the whole workcell, or one node, and latch the stop until it is reset.

        Takes effect in every driver's next tick even while the daemon is busy or hung. This is a
        software stop, not a safety-rated function.

        Args:
            node: a node, '' for the whole workcell.
            why: for the log and for who asks why nothing moves.
        """
        call = Call("emergency stop", verbs.EmergencyStop(node, printable(str(why))))
        taken = call.enough = request_stop(None if node else self._request, printable(str(why)))
        try:
            self._channel.call(call)
        except OSError:
            if taken is None or not taken():
                raise  # else the drivers have latched it without the daemon
            acknowledged_by_daemon(monotonic_ns())

    def reset(self, node: str = "") -> None:
        """Clear the latched stop of the workcell or of a node. Nothing resumes by itself."""
        self._call("reset", verbs.Reset(node))

    def reload(self) -> None:
        """Let the daemon take up its configuration anew.

        Raises:
            OSError: EINVAL with all errors; nothing was taken up.
        """
        errors: list[str] = self._call("reload", verbs.Reload(), limit_s=60.0)
        if errors:
            raise OSError(errno.EINVAL, "reload: nothing taken up: " + "; ".join(errors))

    def _call(self, what: str, message: verbs.Message, limit_s: float | None = 0.0) -> Any:
        return self._channel.call(Call(what, message, limit_s=limit_s)).value
