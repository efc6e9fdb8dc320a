"""What a session with a daemon is below the nodes that it opens: its connection, and its markers."""

from __future__ import annotations

import errno

from sioms.protocol import verbs

from .channel import Call, Channel
from .marks import Generic, verb

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, ClassVar, Self, TypeVar

    from .typed_faces import Waiter

    M = TypeVar("M", bound="MarkerVerbs")
else:
    M = None


class MarkerVerbs(int):
    """A reserved marker: the integer of its token."""

    _cell: Session[Any]

    def __new__(cls, cell: Session[Any], token: int) -> Self:
        """Make a marker of its token."""
        marker = int.__new__(cls, token)
        marker._cell = cell
        return marker

    @property
    def token(self) -> int:
        """Number and key in one integer, below 2**50; needed to signal and to free."""
        return int(self)

    @property
    def number(self) -> int:
        """Its number, which is enough to wait."""
        return int(self) & 1023

    @verb
    async def signal(self) -> None:
        """Signal it; once is enough, more has no effect."""
        await Session.signal_marker(self._cell, self)

    @verb
    async def wait(self, timeout: float | None = None) -> int:
        """Wait until it is signalled; return when that was [ns, CLOCK_MONOTONIC]."""
        return await Session.wait_marker(self._cell, self, timeout)

    @verb
    async def free(self) -> None:
        """Free it; who waits for it gets EPIPE."""
        await Session.free_marker(self._cell, self)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.number}>"

    __str__ = __repr__

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)


class Session(Generic[M]):
    """The connection to a daemon.

    Args:
        channel: the socket.
        waiter: what waits for answers on it.
    """

    _MARKER: ClassVar[type[MarkerVerbs]]

    def __init__(self, channel: Channel, waiter: Waiter) -> None:
        self._channel = channel
        self._waiter = waiter
        self._nodes: dict[int, Any] = {}
        self._drivers: dict[int, int] = {}
        """Processes that halt what a node owns before its close is answered, as far as they are known."""

    async def _ask(self, what: str, message: verbs.Message, limit_s: float | None = 0.0) -> Any:
        return (await self._waiter.call(Call(what, message, limit_s=limit_s))).value

    async def _closed_handle(self, handle: int) -> None:
        """Tell the daemon that a node was closed, and wait until its channels are free (nodes call this)."""
        self._nodes.pop(handle, None)
        driver = self._drivers.pop(handle, 0)
        try:
            await self._waiter.call(Call("close", verbs.Close(handle), through=driver))
        except OSError as error:
            # The session has ended, the daemon has gone, or knows no such handle any more: the driver has halted the
            # axes at the end of file of the node's own socket either way.
            if error.errno not in (errno.EIO, errno.EBADF) and not self._channel.ended:
                raise

    def _here(self, there_ns: int) -> int:
        """Return an instant of the cell's clock in that of this machine."""
        return there_ns if self._channel.clock is None else self._channel.clock.here(there_ns)

    @verb
    async def reserve_marker(self) -> M:
        """Reserve a marker; it is freed with the session."""
        return (await Session.reserve_markers(self, 1))[0]

    @verb
    async def reserve_markers(self, count: int, *, persist: bool = False) -> list[M]:
        """Reserve markers, all or none.

        Args:
            count: how many.
            persist: keep them beyond the end of the session.
        """
        tokens = await self._ask(f"reserve {count} markers", verbs.ReserveMarker(count, persist))
        marker: Any = self._MARKER
        return [marker(self, token) for token in tokens]

    @verb
    async def free_marker(self, token: int) -> None:
        """Free a marker; needs its token."""
        await self._ask("free marker", verbs.FreeMarker(token))

    @verb
    async def signal_marker(self, token: int) -> None:
        """Signal a marker; needs its token."""
        await self._ask("signal marker", verbs.SignalMarker(token))

    @verb
    async def wait_marker(self, number: int, timeout: float | None = None) -> int:
        """Wait until a marker is signalled; return when that was [ns, CLOCK_MONOTONIC]."""
        return self._here(int(await self._ask("wait for marker", verbs.WaitMarker(number, timeout), limit_s=timeout)))
