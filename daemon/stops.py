"""Stops of the workcell and of nodes: latched, kept, passed on to drivers, and reset.

What a stop is and why it outlives everything: docs/decisions/0140-a-stop-outlives-everything.md.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import time
from typing import Any

from sioms.protocol import driver_verbs
from sioms.protocol.stopfile import SOMEBODY
from sioms.protocol.stopjournal import NODE, PID, asked_ns, node_entry, parts_of, workcell_entry
from sioms.protocol.verbs import Message

from .cell import Cell
from .devices import DriverProcess
from .names import Node

FILE_CLOCK_NS = 10_000_000
"""How far the time of a file's last change may lie before it: the kernel's clock of files goes in ticks [ns]."""


class Stops:
    """The emergency stop of the workcell, and the stops of its nodes.

    Args:
        cell: the workcell.
    """

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._shared = cell.shared
        self._request_seen = self._shared.latch.answered_request

    def restore(self) -> None:
        """Be stopped from the beginning when it was so at the end."""
        stopped = self._shared.record.state
        if stopped.workcell:
            since = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(stopped.since_s))
            self._shared.latch.stop(time.monotonic_ns(), f"{stopped.workcell} (since {since})")
            self._cell.log("warning", "still stopped", source=self._shared.latch.source)
        for node, source in stopped.nodes():
            self._cell.log("warning", "still stopped", node=node, source=source)

    def stop_workcell(self, source: str, by: int = 0, asked_ns: int = 0) -> None:
        """Latch the emergency stop, wake every driver, and keep it.

        Args:
            source: who asks for it, and why.
            by: number of the session that does; 0: none.
            asked_ns: when that was, at the latest [ns, CLOCK_MONOTONIC]; 0: now.
        """
        latch, now_ns = self._shared.latch, time.monotonic_ns()
        self._shared.record.asked.note_all(asked_ns or now_ns, by)
        known = not latch.stop(now_ns, source) and not (
            source != latch.source and latch.source in (SOMEBODY, self._shared.request.source)
        )
        if not known:
            self._cell.log("warning", "emergency stop", source=source)
            latch.name_source(source)  # drivers see the request page before the message that says who
        self._wake_drivers()
        self._shared.record.look()
        if not known or not self._shared.record.state.workcell:
            self._note(workcell_entry(source, stop=True, named=True))

    def hear_request(self) -> str:
        """Obey the stop-request file, and what drivers note of that of a daemon before us; return who has asked for a
        stop that nobody had heard yet, '' for nobody.

        A client that could not reach us has asked the drivers directly; they have acted already, as a rule.
        """
        request, record = self._shared.request, self._shared.record
        record.look()
        elsewhere, record.elsewhere = record.elsewhere, []
        for source in elsewhere:
            self.stop_workcell(source)
        if (mark := request.mark) == self._request_seen:
            return elsewhere[0] if elsewhere else ""
        self._request_seen = mark
        source, heard = request.source, request.obeyed == mark
        self.stop_workcell(source, asked_ns=self._written_ns(mark))
        request.take(mark)
        return "" if heard and not elsewhere else source

    def _written_ns(self, mark: tuple[int, int]) -> int:
        """Return when a request was written to the file [ns, CLOCK_MONOTONIC]: as its word says, or the time of the
        file's change, if that is later, and they do not contradict each other; else at the latest; 0: that is not
        known.
        """
        word, changed_ns = mark
        written_ns = self._cell.timestamps.monotonic_ns(changed_ns)
        if written_ns and abs(word - written_ns) < FILE_CLOCK_NS:
            return min(max(word, written_ns), time.monotonic_ns())
        return written_ns and min(written_ns + FILE_CLOCK_NS, time.monotonic_ns())

    def stop_for(self, pid: int, word: int, source: str, by: int = 0) -> None:
        """Stop the workcell for a session. A request of this word, if its process has made it and nobody has heard it
        yet, is the same stop: clients write one ahead, for the drivers, in case that we hang. What another session of
        that process has asked for is another.
        """
        request = self._shared.request
        mark = request.mark
        is_same = mark[0] == word != 0 and request.pid == pid and request.mark == mark  # else somebody is just writing
        if is_same and mark == self._shared.latch.answered_request:
            return  # who has reset it had seen it
        if is_same:
            self._request_seen = mark
        else:
            self.hear_request()
        self.stop_workcell(source, by)
        if is_same:
            request.take(mark)

    def reset_workcell(self, who: str, sent_ns: int, by: int) -> None:
        """Clear the latch and give devices in fault another try; nothing moves by itself.

        Args:
            who: asks for it.
            sent_ns: when that was sent, at the earliest [ns, CLOCK_MONOTONIC].
            by: number of the session.
        """
        latch, record, answered = self._shared.latch, self._shared.record, self._request_seen
        record.look()
        marks = [answered, *self._shared.left]
        if self._shared.request.mark == answered:  # then what drivers have read there was before it, whatever its mark
            marks += record.state.requested
        entry = workcell_entry(who, stop=False, resets=latch.resets + 1, requests=marks)
        self._note(entry)  # first: a later stop is noted after it
        sent_ns = max(sent_ns, record.asked.own_of_any_ns(by))
        latch.reset(time.monotonic_ns(), answered, sent_ns)
        self._cell.log("warning", "reset", by=who)
        self.hear_request()  # what has been asked for since
        for device in self._cell.devices.values():
            device.tell(driver_verbs.StopChanged())
            device.reset(sent_ns)
        for device in self._cell.devices.values():
            self.look_at_inputs(device)  # as one that is still pressed, it stops the workcell again

    def stop_node(self, node: Node, source: str, by: int = 0) -> None:
        """Stop a node and keep that; one whose driver is not there starts stopped.

        Args:
            node: which.
            source: who asks for it, and why.
            by: number of the session.

        Raises:
            OSError: EIO, its driver takes no messages: it will be stopped when it is started again.
        """
        now_ns = time.monotonic_ns()
        self._shared.record.asked.note(*self._parts(node), now_ns, by)
        try:
            self._order(node, driver_verbs.NodeStop(*_shown(node), source, self._shared.latch.resets, now_ns))
        finally:
            self._note(self._node_entry(node, source, stop=True))
            self._cell.log("warning", "emergency stop", node=node.name, source=source)

    def stopped_since(self, instant_ns: int, by: int, node: Node | None = None) -> bool:
        """Return whether somebody else has stopped what is to be reset since an instant.

        Args:
            instant_ns: [ns, CLOCK_MONOTONIC].
            by: number of the session that is to reset it.
            node: which; None: the workcell, and with it all nodes.
        """
        record = self._shared.record
        record.look()
        asked, unshown = record.asked, record.unshown()
        if node is None:
            return bool(unshown) or asked.latest_of_any_ns(by) > instant_ns
        block, parts = self._parts(node)
        mine = {(*block, *part) for part in parts}
        return not mine.isdisjoint(unshown) or asked.latest_ns(*_masks(block, parts), by) > instant_ns

    def stopped_by(self, node: Node | None = None) -> str:
        """Return who has stopped a node, or the workcell or any of its nodes, in words that somebody is told."""
        self._shared.record.shown(time.monotonic_ns())
        if node is None:
            nodes = [f"{name}: {by}" for name, by in self._shared.record.state.nodes()]
            return self._shared.latch.source if self._shared.latch.stopped_ns else ", ".join(nodes[-2:])
        block, parts = self._parts(node)
        stopped = self._shared.record.state.parts
        return next((stopped[(*block, *part)][0] for part in parts if (*block, *part) in stopped), "it has been reset")

    def reset_node(self, node: Node, who: str, sent_ns: int, by: int) -> None:
        """Clear the stop and the faults of a node.

        The reset is noted first: a stop that its driver takes after the reset, and notes by itself, is noted after it.

        Args:
            node: which.
            who, sent_ns, by: as of ``reset_workcell``.

        Raises:
            OSError: EIO, its driver takes no messages.
        """
        record = self._shared.record
        record.look()
        before = [entry for entry in record.state.entries() if entry.get("device") == node.device]
        self._note(self._node_entry(node, who, stop=False))
        resets, now_ns = self._shared.latch.resets, time.monotonic_ns()
        try:
            sent_ns = max(sent_ns, record.asked.own_ns(*_masks(*self._parts(node)), by))
            self._order(node, driver_verbs.NodeReset(*_shown(node), who, resets, now_ns, sent_ns))
        except OSError:
            for entry in before:
                self._note(entry)
            raise
        self._cell.log("warning", "reset", node=node.name, by=who)

    def _order(self, node: Node, order: Message) -> None:
        """Send the driver of a node an order, which its next tick obeys first."""
        device = self._cell.devices.get(node.device) or self._cell.leaving.get(node.device)
        if device is not None and device.is_there:
            device.send(order)
            self._shared.latch.ordered()

    def _node_entry(self, node: Node, source: str, *, stop: bool) -> dict[str, Any]:
        (device, block), parts = self._parts(node)
        return node_entry(node.name, device, block, parts, source, stop=stop)

    def _parts(self, node: Node) -> tuple[tuple[str, str], list[tuple[int, int]]]:
        """Return device and block of a node, and its parts."""
        block = self._cell.names.devices[node.device].blocks[node.block]
        parts = [part for c in node.channels for part in parts_of(c, node.bit, block.channels[c].width)]
        return (node.device, block.name), parts

    def _note(self, entry: dict[str, Any]) -> None:
        try:
            self._shared.record.note(entry)
        except OSError as error:
            self._cell.log("error", "not kept", what=str(entry), path=self._shared.record.path, why=error.strerror)

    def stopped_of(self, device: str) -> list[list[Any]]:
        """Return what of a device is stopped and must be so from its driver's start."""
        record = self._shared.record
        record.look()
        record.by_drivers = [entry for entry in record.by_drivers if entry.get("device") != device]
        return self._shared.record.state.of_device(device)

    def _pass_on_stops(self) -> None:
        """Send on the stops of nodes that drivers have acknowledged which are not ours, as of a daemon before us.

        Only stops: what such a driver resets, it resets for itself.
        """
        record = self._shared.record
        entries, record.by_drivers = record.by_drivers, []
        for entry in entries:
            device = self._cell.devices.get(str(entry.get("device")))
            if device is None or not device.is_there or device.pid == entry[PID]:
                continue
            channels_of: dict[tuple[int, int], list[int]] = {}
            for _, name, channel, bit in record.state.still(entry):
                number = next((i for i, block in enumerate(device.info.blocks) if block.name == name), -1)
                if number >= 0 and channel < len(channels := device.info.blocks[number].channels):
                    channels_of.setdefault((number, bit if channels[channel].width else -1), []).append(channel)
            for (number, bit), stopped in channels_of.items():
                resets, at_ns = self._shared.latch.resets, min(asked_ns(entry), time.monotonic_ns())
                device.tell(driver_verbs.NodeStop(number, stopped, bit, str(entry["by"]), resets, at_ns))
                self._shared.latch.ordered()
            self._cell.log("warning", "emergency stop", node=entry[NODE], source=entry["by"], heard_by=entry[PID])

    def _wake_drivers(self) -> None:
        """Have processes look at the latch before their next tick, which looks anyway; of several devices in one, one
        looks for all: one that ticks, where there is one, as others may not have begun to listen.
        """
        told = set()
        for device in sorted(self._cell.devices.values(), key=lambda device: device.contact is None):
            if device.is_there and device.lives_in not in told:
                told.add(device.lives_in)
                device.tell(driver_verbs.StopChanged())

    def look_at_inputs(self, device: DriverProcess) -> None:
        """Stop the workcell when an input of a device that is to stop it cannot be read: it may be pressed."""
        for block, node in self._cell.watched_inputs.get(device.name, {}).items():
            if why := device.why_unreadable(block):
                self.stop_workcell(f"input {node} stops the workcell, and it cannot be read: {why}")
                return

    def look(self) -> None:
        """Take up what has been asked for and noted by others since the last look."""
        self.hear_request()
        self._shared.record.look()
        if (source := self._shared.record.state.workcell) and not self._shared.latch.stopped_ns:
            self.stop_workcell(source)  # a driver could not keep a stop
        self._pass_on_stops()


def _shown(node: Node) -> tuple[int, list[int], int]:
    """Return the block, the channels and the bit that a node shows."""
    return node.block, list(node.channels), node.bit


def _masks(block: tuple[str, str], parts: list[tuple[int, int]]) -> tuple[tuple[str, str], dict[int, int]]:
    """Return parts of a block as masks; see ``PartTimes``."""
    masks: dict[int, int] = {}
    for channel, bit in parts:
        masks[channel] = masks.get(channel, 0) | 1 << bit
    return block, masks
