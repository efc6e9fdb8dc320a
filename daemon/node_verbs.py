"""Node requests of clients: list, information, open, close.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
import itertools
import math
import os
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from sioms.descriptors import enable_timestamps
from sioms.protocol.driver_verbs import Attach, Detach
from sioms.protocol.flags import READONLY, Access, Right
from sioms.protocol.journal import Note
from sioms.protocol.messages import refusal, reply
from sioms.protocol.verbs import Open
from sioms.wording import did_you_mean

from .cell import Cell
from .claims import Claims
from .clients import Clients
from .devices import DriverProcess, State
from .names import Claim, Node
from .rights import in_words
from .sessions import LATER, Handle, Refused, Session, Wait
from .suspended import Suspended
from .use import tell_use

_SEND_BUFFER = 1 << 18
_START_S = 1.5
"""How long an open that is not to wait for other clients waits for a device that is just starting; below the client's
grace.
"""
_AGAIN_S = 0.02
"""A driver that had no room for the message that ends a handle is told again after so long [s]."""


class NodeVerbs:
    """Nodes on behalf of clients: who has which open.

    Args:
        cell: the workcell: names and devices.
        clients: who asks, waits and is answered, and what they may.
    """

    def __init__(self, cell: Cell, clients: Clients) -> None:
        self._cell = cell
        self._clients = clients
        self._handles: dict[int, Handle] = {}
        self._open: Counter[str] = Counter()
        self._claims: Claims[Handle] = Claims()
        self._opens: list[tuple[Wait, Node, Callable[[], None]]] = []
        self._numbers = itertools.count(1)
        self._suspended = Suspended()
        self._then: list[tuple[set[int], Callable[[], None]]] = []

    def find(self, session: Session, what: str, name: str, right: Right = Right.READ) -> Node:
        """Return a node on which the session has a right, or one of several.

        Raises:
            Refused: ENOENT, EACCES.
        """
        node = self._cell.names.nodes.get(name)
        if node is None:
            raise Refused(
                errno.ENOENT,
                f"{what} of {name}: no such node{did_you_mean(name, self._cell.names.nodes)}",
            )
        if not self._clients.rights.on_node(session.peer, node.name) & right:
            raise Refused(
                errno.EACCES if right is Right.READ else errno.EPERM,
                f"{what} of {name}: {session.peer.user} has no right to {in_words(right, ' or ')} it; ask for a "
                "[[grant]]",
            )
        return node

    def open(self, session: Session, number: int, message: Open) -> Any:
        """Open a node, at once or when it becomes free."""
        name, mode, timeout_s, lease_s = message
        node = self._openable(session, name)
        if not 1 <= mode <= 3:
            raise Refused(errno.EINVAL, f"open {name}: mode {mode}; want read (1), write (2) or both (3)")
        access = Access(mode)
        if access & Access.WRITE and node.read_only:
            raise Refused(errno.EACCES, f"open {name} for writing: it is a read-only node; open it for reading")
        if not 0 <= float(lease_s) <= 3600:
            raise Refused(errno.EINVAL, f"open {name}: lease {lease_s} s; want 0 (none) to 3600")
        open_ones = self._clients.handles_of(session.peer)
        if why := self._cell.quotas.over(session.peer, "handles", open_ones, "nodes open"):
            raise Refused(errno.EMFILE, f"open {name}: {why}; close some")
        obstacle = self._obstacle(node)
        if obstacle is None:
            self._grant(session, number, node, access, float(lease_s))
            return LATER
        patient = timeout_s is None or float(timeout_s) > 0
        if not patient:
            if not self._is_starting(node):
                raise obstacle
            timeout_s = _START_S
        wait = self._clients.wait(session, number, timeout_s, f"open {name}")
        wait.why = lambda: str(self._obstacle(node) or "it has just become free").removeprefix(f"open {name}: ")

        def retry() -> None:
            try:
                if self._cell.names.nodes.get(node.name) != node:  # a reload came in between
                    why = f"open {name}: it has been removed or changed meanwhile; open it again"
                    raise Refused(errno.EIO, why)
                self._openable(session, name)
                obstacle = self._obstacle(node)
                if obstacle is not None:
                    if patient or self._is_starting(node):
                        return
                    raise obstacle
                if self._clients.drop(wait):
                    self._grant(session, number, node, access, float(lease_s))
            except Refused as error:
                self._clients.drop(wait)
                self._clients.send(session, refusal(number, error.errno, str(error)))

        self._opens.append((wait, node, retry))
        wait.forget = partial(self._forget_open, wait)
        return LATER

    def _openable(self, session: Session, name: str) -> Node:
        """Return a node that the session may open: asked first, and again whenever that may have changed.

        Raises:
            Refused: ENOENT, EACCES.
        """
        node = self.find(session, "open", name)
        if not node.read_only and not self._clients.rights.on_node(session.peer, node.name) & Right.WRITE:
            raise Refused(
                errno.EACCES,
                f"open {name}: {session.peer.user} has no right to write it; use {name}{READONLY} to observe",
            )
        return node

    def _obstacle(self, node: Node, device_of: str = "") -> Refused | None:
        """Return why a node cannot be opened now, or None.

        Args:
            node: it.
            device_of: the device that is to hold it; '' for a client.
        """
        holder = self._claims.holder(node)
        owner = self._cell.names.holder(node)
        if holder is None and owner and owner != device_of:
            return Refused(
                errno.EBUSY,
                f"open {node.name}: device {owner} drives it; command {owner}, or use {node.name}{READONLY} to observe",
            )
        if holder is not None:
            held_s = (time.monotonic_ns() - holder.since_ns) / 1e9
            other = "" if holder.node.name == node.name else f" through {holder.node.name}"
            return Refused(
                errno.EBUSY,
                f"open {node.name}: held by {holder.session} for {held_s:.1f} s{other}; use {node.name}{READONLY} to "
                "observe",
            )
        device = self._cell.devices.get(node.device)
        if device is None or device.state is not State.UP:
            state, reason = (
                (device.state.value, device.reason)
                if device
                else ("starting", "it has been reloaded")
                if self._cell.is_replaced(node.device)
                else ("gone", "no longer configured")
            )
            return Refused(
                errno.EIO,
                f"open {node.name}: device {node.device} is {state}" + (f": {reason}" if reason else ""),
            )
        return None

    def _is_starting(self, node: Node) -> bool:
        device = self._cell.devices.get(node.device)
        return self._cell.is_replaced(node.device) or (device is not None and device.state is State.STARTING)

    def hold(self, session: Session, holder: str, node: Node, lease_s: float) -> tuple[Handle, socket.socket] | None:
        """Give a device a node as its own, if that is free; the caller sends it the socket, and closes it here."""
        if self._obstacle(node, holder) is not None:
            return None
        handle, ours, readable = self._attach(session, node, Access.READ | Access.WRITE, lease_s)
        os.close(readable)
        return handle, ours

    def _grant(self, session: Session, number: int, node: Node, access: Access, lease_s: float) -> None:
        device = self._cell.devices[node.device]
        handle, ours, readable = self._attach(session, node, access, lease_s)
        try:
            behind = [os.getpid(), device.pid]
            value = [handle.number, self._cell.names.pack(node), node.channels, node.bit, behind]
            self._clients.send(session, reply(number, value), [device.page_fds[node.block], readable, ours.fileno()])
        finally:
            os.close(readable)
            ours.close()

    def _attach(
        self, session: Session, node: Node, access: Access, lease_s: float
    ) -> tuple[Handle, socket.socket, int]:
        """Have a driver serve a handle; return it, the client's end of its socket, and that of the wake pipe.

        Raises:
            Refused: EIO, the driver takes no messages.
        """
        device = self._cell.devices[node.device]
        rights = self._clients.rights.on_node(session.peer, node.name)
        now_ns = time.monotonic_ns()
        handle = Handle(next(self._numbers), session, node, access, now_ns, device.generation, rights)
        if node.read_only:
            access &= ~Access.WRITE
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        enable_timestamps(theirs)  # before the client can send
        readable, wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            fds = [theirs.fileno(), wake] + ([session.pidfd] if session.pidfd >= 0 else [])
            exclusive = not node.read_only
            try:
                device.send(
                    Attach(
                        handle.number, node.block, node.channels, node.bit, int(access), exclusive,
                        int(rights), math.ceil(lease_s * 1e9), str(session), session.peer.uid,
                        self._cell.quotas.of_device(session.peer.uid), node.name,
                    ),
                    fds,
                )  # fmt: skip
            except OSError as error:
                raise Refused(errno.EIO, f"open {node.name}: {error.strerror}") from None
            self._handles[handle.number] = session.handles[handle.number] = handle
            self._claims.take(handle.claims, handle)
            self._open[node.device] += 1
            if self._open[node.device] == 1:
                self.tell_use()
        except BaseException:
            os.close(readable)
            ours.close()
            raise
        finally:
            os.close(wake)
            theirs.close()
        return handle, ours, readable

    def retry_opens(self) -> None:
        """Try the waiting opens again, the oldest first, and ask again whether they may."""
        for _, _, retry in list(self._opens):
            retry()

    def _retry_those_for(self, freed: list[Claim]) -> None:
        """Try again the opens that wait for what has just become free, until somebody has it."""
        channels = {claim[:3] for claim in freed}
        for _, node, retry in list(self._opens):
            if self._claims.holder(node) is None and any(claim[:3] in channels for claim in node.claims()):
                retry()

    def close(self, session: Session, number: int, handle_number: int) -> Any:
        """Close a handle; answered when its driver has halted what it owned."""
        handle = session.handles.get(handle_number)
        if handle is None:
            raise Refused(errno.EBADF, f"close: this session has no handle {handle_number}")
        if handle.closing:
            raise Refused(errno.EBADF, f"close {handle.node.name}: it is already being closed")
        if handle.claims and self.detach(handle):
            handle.closing = number
            session.waits[number] = Wait(number, session, None, f"close {handle.node.name}")
            return LATER
        self._forget(handle)
        return None

    def detach(self, handle: Handle) -> bool:
        """Ask the driver to end a handle; its channels are free when the driver says so.

        Returns:
            Whether there is a driver to wait for.
        """
        device = self._cell.devices.get(handle.node.device)
        there = device is not None and device.generation == handle.generation and device.state is State.UP
        if device is not None and there:
            self._order_end(device, handle, 0, "")
            if handle.claims:
                return True
        self._forget(handle)
        return False

    def take_up_rights(self) -> None:
        """End what is open by a name that is no more, or by a right that was taken away."""
        for handle in list(self._handles.values()):
            name = handle.node.name
            lost = handle.rights & ~self._clients.rights.on_node(handle.session.peer, name)
            if self._cell.names.nodes.get(name) != handle.node:
                self._end(handle, errno.EIO, f"{name}: it has been removed or changed; open it again")
            elif lost:
                text = f"{name}: the right to {in_words(lost, ', ')} it was taken away; open it again"
                self._end(handle, errno.EACCES, text)

    def when_ended(self, then: Callable[[], None]) -> None:
        """Call back when all handles whose end has been decided have ended, perhaps at once."""
        ending = {handle.number for handle in self._handles.values() if handle.ending}
        if ending:
            self._then.append((ending, then))
        else:
            then()

    def end_suspended(self) -> None:
        """End the handles of clients that are stopped by a signal, or frozen: what they moved halts."""
        stopped = self._suspended.look(handle.session.peer.pid for handle in self.holders())
        for handle in [h for h in self.holders() if h.session.peer.pid in stopped]:
            who = "gateway" if handle.session.peer.key else "client"
            text = f"{handle.node.name}: its {who} was stopped, as by Ctrl-Z, or frozen; open it again"
            if self._end(handle, errno.ETIMEDOUT, text):
                self._cell.log("warning", "client stopped", node=handle.node.name, client=handle.session)

    def _end(self, handle: Handle, errno_: int, text: str) -> bool:
        """Have a handle end and its client told why; return whether that is news. It cannot get lost."""
        device = self._cell.devices.get(handle.node.device)
        if handle.ending or device is None or device.generation != handle.generation:
            return False  # the end of a driver process ends its handles
        handle.ending = True
        self._order_end(device, handle, errno_, text)
        return True

    def _order_end(self, device: DriverProcess, handle: Handle, errno_: int, text: str) -> None:
        try:
            device.send(Detach(handle.number, errno_, text))
        except OSError:
            if device.is_there and device.generation == handle.generation:
                self._cell.loop.after(_AGAIN_S, lambda: self._order_end(device, handle, errno_, text))

    def detached(self, device: DriverProcess, number: int) -> None:
        """The driver has ended a handle: its axes are being halted."""
        handle = self._handles.get(number)
        if handle is not None and handle.node.device == device.name:
            self._forget(handle)

    def _forget(self, handle: Handle) -> None:
        if self._handles.pop(handle.number, None) is None:
            return
        handle.session.handles.pop(handle.number, None)
        self._cell.shared.journal.note(Note.CLOSED, time.monotonic_ns(), handle.node.name, str(handle.session))
        self._open[handle.node.device] -= 1
        if not self._open[handle.node.device]:
            self.tell_use()
        self._claims.release(handle.claims)
        wait = handle.session.waits.get(handle.closing)
        if wait is not None:
            self._clients.answer(wait, reply(handle.closing, None, time.monotonic_ns()))
        if self._opens and handle.claims:
            self._retry_those_for(handle.claims)
        if self._then:
            self._tell_ended(handle.number)

    def _tell_ended(self, number: int) -> None:
        for entry in list(self._then):
            entry[0].discard(number)
            if not entry[0] and entry in self._then:
                self._then.remove(entry)
                entry[1]()

    def device_gone(self, device: DriverProcess) -> None:
        """Void all handles of a driver process that is no more."""
        for handle in [h for h in self._handles.values() if h.node.device == device.name]:
            self._forget(handle)
        self.retry_opens()

    def tell_use(self) -> None:
        """Tell drivers whether somebody reads them through other devices."""
        tell_use(self._cell, self.is_open)

    def is_open(self, device: str) -> bool:
        """Whether somebody has a node of a device open."""
        return self._open[device] > 0

    def holders(self) -> Iterator[Handle]:
        """Return the handles that own outputs."""
        return (handle for handle in self._handles.values() if handle.claims)

    def _forget_open(self, wait: Wait) -> None:
        """Drop an open that waits no longer."""
        self._opens = [entry for entry in self._opens if entry[0] is not wait]

    def listing(self, session: Session) -> list[object]:
        """Return the nodes that the session may read, and who holds them."""
        names = self._cell.names
        listed: list[object] = []
        for node in names.nodes.values():
            if self._clients.rights.on_node(session.peer, node.name) & Right.READ:
                holder = self._claims.holder(node)
                device = self._cell.devices.get(node.device)
                state = device.state.value if device else "gone"
                listed.append([
                    node.name, int(names.block(node).node_class), len(node.channels), node.read_only,
                    node.device, state, str(holder.session) if holder else "", node.bit,
                ])  # fmt: skip
        return listed
