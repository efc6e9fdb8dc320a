"""Devices that are made of devices: the daemon opens for them the nodes that they hold, with its own authority.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import os
import socket

from sioms.protocol.driver_verbs import Held

from .cell import Cell
from .devices import DriverProcess
from .node_verbs import NodeVerbs
from .rights import Peer
from .sessions import Refused, Session
from .stops import Stops


class Holds:
    """Handles of devices on nodes of other devices; to the drivers that serve them they are clients as any other.

    Args:
        cell: the workcell.
        stops: what stops a node whose driver takes no orders.
        nodes: who has which open.
    """

    def __init__(self, cell: Cell, stops: Stops, nodes: NodeVerbs) -> None:
        self._cell = cell
        self._stops = stops
        self._nodes = nodes
        self._sessions: dict[str, Session] = {}

    def look(self) -> None:
        """Give each device what it holds and does not have yet, as far as that is there and free."""
        names = self._cell.names
        for device in self._cell.devices.values():
            contact = device.contact if device.info.holds else None
            if contact is None:
                continue
            session = self._session(device, *contact)
            has = {handle.node.name for handle in session.handles.values()}
            for name in device.info.holds:
                node = names.nodes.get(name)
                if name in has or node is None:
                    continue
                try:
                    held = self._nodes.hold(session, device.name, node, device.lease_s)
                except Refused:
                    continue  # its driver is about to be lost; the next look finds another
                if held is None:
                    continue
                handle, ours = held
                channels = [names.block(node).channels[channel].pack() for channel in node.channels]
                with ours:
                    try:
                        device.send(Held(name, channels), [ours.fileno()])
                    except OSError:
                        self._nodes.detach(handle)  # the end of the socket here does the same, a little later

    def silent(self, device: DriverProcess, name: str, why: str) -> None:
        """Stop a node whose driver takes no orders from who holds it, past its handles, and end that handle."""
        session, node = self._sessions.get(device.name), self._cell.names.nodes.get(name)
        handles = [h for h in session.handles.values() if h.node.name == name] if session is not None else []
        if node is None or not handles:
            return  # it has been taken from it meanwhile
        try:
            self._stops.stop_node(node, f"device {device.name}: {why}")
        except OSError as error:
            self._cell.log("error", "held node not stopped", node=name, by=device.name, why=error.strerror)
        for handle in handles:
            self._nodes.detach(handle)

    def device_gone(self, device: DriverProcess) -> None:
        """End what a process that is no more has held."""
        session = self._sessions.pop(device.name, None)
        for handle in list(session.handles.values()) if session is not None else ():
            self._nodes.detach(handle)

    def _session(self, device: DriverProcess, sock: socket.socket, pidfd: int) -> Session:
        session = self._sessions.get(device.name)
        if session is None:
            peer = Peer(device.pid, os.getuid(), f"device {device.name}", frozenset())
            session = self._sessions[device.name] = Session(sock, peer, pidfd)
        return session
