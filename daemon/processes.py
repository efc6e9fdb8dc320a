"""The driver processes of a workcell: which run, what happens to them, and what that means for all others.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from sioms.protocol import driver_verbs
from sioms.protocol.flags import PageState
from sioms.protocol.journal import Note
from sioms.protocol.verbs import Message

from .alarm_keeper import AlarmKeeper
from .cell import Cell
from .devices import DriverProcess, State
from .fork_server import ForkServer
from .holds import Holds
from .loading import Plan
from .marker_verbs import MarkerVerbs
from .names import NameTable, part_name
from .needs import priorities
from .node_verbs import NodeVerbs
from .stops import Stops


class Processes:
    """What the daemon does when something happens to a device (Owner).

    Args:
        cell: the workcell.
        stops: what stops it when a device is lost that it depends on.
        alarms: of the workcell.
        nodes: who has which open.
        markers: of clients.
        settled: called when a device has come up or is lost.
        ended: called when all have ended after ``shutdown``.
    """

    def __init__(
        self, cell: Cell, stops: Stops, alarms: AlarmKeeper, nodes: NodeVerbs, markers: MarkerVerbs,
        settled: Callable[[], None], ended: Callable[[], None],
    ) -> None:  # fmt: skip
        self._cell = cell
        self._stops = stops
        self._alarms = alarms
        self._nodes = nodes
        self._markers = markers
        self._settled = settled
        self._ended = ended
        self._holds = Holds(cell, stops, nodes)
        self._fork_server: ForkServer | None = None
        self._options: dict[str, dict[str, Any]] = {}
        self._ending = False

    # --- what devices tell -----------------------------------------------------------------------

    def device_up(self, device: DriverProcess) -> None:
        """Give the new process the pages it reads, and its page to those that read it."""
        self._alarms.of_device(device.name, "driver", "")
        for other in self._cell.devices.values():
            for name in other.info.inputs:
                if other is device or self._cell.names.nodes[name].device == device.name:
                    self._send_input(other, name)
        self._nodes.tell_use()
        self._holds.look()
        self._nodes.retry_opens()
        self._settled()

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        """Void the handles of a process that is no more, and stop what is tied to it."""
        device.trouble = ""
        self._holds.device_gone(device)
        self._nodes.device_gone(device)
        self._alarms.gone(device, reason)
        if device.state is not State.DOWN and device.device.common.on_loss == "stop":
            self._stops.stop_workcell(f"device {device.name} lost: {reason}")
        if device.state is not State.DOWN:
            self._stops.look_at_inputs(device)
        self._settled()

    def device_hung(self, device: DriverProcess, reason: str) -> None:
        """Report a missed lease, and stop what is tied to the device."""
        self._cell.log("warning", "device late", device=device.name, reason=reason)
        self._alarms.hung(device, reason)
        if device.device.common.on_loss == "stop":
            self._stops.stop_workcell(f"device {device.name}: {reason}")
        self._stops.look_at_inputs(device)

    def device_ticks(self, device: DriverProcess) -> None:
        """Note that a driver that had missed its lease ticks again."""
        self._alarms.of_device(device.name, "driver", "")

    def device_message(self, device: DriverProcess, message: Message) -> None:
        """Take a notice of a driver."""
        match message:
            case driver_verbs.Detached(handle):
                self._nodes.detached(device, handle)
            case driver_verbs.MarkerSignalled(number):
                stamp_ns = self._cell.shared.markers.stamp_ns(number)
                self._cell.shared.journal.note(Note.MARKER, stamp_ns, device.name, number)
                self._markers.signalled()
            case driver_verbs.Stopped(source):
                self._stops.stop_workcell(source)
            case driver_verbs.StopsShown(at_ns):
                self._cell.shared.record.shown(at_ns, device.name)
            case driver_verbs.LinkChanged(number, reason):
                state = PageState(number)
                good = state in (PageState.GOOD, PageState.STARTING)
                self._cell.log(
                    "info" if good else "error",
                    "link",
                    device=device.name,
                    state=state.name.lower(),
                    reason=reason,
                )
                if state is not PageState.STARTING:
                    self._alarms.of_device(device.name, "link", "" if good else reason or state.name.lower())
                if not good and device.device.common.on_loss == "stop":
                    self._stops.stop_workcell(f"device {device.name}: {reason}")
                if not good:
                    self._stops.look_at_inputs(device)
            case driver_verbs.AlarmChanged(block, channel, bit, what, severity, text, at_ns):
                if what == "fault":
                    device.note_fault(block, channel, at_ns, text)
                node = part_name(device.info, block, channel, bit)
                self._alarms.take(node, device.name, what, severity, text)
            case driver_verbs.HeldSilent(name, why):
                self._holds.silent(device, name, why)
            case driver_verbs.LogLine(level, text):
                if text.startswith("fault of "):
                    device.note_trouble(text)
                self._cell.log(level, "driver", device=device.name, text=text)
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    def stopped_of(self, device: str) -> dict[str, Any]:
        """Return options of a driver: what is ``stopped`` from its start, as of how many ``resets`` of the workcell."""
        return {"stopped": self._stops.stopped_of(device), "resets": self._cell.shared.latch.resets}

    # --- their beginning and end -----------------------------------------------------------------

    def adopt(self, plan: Plan) -> ForkServer | None:
        """Fork from now on as a configuration wants; return the fork server of before, for the caller to close."""
        old, self._fork_server = self._fork_server, plan.fork_server
        of_all = self._bounded(priorities(plan.names, plan.config))
        self._options = {name: _options_of(name, plan, of_all[name]) for name in plan.config.devices}
        return old

    def _bounded(self, wanted: Mapping[str, int]) -> Mapping[str, int]:
        """Return the real-time priorities that drivers get: below that with which the daemon works."""
        precedence = self._cell.loop.precedence
        if precedence is None:
            return wanted
        for name, priority in wanted.items():
            if priority > precedence.most:
                self._cell.log("warning", "real-time priority", device=name, wanted=priority, given=precedence.most,
                               why="the daemon must be able to work before its drivers")  # fmt: skip
        given = {name: min(priority, precedence.most) for name, priority in wanted.items()}
        precedence.adopt(given.values())
        return given

    def take_up(self, plan: Plan, names: NameTable) -> None:
        """Start, replace and end devices, so that those of an adopted configuration run.

        Args:
            plan: the configuration.
            names: the nodes before it.
        """
        for name, device in list(self._cell.devices.items()):
            wanted = plan.config.devices.get(name)
            same = wanted == device.device and plan.names.devices[name].facts() == device.info.facts()
            if not same or {**self._options[name], "phase": 0} != {**device.options, "phase": 0}:
                self._cell.log("info", "device ends", device=name, why="removed" if wanted is None else "changed")
                self._retire(device)
        for name in plan.config.devices:
            self._start(name)
        for device in self._cell.devices.values():
            for name in device.info.inputs:
                if names.nodes.get(name) != self._cell.names.nodes[name]:
                    self._send_input(device, name)  # the name shows something else now

    def look(self, now_ns: int) -> None:
        """Look whether all are alive, and give those what they hold that do not have it."""
        self._holds.look()
        for device in list(self._cell.devices.values()):
            device.check(now_ns)
        if self._fork_server is not None and (why := self._fork_server.check(now_ns / 1e9)):
            self._cell.log("error", "fork server killed", why=why)

    def shutdown(self) -> None:
        """End all; nothing starts any more."""
        self._ending = True
        for device in list(self._cell.devices.values()):
            self._retire(device)
        self._maybe_end()

    def _maybe_end(self) -> None:
        if self._ending and not self._cell.leaving:
            if self._fork_server is not None:
                self._fork_server.close()
            self._ended()

    def fork_server_died(self, fork_server: ForkServer) -> None:
        """Have another one made when it is needed."""
        if fork_server is self._fork_server and not self._ending:
            self._cell.log("error", "fork server died")
            self._fork_server = None

    def _start(self, name: str) -> None:
        """Start a configured device that is not there yet; one that is leaving starts when it has left."""
        if self._cell.config is None or self._ending or name in self._cell.devices or name in self._cell.leaving:
            return
        device = DriverProcess(
            self._cell.loop, self._current_fork_server, self._cell.config.devices[name], self._cell.names.devices[name],
            self._cell.shared.fds, self, self._cell.log, self._options[name],
        )  # fmt: skip
        self._cell.devices[name] = device
        device.start()

    def _retire(self, device: DriverProcess) -> None:
        del self._cell.devices[device.name]
        self._cell.leaving[device.name] = device
        device.shutdown(lambda: self._left(device))

    def _left(self, device: DriverProcess) -> None:
        os.close(device.journal_fd)
        del self._cell.leaving[device.name]
        if self._cell.config is not None and device.name in self._cell.config.devices:
            self._start(device.name)
        self._maybe_end()

    def _current_fork_server(self) -> ForkServer:
        if self._fork_server is None:
            self._fork_server = ForkServer(self._cell.loop, self.fork_server_died)
        return self._fork_server

    def _send_input(self, reader: DriverProcess, name: str) -> None:
        node = self._cell.names.nodes[name]
        source = self._cell.devices.get(node.device)
        if source is None or reader.state is not State.UP or source.state is not State.UP:
            return
        try:
            reader.send(driver_verbs.Input(name, node.channels, node.bit), [source.page_fds[node.block]])
        except OSError as error:
            self._cell.log("warning", "input lost", device=reader.name, node=name, why=error.strerror)


def _options_of(name: str, plan: Plan, priority: int) -> dict[str, Any]:
    """Return what a driver is told beside its own settings."""
    return {
        "stop_sources": plan.stop_sources.get(name, []),
        "alarms": plan.alarms.get(name, []),
        "daemon_lease_s": plan.config.workcell.daemon_lease_s,
        "folder": plan.config.folder,
        "state_folder": plan.config.state_folder(os.environ),
        "realtime_priority": priority,
        # Golden-ratio steps: however many drivers there are, their ticks do not fall together. Those of one process
        # do: they need one wake.
        "phase": (plan.config.processes.index(plan.config.process_of(name)) * 0.6180339887) % 1.0,
    }
