"""Requests of clients to stop, to reset what is stopped, and to supervise.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Sequence

from sioms.protocol.text import printable
from sioms.protocol.verbs import EmergencyStop, Reset, Supervise

from .cell import Cell
from .clients import Clients
from .devices import DriverProcess, State
from .node_verbs import NodeVerbs
from .sessions import Refused, Session
from .stops import Stops
from .supervision import Supervision


class StopVerbs:
    """Stops on behalf of clients.

    Args:
        cell: the workcell.
        clients: what they may.
        stops: what stops the workcell and nodes.
        nodes: finds nodes for who asks.
        supervision: who supervises.
    """

    def __init__(self, cell: Cell, clients: Clients, stops: Stops, nodes: NodeVerbs, supervision: Supervision) -> None:
        self._cell = cell
        self._clients = clients
        self._stops = stops
        self._nodes = nodes
        self._supervision = supervision

    def emergency_stop(self, session: Session, message: EmergencyStop) -> None:
        """Stop the workcell, or a node."""
        name, why, or_all, word = message
        source = f"{session}" + (f": {printable(why, 80)}" if why else "")
        if not name:
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                raise Refused(
                    errno.EPERM,
                    f"emergency stop: {session.peer.user} has no right to stop; ask for a [[grant]]",
                )
            self._stops.stop_for(session.peer.pid, word, source, session.number)
            return
        try:
            node = self._nodes.find(session, "emergency stop", name, message.right)
        except Refused as error:
            if error.errno != errno.ENOENT or not or_all:
                raise
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                raise
            missing = f"{source} (of {printable(name, 80)}, which there is not)"
            self._stops.stop_workcell(missing, session.number)
            raise Refused(errno.ENOENT, f"{error}; the whole workcell has been stopped instead") from None
        try:
            self._stops.stop_node(node, source, session.number)
        except OSError as error:
            raise Refused(errno.EIO, f"emergency stop of {name}: {error.strerror}") from None

    def supervise(self, session: Session, message: Supervise) -> float:
        """Take a session for a supervisor of the workcell."""
        if not self._clients.rights.on_workcell(session.peer) & message.right:
            raise Refused(errno.EPERM, f"supervise: {session.peer.user} has no right to stop; ask for a [[grant]]")
        if not message.lease_s > 0:
            raise Refused(errno.EINVAL, f"supervise: lease {message.lease_s:g} s; want more than 0")
        return self._supervision.renew(session, message.lease_s)

    def _sent_ns(self, session: Session, said_ns: int) -> int:
        """Return when the reset that is served was sent, at the earliest [ns, CLOCK_MONOTONIC].

        Args:
            session: whose it is.
            said_ns: what a gateway has said of it; 0: nothing.
        """
        sent_ns = self._cell.timestamps.monotonic_ns(session.timestamp_ns)
        return min(sent_ns, said_ns) if said_ns else sent_ns

    def _refuse_unseen(
        self, what: str, sent_ns: int, devices: Iterable[DriverProcess], block: int = -1, channels: Sequence[int] = ()
    ) -> None:  # fmt: skip
        """Refuse a reset that was sent before a fault which somebody may know of by now: it would not be cleared."""
        for device in devices:
            if why := device.failed_since(sent_ns, block, channels):
                raise Refused(errno.EAGAIN, f"{what}: {why} after this was sent; see why, and reset again")

    def reset(self, session: Session, message: Reset) -> None:
        """Reset the workcell, or a node, or the fault of its device."""
        (name,) = message
        said_ns, session.said_ns = session.said_ns, 0
        if not name:
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                raise Refused(errno.EPERM, f"reset: {session.peer.user} has no right to write or administer every node")
            if self._supervision.missing:
                raise Refused(errno.EPERM, "reset: the workcell has no supervisor; start `sioms supervise`")
            devices = list(self._cell.devices.values())
            for each in devices:
                each.hear()  # what it tells may stop something
            if source := self._stops.hear_request():
                raise Refused(errno.EAGAIN, f"reset: a stop has just been requested ({source}); reset again")
            sent_ns = self._sent_ns(session, said_ns)
            if self._stops.stopped_since(sent_ns, session.number):
                by = self._stops.stopped_by()
                raise Refused(errno.EAGAIN, f"reset: stopped after this was sent ({by}); see why, and reset again")
            self._refuse_unseen("reset", sent_ns, devices)
            self._stops.reset_workcell(str(session), sent_ns, session.number)
            return
        node = self._nodes.find(session, "reset", name, message.right)
        device = self._cell.devices.get(node.device)
        if device is not None:
            device.hear()
        sent_ns = self._sent_ns(session, said_ns)
        if device is not None:
            self._refuse_unseen(f"reset {name}", sent_ns, [device], node.block, node.channels)
        if device is not None and device.state is State.FAULT:
            device.reset(sent_ns)
            self._cell.log("info", "reset", node=node.name, device=device.name, by=session)
            return
        self._stops.hear_request()
        latch = self._cell.shared.latch
        if latch.stopped_ns:
            raise Refused(errno.EPERM, f"reset {name}: the whole workcell is stopped ({latch.source}); reset that")
        if self._stops.stopped_since(sent_ns, session.number, node):
            by = self._stops.stopped_by(node)
            raise Refused(errno.EAGAIN, f"reset {name}: stopped after this was sent ({by}); see why, and reset again")
        try:
            self._stops.reset_node(node, str(session), sent_ns, session.number)
        except OSError as error:
            raise Refused(errno.EIO, f"reset {name}: {error.strerror}") from None
        if device is not None:
            device.reset(sent_ns)
