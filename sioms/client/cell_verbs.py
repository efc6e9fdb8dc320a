"""The verbs of a session with a daemon, the one list of which both faces are made (``faces``): names, opens, stops."""

from __future__ import annotations

import errno
import os
from time import monotonic, monotonic_ns

from sioms.protocol import verbs
from sioms.protocol.flags import PROTOCOL_VERSION, READONLY, Access, NodeClass, Request
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.text import printable, shown

from .arguments import checked
from .arguments import number as as_number
from .channel import Call, Channel
from .local import RENEWED_NS, node_parts
from .marks import verb
from .session import M, Session
from .shown import acknowledged_by_daemon

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import Any, ClassVar

    from sioms.protocol.clock import Clock

    from .node_verbs import AxisVerbs, NodeVerbs
    from .typed_faces import Waiter

STARTING_S = 5.0
"""How long a client waits for a daemon that says that it is starting [s]."""
SYNCH_LEAD_S = 0.01
"""How far ahead a synchronised start lies: long enough for every driver to hear of it."""
REMOTE_LEASE_S = 0.2
"""Lease of what can be written, on another machine, when none is asked for [s]."""
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


def open_call(name: str, mode: str, timeout: float | None, lease: float) -> Call:
    """Make the request that opens a node."""
    access = _ACCESS.get(mode) if isinstance(mode, str) else None
    if access is None:
        raise OSError(errno.EINVAL, f"open {name}: mode {shown(mode)}; want 'r', 'w' or 'rw'")
    return Call(f"open {name}", verbs.Open(name, int(access), timeout, lease), limit_s=timeout)


class Asked:
    """A stop of the workcell that is requested past the daemon; called, it tells whether it has been taken.

    Attributes:
        word: what stands for it in the stop-request file.
    """

    __slots__ = ("_mark", "_request", "word")

    def __init__(self, request: StopRequest, why: str) -> None:
        self._request = request
        self._mark = request.request(monotonic_ns(), os.getpid(), why)
        self.word = self._mark[0]

    def __call__(self) -> bool:
        return self._request.taken(self._mark)


def request_stop(request: StopRequest | None, why: str) -> Asked | None:
    """Request a stop of the workcell past the daemon.

    Comes before the request to the daemon: what is written after it may be found after a reset, as a new stop.

    Args:
        request: the stop-request file; None: this client has no right to it, or does not want it.
        why: for the log.
    """
    return None if request is None else Asked(request, why)


def stop_call(node: str, why: str, or_all: bool, asked: Asked | None) -> Call:
    """Return the request for a stop to the daemon, which is the same as one that has been made past it, if any has."""
    message = verbs.EmergencyStop(node, why, or_all, asked.word if asked else 0)
    return Call("emergency stop", message, enough=asked)


class WorkcellVerbs(Session[M]):
    """The verbs of a session with a daemon.

    Attributes:
        name: what the workcell is called; rights: of this client on all of it.
    """

    _NODE: ClassVar[type[NodeVerbs[Any]]]
    _NODES: ClassVar[Mapping[NodeClass, type[NodeVerbs[Any]]]]
    _nodes: dict[int, NodeVerbs[Any]]

    def _waiter_of(self, channel: Channel) -> Waiter:
        """Return what waits for the answers on the channel of a node."""
        raise NotImplementedError

    def __init__(self, channel: Channel, waiter: Waiter, path: str) -> None:
        super().__init__(channel, waiter)
        self._path = path
        self.name, self.rights = "", 0
        self._request: StopRequest | None = None
        self._fellows: list[Channel] = []
        self._beat_s = 0.0

    async def _greet(self, name: str, enough: Callable[[], bool] | None = None) -> None:
        """Say hello; to a daemon that is starting again and again, for a while."""
        call = Call("hello", verbs.Hello(PROTOCOL_VERSION, name), enough=enough)
        deadline = monotonic() + STARTING_S
        while True:
            try:
                answer = await self._waiter.call(call)
            except OSError as error:
                if error.errno != errno.EAGAIN or monotonic() > deadline:
                    self._waiter.close()
                    raise
            else:
                _, self.name, self.rights = answer.value
                self._request = StopRequest(*answer.fds.take()) if answer.fds else None
                return
            await self._waiter.pause(0.02)

    def __repr__(self) -> str:
        if self._channel.closed:
            return f"<{type(self).__name__} {self.name}, closed>"
        nodes = ", ".join(sorted(node.name for node in self._nodes.values()))
        return f"<{type(self).__name__} {self.name} at {self._path}: {nodes or 'no node'} open>"

    @verb
    async def close(self) -> None:
        """End the session: its nodes are closed and its markers freed."""
        nodes, self._nodes = self._nodes, {}
        for node in nodes.values():
            node.release()
        self._waiter.close()
        if self._request is not None:
            self._request.close()
            self._request = None

    def fileno(self) -> int:
        """Return the descriptor of the session's socket; it becomes readable when the daemon goes."""
        return self._channel.fileno()

    async def _open(self, name: str, mode: str, timeout: float | None, lease: float, kind: type | None) -> Any:
        """Open a node.

        Args:
            name: node name.
            mode: 'r', 'w' or 'rw'. A node that can be written is exclusive in whatever mode; its
                ``.readonly`` companion opens any number of times.
            timeout: how long to wait for it to be free [s]; 0: not; None: for ever. For a device that is
                just starting any open waits 1.5 s.
            lease: longest silence of this client [s] before its axes are halted, for programs that may
                hang; 0: none. Any request of the node renews it, ``keepalive`` does, and a call that
                waits on the node keeps renewing it. On another machine whatever can be written has one, 0.2 s unless
                another is asked for, at most 10 s, and every call or read of the session renews it.
            kind: the class of the node, as AxisNode, AnalogNode or BinaryNode: what the node must be, for type checkers
                and against mistakes; None takes any.

        Returns:
            A node of its class and of this face.

        Raises:
            OSError: ENOENT no such node; EBUSY held, by whom; EACCES no right; EIO device lost;
                ETIMEDOUT not free in time; EINVAL not of that kind.
        """
        if kind is not None and not (isinstance(kind, type) and issubclass(kind, self._NODE)):
            raise TypeError(f"open {name}: kind {shown(kind)}; want AxisNode, AnalogNode or BinaryNode")
        answer = await self._waiter.call(open_call(name, mode, timeout, lease))
        core = node_parts(answer.value, answer.fds, self._channel.clock, self._channel.carrier)
        if self._channel.clock is not None:
            lease = 0.0 if core[0].read_only else lease or REMOTE_LEASE_S
        node = self._NODES[core[0].node_class](core, self, self._waiter_of(core[-1]), lease)
        if kind is not None and not isinstance(node, kind):
            node.release()
            await self._closed_handle(node.handle)
            raise OSError(errno.EINVAL, f"open {name}: it is an {type(node).__name__}; want an {kind.__name__}")
        handle, server = node.handle, core[-1].server
        try:
            node._owe()
            if self._channel.clock is not None:
                self._live_together(node, lease)
        except BaseException:  # of a signal: nobody will ever close it
            node.release()
            raise
        # From here on the session keeps it: no call comes behind that, and so no signal that would leave it unknown.
        self._drivers[handle] = server
        self._nodes[handle] = node
        return node

    def _live_together(self, node: NodeVerbs[Any], lease: float) -> None:
        """Renew the leases of a session's nodes on another machine by every call of it, whichever that is about."""
        self._fellows[:] = [each for each in self._fellows if not each.closed]
        if not self._fellows:
            self._beat_s = 0.0
        if lease:
            self._fellows.append(node._channel)
            self._beat_s = min(self._beat_s or lease, lease / 3)
        nodes = [*self._nodes.values(), node]
        for channel in (self._channel, *[each._channel for each in nodes]):
            channel.fellows, channel.keepalive_s = self._fellows, self._beat_s
        for each in nodes:
            each._page.every_ns = min(int(self._beat_s * 1e9) or RENEWED_NS, RENEWED_NS)  # type: ignore[attr-defined]

    @verb
    async def nodes(self) -> list[NodeEntry]:
        """Return all nodes that this user may read."""
        value = await self._ask("list nodes", verbs.List())
        return [NodeEntry(packed) for packed in value]

    @verb
    async def info(self, name: str) -> NodeInfo:
        """Return what a node is, without opening it."""
        return NodeInfo(await self._ask(f"get information of {name}", verbs.Info(name)))

    @property
    def address(self) -> str:
        """Where it is reached: the path of a socket, or ``zmq://HOST:PORT`` of a gateway."""
        return self._path

    @property
    def clock(self) -> Clock:
        """The clock of the cell's machine beside that of this one, and beside UTC."""
        if self._channel.clock is not None:
            return self._channel.clock
        from sioms.protocol.clock import Clock

        from .wall import wall

        clock = Clock()
        clock.wall = wall()
        return clock

    @verb
    async def status(self) -> dict[str, Any]:
        """Return devices, sessions, holders and the state of the emergency stop."""
        value: dict[str, Any] = await self._ask("get status", verbs.Status())
        if value["stopped_ns"]:
            value["stopped_ns"] = self._here(value["stopped_ns"])
        return value

    @verb
    async def journal(self, device: str = "") -> tuple[int, int]:
        """Open the journal of a device's driver, '' = of the daemon, for ``JournalReader``.

        Returns:
            Two descriptors, to be closed by the caller: one to be mapped for reading, and one that becomes readable
            when the right to it has ended, or the session. On another machine the former is a copy, which goes on until
            then.

        Raises:
            OSError: EPERM, without the right to administer every node; ENOENT, no such device; EMFILE.
        """
        answer = await self._waiter.call(Call(f"open the journal of {device or 'the daemon'}", verbs.Journal(device)))
        if len(answer.fds) < 2:  # the kernel drops what goes beyond the limit of open descriptors
            raise OSError(errno.EMFILE, f"open the journal of {device or 'the daemon'}: too many open descriptors")
        first, second = answer.fds.take()
        return first, second

    @verb
    async def report(self, level: str, text: str) -> None:
        """Write a line to the daemon's log.

        Args:
            level: "info", "warning" or "error"; the last two stand in the status, too.
            text: a sentence.
        """
        await self._ask("report", verbs.Report(level, printable(text)))

    @verb
    async def synch(self, *nodes: AxisVerbs, lead: float = SYNCH_LEAD_S) -> int:
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
        told: list[AxisVerbs] = []
        try:
            for node in nodes:
                await node._ask(Request.SEND_EXTERNAL_SYNCH, node._there(start_ns))
                told.append(node)
        except OSError:
            for node in told:
                await node._ask(Request.STOP)
            raise
        return start_ns

    # --- stops -----------------------------------------------------------------------------------

    @verb
    async def emergency_stop_workcell(self, why: str = "") -> None:
        """Stop the whole workcell, and latch the stop until it is reset.

        Takes effect in every driver's next tick even while the daemon is busy or hung. This is a
        software stop, not a safety-rated function. ``AxisNode.stop`` is a controlled stop of one node that is not
        latched, ``AxisNode.emergency_stop`` that of one node which is.

        Args:
            why: for the log and for who asks why nothing moves.
        """
        await self._stop("", why)

    @verb
    async def emergency_stop(self, node: str = "", why: str = "", *, or_all: bool = True) -> None:
        """Stop one node by its name, open or not, and latch the stop until it is reset; '' = the whole workcell.

        Args:
            node: a node, '' as ``emergency_stop_workcell``.
            why: for the log and for who asks why nothing moves.
            or_all: stop the whole workcell when there is no such node: whoever stops by a wrong name, or gives the
                reason as the name, wants less motion, not more.

        Raises:
            OSError: ENOENT there is no such node; the sentence says whether all has been stopped.
        """
        await self._stop(node, why, or_all)

    async def _stop(self, node: str, why: str, or_all: bool = False) -> None:
        why = printable(str(why))
        checked("emergency stop", verbs.EmergencyStop(node, why, or_all, 0))  # a name that is none stops nothing
        taken = request_stop(None if node else self._request, why)
        try:
            await self._waiter.call(stop_call(node, why, or_all, taken))
        except OSError:
            if taken is None or not taken():
                raise  # else the drivers have latched it without the daemon
            acknowledged_by_daemon(monotonic_ns())

    @verb
    async def reset(self, node: str = "") -> None:
        """Clear the latched stop of the workcell or of a node, and faults. Nothing resumes by itself.

        Args:
            node: a node, '' = the workcell, with all its nodes.

        Raises:
            OSError: EAGAIN somebody else has stopped something since this was sent, or something has come into fault:
                nothing has been cleared; look, and reset again.
        """
        await self._ask("reset", verbs.Reset(node))

    @verb
    async def supervise(self, lease: float) -> float:
        """Supervise the workcell for a while: where its configuration asks for a supervisor, it is stopped when the
        last one ends its session, or is silent for longer than the lease.

        Args:
            lease: until when that holds at most [s]; call again before, a few times in each lease.

        Returns:
            How long a supervisor may be silent there [s]; 0 = the workcell asks for none.
        """
        return float(await self._ask("supervise", verbs.Supervise(as_number("supervise: lease", lease, "seconds"))))

    # --- alarms ----------------------------------------------------------------------------------

    @verb
    async def alarms(self) -> list[dict[str, Any]]:
        """Return the alarms that are active, or that nobody has acknowledged yet, on nodes that this user may read.

        Returns:
            A map each: ``node`` (of one channel or bit, or a device), ``device``, ``what`` (the column that is watched,
            "fault", "link" or "driver", or "drift", which a program tells), ``severity`` and ``worst`` (as Severity),
            ``state`` ("unacknowledged", "acknowledged", "returned": to normal, and nobody has acknowledged it),
            ``text``, ``since`` [s, UTC], ``times`` it has been raised, ``by``, ``at`` [s, UTC] and ``note`` of who has
            acknowledged it.
        """
        alarms: list[dict[str, Any]] = await self._ask("list alarms", verbs.Alarms())
        return alarms

    @verb
    async def acknowledge(self, node: str = "", note: str = "") -> list[dict[str, Any]]:
        """Acknowledge alarms, on behalf of this user.

        Args:
            node: a node or device, with all its parts; '' = all on which this user has the right.
            note: a note for others.

        Returns:
            Those that nobody had acknowledged before, as ``alarms``.

        Raises:
            OSError: ENOENT, no such node; EPERM, without the right to write or to administer it.
        """
        what = f"acknowledge {node or 'all alarms'}"
        done: list[dict[str, Any]] = await self._ask(what, verbs.Acknowledge(node, printable(str(note), 200)))
        return done

    @verb
    async def tell_alarm(self, node: str, what: str, severity: int, text: str = "") -> None:
        """Tell how bad a condition is that this program watches; it then stands in the list of alarms.

        It stops nothing. It outlives this program, the driver and the daemon, and is over when a program says so.

        Args:
            node: of one channel.
            what: "drift".
            severity: 0: it is over; 1: minor; 2: major (as Severity).
            text: why, a sentence of at most 300 characters.

        Raises:
            OSError: ENOENT, no such node; EPERM, without the right to write or to administer it; EINVAL, anything
                else that is no such alarm.
        """
        await self._ask(f"tell an alarm of {node}", verbs.TellAlarm(node, what, severity, printable(str(text), 300)))

    @verb
    async def reload(self) -> None:
        """Let the daemon take up its configuration anew.

        Raises:
            OSError: EINVAL with all errors; nothing was taken up.
        """
        errors: list[str] = await self._ask("reload", verbs.Reload(), limit_s=60.0)
        if errors:
            raise OSError(errno.EINVAL, "reload: nothing taken up: " + "; ".join(errors))
