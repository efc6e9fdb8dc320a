"""The recorder: looks into the rings of pages and journals often enough to miss nothing, and says what it missed.

It is an ordinary client of the daemon, in a process of its own: drivers and daemon wait for nothing that it does.
"""

from __future__ import annotations

import errno
import json
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from select import POLLIN, poll
from typing import Any

from sioms.client.workcell import Workcell, is_part
from sioms.protocol.flags import READONLY
from sioms.recording import mcap, messages
from sioms.recording.messages import Event, NodeFormat

from .files import Sink
from .taps import JournalTap, NodeTap
from .times import CellTime

PERIOD_S = (0.004, 0.04)
"""Least and longest time between two looks [s]; a third of the time that snapshots stay in the shortest ring. Most of a
look costs the same for any number of snapshots: at 20 ms the recorder took half as much again of a core.
"""
RETRY_S = 0.25
"""How often a node or a daemon that is gone is looked for [s]."""


class Recorder:
    """Everything that a workcell publishes and is told, into a sink.

    Args:
        sink: where it goes.
        connect: makes a session with the daemon.
        wanted: nodes; none: all.
        seen: called with each event, after it has been recorded.
        log: called with a sentence that its user shall see.

    Attributes:
        recorded: snapshots that are safe, by node.
        lost: snapshots that were overwritten before they were taken, by node.
        period_s: how long to wait until the next look [s].

    Concurrency: one thread.
    """

    def __init__(
        self, sink: Sink, connect: Callable[[], Workcell], wanted: Sequence[str] = (), *,
        seen: Callable[[Event], None] = lambda _event: None, log: Callable[[str], None] = lambda _text: None,
    ) -> None:  # fmt: skip
        self.recorded: dict[str, int] = {}
        self.lost: dict[str, int] = {}
        self._sink, self._connect, self._wanted = sink, connect, list(wanted)
        self._seen, self._log = seen, log
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels = 0
        self._taps: dict[str, tuple[NodeTap, NodeFormat]] = {}
        self._journals: dict[str, JournalTap] = {}
        self._pending: list[Event] = []
        self._sequence = 0
        self._retry_s = 0.0
        self._poll = poll()
        self._may_hear, self._over = True, False
        self.period_s = PERIOD_S[0]
        self._gone: list[Workcell] = []
        self.cell: Workcell | None = connect()
        self._time = CellTime(self.cell.clock)
        self._sink.define(mcap.metadata("sioms", _about(self.cell) | self._time.about()))
        self._events = self._channel(messages.EVENT, messages.EVENTS)
        try:
            self._sink.define(mcap.metadata("status", {"json": json.dumps(self.cell.status(), default=str)}))
            self._attach(self.cell)
        except OSError:
            self._release()
            raise
        missing = [name for name in self._wanted if name not in self._taps]
        if missing:
            entries = self.cell.nodes()
            nodes = ", ".join(entry.name for entry in entries if not is_part(entry, entries))
            raise OSError(
                errno.ENOENT, f"record {missing[0]}: no such node, or its device is not up; there are: {nodes}"
            )

    # --- what is in the file ---------------------------------------------------------------------

    def _schema(self, name: str, definition: str) -> int:
        if (name, definition) not in self._schemas:
            number = self._schemas[name, definition] = len(self._schemas) + 1
            self._sink.define(mcap.Schema(number, name, "ros2msg", definition.encode()).packed())
        return self._schemas[name, definition]

    def _channel(self, type_: tuple[str, str], topic: str) -> int:
        self._channels += 1
        self._sink.define(mcap.Channel(self._channels, self._schema(*type_), topic, "cdr").packed())
        return self._channels

    # --- what is read ----------------------------------------------------------------------------

    def _attach(self, cell: Workcell) -> None:
        """Open what is there and not open yet, journals first: a replay begins with the first node."""
        try:
            for device in ["", *[each["name"] for each in cell.status()["devices"]]] if self._may_hear else []:
                if device not in self._journals:
                    fds = cell.journal(device)
                    self._journals[device] = JournalTap(*fds, device or "daemon")
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.EROFS):
                raise
            self._may_hear = False
            self._tell("lost", text=f"commands, stops and faults are not recorded: {error.strerror}")
            self._log(f"only readings are recorded: {error.strerror}")
        entries = cell.nodes()
        alike = {(e.name, e.device, e.node_class, e.channels) for e in entries}
        for entry in entries:
            name = entry.name
            if name.endswith(READONLY) or entry.state != "up":
                continue
            parent = name.rpartition(".")[0]  # of a device with one channel both names show the same
            part = is_part(entry, entries) or (parent, entry.device, entry.node_class, entry.channels) in alike
            if name not in self._wanted if self._wanted else part:
                continue
            try:
                if name not in self._taps:
                    tap = NodeTap(cell, name, name if entry.read_only else name + READONLY)
                    self._add(name, tap)
                elif self._taps[name][0].is_over:
                    self._taps[name][0].open(cell)
                    self._tell("opened again", name, text="its driver process is another one")
            except OSError as error:
                self._log(f"{name}: {error.strerror}")
        self._poll = poll()
        self._poll.register(cell.fileno(), POLLIN)
        self._set_period()

    def _add(self, name: str, tap: NodeTap) -> None:
        form = NodeFormat(tap.info, tap.bit, self._channels + 1, self._schema, self._time.offset_ns)
        self._channels += len(form.channels)
        for channel in form.channels:
            self._sink.define(channel.packed())
        self._taps[name] = (tap, form)
        self.recorded[name] = self.lost[name] = 0

    def _tell(self, kind: str, node: str = "", text: str = "", **data: Any) -> None:
        """Record something about the recording itself."""
        self._pending.append(Event(self._time.now_ns(), 0, "recorder", kind, node, text=text, data=data or None))

    def _set_period(self) -> None:
        rings = [tap.ring_s for tap, _ in self._taps.values() if not tap.is_over]
        self.period_s = min(max(min(rings, default=1.0) / 3, PERIOD_S[0]), PERIOD_S[1])

    def look(self) -> int:
        """Take what is new and write it; return how many snapshots there were.

        Raises:
            OSError: it cannot be written.
        """
        parts, counts = [], dict[str, int]()
        for name, (tap, form) in self._taps.items():
            slots, lost = tap.take()
            if lost:
                self.lost[name] += lost
                last = int(slots[0, 0]) if slots is not None and len(slots) else 0
                text = f"{lost} snapshots before number {last} were overwritten before they were taken"
                self._tell("lost", name, text, snapshots=lost, before=last)
            if slots is not None and len(slots):
                counts[name] = len(slots)
                parts.append(form.messages(slots, self._time.shift_ns))
        events, self._pending = self._pending, []
        for source, journal in self._journals.items():
            found, lost = journal.take()
            events += [event.moved(self._time.shift_ns) for event in found]
            if lost:
                text = f"{lost} events of {source or 'the daemon'} were overwritten before they were taken"
                events.append(Event(self._time.now_ns(), 0, "recorder", "lost", text=text, data={"events": lost}))
        for event in events:
            self._sequence += 1
            when_ns = event.stamp_ns + self._time.offset_ns
            parts.append(mcap.message(self._events, self._sequence, when_ns, event.packed()))
        if parts:
            self._sink.append(b"".join(parts))
        for name, count in counts.items():
            self.recorded[name] += count
        for event in events:
            self._seen(event)
        self._look_around(events)
        self._sink.look()
        return sum(counts.values())

    def _look_around(self, events: list[Event]) -> None:
        """See whether the daemon or drivers are others than before."""
        if self.cell is not None and self._poll.poll(0):
            self._gone.append(self.cell)  # its pages are read to their end
            self.cell = None
            for tap, _ in self._taps.values():
                tap.renew = True
            self._tell("daemon gone", text="the daemon has ended; drivers stop by themselves")
        self._look_at_rights()
        changed = any(
            event.source == "daemon" and event.kind == "log" and event.text == "device up" for event in events
        )
        over = self.cell is None or any(tap.is_over for tap, _ in self._taps.values())
        now_s = time.monotonic()
        if not changed and (not over or now_s < self._retry_s):
            return
        self._retry_s = now_s + RETRY_S
        if self.cell is None:
            with suppress(OSError):
                self.cell = self._connect()
                if self._time.resume(self.cell.clock):
                    self._tell("clock anew", text="the workcell's machine was started anew; stamps go on from before")
                self._tell("daemon back", text=f"connected to the daemon of {self.cell.name} again")
                for journal in self._journals.values():
                    journal.release()
                self._journals, self._may_hear = {}, True
        if self.cell is not None:
            with suppress(OSError):
                self._attach(self.cell)

    def _look_at_rights(self) -> None:
        """Let go of journals when the right to them has ended; at the end of a session they are read to their end."""
        over = self.cell is not None and any(journal.is_over for journal in self._journals.values())
        if over and self._over:  # seen twice: the end of a session would have been seen by now
            for journal in self._journals.values():
                journal.release()
            self._journals, self._may_hear = {}, False
            text = "commands, stops and faults are not recorded any more: the right to administer every node has ended"
            self._tell("lost", text=text)
            self._log(text)
        self._over = over

    def run(self, until: Callable[[], bool]) -> None:
        """Record until told to end.

        Raises:
            OSError: it cannot be written.
        """
        self._tell("began", text="recording begins")
        next_s = time.monotonic()
        while not until():
            self.look()
            next_s = max(next_s + self.period_s, time.monotonic())
            time.sleep(max(0.0, next_s - time.monotonic()))

    def close(self) -> None:
        """Take what is left, and end in order."""
        with suppress(OSError):
            self._tell("ended", text="recording ends", lost={name: lost for name, lost in self.lost.items() if lost})
            self.look()
        self._release()
        self._sink.close()

    def _release(self) -> None:
        """Let go of everything but the sink."""
        for tap, _ in self._taps.values():
            tap.release()
        for journal in self._journals.values():
            journal.release()
        for cell in [*self._gone, *([self.cell] if self.cell is not None else [])]:
            cell.close()
        self.cell = None


def _about(cell: Workcell) -> dict[str, str]:
    """Return what a recording says of where it was made."""
    here = "://" not in cell.address
    return {
        "workcell": cell.name, "host": socket.gethostname() if here else cell.address, "recorder": socket.gethostname(),
        "began": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "boot": _boot() if here else "",
    }  # fmt: skip


def _boot() -> str:
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return file.read().strip()
    except OSError:
        return ""
