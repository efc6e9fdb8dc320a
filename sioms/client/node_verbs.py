"""The verbs of open nodes, the one list of which both faces are made (``faces``).

Reading is a copy out of shared memory, everything else a message to the driver.
"""

from __future__ import annotations

import errno
from time import monotonic, monotonic_ns

from sioms.protocol.flags import Request
from sioms.protocol.page import NotReadable
from sioms.protocol.verbs import Subscribe

from .arguments import integer, number, numbers, seconds
from .channel import Call
from .command import command
from .marks import stream, verb
from .node_core import Edges, Event, NodeCore, S
from .session import Session
from .snapshot import AnalogSnapshot, AxisSnapshot, BinarySnapshot

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Sequence
    from typing import Any, TypeVar

    from .node_core import Records
    from .snapshot import BinarySnapshot
    from .typed_faces import Sleeper, Waiter

    N = TypeVar("N", bound=NodeCore[Any])
    A = TypeVar("A", bound="AxisVerbs")


def deadline_of(what: str, timeout: float | None) -> float | None:
    """Return when a time-out that begins now ends [s, time.monotonic], None = never; raises TypeError or ValueError."""
    limit_s = seconds(what, timeout)
    return None if limit_s is None else monotonic() + limit_s


class NodeVerbs(NodeCore[S]):
    """The verbs of every node."""

    def __init__(self, core: tuple[Any, ...], cell: Session[Any], waiter: Waiter, lease: float = 0.0) -> None:
        super().__init__(*core)
        self._cell = cell
        self._waiter = waiter
        self._channel.keepalive_s = lease / 3

    @verb
    async def close(self) -> None:
        """Close the node: axes halt, buffers empty, outputs become safe. Returns when the node is free."""
        if not self.closed:
            self.release()
            await self._cell._closed_handle(self.handle)

    def release(self) -> None:
        """Let go of memory and descriptors; the driver ends the handle at the end of file."""
        self._waiter.close()
        super().release()

    @verb
    async def subscribe(self, every: int) -> None:
        """Have ``fileno`` become readable with every n-th publication, -1: with edges only, 0: not at all."""
        if every != self._subscribed:
            await self._waiter.call(Call(f"subscribe to {self.name}", Subscribe(every)))
            self._subscribed = every

    @verb
    async def ioctl(self, request: Request, argument: object = None, timeout: float | None = 0.0) -> Any:
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
                return int(await Session.reserve_marker(self._cell))
            case Request.FREE_MARKER:
                return await Session.free_marker(self._cell, argument)  # type: ignore[arg-type]
            case Request.SIGNAL_MARKER:
                return await Session.signal_marker(self._cell, argument)  # type: ignore[arg-type]
            case Request.WAIT_MARKER:
                return await Session.wait_marker(self._cell, argument, timeout)  # type: ignore[arg-type]
            case Request.WAIT_UNTIL_EVENT if isinstance(self, BinaryVerbs):
                mask: Any = -1 if argument is None else argument
                return await BinaryVerbs.wait_event(self, mask, timeout=timeout)
        return await self._ask(request, argument, timeout)

    async def _ask(self, request: Request, argument: object = None, timeout: float | None = 0.0) -> Any:
        return (await self._waiter.call(self._ioctl(request, argument, timeout))).value

    @verb
    async def write(self, records: Records, timeout: float | None = 0.0, *, replace: bool = False) -> int:
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
        tick: int = (await self._waiter.call(self._write(records, timeout, replace))).value
        return tick

    @verb
    async def wait_new(self, after: int, timeout: float | None = None) -> S:
        """Wait for a snapshot newer than a given number and return the newest.

        Raises:
            TimeoutError: none came.
        """
        if not self._subscribed:
            await NodeVerbs.subscribe(self, 1)
        after = integer(f"wait for new data of {self.name}", after, "the number of a snapshot")
        deadline = deadline_of(f"wait for new data of {self.name}", timeout)
        while True:
            snapshot = await NodeVerbs.fresh(self)
            if snapshot.number > after:
                return snapshot
            await self._woken(deadline, f"wait for new data of {self.name}")

    @verb
    async def emergency_stop(self) -> None:
        """Emergency stop of this node alone: maximum deceleration, buffers emptied, latched until ``reset``.

        ``AxisNode.stop`` is the controlled stop, which is not latched; ``Workcell.emergency_stop_workcell`` stops
        everything.
        """
        await self._ask(Request.EMERGENCY_STOP)

    stop_all = emergency_stop  # its name of old

    @verb
    async def reset(self) -> None:
        """Clear a latched stop or fault of this node; shown from the next tick on. Nothing resumes.

        Raises:
            OSError: EAGAIN as of ``Workcell.reset``.
        """
        await self._ask(Request.RESET)

    @verb
    async def cancel_waits(self) -> int:
        """End the waits of all sessions on this node with ECANCELED; return how many there were."""
        return int(await self._ask(Request.CANCEL_WAITS))

    @verb
    async def statistics(self, last: int | None = None) -> dict[str, Any]:
        """Return the driver's tick times and link counters.

        Args:
            last: over so many of the last ticks, at most 8192, None for 1000; each costs the driver a microsecond.
        """
        value: dict[str, Any] = await self._ask(Request.GET_STATISTICS, last)
        return value

    @verb
    async def fresh(self) -> S:
        """Return what ``read`` returns, but let an event loop go on until the newest snapshot shows what was
        acknowledged.
        """
        await self._settled()
        return self.read()

    @stream
    async def snapshots(self, every: int = 1) -> AsyncIterator[S]:
        """Yield the newest snapshot after every n-th publication, for ever."""
        await NodeVerbs.subscribe(self, every)
        number = 0
        while True:
            snapshot = await NodeVerbs.fresh(self)
            if snapshot.number > number:
                number = snapshot.number
                yield snapshot
            await self._woken(None, f"wait for new data of {self.name}")

    async def _settled(self) -> None:
        """Wait until ``read`` need not."""
        heard_s = monotonic()
        while not self.is_shown():
            await self._waiter.pause(self.look_s)
            if self._channel.keepalive_s and monotonic() - heard_s > self._channel.keepalive_s:
                heard_s = monotonic()
                self.keepalive()

    async def _woken(self, deadline: float | None, what: str) -> None:
        """Wait until the wake pipe is readable, then look at the page's state at least every 50 ms."""
        left = None if deadline is None else deadline - monotonic()
        if left is not None and left <= 0:
            raise TimeoutError(errno.ETIMEDOUT, f"{what}: nothing within its time-out")
        # A hung driver wakes nobody: look at its lease now and then.
        step_s = min(0.05, self._channel.keepalive_s or 0.05)
        if await self._waiter.readable([self._event], step_s if left is None else min(step_s, left)):
            return
        if self._channel.keepalive_s:
            self.keepalive()
        if not self.closed:
            try:
                self._page.check(monotonic_ns())
            except NotReadable as error:
                raise self._unreadable(error) from None


class AxisVerbs(NodeVerbs[AxisSnapshot]):
    """Axes. Positions and steps in the channel's unit (m or rad), velocities in it per second and so on, forces in N or
    N*m.

    Every verb raises OSError: EBADF the node is closed or was opened for reading only, EPERM the user has no right to
    it, EIO its device is lost or its driver has ended, ETIMEDOUT the driver does not answer. An axis whose name or
    index the node has not is EINVAL; what is neither is a TypeError.

    Concurrency: any number of threads.
    """

    @verb
    async def move(
        self,
        /,
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

        Raises:
            OSError: EAGAIN no room in the buffer in time; ERANGE beyond a limit; EPERM stopped, in fault or not homed;
                EINVAL words that do not go together. Nothing has been taken then.
        """
        record = command(self.index_of(axis), position=position, **words)
        return await NodeVerbs.write(self, record, timeout, replace=replace)

    @verb
    async def command(
        self, /, axis: int | str = 0, *, timeout: float | None = 0.0, replace: bool = False, **words: Any
    ) -> int:
        """Append one command to an axis, given by index or name; see ``sioms.command`` for the words and their units.

        Args:
            axis: index of the axis in the node, or its name.
            timeout: how long to wait for room in the command buffer [s]; 0: not; None: for ever.
            replace: instead of what the axis does and of all that waits.
            **words: of ``sioms.command``.

        Returns:
            The driver's tick when it was taken.

        Raises:
            OSError: as of ``move``.
        """
        return await NodeVerbs.write(self, command(self.index_of(axis), **words), timeout, replace=replace)

    @verb
    async def jog(self, velocity: float, axis: int | str = 0, *, acceleration: float | None = None) -> int:
        """Go over to a velocity at once, instead of what the axis does, until told otherwise; ``stop`` ends it.

        Args:
            velocity: signed [unit/s].
            axis: index of the axis in the node, or its name.
            acceleration: at most so much, for this jog alone [unit/s^2]; None: that of the axis.

        Jogs end with this client, however that ends; open with a lease if it may hang.

        Raises:
            OSError: as of ``move``.
        """
        words = {} if acceleration is None else {"acceleration": acceleration}
        return await AxisVerbs.command(self, axis, velocity=velocity, replace=True, **words)

    @verb
    async def tweak(self, /, step: float, axis: int | str = 0, **words: Any) -> int:
        """Append a step [unit] from where the preceding command ends, so that quick tweaks add up; see ``command``.

        Raises:
            OSError: as of ``move``.
        """
        return await AxisVerbs.command(self, axis, position=step, relative=True, **words)

    @verb
    async def diagnostics(self) -> dict[str, list[float]]:
        """Return what readings do not tell, one value an axis: raw and offset [unit], retries and misses.

        ``raw`` is what the device counts, in the axis' unit; ``raw + offset`` is the position; ``retries`` are those
        of the last point move, ``misses`` all since the driver started.
        """
        value: dict[str, list[float]] = await self._ask(Request.GET_DIAGNOSTICS)
        return value

    @verb
    async def wait_until_idle(self, timeout: float | None = None, axis: int | str | None = None) -> None:
        """Wait until axes stand still and their buffers are empty.

        A motion of this node that others, a limit or a fault have ended before the wait was asked for is told, once.

        Args:
            timeout: how long at most [s]; None: for ever.
            axis: index or name of one axis; None: all of the node.

        Raises:
            OSError: ETIMEDOUT; ECANCELED stopped; EIO fault; ERANGE a limit; EPIPE a marker waited for was freed.
        """
        await self._ask(Request.WAIT_UNTIL_IDLE, self._one(axis), timeout)

    def _one(self, axis: int | str | None) -> int | None:
        return None if axis is None else self.index_of(axis)

    @verb
    async def synch(self, start_ns: int | None = None) -> int:
        """Send the external synch; return the instant at which the axes start [ns, CLOCK_MONOTONIC].

        Args:
            start_ns: that instant, on this machine's CLOCK_MONOTONIC [ns]; None: as soon as possible.

        Raises:
            OSError: ETIME the instant has passed; EINVAL it is more than 60 s away.
        """
        there_ns = None if start_ns is None else self._there(start_ns)
        started_ns = int(await self._ask(Request.SEND_EXTERNAL_SYNCH, there_ns))
        return started_ns if self.clock is None else self.clock.here(started_ns)

    def _there(self, here_ns: int) -> int:
        """Return an instant of this machine's clock in that of the cell."""
        return here_ns if self.clock is None else self.clock.there(here_ns)

    @verb
    async def stop(self, axis: int | str | None = None) -> None:
        """Stop at maximum deceleration and empty the buffers; not latched.

        Args:
            axis: index or name of one axis; None: all of the node.

        Raises:
            OSError: EINVAL the node has no such axis: all have then been stopped; EBADF, EIO the node is closed, or its
                driver has gone, which halts the axes.
        """
        try:
            which = self._one(axis)
        except (OSError, TypeError, ValueError):
            await self._ask(Request.STOP)  # whoever stops an axis by a wrong name wants less motion, not more
            raise
        await self._ask(Request.STOP, which)

    @verb
    async def flush(self) -> None:
        """Empty the buffers; the running command goes on."""
        await self._ask(Request.FLUSH)

    @verb
    async def home(self, axis: int | str | None = None) -> None:
        """Start homing one axis, given by index or name, or all of the node; ``wait_until_idle`` waits for its end.

        Raises:
            OSError: EINVAL no homing is configured for it; EPERM stopped or in fault.
        """
        await self._ask(Request.HOME, self._one(axis))

    @verb
    async def zero(self, axis: int | str | None = None) -> None:
        """Make the present position 0, without motion, for all clients: of one axis, given by index or name, or of all
        of the node.

        Raises:
            OSError: EBUSY an axis moves or has commands.
        """
        await self._ask(Request.ZERO_DEVICE, self._one(axis))

    @verb
    async def calibrate(self, *positions: float | None) -> None:
        """Give the present position of each axis a new value, without motion, for all clients.

        Args:
            *positions: one of each axis [m or rad]; None: it keeps the one that it has.

        Raises:
            OSError: EBUSY an axis moves or has commands; ERANGE the new position is beyond a limit; EINVAL another
                number of positions than of axes.
        """
        what = f"calibrate {self.name}"
        wanted = [None if position is None else number(what, position) for position in positions]
        await self._ask(Request.CALIBRATE_DEVICE, wanted)

    @verb
    async def limits(self) -> dict[str, list[float | None]]:
        """Return the limits in force by name, one value an axis, None where there is none.

        They are ``position_min``, ``position_max`` [unit], ``velocity_max`` [unit/s], ``acceleration_max`` [unit/s^2],
        ``jerk_max`` [unit/s^3] and ``force_max`` [N or N*m].
        """
        value: dict[str, list[float | None]] = await self._ask(Request.GET_LIMITS)
        return value

    @verb
    async def set_limits(self, /, **limits: float | None) -> None:
        """Narrow the limits of all axes of the node, e.g. ``position_max=0.2``.

        Args:
            **limits: names and units as of ``limits``; one number for all axes, or one an axis; None: as configured.

        Raises:
            OSError: EBUSY an axis moves or has commands; ERANGE wider than configured; EINVAL there is no such limit.
        """
        await self._ask(Request.SET_LIMITS, limits)

    def room(self) -> int:
        """Return how many commands the fullest of the node's command buffers still takes."""
        fullest: int = max(self.read().buffered)
        return self.info.buffer_capacity - fullest

    @verb
    async def wait_room(self, commands: int = 1, timeout: float | None = None) -> None:
        """Wait until the command buffers take so many more commands.

        Raises:
            TimeoutError: they did not.
        """
        commands = integer(f"wait for room on {self.name}", commands, "a number of commands")
        deadline = deadline_of(f"wait for room on {self.name}", timeout)
        if not self._subscribed:
            await NodeVerbs.subscribe(self, 1)
        while True:
            await self._settled()
            if self.room() >= commands:
                return
            await self._woken(deadline, f"wait for room on {self.name}")


class AnalogVerbs(NodeVerbs[AnalogSnapshot]):
    """Analog channels in their declared units."""

    @verb
    async def set(self, *values: float) -> int:
        """Write all output channels."""
        return await NodeVerbs.write(self, self._outputs(values))

    @verb
    async def zero(self, samples: int = 1, timeout: float | None = 10.0) -> list[float]:
        """Take the mean of the next readings as offset; return what it was.

        Readings that were measured before the request, INVALID or SATURATED ones do not count. What is read after it
        counts from the new zero.

        Args:
            samples: readings to be averaged, from 1.
            timeout: longest wait [s], None = for ever.

        Raises:
            OSError: EIO as many bad readings came as good ones were asked for, or the device is lost; EBUSY a tactile
                finger is touched or blind; the offset is then as before.
            TimeoutError: too few readings came in time.
        """
        value: list[float] = await self._ask(
            Request.ZERO_DEVICE, integer(f"zero {self.name}: samples", samples), timeout
        )
        return value

    @verb
    async def set_gains(self, gains: Sequence[float]) -> None:
        """Set the gain matrix: n*n numbers in rows, or the n of its diagonal."""
        await self._ask(Request.SET_GAINS, numbers(f"set gains of {self.name}", gains))

    @verb
    async def gains(self) -> list[float]:
        """Return the gain matrix, n*n numbers in rows."""
        value: list[float] = await self._ask(Request.GET_GAINS)
        return value


class BinaryVerbs(NodeVerbs[BinarySnapshot]):
    """Binary ports and bits."""

    @verb
    async def set(self, *values: int) -> int:
        """Write all ports of the node, or its bit."""
        return await NodeVerbs.write(self, self._outputs(values))

    @verb
    async def wait_event(
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
        deadline = deadline_of(f"wait for an event on {self.name}", timeout)
        await self._settled()
        edges = Edges(self, mask, last)
        if self._subscribed == 0:
            await NodeVerbs.subscribe(self, -1)
        while True:
            event = edges.look()
            if event is not None:
                return event
            await self._woken(deadline, f"wait for an event on {self.name}")


async def select_nodes(
    waiter: Sleeper, readable: Iterable[N] = (), room: Iterable[A] = (), timeout: float | None = None
) -> tuple[list[N], list[A]]:
    """Wait for new data or for room in a command buffer, on several nodes at once.

    Args:
        readable: nodes whose next publication is waited for.
        room: axis nodes that shall take at least one more command.
        timeout: how long [s]; None = for ever; 0 = only look.

    Returns:
        The nodes with new data, and those with room; both empty when the time is over.
    """
    readable, room = list(readable), list(room)
    deadline = deadline_of("select", timeout)
    for node in {*readable, *room}:
        if not node._subscribed:
            await NodeVerbs.subscribe(node, 1)
    fds = {node._event for node in (*readable, *room)}
    while True:
        for node in room:
            await node._settled()
        roomy = [node for node in room if node.room() > 0]
        left = None if deadline is None else max(0.0, deadline - monotonic())
        woken = await waiter.readable(fds, 0.0 if roomy else 0.05 if left is None else min(0.05, left))
        fresh = [node for node in readable if node._event in woken]
        if fresh or roomy or left == 0:
            return fresh, roomy
