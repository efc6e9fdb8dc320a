"""Open nodes: reading is a copy out of shared memory, everything else a message to the driver.

Concurrency: a node may be used by many threads; each request has its own answer. Closing ends the
requests of other threads with EBADF.
"""

from __future__ import annotations

import errno
from select import POLLIN, poll
from time import monotonic, monotonic_ns

from sioms.protocol.flags import NodeClass, Request
from sioms.protocol.page import NotReadable
from sioms.protocol.verbs import Subscribe

from .arguments import integer, numbers, seconds
from .channel import Call
from .command import command
from .node_core import Edges, Event, NodeCore
from .snapshot import AnalogSnapshot, AxisSnapshot, BinarySnapshot

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from typing import Any, Self

    from .coordinates import UserAxis
    from .node_core import Records
    from .workcell import Workcell

SYNCH_LEAD_S = 0.01
"""How far ahead a synchronised start lies: long enough for every driver to hear of it."""


class Node(NodeCore):
    """An open node, with calls that wait. Use it in a ``with`` block: closing halts its axes."""

    def __init__(self, core: tuple[Any, ...], cell: Workcell, lease: float = 0.0) -> None:
        super().__init__(*core)
        self._cell = cell
        self._channel.keepalive_s = lease / 3

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the node: axes halt, buffers empty, outputs become safe. Returns when the node is free."""
        if self._map is not None:
            self.release()
            self._cell.close_handle(self.handle)

    def subscribe(self, every: int) -> None:
        """Have ``fileno`` become readable with every n-th publication, -1: with edges only, 0: not at all."""
        if every != self._subscribed:
            self._channel.call(Call(f"subscribe to {self.name}", Subscribe(every)))
            self._subscribed = every

    def ioctl(self, request: Request, argument: object = None, timeout: float | None = 0.0) -> Any:
        """Send a request to the driver and return its answer.

        Those of tables F.2 and F.5 that are not the driver's to answer are answered here:
        GET_IO_STRUCT_INFO out of what the open told, markers by the daemon, WAIT_UNTIL_EVENT out of
        the page.

        Args:
            request: one of Request.
            argument: what the request takes: a marker's token or number, an event mask, positions ...
            timeout: how long a request that waits may wait [s]; None = for ever.

        Raises:
            OSError: with the errno and the sentence of who refuses.
        """
        match request:
            case Request.GET_IO_STRUCT_INFO:
                return self.info
            case Request.RESERVE_MARKER:
                return self._cell.reserve_marker().token
            case Request.FREE_MARKER:
                return self._cell.free_marker(argument)  # type: ignore[arg-type]
            case Request.SIGNAL_MARKER:
                return self._cell.signal_marker(argument)  # type: ignore[arg-type]
            case Request.WAIT_MARKER:
                return self._cell.wait_marker(argument, timeout)  # type: ignore[arg-type]
            case Request.WAIT_UNTIL_EVENT if isinstance(self, BinaryNode):
                return self.wait_event(-1 if argument is None else argument, timeout=timeout)  # type: ignore[arg-type]
        return self._channel.call(self._ioctl(request, argument, timeout)).value

    def write(self, records: Records, timeout: float | None = 0.0, *, replace: bool = False) -> int:
        """Write records, all or none.

        Args:
            records: packed records, joined or as an iterable (see ``command``), or a numpy array of
                the record type.
            timeout: how long to wait for room in the command buffer [s]; 0: not; None: for ever.
            replace: empty the buffer first and re-plan from the present state.

        Returns:
            The driver's tick when they were taken.

        Raises:
            OSError: EINVAL, ERANGE a bad record; EAGAIN, ETIMEDOUT no room; EPERM stopped by
                emergency stop; EIO the device is lost. Nothing was taken.
        """
        call = self._write(records, timeout, replace)
        tick: int = self._channel.call(call).value
        return tick

    def wait_new(self, after: int, timeout: float | None = None) -> Any:
        """Wait for a snapshot newer than a given number and return the newest.

        Raises:
            TimeoutError: none came.
        """
        if not self._subscribed:
            self.subscribe(1)
        after = integer(f"wait for new data of {self.name}", after, "the number of a snapshot")
        deadline = _deadline(f"wait for new data of {self.name}", timeout)
        while True:
            snapshot = self.read()
            if snapshot.number > after:
                return snapshot
            self._poll(deadline, f"wait for new data of {self.name}")

    def stop_all(self) -> None:
        """Emergency stop of this node: maximum deceleration, buffers emptied, latched until ``reset``."""
        self.ioctl(Request.EMERGENCY_STOP)

    emergency_stop = stop_all

    def reset(self) -> None:
        """Clear a latched stop or fault of this node; shown from the next tick on. Nothing resumes."""
        self.ioctl(Request.RESET)

    def cancel_waits(self) -> int:
        """End the waits of all sessions on this node with ECANCELED; return how many there were."""
        return int(self.ioctl(Request.CANCEL_WAITS))

    def statistics(self, last: int | None = None) -> dict[str, Any]:
        """Return the driver's tick times and link counters.

        Args:
            last: over so many of the last ticks, at most 8192, None for 1000; each costs the driver a microsecond.
        """
        value: dict[str, Any] = self.ioctl(Request.GET_STATISTICS, last)
        return value

    def _poll(self, deadline: float | None, what: str) -> None:
        """Wait until the wake pipe is readable, then look at the page's state at least every 50 ms."""
        left = None if deadline is None else deadline - monotonic()
        if left is not None and left <= 0:
            raise TimeoutError(errno.ETIMEDOUT, f"{what}: nothing within its time-out")
        poller = poll()
        poller.register(self._event, POLLIN)
        # A hung driver wakes nobody: look at its lease now and then.
        step_s = min(0.05, self._channel.keepalive_s or 0.05)
        if poller.poll(1e3 * (step_s if left is None else min(step_s, left))):
            return
        if self._channel.keepalive_s:
            self.keepalive()
        if self._map is not None:
            try:
                self._page.check(monotonic_ns())
            except NotReadable as error:
                raise self._unreadable(error) from None


class AxisNode(Node):
    """Axes. Positions in the channel's unit (m or rad), forces in N or N*m."""

    if TYPE_CHECKING:

        def read(self) -> AxisSnapshot: ...

    def move(
        self,
        position: float,
        axis: int | str = 0,
        *,
        timeout: float | None = 0.0,
        replace: bool = False,
        **words: Any,
    ) -> int:
        """Append a command to go to a position.

        Args:
            position: target in the axis' unit, m or rad.
            axis: index of the axis in the node, or its name, e.g. ``"xaxis"``.
            timeout: how long to wait for room in the command buffer [s]; 0: not; None: for ever.
            replace: instead of what the axis does and of all that waits.
            **words: further words of ``sioms.command``, e.g. ``time`` [s] or ``relative``.

        Returns:
            The driver's tick when it was taken; ``wait_until_idle`` waits for the end of the motion.
        """
        return self.write(command(self.index_of(axis), position=position, **words), timeout, replace=replace)

    def command(
        self, axis: int | str = 0, *, timeout: float | None = 0.0, replace: bool = False, **words: Any
    ) -> int:
        """Append one command to an axis, given by index or name; see ``sioms.command`` for the words."""
        return self.write(command(self.index_of(axis), **words), timeout, replace=replace)

    def jog(self, velocity: float, axis: int | str = 0, *, acceleration: float | None = None) -> int:
        """Go over to a velocity at once, instead of what the axis does, until told otherwise; ``stop`` ends it.

        Args:
            velocity: signed [unit/s].
            axis: index of the axis in the node, or its name.
            acceleration: at most so much, for this jog alone [unit/s^2]; None: that of the axis.

        Jogs end with this client, however that ends; open with a lease if it may hang.
        """
        words = {} if acceleration is None else {"acceleration": acceleration}
        return self.command(axis, velocity=velocity, replace=True, **words)

    def tweak(self, step: float, axis: int | str = 0, **words: Any) -> int:
        """Append a step [unit] from where the preceding command ends, so that quick tweaks add up; see ``command``."""
        return self.write(command(self.index_of(axis), position=step, relative=True, **words))

    def user(self, axis: int | str = 0, *, offset: float = 0.0, direction: int = 1) -> UserAxis:
        """Return one axis in coordinates of one's own: user = direction * position + offset."""
        from .coordinates import UserAxis

        return UserAxis(self, self.channel(axis), offset, direction)

    def __getitem__(self, axis: int | str) -> UserAxis:
        """Return one axis by index or name, ``arm["xaxis"]``, in the node's own coordinates."""
        return self.user(axis)

    def particulars(self) -> dict[str, list[float]]:
        """Return what readings do not tell, one value an axis: raw and offset [unit], retries and misses.

        ``raw`` is what the device counts; ``raw + offset`` is the position; ``retries`` are those of the last
        point move, ``misses`` all since the driver started.
        """
        value: dict[str, list[float]] = self.ioctl(Request.GET_PARTICULARS)
        return value

    def wait_until_idle(self, timeout: float | None = None) -> None:
        """Wait until all axes of the node stand still and their buffers are empty.

        Raises:
            OSError: ETIMEDOUT; ECANCELED stopped; EIO fault; EPIPE a marker waited for was freed.
        """
        self.ioctl(Request.WAIT_UNTIL_IDLE, None, timeout)

    def synch(self, start_ns: int | None = None) -> int:
        """Send the external synch; return the instant at which the axes start [ns, CLOCK_MONOTONIC]."""
        return int(self.ioctl(Request.SEND_EXTERNAL_SYNCH, start_ns))

    def stop(self) -> None:
        """Stop at maximum deceleration and empty the buffers; not latched."""
        self.ioctl(Request.STOP)

    def flush(self) -> None:
        """Empty the buffers; the running command goes on."""
        self.ioctl(Request.FLUSH)

    def home(self) -> None:
        """Start homing; ``wait_until_idle`` waits for its end."""
        self.ioctl(Request.HOME)

    def zero(self) -> None:
        """Make the present position 0."""
        self.ioctl(Request.ZERO_DEVICE)

    def calibrate(self, *positions: float) -> None:
        """Give the present position of each axis a new value, without motion."""
        self.ioctl(Request.CALIBRATE_DEVICE, numbers(f"calibrate {self.name}", positions))

    def limits(self) -> dict[str, list[float | None]]:
        """Return the limits in force by name, one value an axis, None where there is none."""
        value: dict[str, list[float | None]] = self.ioctl(Request.GET_LIMITS)
        return value

    def set_limits(self, **limits: float | None) -> None:
        """Narrow the limits of all axes of the node, e.g. ``position_max=0.2``."""
        self.ioctl(Request.SET_LIMITS, limits)

    def wait_room(self, commands: int = 1, timeout: float | None = None) -> None:
        """Wait until the command buffers take so many more commands.

        Raises:
            TimeoutError: they did not.
        """
        commands = integer(f"wait for room on {self.name}", commands, "a number of commands")
        deadline = _deadline(f"wait for room on {self.name}", timeout)
        if not self._subscribed:
            self.subscribe(1)
        while self.room() < commands:
            self._poll(deadline, f"wait for room on {self.name}")


class AnalogNode(Node):
    """Analog channels in their declared units."""

    if TYPE_CHECKING:

        def read(self) -> AnalogSnapshot: ...

    def set(self, *values: float) -> int:
        """Write all output channels."""
        return self.write(self._outputs(values))

    def zero(self, samples: int = 1, timeout: float | None = 10.0) -> list[float]:
        """Take the mean of the next readings as offset; return what it was.

        Readings that were measured before the request, INVALID or SATURATED ones do not count. What is read after it counts from
        the new zero.

        Args:
            samples: readings to be averaged, from 1.
            timeout: longest wait [s], None = for ever.

        Raises:
            OSError: EIO as many bad readings came as good ones were asked for, or the device is lost; EBUSY a tactile finger is touched
                or blind; the offset is then as before.
            TimeoutError: too few readings came in time.
        """
        value: list[float] = self.ioctl(
            Request.ZERO_DEVICE, integer(f"zero {self.name}: samples", samples), timeout
        )
        return value

    def set_gains(self, gains: Sequence[float]) -> None:
        """Set the gain matrix: n*n numbers in rows, or the n of its diagonal."""
        self.ioctl(Request.SET_GAINS, numbers(f"set gains of {self.name}", gains))

    def gains(self) -> list[float]:
        """Return the gain matrix, n*n numbers in rows."""
        value: list[float] = self.ioctl(Request.GET_GAINS)
        return value


class BinaryNode(Node):
    """Binary ports and bits."""

    if TYPE_CHECKING:

        def read(self) -> BinarySnapshot: ...

    def set(self, *values: int) -> int:
        """Write all ports of the node, or its bit."""
        return self.write(self._outputs(values))

    def wait_event(
        self, mask: int = -1, last: Event | BinarySnapshot | None = None, timeout: float | None = None
    ) -> Event:
        """Wait until a masked bit differs from the last state seen.

        Args:
            mask: bits to watch.
            last: the event or snapshot seen last; every edge after it counts, also one that is over
                by now, as far as the page's history reaches. None: the present state.
            timeout: how long [s]; None = for ever.

        Raises:
            TimeoutError: nothing changed.
            EdgesLost: more edges came since ``last`` than can be told; its ``lost`` says how many, its ``event`` is
                where to go on from.
        """
        deadline = _deadline(f"wait for an event on {self.name}", timeout)
        edges = Edges(self, mask, last)
        if self._subscribed == 0:
            self.subscribe(-1)
        while True:
            event = edges.look()
            if event is not None:
                return event
            self._poll(deadline, f"wait for an event on {self.name}")


NODE: dict[NodeClass, type[Node]] = {
    NodeClass.AXIS: AxisNode,
    NodeClass.ANALOG: AnalogNode,
    NodeClass.BINARY: BinaryNode,
}


def _deadline(what: str, timeout: float | None) -> float | None:
    """Return when a time-out that begins now ends [s, time.monotonic], None = never; raises TypeError or ValueError."""
    limit_s = seconds(what, timeout)
    return None if limit_s is None else monotonic() + limit_s


def select(
    readable: Iterable[NodeCore] = (), room: Iterable[AxisNode] = (), timeout: float | None = None
) -> tuple[list[NodeCore], list[AxisNode]]:
    """Wait for new data or for room in a command buffer, on several nodes at once.

    Args:
        readable: nodes whose next publication is waited for.
        room: axis nodes that shall take at least one more command.
        timeout: how long [s]; None = for ever; 0 = only look.

    Returns:
        The nodes with new data, and those with room; both empty when the time is over.
    """
    readable, room = list(readable), list(room)
    deadline = _deadline("select", timeout)
    poller = poll()
    for node in {*readable, *room}:
        poller.register(node.fileno(), POLLIN)
    while True:
        roomy = [node for node in room if node.room() > 0]
        left = None if deadline is None else max(0.0, deadline - monotonic())
        events = {fd for fd, _ in poller.poll(0 if roomy else 50 if left is None else min(50.0, left * 1e3))}
        fresh = [node for node in readable if node.fileno() in events]
        if fresh or roomy or left == 0:
            return fresh, roomy
