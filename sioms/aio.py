"""The asyncio face of the client library.

    async with await sioms.aio.connect() as cell:
        async with await cell.open("mod0", "rw") as mod0:
            await mod0.write(sioms.command(0, position=0.1))
            await mod0.wait_until_idle()

Its verbs are those of the blocking face, made of the same list (``sioms.client.faces``); only the waiting differs.
Reading needs no waiting: ``read`` is an ordinary call. Only right after an acknowledgement it may take until the driver
publishes again; ``await node.fresh()`` lets the loop go on meanwhile.

Concurrency: one event loop, any number of its tasks. Cancelling a task cancels its request.
"""

from __future__ import annotations

import asyncio
import errno
from contextlib import nullcontext, suppress
from select import POLLIN, poll
from time import monotonic
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Self, TypeVar, overload

from sioms.protocol import verbs
from sioms.protocol.flags import NodeClass
from sioms.protocol.socketpath import cell_address

from .client.abandoned import undoing
from .client.cell_verbs import WorkcellVerbs
from .client.channel import KEEPALIVE, Answer, Call, Channel
from .client.connecting import connect_channel
from .client.faces import Awaiting
from .client.fleet_verbs import FleetMarkerVerbs, FleetVerbs
from .client.node_core import S
from .client.node_verbs import AnalogVerbs, AxisVerbs, BinaryVerbs, NodeVerbs, select_nodes
from .client.session import MarkerVerbs
from .client.snapshot import AnalogSnapshot, AxisSnapshot, BinarySnapshot
from .client.title import title

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
    from contextlib import AbstractContextManager

    from .client.coordinates import AsyncUserAxis
    from .client.overdue import Overdue

N = TypeVar("N", bound="AsyncNode[Any]")
A = TypeVar("A", bound=AxisVerbs)
_woken: dict[tuple[asyncio.AbstractEventLoop, int], list[asyncio.Future[None]]] = {}
"""Tasks that wait for a descriptor; a loop calls one only."""


def _wake(key: tuple[asyncio.AbstractEventLoop, int]) -> None:
    for waiting in _woken.get(key, ()):
        if not waiting.done():
            waiting.set_result(None)


class _Waiter:
    """What waits in the asyncio face."""

    async def readable(self, fds: Iterable[int], timeout_s: float | None) -> set[int]:
        """Wait until one of several descriptors is readable; return those that are, none when the time is over."""
        loop, fds = asyncio.get_running_loop(), list(fds)
        poller = poll()
        woken = loop.create_future()
        for fd in fds:
            poller.register(fd, POLLIN)
            waiting = _woken.setdefault((loop, fd), [])
            if not waiting:
                loop.add_reader(fd, _wake, (loop, fd))
            waiting.append(woken)
        try:
            async with asyncio.timeout(timeout_s):
                await woken
        except TimeoutError:
            return set()
        finally:
            for fd in fds:
                _woken[loop, fd].remove(woken)
                if not _woken[loop, fd]:
                    del _woken[loop, fd]
                    loop.remove_reader(fd)
        return {fd for fd, _ in poller.poll(0)}

    async def pause(self, seconds: float) -> None:
        """Let time pass."""
        await asyncio.sleep(seconds)


class _Requests(_Waiter):
    """Requests in flight on a channel, answered by the event loop."""

    def __init__(self, channel: Channel, cancel: type[verbs.Cancel | verbs.CancelOnHandle]) -> None:
        self._channel = channel
        self._cancel_message = cancel
        self._futures: dict[int, tuple[asyncio.Future[Answer], Call]] = {}
        self._abandoned: dict[int, Call] = {}
        self._looks: dict[int, asyncio.TimerHandle] = {}
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(channel.fileno(), self._readable)

    async def call(self, call: Call) -> Answer:
        """Send a request and wait for its answer; a cancelled task cancels the request."""
        number = self._channel.send(call)
        future: asyncio.Future[Answer] = self._loop.create_future()
        self._futures[number] = future, call
        if call.limit_s is not None:
            due_s = monotonic() + call.limit_s
            self._looks[number] = self._loop.call_later(
                call.limit_s + call.first_look_s, self._look, number, call, due_s, None
            )
        self._keep_alive(number)
        try:
            return await future
        except asyncio.CancelledError:
            self._cancel(number, call)
            if future.done() and not future.cancelled():  # it came first, and nobody takes it
                self._take_unasked(call, future)
            raise
        finally:
            look = self._looks.pop(number, None)
            if look is not None:
                look.cancel()

    def _keep_alive(self, number: int) -> None:
        """Renew the lease of a node as long as a request of it waits."""
        if self._channel.keepalive_s and number in self._futures:
            self._loop.call_later(self._channel.keepalive_s, self._renew, number)

    def _renew(self, number: int) -> None:
        if number in self._futures:
            with suppress(OSError):  # who waits hears of it
                self._channel.keepalive()
            self._keep_alive(number)

    def _look(self, number: int, call: Call, due_s: float, overdue: Overdue | None) -> None:
        """Judge by the process that owes an overdue answer whether to wait on."""
        overdue = overdue or self._channel.overdue(call, due_s)
        now_s = monotonic()
        until_s = overdue.until(now_s)
        if until_s:
            self._looks[number] = self._loop.call_later(until_s - now_s, self._look, number, call, due_s, overdue)
            return
        future, _ = self._futures.get(number, (None, None))
        if future is not None and not future.done():
            future.set_exception(self._channel.late(call))
            self._cancel(number, call)

    def _take_unasked(self, call: Call, future: asyncio.Future[Answer]) -> None:
        """Let go of an answer that came just before the cancel did."""
        error, refused, value = future.exception(), 0, None
        if error is None:
            future.result().fds.close()
            value = future.result().value
        else:
            refused = (isinstance(error, OSError) and error.errno) or errno.EIO
        with suppress(OSError):
            self._undo(call, refused, value)

    def _undo(self, call: Call | None, refused: int, value: Any) -> None:
        """Undo what was done before the cancel came, or the answer reached who was cancelled: nobody else will."""
        for each in undoing(None if call is None else call.message, refused, value):
            self._channel.send(Call("undo", each))

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
                future, call = self._futures.pop(message[1], (None, None))
                if future is None or future.done():  # cancelled, of which its task may not have heard yet
                    fds.close()
                    self._undo(call or self._abandoned.pop(message[1], None), message[2], message[3])
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
        for future, _ in futures.values():
            if not future.done():
                future.set_exception(error)
                future.exception()  # whoever still waits gets it; who does not must not be warned


class AsyncNode(Awaiting, NodeVerbs[S]):
    """An open node in an event loop. Use it in an ``async with`` block: closing halts its axes."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    subscribed = NodeVerbs.subscribe  # its name of old


class AsyncAxisNode(AsyncNode[AxisSnapshot], AxisVerbs):
    __doc__ = AxisVerbs.__doc__

    def user(self, axis: int | str = 0, *, offset: float = 0.0, direction: int = 1) -> AsyncUserAxis:
        """Return one axis in coordinates of one's own: user = direction * position + offset."""
        from .client.coordinates import AsyncUserAxis

        return AsyncUserAxis(self, self.channel(axis), offset, direction)

    def __getitem__(self, axis: int | str) -> AsyncUserAxis:
        """Return one axis by index or name, ``arm["xaxis"]``, in the node's own coordinates."""
        return self.user(axis)


class AsyncAnalogNode(AsyncNode[AnalogSnapshot], AnalogVerbs):
    __doc__ = AnalogVerbs.__doc__


class AsyncBinaryNode(AsyncNode[BinarySnapshot], BinaryVerbs):
    __doc__ = BinaryVerbs.__doc__


NODE: dict[NodeClass, type[AsyncNode[Any]]] = {
    NodeClass.AXIS: AsyncAxisNode,
    NodeClass.ANALOG: AsyncAnalogNode,
    NodeClass.BINARY: AsyncBinaryNode,
}


class AsyncMarker(Awaiting, MarkerVerbs):
    __doc__ = MarkerVerbs.__doc__


class AsyncWorkcell(Awaiting, WorkcellVerbs[AsyncMarker]):
    """A session with the daemon in an event loop; made by ``connect``."""

    _NODE, _NODES, _MARKER = AsyncNode, NODE, AsyncMarker

    def _waiter_of(self, channel: Channel) -> _Requests:
        return _Requests(channel, verbs.CancelOnHandle)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @overload
    async def open(
        self, name: str, mode: str = "r", timeout: float | None = 0.0, *, lease: float = 0.0, kind: type[N]
    ) -> N: ...

    @overload
    async def open(self, name: str, mode: str = "r", timeout: float | None = 0.0, *, lease: float = 0.0) -> Any: ...

    async def open(
        self,
        name: str,
        mode: str = "r",
        timeout: float | None = 0.0,
        *,
        lease: float = 0.0,
        kind: type[AsyncNode[Any]] | None = None,
    ) -> Any:
        node = await self._open(name, mode, timeout, lease, kind)
        if node.clock is not None and not node.info.read_only:
            self._renew(node)
        return node

    def _renew(self, node: AsyncNode[Any]) -> None:
        """Renew the lease of a node of another machine for as long as the loop runs."""
        if not node.closed:
            with suppress(OSError):  # its next request says what has happened
                node._channel.notice(KEEPALIVE)
            asyncio.get_running_loop().call_later(node._channel.keepalive_s, self._renew, node)

    open.__doc__ = WorkcellVerbs._open.__doc__


async def connect(path: str | None = None, name: str | None = None) -> AsyncWorkcell:
    """Open a session with the daemon.

    Args:
        path: the daemon's socket, or ``zmq://HOST:PORT`` or ``zenoh://HOST:PORT`` of a gateway; None for $SIOMS_CELL,
            $SIOMS_SOCKET or the usual places. Connecting to a gateway takes some milliseconds, in which the loop does
            nothing else.
        name: what this client calls itself; None for how it was started.
    """
    path = path or cell_address()
    channel = connect_channel(path, waits=False)
    cell = AsyncWorkcell(channel, _Requests(channel, verbs.Cancel), path)
    await cell._greet(title() if name is None else name)
    return cell


class AsyncFleetMarker(Awaiting, FleetMarkerVerbs):
    __doc__ = FleetMarkerVerbs.__doc__


class _Together:
    """What waits for several cells in an event loop."""

    async def calls(
        self, calls: Sequence[tuple[WorkcellVerbs[Any], Call]], sent: Callable[[], None] | None = None
    ) -> list[Answer | OSError]:
        return await self.all([cell._waiter.call(call) for cell, call in calls])

    def undisturbed(self) -> AbstractContextManager[Any]:
        return nullcontext(SimpleNamespace(end=None))  # a loop heeds signals between steps alone

    async def all(self, steps: Sequence[Coroutine[Any, Any, Any]]) -> list[Any]:
        return await asyncio.gather(*steps, return_exceptions=True)

    async def connect(self, address: str, name: str) -> AsyncWorkcell:
        return await connect(address, name or None)

    def close(self) -> None:
        pass


class AsyncFleet(Awaiting, FleetVerbs[AsyncWorkcell]):
    """Sessions with several cells in an event loop; made by ``fleet``."""

    _MARKER = AsyncFleetMarker

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


async def fleet(
    cells: Mapping[str, str] | Iterable[str] | str | None = None, name: str = "", *, partial: bool = False
) -> AsyncFleet:
    """Open sessions with several cells; see ``sioms.Fleet``."""
    from .client.fleet_places import wanted

    opened = AsyncFleet(_Together(), name)
    await opened._connect(wanted(cells), partial)
    return opened


async def select(
    readable: Iterable[N] = (), room: Iterable[A] = (), timeout: float | None = None
) -> tuple[list[N], list[A]]:
    return await select_nodes(_Waiter(), readable, room, timeout)


select.__doc__ = select_nodes.__doc__
