"""The journal of stops: what is stopped outlives every process that acts on it.

A file of lines that are only ever appended, each one JSON object: a stop, or a reset, of the workcell or of a node.
Daemon and drivers append to it before they acknowledge the request; who starts reads it and finds what was stopped, by
whom, and that nobody has reset it since. A line is one write(2), which no death of a process can divide; what the power
takes from the last one, or a full disk, is found, and counts as a stop of the workcell. So the file is never empty.

From time to time the daemon appends a checkpoint, the state as of an earlier place in the file, and frees what lies
before that place.

Concurrency: any number of processes append; only the daemon makes checkpoints.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from .text import printable

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, TypeAlias

    from .stopfile import Mark

    Part: TypeAlias = tuple[str, str, int, int]
    """(device, block, channel, bit): a piece that can be stopped by itself; bit 0 for a channel without bits."""

NODE, WORKCELL, CHECKPOINT, PID, ASKED = "node", "workcell", "checkpoint", "pid", "asked"
RESETS, REQUEST, FILE, INODE = "resets", "request", "file", "inode"
MOST_REQUESTED = 64
"""Requests that drivers have obeyed, of which the journal knows at a time; of more it knows the last."""
MOST_PARTS = 1 << 20
"""Channels, and bits of channels, that an entry may name, and that may be stopped in all."""
LAST_S = 1e11
"""No entry is of a later time [s since 1970]: a calendar could not show it."""
_DAMAGE = (ValueError, TypeError, LookupError, ArithmeticError)
"""What an entry raises that is none."""


def node_entry(
    name: str, device: str, block: str, parts: Iterable[tuple[int, int]], source: str, *, stop: bool, pid: int = 0,
    at_ns: int = 0,
) -> dict[str, Any]:  # fmt: skip
    """Return the entry of the stop or the reset of a node: its name, its parts (channel, bit), and who did it.

    ``pid`` is that of the driver process in which it holds; 0: the daemon tells the driver. ``at_ns`` is when a stop
    was asked for [ns, CLOCK_MONOTONIC]; 0: unknown.
    """
    of_driver = {PID: pid} if pid else {}
    of_driver |= {ASKED: at_ns} if at_ns else {}
    return {
        NODE: name, "device": device, "block": block, "parts": _packed(parts), "stop": stop, "by": source, **of_driver,
    }  # fmt: skip


def asked_ns(entry: Mapping[str, Any]) -> int:
    """Return when the stop of an entry was asked for; of one by an alarm, when it can be known of at the latest [ns,
    CLOCK_MONOTONIC]; 0: unknown.
    """
    at_ns = entry.get(ASKED, 0)
    return at_ns if type(at_ns) is int else 0


def parts_of(channel: int, bit: int, width: int) -> list[tuple[int, int]]:
    """Return the parts of a channel of so many bits (0: it has none), or of one bit of it (-1: of all)."""
    return [(channel, bit)] if bit >= 0 else [(channel, b) for b in range(width or 1)]


def workcell_entry(
    source: str, *, stop: bool, named: bool = False, resets: int = 0, requests: Sequence[Mark] = (), inode: int = 0
) -> dict[str, Any]:  # fmt: skip
    """Return the entry of the stop or the reset of the workcell.

    Args:
        source: who did it, and why.
        stop: whether it is a stop.
        named: it says better who has stopped it.
        resets: how many resets there had been before a stop by the stop-request file; of a reset, with itself.
        requests: mark of the file that a driver obeys; of a reset, those that it answers, that of the file first.
        inode: of the file that a driver has read; 0: unknown.
    """
    marks = [list(mark) for mark in requests]
    known = {key: value for key, value in ((RESETS, resets), (REQUEST, marks), (INODE, inode)) if value}
    return {WORKCELL: "", "stop": stop, "by": source, **({"named": True} if named else {}), **known}


def file_entry(mark: Mark) -> dict[str, Any]:
    """Return the entry of a stop-request file that begins with a mark of which nobody has asked for anything; what has
    been asked for by another is noted before.
    """
    return {WORKCELL: "", FILE: list(mark)}


def _marks(entry: Mapping[str, Any]) -> list[Mark]:
    """Return the marks that an entry names; before version 6 these were words alone."""
    marks = entry.get(REQUEST, [])
    return [(int(word), int(changed_ns)) for word, changed_ns in ([[marks, 0]] if type(marks) is int else marks)]


def _packed(parts: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Return parts as [first channel, last channel, bits]: a node of 10,000 channels is one line of 60 bytes."""
    bits: dict[int, int] = {}
    for channel, bit in parts:
        bits[channel] = bits.get(channel, 0) | 1 << bit
    runs: list[list[int]] = []
    for channel in sorted(bits):
        if runs and runs[-1][1] == channel - 1 and runs[-1][2] == bits[channel]:
            runs[-1][1] = channel
        else:
            runs.append([channel, channel, bits[channel]])
    return runs


def _unpacked(runs: Iterable[Iterable[int]]) -> Iterable[tuple[int, int]]:
    left = MOST_PARTS
    for first, last, bits in runs:
        if not (0 <= first <= last < MOST_PARTS and 0 < bits < 1 << 64):
            raise ValueError(f"channels {first} to {last}, bits {bits:#x}")
        left -= (last - first + 1) * bits.bit_count()
        if left < 0:
            raise ValueError(f"more than {MOST_PARTS} parts")
        for channel in range(first, last + 1):
            yield from ((channel, bit) for bit in range(bits.bit_length()) if bits >> bit & 1)


@dataclass(slots=True)
class Stopped:
    """What is stopped.

    Attributes:
        workcell: who has stopped the workcell, '' when it is not stopped.
        since_s: when that was [s since 1970].
        parts: of nodes that are stopped: who did it, and the name of the node.
        resets: how many resets of the workcell there have been.
        answered: marks of the stop-request file of which nobody asks for anything: that of the file there is first,
            as the last reset has answered it.
        requested: marks that drivers have obeyed and no reset is known to have answered. They say something where the
            file is lost, or another daemon's (``INODE``): the daemon's own tells by itself what has been asked for.
        requested_by: who has asked by the first of them, and requested_s: when that was noted [s since 1970].
    """

    workcell: str = ""
    since_s: float = 0.0
    parts: dict[Part, tuple[str, str]] = field(default_factory=dict)
    resets: int = 0
    answered: list[Mark] = field(default_factory=list)
    requested: list[Mark] = field(default_factory=list)
    requested_by: str = ""
    requested_s: float = 0.0

    def apply(self, entry: Mapping[str, Any]) -> None:
        """Take an entry into account.

        Raises:
            ValueError, TypeError, LookupError, ArithmeticError: it is none.
        """
        if FILE in entry:
            word, changed_ns = entry[FILE]
            self.answered = [(int(word), int(changed_ns)), *self.answered][:MOST_REQUESTED]
            self.requested = []
            return
        stop, by = bool(entry["stop"]), printable(str(entry["by"]), 400)
        if WORKCELL in entry:
            self._apply_to_workcell(entry, stop, by)
            return
        name, device, block = (printable(str(entry[key]), 256) for key in (NODE, "device", "block"))
        if stop and len(self.parts) > MOST_PARTS:
            raise ValueError(f"more than {MOST_PARTS} parts")
        for channel, bit in _unpacked(entry["parts"]):
            if stop:
                self.parts.setdefault((device, block, channel, bit), (by, name))
            else:
                self.parts.pop((device, block, channel, bit), None)

    def _apply_to_workcell(self, entry: Mapping[str, Any], stop: bool, by: str) -> None:
        resets, marks = int(entry.get(RESETS, 0)), _marks(entry)
        if not stop:
            self.workcell, self.since_s, self.resets, self.answered = "", 0.0, max(self.resets, resets), marks
            self.requested = [mark for mark in self.requested if not self._has_answered(mark)]
            self.parts.clear()
            return
        if not 0 <= (at := float(entry["at"])) < LAST_S:
            raise ValueError(f"at {at} s")
        if not marks:
            if not self.workcell or entry.get("named"):
                self.workcell, self.since_s = by or "somebody", self.since_s or at
        elif marks[0] not in self.requested and (resets >= self.resets or not self._has_answered(marks[0])):
            if not self.requested:
                self.requested_by, self.requested_s = by or "somebody", at
            self.requested = [*self.requested, marks[0]][-MOST_REQUESTED:]

    def _has_answered(self, mark: Mark) -> bool:
        """Tell whether what was written to the file has been answered, be it that this is noted behind its reset. Who
        is held up between looking at the clock and writing is the last with an earlier word, and the clock of files may
        be set: both have to be earlier.
        """
        return any(mark == each or (mark[0] < each[0] and mark[1] < each[1]) for each in self.answered)

    def take(
        self, entry: Mapping[str, Any] | None, damage: str = "a line that is not an entry", now_s: float = 0.0
    ) -> None:
        """Take an entry of a journal into account; what is none stops the workcell, since now."""
        try:
            if entry is None:
                raise ValueError
            self.apply(entry)
        except _DAMAGE:
            if not self.workcell:
                self.workcell = f"the journal of stops, which is damaged: {damage}"
                self.since_s = now_s

    def still(self, entry: Mapping[str, Any]) -> list[Part]:
        """Return the parts of the stop of a node that are stopped still; none for what is no such stop."""
        try:
            device, block = printable(str(entry["device"]), 256), printable(str(entry["block"]), 256)
            parts = [(device, block, *part) for part in _unpacked(entry["parts"])] if entry["stop"] else []
        except _DAMAGE:
            return []
        return [part for part in parts if part in self.parts]

    def nodes(self) -> list[list[str]]:
        """Return the nodes that are stopped, in whole or in part, each [name, who did it]."""
        return [[name, by] for by, name in dict.fromkeys(self.parts.values())]

    def of_device(self, device: str) -> list[list[Any]]:
        """Return what is stopped of a device, each [block, [[first channel, last channel, bits], ...], who, name of the
        node].
        """
        groups: dict[tuple[str, str, str], list[tuple[int, int]]] = {}
        for (of, block, channel, bit), (by, name) in self.parts.items():
            if of == device:
                groups.setdefault((block, by, name), []).append((channel, bit))
        return [[block, _packed(parts), by, name] for (block, by, name), parts in groups.items()]

    def entries(self) -> list[dict[str, Any]]:
        """Return entries that lead from nothing to this state."""
        entries = []
        if self.resets or self.answered:
            entries.append(workcell_entry("", stop=False, resets=self.resets, requests=self.answered))
        if self.workcell:
            entries.append({**workcell_entry(self.workcell, stop=True), "at": self.since_s})
        for mark in self.requested:
            entry = workcell_entry(self.requested_by, stop=True, resets=self.resets, requests=[mark])
            entries.append({**entry, "at": self.requested_s})
        for device in dict.fromkeys(part[0] for part in self.parts):
            for block, runs, by, name in self.of_device(device):
                entries.append(node_entry(name, device, block, _unpacked(runs), by, stop=True))
        return entries


def channels_and_bits(runs: Iterable[Iterable[int]]) -> list[tuple[int, int]]:
    """Return the parts (channel, bit) of ``Stopped.of_device``."""
    return list(_unpacked(runs))


def replay(data: bytes, start: int, now_s: float) -> Stopped:
    """Return what is stopped after a journal.

    Args:
        data: of the file, from a place on.
        start: that place; above 0 there must be a checkpoint in what follows.
        now_s: the time [s since 1970], from which on a damaged journal stops the workcell.
    """
    state, at = Stopped(), start
    lines = _lines(data, start)
    found = next(((place, entry) for place, entry in reversed(lines) if entry and CHECKPOINT in entry), None)
    if found is None and start:
        state.take(None, f"the entries before byte {start} are lost", now_s)
    if found is not None:
        state, at = _from_checkpoint(*found, start, now_s)
    for place, entry in lines:
        if place >= at and not (entry and CHECKPOINT in entry):
            state.take(entry, f"it cannot be read at byte {place}", now_s)
    return state


def _from_checkpoint(place: int, checkpoint: Mapping[str, Any], start: int, now_s: float) -> tuple[Stopped, int]:
    """Return the state of the checkpoint at a place, and the place from which on entries add to it."""
    state = Stopped()
    try:
        for entry in checkpoint[CHECKPOINT]:
            state.apply(entry)
        if not start <= (at := int(checkpoint["from"])) <= place:
            raise ValueError(f"it is of byte {at}; want {start} to {place}")
        return state, at
    except _DAMAGE:
        state.take(None, "its checkpoint cannot be read", now_s)
        return state, start


def entries_from(data: bytes) -> tuple[list[dict[str, Any] | None], int]:
    """Return the entries of the whole lines in what has come to a journal, and how many bytes these are."""
    whole = data[: data.rfind(b"\n") + 1]
    return [entry for _, entry in _lines(whole) if not (entry and CHECKPOINT in entry)], len(whole)


def _lines(data: bytes, start: int = 0) -> list[tuple[int, dict[str, Any] | None]]:
    """Return the lines of a journal, each its place and its entry, None for what is none, as a last line without its
    end.
    """
    lines: list[tuple[int, dict[str, Any] | None]] = []
    *whole, rest = data.split(b"\n")
    for line in whole:
        if line.strip(b"\0"):
            lines.append((start, _entry(line)))
        start += len(line) + 1
    if rest.strip(b"\0"):
        lines.append((start, None))
    return lines


def _entry(line: bytes) -> dict[str, Any] | None:
    try:
        entry = json.loads(line.strip(b"\0"))
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None


class StopJournal:
    """An open journal.

    Args:
        fd: of the file, opened for reading and appending; closed by ``close``.

    Concurrency: one thread.
    """

    def __init__(self, fd: int) -> None:
        self.fd = fd

    def append(self, entry: Mapping[str, Any], at_s: float) -> None:
        """Append an entry; begin a line of its own, whatever has become of the last one.

        A stop that cannot be written damages the journal, which takes no room on the disk: whoever reads it finds that
        and stops the workcell. Of a reset that cannot be written nothing is left, so that what was stopped stays so.

        Args:
            entry: of a stop, a reset or a checkpoint.
            at_s: the time [s since 1970].

        Raises:
            OSError: it could not be written, as on a full disk.
        """
        line = json.dumps({"at": round(at_s, 3), **entry}, separators=(",", ":")).encode() + b"\n"
        size = os.fstat(self.fd).st_size
        if size and os.pread(self.fd, 1, size - 1) != b"\n":
            line = b"\n" + line
        try:
            if os.write(self.fd, line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            if entry.get("stop") and size:
                os.ftruncate(self.fd, max(1, size - 2))  # its last line is none then, whatever comes after it
            raise

    def close(self) -> None:
        """Close the file."""
        os.close(self.fd)
