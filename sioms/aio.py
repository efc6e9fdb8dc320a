"""The asyncio face of the client library.

    async with await sioms.aio.connect() as cell:
        async with await cell.open("mod0", "rw") as mod0:
            await mod0.write(sioms.command(0, position=0.1))
            await mod0.wait_until_idle()

Requests are the same values that the blocking face sends (``sioms.client.node_core``); only the waiting
differs. Reading needs no waiting: ``read`` is an ordinary call. Only right after an acknowledgement it may
take until the driver publishes again; ``await node.fresh()`` lets the loop go on meanwhile.

Concurrency: one event loop, any number of its tasks. Cancelling a task cancels its request.
"""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import AsyncIterator
from contextlib import suppress
from time import monotonic, monotonic_ns
from typing import TYPE_CHECKING, Any, Self

from sioms.protocol import verbs
from sioms.protocol.flags import PROTOCOL_VERSION, Request
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.socketpath import socket_path
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.text import printable

from .client.arguments import seconds
from .client.channel import Answer, Call, Channel
from .client.channel import connect as connect_socket
from .client.command import command
from .client.node_core import Edges, Event, NodeCore
from .client.shown import acknowledged_by_daemon
from .client.workcell import STARTING_S, node_parts, open_call, request_stop

if TYPE_CHECKING:
    from .client.node_core import Records
    from .client.overdue import Overdue


class _Requests:
    """Requests in flight on a channel, answered by the event loop."""

    def __init__(self, channel: Channel, cancel: type[verbs.Cancel | verbs.CancelOnHandle]) -> None:
        self._channel = channel
        self._cancel_message = cancel
        self._futures: dict[int, asyncio.Future[Answer]] = {}
        self._abandoned: dict[int, Call] = {}
        self._looks: dict[int, asyncio.TimerHandle] = {}
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(channel.fileno(), self._readable)

    async def call(self, call: Call) -> Answer:
        """Send a request and wait for its answer; a cancelled task cancels the request."""
        number = self._channel.send(call)
        future: asyncio.Future[Answer] = self._loop.create_future()
        self._futures[number] = future
        if call.limit_s is not None:
            due_s = monotonic() + call.limit_s
            self._looks[number] = self._loop.call_later(
                call.limit_s + call.first_look_s, self._look, number, call, due_s, None
            )
        try:
            return await future
        except asyncio.CancelledError:
            self._cancel(number, call)
            raise
        finally:
            look = self._looks.pop(number, None)
            if look is not None:
                look.cancel()

    def _look(self, number: int, call: Call, due_s: float, overdue: Overdue | None) -> None:
        """Judge by the process that owes an overdue answer whether to wait on."""
        overdue = overdue or self._channel.overdue(call, due_s)
        now_s = monotonic()
        until_s = overdue.until(now_s)
        if until_s:
            self._looks[number] = self._loop.call_later(
                until_s - now_s, self._look, number, call, due_s, overdue
            )
            return
        future = self._futures.get(number)
        if future is not None and not future.done():
            future.set_exception(self._channel.late(call))
            self._cancel(number, call)

    def _cancel(self, number: int, call: Call) -> None:
        if self._futures.pop(number, None) is not None:
            self._abandoned[number] = call
            with suppress(OSError):  # the other side has gone, and the request with it
                self._channel.send(Call("cancel", self._cancel_message(number)))

    @property
    def closed(self) -> bool:
        """Whether it has been closed."""
        return self._channel.closed

    def close(self) -> None:
        """Stop reading; requests in flight end with EBADF."""
        if not self._channel.closed:
            self._loop.remove_reader(self._channel.fileno())
            self._channel.close()
        self._fail(OSError(errno.EBADF, f"{self._channel.name} is closed"))

    def _readable(self) -> None:
        try:
            while (packet := self._channel.take()) is not None:
                message, fds = packet
                future = self._futures.pop(message[1], None)
                if future is None or future.done():
                    for fd in fds:
                        os.close(fd)
                    call = self._abandoned.pop(message[1], None)
                    if call is not None and isinstance(call.message, verbs.Open) and fds:
                        # Opened just before the cancel arrived: nobody will close it but us.
                        self._channel.send(Call("close", verbs.Close(message[3][0])))
                    continue
                try:
                    future.set_result(self._channel.result(packet))
                except OSError as error:
                    future.set_exception(error)
        except OSError as error:
            self._loop.remove_reader(self._channel.fileno())
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        futures, self._futures = self._futures, {}
        for future in futures.values():
            if not future.done():
                future.set_exception(error)
                future.exception()  # whoever still waits gets it; who does not must not be warned


class AsyncNode(NodeCore):
    """An open node in an event loop; see the blocking nodes for what the calls do."""

    def __init__(self, core: tuple[Any, ...], cell: AsyncWorkcell) -> None:
        super().__init__(*core)
        self._cell = cell
        self._requests = _Requests(self._channel, verbs.CancelOnHandle)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the node: axes halt, buffers empty, outputs become safe. Returns when the node is free."""
        if not self.closed:
            self._requests.close()
            self.release()
            await self._cell.forget(self.handle)

    async def ioctl(self, request: Request, argument: object = None, timeout: float | None = 0.0) -> Any:
        """Send a request to the driver and return its answer."""
        return (await self._requests.call(self._ioctl(request, argument, timeout))).value

    async def write(self, records: Records, timeout: float | None = 0.0, *, replace: bool = False) -> int:
        """Write records, all or none; see ``Node.write``."""
        call = self._write(records, timeout, replace)
        tick: int = (await self._requests.call(call)).value
        return tick

    async def command(
        self, axis: int | str = 0, *, timeout: float | None = 0.0, replace: bool = False, **words: Any
    ) -> int:
        """Append one command to an axis, given by index or name; see ``sioms.command`` for the words."""
        return await self.write(command(self.index_of(axis), **words), timeout, replace=replace)

    async def move(
        self,
        position: float,
        axis: int | str = 0,
        *,
        timeout: float | None = 0.0,
        replace: bool = False,
        **words: Any,
    ) -> int:
        """Append a position command; see ``AxisNode.move``."""
        return await self.command(axis, position=position, timeout=timeout, replace=replace, **words)

    async def jog(self, velocity: float, axis: int | str = 0, *, acceleration: float | None = None) -> int:
        """Go over to a velocity at once, until told otherwise; see ``AxisNode.jog``."""
        words = {} if acceleration is None else {"acceleration": acceleration}
        return await self.command(axis, velocity=velocity, replace=True, **words)

    async def tweak(self, step: float, axis: int | str = 0, **words: Any) -> int:
        """Append a step from where the preceding command ends; see ``AxisNode.tweak``."""
        return await self.command(axis, position=step, relative=True, **words)

    async def stop(self) -> None:
        """Stop at maximum deceleration and empty the buffers; not latched."""
        await self.ioctl(Request.STOP)

    async def stop_all(self) -> None:
        """Emergency stop of this node, latched until ``reset``."""
        await self.ioctl(Request.EMERGENCY_STOP)

    async def reset(self) -> None:
        """Clear a latched stop or fault of this node. Nothing resumes."""
        await self.ioctl(Request.RESET)

    async def home(self) -> None:
        """Start homing; ``wait_until_idle`` waits for its end."""
        await self.ioctl(Request.HOME)

    async def set(self, *values: float) -> int:
        """Write all channels of a binary or analog output."""
        return await self.write(self._outputs(values))

    async def fresh(self) -> Any:
        """Return what ``read`` returns, but let the loop go on until the newest snapshot shows what was acknowledged."""
        while not self.is_shown():
            await asyncio.sleep(self.look_s)
        return self.read()

    async def wait_until_idle(self, timeout: float | None = None) -> None:
        """Wait until all axes of the node stand still and their buffers are empty."""
        await self.ioctl(Request.WAIT_UNTIL_IDLE, None, timeout)

    async def subscribed(self, every: int) -> None:
        """Have the node's descriptor become readable with every n-th publication, -1: with edges only."""
        if every != self._subscribed:
            await self._requests.call(Call(f"subscribe to {self.name}", verbs.Subscribe(every)))
            self._subscribed = every

    async def snapshots(self, every: int = 1) -> AsyncIterator[Any]:
        """Yield the newest snapshot after every n-th publication, for ever."""
        await self.subscribed(every)
        number = 0
        while True:
            snapshot = await self.fresh()
            if snapshot.number > number:
                number = snapshot.number
                yield snapshot
            await self._wake()

    async def wait_event(self, mask: int = -1, last: Any = None, timeout: float | None = None) -> Event:
        """Wait until a masked bit differs from the last state seen; see ``BinaryNode.wait_event``."""
        timeout = seconds(f"wait for an event on {self.name}", timeout)
        if last is None:
            await self.fresh()
        edges = Edges(self, mask, last)
        if self._subscribed == 0:
            await self.subscribed(-1)
        try:
            async with asyncio.timeout(timeout):
                while True:
                    event = edges.look()
                    if event is not None:
                        return event
                    await self._wake()
        except TimeoutError as error:
            if error.errno:
                raise
            text = f"wait for an event on {self.name}: nothing within its time-out"
            raise TimeoutError(errno.ETIMEDOUT, text) from None

    async def _wake(self) -> None:
        """Wait for the wake pipe, and look at the page at least every 50 ms: a hung driver wakes nobody."""
        loop = asyncio.get_running_loop()
        woken = loop.create_future()

        def wake() -> None:
            if not woken.done():
                woken.set_result(None)

        loop.add_reader(self._event, wake)
        try:
            async with asyncio.timeout(0.05):
                await woken
        except TimeoutError:
            return
        finally:
            loop.remove_reader(self._event)


class AsyncWorkcell:
    """A session with the daemon in an event loop; made by ``connect``."""

    def __init__(self, requests: _Requests, page: StopRequest | None, name: str = "") -> None:
        self._requests = requests
        self._page = page
        self.name = name

    def __repr__(self) -> str:
        return f"<AsyncWorkcell {self.name}{', closed' if self._requests.closed else ''}>"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._requests.close()
        if self._page is not None:
            self._page.close()
            self._page = None

    async def open(
        self, name: str, mode: str = "r", timeout: float | None = 0.0, *, lease: float = 0.0
    ) -> AsyncNode:
        """Open a node; see ``Workcell.open``."""
        answer = await self._requests.call(open_call(name, mode, timeout, lease))
        return AsyncNode(node_parts(answer.value, answer.fds), self)

    async def info(self, name: str) -> NodeInfo:
        """Return what a node is, without opening it."""
        return NodeInfo(await self._call(f"get information of {name}", verbs.Info(name)))

    async def status(self) -> dict[str, Any]:
        """Return devices, sessions, holders and the state of the emergency stop."""
        value: dict[str, Any] = await self._call("get status", verbs.Status())
        return value

    async def reserve_marker(self) -> int:
        """Reserve a marker; return its token."""
        tokens: list[int] = await self._call("reserve marker", verbs.ReserveMarker(1, False))
        return tokens[0]

    async def signal_marker(self, token: int) -> None:
        """Signal a marker."""
        await self._call("signal marker", verbs.SignalMarker(token))

    async def wait_marker(self, number: int, timeout: float | None = None) -> int:
        """Wait until a marker is signalled; return when that was [ns, CLOCK_MONOTONIC]."""
        stamp_ns: int = await self._call("wait for marker", verbs.WaitMarker(number, timeout))
        return stamp_ns

    async def emergency_stop(self, node: str = "", why: str = "") -> None:
        """Stop the workcell or a node, latched until reset; the workcell also while the daemon hangs."""
        call = Call("emergency stop", verbs.EmergencyStop(node, printable(str(why))))
        taken = call.enough = request_stop(None if node else self._page, printable(str(why)))
        try:
            await self._requests.call(call)
        except OSError:
            if taken is None or not taken():
                raise  # else the drivers have latched it without the daemon
            acknowledged_by_daemon(monotonic_ns())

    async def reset(self, node: str = "") -> None:
        """Clear the latched stop of the workcell or of a node."""
        await self._call("reset", verbs.Reset(node))

    async def forget(self, handle: int) -> None:
        """Tell the daemon that a node was closed."""
        try:
            await self._call("close", verbs.Close(handle))
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EBADF):
                raise

    async def _call(self, what: str, message: verbs.Message) -> Any:
        return (await self._requests.call(Call(what, message))).value


async def connect(path: str | None = None, name: str = "") -> AsyncWorkcell:
    """Open a session with the daemon.

    Args:
        path: the daemon's socket; None for $SIOMS_SOCKET or the usual places.
        name: what this client calls itself.
    """
    channel = Channel(connect_socket(path or socket_path()), "the daemon")
    requests = _Requests(channel, verbs.Cancel)
    answer = await _hello(requests, name)
    return AsyncWorkcell(requests, StopRequest(*answer.fds) if answer.fds else None, answer.value[1])


async def _hello(requests: _Requests, name: str) -> Answer:
    """Say hello; to a daemon that is starting again and again, for a while."""
    deadline = monotonic() + STARTING_S
    while True:
        try:
            return await requests.call(Call("hello", verbs.Hello(PROTOCOL_VERSION, name)))
        except OSError as error:
            if error.errno != errno.EAGAIN or monotonic() > deadline:
                requests.close()
                raise
        await asyncio.sleep(0.02)
