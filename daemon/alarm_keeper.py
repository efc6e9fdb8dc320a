"""The daemon's alarms: what drivers tell and what it sees itself, in the list, in the log, and kept over its end.

Concurrency: everything runs in the daemon's loop, but for a thread that waits for the disk, so that nobody else does.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any

from sioms.protocol.flags import Reaction, Severity

from .alarms import OF_CLIENTS, Alarm, AlarmFile, AlarmList
from .cell import Cell
from .devices import DriverProcess, State
from .loading import Plan
from .names import Node, part_name
from .realtime import end_promptly
from .stops import Stops

KEPT_S = 0.1
"""How long a change may wait to be kept [s]."""
OF_DEVICES = ("driver", "fault", "link")
"""Alarms that nobody configures."""


class AlarmKeeper:
    """All alarms of a workcell.

    Args:
        cell: the workcell.
        stops: what stops it, or a node.
        path: of the file in which they are kept.
    """

    def __init__(self, cell: Cell, stops: Stops, path: str) -> None:
        self._cell = cell
        self._stops = stops
        self._list = AlarmList(self._changed)
        self._file = AlarmFile(path)
        self._is_kept, self._looks = True, False
        self._writer: threading.Thread | None = None
        self._failure = ""
        try:
            why = self._list.restore(self._file.load())
        except (OSError, ValueError) as error:
            why = str(error)
        if why:
            cell.log("error", "alarms of before lost", path=path, why=why)
        for alarm in self:  # of all others their drivers tell soon what is the matter now
            if alarm.what == "fault":
                self.take(alarm.node, alarm.device, "fault", Severity.NONE, "")

    def __iter__(self) -> Iterator[Alarm]:
        return iter(self._list)

    def take(self, node: str, device: str, what: str, severity: int, text: str) -> None:
        """Take what a condition is now; see AlarmList."""
        self._list.take(node, device, what, severity, text, time.time())

    def acknowledge(self, alarms: Iterable[Alarm], by: str, note: str) -> list[Alarm]:
        """Acknowledge alarms; return those that nobody had acknowledged before."""
        return self._list.acknowledge(alarms, by, note, time.time())

    def of_device(self, device: str, what: str, why: str) -> None:
        """Take what is wrong with the link to a device, or with its driver; '' = nothing."""
        self.take(device, device, what, Severity.MAJOR if why else Severity.NONE, why)

    def look_at_plan(self, plan: Plan) -> None:
        """Take for over what nobody watches any more by the configuration of now."""
        watched = {
            (part_name(plan.names.devices[device], block, channel, bit), what)
            for device, rules in plan.alarms.items() for block, channel, bit, what, *_ in rules
        }  # fmt: skip
        for alarm in self:
            of_device = alarm.what in OF_DEVICES and alarm.device in plan.config.devices
            of_client = alarm.what in OF_CLIENTS and alarm.node in plan.names.nodes
            if not of_device and not of_client and (alarm.node, alarm.what) not in watched:
                self.take(alarm.node, alarm.device, alarm.what, Severity.NONE, "")

    def hung(self, device: DriverProcess, reason: str) -> None:
        """Take a driver for one that does not watch."""
        self.of_device(device.name, "driver", reason)
        self._react(device, reason)

    def gone(self, device: DriverProcess, reason: str) -> None:
        """Take what a driver has watched for unknown; of one that was told to end, its successor tells."""
        if device.state is State.DOWN:
            for alarm in self:
                if alarm.device == device.name and alarm.what in OF_DEVICES:
                    self.take(alarm.node, alarm.device, alarm.what, Severity.NONE, "")
            return
        self.of_device(device.name, "driver", reason)
        self._list.lose(device.name, f"its driver does not watch it: {reason}", time.time())
        for block, channel, bit, what, *_ in device.options.get("alarms", ()):
            node = part_name(device.info, block, channel, bit)
            self.take(node, device.name, what, Severity.INVALID, f"its driver does not watch it: {reason}")
        if not device.hung:
            self._react(device, reason)

    def _react(self, device: DriverProcess, reason: str) -> None:
        """Stop what alarms stop that cannot be judged: their driver does not."""
        names = self._cell.names.nodes
        for *_, reaction, name, _ in device.options.get("alarms", ()):
            source = f"alarm of {name}: its driver does not watch it: {reason}"
            nodes: list[Node] = []
            match Reaction(reaction):
                case Reaction.STOP_WORKCELL:
                    self._stops.stop_workcell(source)
                case Reaction.STOP_NODE:
                    nodes = [names[name]] if name in names else []
                case Reaction.STOP_DEVICE:
                    nodes = [
                        Node(device.name, device.name, i, tuple(range(len(block.channels))), -1, False)
                        for i, block in enumerate(device.info.blocks) if block.writable
                    ]  # fmt: skip
            for node in nodes:
                with suppress(OSError):  # it is noted, and holds when the driver is there again
                    self._stops.stop_node(node, source)

    def _changed(self, event: str, alarm: Alarm) -> None:
        by = {"by": alarm.by, "note": alarm.note} if event == "acknowledged" else {}
        self._cell.log(
            "warning" if event == "raised" else "info", "alarm", device=alarm.device, node=alarm.node, what=alarm.what,
            change=event, severity=Severity(alarm.severity).name.lower(), text=alarm.text, **by,
        )  # fmt: skip
        self._is_kept = False
        if not self._looks:
            self._look_later()

    def _look_later(self) -> None:
        self._looks = True
        self._cell.loop.after(KEPT_S, self._look)

    def _look(self) -> None:
        """Have kept what has changed, when what was to be kept before is; and look how that ended."""
        self._looks = False
        if self._writer is not None and self._writer.is_alive():
            self._look_later()
            return
        self._tell()
        if not self._is_kept:
            self._is_kept = True
            self._writer = threading.Thread(target=self._keep, args=(self._list.entries(),), daemon=True, name="alarms")
            try:
                self._writer.start()
            except RuntimeError:  # no memory, or no more threads
                self._writer = None
                self._keep(self._list.entries())
            self._look_later()

    def _keep(self, entries: list[dict[str, Any]]) -> None:
        if threading.current_thread() is self._writer:
            end_promptly()
        try:
            self._file.keep(entries)
        except OSError as error:
            self._failure = error.strerror or str(error)

    def _tell(self) -> None:
        if self._failure:
            self._cell.log("error", "not kept", what="alarms", path=self._file.path, why=self._failure)
            self._failure = ""

    def close(self) -> None:
        """Keep what has changed last."""
        if self._writer is not None:
            self._writer.join()
        if not self._is_kept:
            self._keep(self._list.entries())
        self._tell()
