"""Handles: the connections of clients to this driver process, and what they are waiting for.

A handle is a socket, a pipe and, for its owner's death, a pidfd. All three belong to the kernel, so a client that dies in any way is noticed here directly, without the daemon. The client holds the other ends: nothing
it does to them makes a call of this process block.

Concurrency: owned by the driver process's one thread.
"""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import Access, Right
from sioms.protocol.messages import refusal, reply

from .blocks import AnyBlock
from .effects import Effects

if TYPE_CHECKING:
    from .writing import AxesWrite

MAX_WAITS = 64
LATER = object()
"""Returned instead of a value when the answer comes later."""


@dataclass(slots=True, eq=False)
class Handle:
    """One open node of one client.

    Attributes:
        number: the daemon's number of it.
        node: name it was opened by.
        who: whose it is, for messages.
        sock: socket to the client, non-blocking.
        wakes: writing end of the pipe that wakes the client, non-blocking.
        pidfd: the client's process, -1 when unknown.
        block: what it shows; ``channels`` of it, and one bit of them if ``bit`` >= 0.
        access: what it may do by its mode; ``exclusive`` says that it owns its channels.
        rights: what its user may do.
        effects: the instant that its answers carry.
        lease_ns: longest silence allowed to the client, 0 = any.
        every: the client is woken by every n-th publication; 0 = not; -1 = when a binary edge came.
        writing: writes of axis records that are not in the buffers yet, the oldest first.
        ahead: number of a write that is to follow, and the records that have come ahead of it.
        waits: unanswered requests by message number; each has a way to be ended.
        writes: whether it may write.
        axes: ``channels`` as plain integers.
        halted: whether the axes that it owns have been halted because it ends.
    """

    number: int
    node: str
    who: str
    sock: socket.socket
    wakes: int
    pidfd: int
    block: AnyBlock
    channels: NDArray[np.intp]
    bit: int
    access: Access
    exclusive: bool
    rights: Right
    lease_ns: int
    heard_ns: int
    effects: Effects
    every: int = 0
    countdown: int = 0
    writes_under_way: int = 0
    waits: dict[int, Wait] = field(default_factory=dict)
    writing: list[AxesWrite] = field(default_factory=list)
    ahead: tuple[int, list[bytes]] = (0, [])
    halted: bool = False
    writes: bool = field(init=False)
    axes: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.writes = self.exclusive and bool(self.access & Access.WRITE)
        self.axes = self.channels.tolist()

    def answer(self, number: int, value: object = None) -> None:
        """Reply to a request; a client that does not read is found dead later, by its socket or its lease."""
        self._send(reply(number, value, self.effects.last_ns))

    def refuse(self, number: int, errno_: int, text: str) -> None:
        """Refuse a request."""
        self._send(refusal(number, errno_, text, self.effects.last_ns))

    def tell_end(self, errno_: int, text: str) -> None:
        """Tell the client why its handle ends, before the socket closes."""
        self._send(refusal(0, errno_, text))

    def wake(self) -> None:
        """Make the client's end of the pipe readable."""
        try:
            os.write(self.wakes, b"\1")
        except OSError:
            return  # full: it has been readable for long; broken: its end of file is on its way

    def close(self) -> None:
        """Release the descriptors."""
        self.sock.close()
        os.close(self.wakes)
        if self.pidfd >= 0:
            os.close(self.pidfd)

    def _send(self, packet: bytes) -> None:
        try:
            self.sock.send(packet)
        except BlockingIOError:
            # A client that does not read its answers is as good as dead: what follows is its end of file.
            self.sock.shutdown(socket.SHUT_RDWR)
        except OSError:
            return


@dataclass(slots=True, eq=False)
class Wait:
    """A request that is answered later.

    Attributes:
        handle, number: what to answer.
        what: the request in words.
        deadline_ns: when it times out, None = never.
        ready: asked every tick; answers with (value,) when done, None while not; raises OSError to refuse.
        channels: axes it depends on: dropped buffers end it.
        cancelled: undoes what the wait has begun.
        looks: it changes nothing, it only waits for what readings show.
    """

    handle: Handle
    number: int
    what: str
    deadline_ns: int | None
    ready: Callable[[], tuple[Any] | None]
    channels: frozenset[int] = frozenset()
    cancelled: Callable[[], None] | None = None
    looks: bool = False


class Waits:
    """All waits of a driver process.

    Args:
        effects: where the effects of what has waited are noted.
    """

    def __init__(self, effects: Effects) -> None:
        self._effects = effects
        self._waits: list[Wait] = []

    def add(self, wait: Wait) -> None:
        """Keep a wait until it is ready, late, cancelled or its handle is gone.

        Raises:
            OSError: EAGAIN, the handle has too many.
        """
        if len(wait.handle.waits) >= MAX_WAITS:
            raise OSError(errno.EAGAIN, f"{wait.what}: {MAX_WAITS} requests of this handle wait already")
        wait.handle.waits[wait.number] = wait
        self._waits.append(wait)

    def check(self, now_ns: int, shown: Sequence[AnyBlock]) -> None:
        """Answer what is ready or late; cheap when nothing waits.

        Args:
            now_ns: the time [ns].
            shown: blocks that have just been published, as they are now.
        """
        if not self._waits:
            return
        for wait in list(self._waits):
            if wait.handle.waits.get(wait.number) is not wait:
                continue  # ended by what another has just brought about
            try:
                done = wait.ready()
            except OSError as error:
                self.end(wait, error.errno or errno.EIO, error.strerror or str(error))
                continue
            if done is not None:
                self._remove(wait)
                if not (wait.looks and any(wait.handle.block is block for block in shown)):
                    self._effects.note()
                wait.handle.answer(wait.number, done[0])
            elif wait.deadline_ns is not None and now_ns >= wait.deadline_ns:
                self.end(wait, errno.ETIMEDOUT, f"{wait.what}: not within its time-out")

    def end(self, wait: Wait, errno_: int, text: str) -> None:
        """End a wait with a refusal."""
        if self._remove(wait):
            if wait.cancelled is not None:
                wait.cancelled()
            wait.handle.refuse(wait.number, errno_, text)

    def end_where(self, condition: Callable[[Wait], bool], errno_: int, text: str) -> int:
        """End all waits that a condition holds for; return how many."""
        ended = [wait for wait in self._waits if condition(wait)]
        for wait in ended:
            self.end(wait, errno_, f"{wait.what}: {text}")
        return len(ended)

    def forget(self, handle: Handle) -> None:
        """Drop the waits of a handle that is gone."""
        for wait in list(handle.waits.values()):
            self._remove(wait)
            if wait.cancelled is not None:
                wait.cancelled()

    def _remove(self, wait: Wait) -> bool:
        if wait.handle.waits.pop(wait.number, None) is None:
            return False
        self._waits.remove(wait)
        return True
