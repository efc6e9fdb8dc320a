"""Alarm requests of clients: list, acknowledge, tell.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
from typing import Any

from sioms.protocol.flags import Right, Severity
from sioms.protocol.text import printable
from sioms.protocol.verbs import Acknowledge, TellAlarm

from .alarm_keeper import AlarmKeeper
from .alarms import OF_CLIENTS, Alarm
from .cell import Cell
from .clients import Clients
from .names import part_name, shows
from .node_verbs import NodeVerbs
from .sessions import Refused, Session


class AlarmVerbs:
    """Alarms on behalf of clients.

    Args:
        cell: the workcell: names and devices.
        clients: what they may.
        alarms: of the workcell.
        nodes: finds nodes for who asks.
    """

    def __init__(self, cell: Cell, clients: Clients, alarms: AlarmKeeper, nodes: NodeVerbs) -> None:
        self._cell = cell
        self._clients = clients
        self._alarms = alarms
        self._nodes = nodes

    def listing(self, session: Session) -> list[dict[str, Any]]:
        """List the alarms on what the session may read."""
        rights = self._clients.rights
        return [
            alarm.packed() for alarm in self._alarms if rights.on_node(session.peer, alarm.node) & Right.READ
        ]  # fmt: skip

    def acknowledge(self, session: Session, message: Acknowledge) -> list[dict[str, Any]]:
        """Acknowledge the alarms of a node or device, '' = all that the session may."""
        (name, note), nodes, alarms = message, self._cell.names.nodes, self._alarms
        what = f"acknowledge {name or 'all alarms'}"
        named = self._nodes.find(session, what, name, message.right) if name in nodes else None
        if name and named is None and name not in self._cell.devices:
            raise Refused(errno.ENOENT, f"{what}: no such node or device; `sioms alarms` lists all alarms")
        parts, others = list[Alarm](), list[Alarm]()
        for alarm in alarms:
            there = nodes.get(alarm.node)
            if alarm.node == name or (named and there and shows(named, there)):
                parts.append(alarm)
            elif name in ("", alarm.device):
                others.append(alarm)
        allowed = [a for a in others if self._clients.rights.on_node(session.peer, a.node) & message.right]
        if named is None and others and not parts + allowed:
            raise Refused(errno.EPERM, f"{what}: {session.peer.user} has no right to write or administer it")
        return [alarm.packed() for alarm in alarms.acknowledge(parts + allowed, str(session), note)]

    def tell(self, session: Session, message: TellAlarm) -> None:
        """Take what a client says of a condition that it watches."""
        name, what, severity, text = message
        where = f"tell an alarm of {name}"
        node = self._nodes.find(session, "tell an alarm", name, message.right)
        if what not in OF_CLIENTS:
            raise Refused(errno.EINVAL, f"{where}: {printable(what, 80)}; want one of: {', '.join(OF_CLIENTS)}")
        if severity not in (Severity.NONE, Severity.MINOR, Severity.MAJOR):
            raise Refused(errno.EINVAL, f"{where}: severity {severity}; want 0, 1 (minor) or 2 (major)")
        if len(node.channels) != 1:
            raise Refused(errno.EINVAL, f"{where}: it has {len(node.channels)} channels; want the node of one")
        part = part_name(self._cell.names.devices[node.device], node.block, node.channels[0], node.bit)
        said = f"{printable(text, 300)} [told by {session}]" if severity else ""
        self._alarms.take(part, node.device, what, severity, said)
