"""Handles: the connections of clients to this driver process, and what they are waiting for.

A handle is a socket, a pipe and, for its owner's death, a pidfd. All three belong to the kernel, so a client that dies
in any way is noticed here directly, without the daemon. The client holds the other ends: nothing it does to them makes
a call of this process block.

Concurrency: owned by the driver process's one thread.
"""

from __future__ import annotations

import errno
import os
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, NamedTuple, Protocol

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from sioms.protocol.flags import Access, Right
from sioms.protocol.journal import JournalWriter, Note
from sioms.protocol.messages import refusal, reply
from sioms.protocol.text import shown
from sioms.timestamps import pending_bytes

from .blocks import AnyBlock
from .effects import Effects
from .exchange import HookError

LOOKS_A_MS = 16
"""Waits of each user that are looked at, for every millisecond of a tick's period: some 20 us, 100 where all are
answered.
"""
LATER = object()
"""Returned instead of a value when the answer comes later."""


class Quota(NamedTuple):
    """What one user may have of a device at a time, over all his handles: requests that wait, and subscriptions."""

    waits: int
    subscriptions: int


class Came(NamedTuple):
    """How a packet came.

    Args:
        resets: how many resets had been seen when it was sent, at least; UNKNOWN: it may be older.
        timestamp_ns: of the kernel [ns, CLOCK_REALTIME].
        latest_ns: it is taken for no younger: what a gateway has told of when it was sent at the earliest [ns,
            CLOCK_MONOTONIC].
    """

    resets: int
    timestamp_ns: int
    latest_ns: int


UNKNOWN = -1


class Writing(Protocol):
    """A write of axis records that is not in the buffers yet, or a request that comes after such writes."""

    lacks_room: bool

    @property
    def axes(self) -> frozenset[int]:
        """The axes of the block that it is for."""

    @property
    def replaces(self) -> bool:
        """Whether it overtakes those before it, and ends them."""

    def leave(self) -> None:
        """Let the later writes of the handle have their turn."""


class Handle(Struct, eq=False):
    """One open node of one client.

    Attributes:
        number: the daemon's number of it.
        node: name it was opened by.
        who: whose it is, for messages; uid: his number.
        sock: socket to the client, non-blocking.
        wakes: writing end of the pipe that wakes the client, non-blocking.
        pidfd: the client's process, -1 when unknown; pid: its number, if it owns something and that is known.
        block: what it shows; ``channels`` of it, and one bit of them if ``bit`` >= 0.
        access: what it may do by its mode; ``exclusive`` says that it owns its channels.
        rights: what its user may do.
        effects: the instant that its answers carry.
        quota: what its user may have.
        lease_ns: longest silence allowed to the client, 0 = any.
        heard_ns: when the client last said something, as its lease knows; came_ns: when the last packet came.
        passed_on: whether a gateway tells when the client said what it passes on.
        every: the client is woken by every n-th publication; 0 = not; -1 = when a binary edge came.
        writing: writes of axis records that are not in the buffers yet, the oldest first.
        ahead: number of a write that is to follow, and the records that have come ahead of it.
        ahead_came: how the first of these came.
        waits: unanswered requests by message number; each has a way to be ended.
        writes: whether it may write.
        axes: ``channels`` as plain integers.
        halted: whether what it owns has been stopped because it ends.
        queued_bytes: how much of what lay in its socket when a reset was seen lies there still.
        reset_ns: when what it shows was reset last [ns, CLOCK_MONOTONIC].
        cut_short: errno and reason by axis, where its motion was ended for a reason of others while it waited for
            nothing: its next wait is told.
    """

    number: int
    node: str
    who: str
    uid: int
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
    quota: Quota
    came_ns: int = 0
    passed_on: bool = False
    every: int = 0
    countdown: int = 0
    writes_under_way: int = 0
    waits: dict[int, Wait] = field(default_factory=dict)
    writing: list[Writing] = field(default_factory=list)
    ahead: tuple[int, list[bytes]] = (0, [])
    ahead_came: Came = field(default_factory=lambda: Came(0, 0, 0))
    halted: bool = False
    queued_bytes: int = 0
    reset_ns: int = 0
    cut_short: dict[int, tuple[int, str]] = field(default_factory=dict)
    pid: int = 0
    writes: bool = False
    axes: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.writes = self.exclusive and bool(self.access & Access.WRITE)
        self.axes = self.channels.tolist()

    def begins_anew(self, axes: Iterable[int]) -> None:
        """Note that it has something else done with axes: how what it did before has ended tells nothing any more."""
        for axis in axes:
            self.cut_short.pop(axis, None)

    def note_reset(self, at_ns: int) -> None:
        """Note that what it shows has been reset [ns, CLOCK_MONOTONIC]: of what comes from before it matters when that
        was sent.
        """
        self.reset_ns = max(self.reset_ns, at_ns)
        self.queued_bytes = pending_bytes(self.sock)

    @property
    def is_in_doubt(self) -> bool:
        """Whether what comes next may have been sent before a reset: it lay there, or was under way on a network."""
        return self.queued_bytes > 0 or (self.passed_on and self.heard_ns < self.reset_ns)

    def took(self, size: int) -> None:
        """Note that a packet of so many bytes has been received; 0: there was none."""
        self.queued_bytes = max(0, self.queued_bytes - size) if size else 0

    def hear(self, now_ns: int) -> None:
        """Note that a packet of the client has come [ns, CLOCK_MONOTONIC]."""
        self.came_ns = now_ns
        if not self.passed_on:
            self.heard_ns = now_ns

    def answer(self, number: int, value: object = None) -> None:
        """Reply to a request; a client that does not read is found dead later, by its socket or its lease."""
        self._send(reply(number, value, self.effects.last_ns))

    def refuse(self, number: int, errno_: int, text: str) -> None:
        """Refuse a request."""
        self._send(refusal(number, errno_, text, self.effects.last_ns))

    def tell_end(self, errno_: int, text: str) -> None:
        """Tell the client why its handle ends, before the socket closes."""
        self._send(refusal(0, errno_, text))

    def cut(self) -> None:
        """Cut the connection: its end of file ends the handle, which halts what it owns."""
        with suppress(OSError):
            self.sock.shutdown(socket.SHUT_RDWR)

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
            self.cut()  # a client that does not read its answers is as good as dead
        except OSError:
            return


class Wait(Struct, eq=False):
    """A request that is answered later.

    Attributes:
        handle, number: what to answer.
        what: the request in words.
        deadline_ns: when it times out, None = never.
        ready: asked every tick; answers with (value,) when done, None while not; raises OSError to refuse.
        channels: axes that it depends on, or is for: when they are stopped, it ends.
        cancelled: undoes what the wait has begun.
        looks: it changes nothing, it only waits for what readings show.
        on_events: it is not ready before an event of the bank, or another request.
        refusal: with what it has ended, until its client is told: errno and sentence.
    """

    handle: Handle
    number: int
    what: str
    deadline_ns: int | None
    ready: Callable[[], tuple[Any] | None]
    channels: frozenset[int] = frozenset()
    cancelled: Callable[[], None] | None = None
    looks: bool = False
    on_events: bool = False
    refusal: tuple[int, str] | None = None


class Waits:
    """All waits of a driver process, looked at in turn: so many of each user a time.

    Args:
        effects: where the effects of what has waited are noted.
        journal: where refusals are noted.
        log: writes a line of a level to the daemon's log.

    Attributes:
        a_look: how many of each user are looked at after a publication.
        before: called before any are told that they have ended.
    """

    def __init__(self, effects: Effects, journal: JournalWriter, log: Callable[[str, str], None]) -> None:
        self.a_look = LOOKS_A_MS
        self.before: Callable[[], None] = lambda: None
        self._log = log
        self._effects = effects
        self._journal = journal
        self._of: dict[int, dict[Wait, None]] = {}
        self._idle: dict[tuple[int, frozenset[int]], bool] = {}

    def add(self, wait: Wait) -> None:
        """Keep a wait until it is ready, late, cancelled or its handle is gone.

        Raises:
            OSError: EAGAIN, its user has too many.
        """
        handle = wait.handle
        waiting = self._of.setdefault(handle.uid, {})
        if len(waiting) >= handle.quota.waits:
            raise OSError(
                errno.EAGAIN,
                f"{wait.what}: {len(waiting)} requests of user {handle.uid} wait at this device already, as many as "
                "waits of [quota] allows",
            )
        handle.waits[wait.number] = wait
        waiting[wait] = None

    @property
    def any(self) -> bool:
        """Whether anything waits."""
        return bool(self._of)

    def until_ns(self) -> int:
        """Return until when nothing can be answered unless there is an event [ns]; 0: now."""
        until_ns = 2**62
        for waiting in self._of.values():
            for wait in waiting if len(waiting) <= LOOKS_A_MS else ():
                if not wait.on_events or wait.refusal is not None:
                    return 0
                until_ns = min(until_ns, until_ns if wait.deadline_ns is None else wait.deadline_ns)
            if len(waiting) > LOOKS_A_MS:
                return 0
        return until_ns

    def check(self, now_ns: int, published: Sequence[AnyBlock]) -> None:
        """Answer what is ready or late, as far as it is looked at; cheap when nothing waits.

        Args:
            now_ns: the time [ns].
            published: blocks that have just been published, as they are now.
        """
        if not self._of:
            return
        self._idle.clear()
        for uid, waiting in list(self._of.items()):
            is_more = len(waiting) > self.a_look
            for wait in list(islice(waiting, self.a_look)):
                if wait not in waiting:
                    continue  # ended by what another has just brought about
                if is_more:
                    del waiting[wait]
                    waiting[wait] = None  # behind the others
                self._look(wait, now_ns, published)
            if not waiting:
                self._of.pop(uid, None)

    def _look(self, wait: Wait, now_ns: int, published: Sequence[AnyBlock]) -> None:
        try:
            done = wait.ready() if wait.refusal is None else None
        except OSError as error:
            self._refuse(wait, error.errno or errno.EIO, error.strerror or str(error))
            return
        except HookError:
            raise  # the driver may have done half of it: it stops its device
        except Exception as error:  # a mistake of ours costs this handle, as it does where nothing waits
            trace = "".join(traceback.format_exception(error)[-3:])
            self._log("error", f"{wait.what}: the driver failed to serve {wait.handle.who}: {trace}")
            self._refuse(wait, errno.EIO, f"{wait.what}: the driver failed: {shown(error)}")
            wait.handle.cut()
            return
        if wait.refusal is not None:
            self._refuse(wait, *wait.refusal)
        elif done is not None:
            self._remove(wait)
            if not (wait.looks and any(wait.handle.block is block for block in published)):
                self._effects.note()
            wait.handle.answer(wait.number, done[0])
        elif wait.deadline_ns is not None and now_ns >= wait.deadline_ns:
            self._refuse(wait, errno.ETIMEDOUT, f"{wait.what}: not within its time-out")

    def is_idle(self, block: AnyBlock, axes: frozenset[int]) -> bool:
        """Whether axes are idle, found out once for all who wait for it."""
        key = (id(block), axes)
        found = self._idle.get(key)
        if found is None:
            found = self._idle[key] = block.bank.is_idle(sorted(axes))  # type: ignore[union-attr]
        return found

    def end(self, wait: Wait, errno_: int, text: str) -> None:
        """End a wait with a refusal."""
        if wait in self._of.get(wait.handle.uid, ()) and wait.refusal is None:
            self._refuse(wait, errno_, text)

    def end_where(self, condition: Callable[[Wait], bool], errno_: int, text: str) -> list[Wait]:
        """End all waits that a condition holds for; return them.

        Nothing of them happens any more; beyond a few of each user, they are told so after the next publications.
        """
        ended: list[Wait] = []
        for waiting in list(self._of.values()):
            mine = [wait for wait in waiting if wait.refusal is None and condition(wait)]
            ended += mine
            if mine:
                self.before()
            for wait in mine[: self.a_look]:
                self._refuse(wait, errno_, f"{wait.what}: {text}")
            for wait in mine[self.a_look :]:
                wait.refusal = (errno_, f"{wait.what}: {text}")
                if wait.cancelled is not None:
                    wait.cancelled()
        return ended

    def end_block(self, block: AnyBlock, errno_: int, text: str) -> None:
        """End all waits for a block."""
        self.end_where(lambda w: w.handle.block is block, errno_, text)

    def end_axes(self, block: AnyBlock, axes: Iterable[int], errno_: int, text: str) -> list[Wait]:
        """End the waits for motion of some axes, and the writes to them that are not in the buffers; return them."""
        ours = {int(a) for a in axes}
        return self.end_where(lambda w: w.handle.block is block and not ours.isdisjoint(w.channels), errno_, text)

    def forget(self, handle: Handle) -> None:
        """Drop the waits of a handle that is gone."""
        for wait in list(handle.waits.values()):
            self._remove(wait)
            if wait.cancelled is not None:
                wait.cancelled()

    def _refuse(self, wait: Wait, errno_: int, text: str) -> None:
        if self._remove(wait):
            if wait.cancelled is not None:
                wait.cancelled()
            handle = wait.handle
            handle.refuse(wait.number, errno_, text)
            self._journal.note(Note.REFUSAL, time.monotonic_ns(), handle.node, handle.who, wait.number, errno_, text)

    def _remove(self, wait: Wait) -> bool:
        if wait.handle.waits.pop(wait.number, None) is None:
            return False
        waiting = self._of[wait.handle.uid]
        del waiting[wait]
        if not waiting:
            del self._of[wait.handle.uid]
        return True
