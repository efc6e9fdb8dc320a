"""The alarms of a workcell: what is wrong or was, who has acknowledged it, and what of that is kept. Pure but for
``AlarmFile``.

An alarm is latched: it stays in the list until the condition is over and somebody has acknowledged it, as in ISA-18.2.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from sioms.protocol.flags import Severity
from sioms.protocol.text import printable

MOST = 1000
"""Alarms that are kept; of more, those that are over go first, the oldest before the others."""
LARGEST = 1 << 20
"""Of the file [bytes]."""


@dataclass(slots=True)
class Alarm:
    """One alarm.

    Attributes:
        node: the node of one channel or bit that it is about, or a device.
        device: whose node that is.
        what: the column that is watched, "fault", "link" or "driver".
        severity: a Severity, at present.
        text: why, a sentence.
        since: when its severity changed last [s, UTC].
        worst: the greatest Severity since it was acknowledged, or since it began.
        times: how often it has become more severe since it was acknowledged, or since it began.
        by, at, note: who has acknowledged it, when [s, UTC], and what he said; by '': nobody.
    """

    node: str
    device: str
    what: str
    severity: int
    text: str
    since: float
    worst: int = 0
    times: int = 0
    by: str = ""
    at: float = 0.0
    note: str = ""

    @property
    def state(self) -> str:
        """unacknowledged, acknowledged, or returned: to normal, and nobody has acknowledged it."""
        if not self.severity:
            return "returned"
        return "acknowledged" if self.by else "unacknowledged"

    def packed(self) -> dict[str, Any]:
        """Return it as plain values, for clients."""
        return {**asdict(self), "state": self.state}


class AlarmList:
    """All alarms that are active or not acknowledged.

    Args:
        changed: called after each change with what has happened, in one word, and the alarm.
    """

    def __init__(self, changed: Callable[[str, Alarm], None] = lambda event, alarm: None) -> None:
        self._alarms: dict[tuple[str, str], Alarm] = {}
        self._changed = changed

    def __iter__(self) -> Iterator[Alarm]:
        return iter(list(self._alarms.values()))

    def take(self, node: str, device: str, what: str, severity: int, text: str, now_s: float) -> None:
        """Take what a condition is now.

        One that becomes worse than what was acknowledged has to be acknowledged again; one that was acknowledged is
        forgotten when it is over.
        """
        alarm = self._alarms.get((node, what))
        if alarm is None:
            if not severity:
                return
            alarm = self._alarms[node, what] = Alarm(node, device, what, 0, "", now_s)
            self._drop()
        before, alarm.severity = alarm.severity, severity
        if severity:  # of one that is over, it still stands what it was
            alarm.text = printable(text, 400)
        if severity == before:
            return
        alarm.since = now_s
        if severity > before:
            alarm.times += 1
        if severity > alarm.worst:
            alarm.worst, alarm.by, alarm.at, alarm.note = severity, "", 0.0, ""
        if not severity and alarm.by:
            del self._alarms[node, what]
        self._changed("raised" if severity > before else "eased" if severity else "returned", alarm)

    def acknowledge(self, alarms: Iterable[Alarm], by: str, note: str, now_s: float) -> list[Alarm]:
        """Acknowledge alarms; return those that nobody had acknowledged before."""
        done = [alarm for alarm in alarms if not alarm.by]
        for alarm in done:
            alarm.by, alarm.at, alarm.note = by, now_s, printable(note, 200)
            alarm.worst, alarm.times = alarm.severity, 0
            if not alarm.severity:
                del self._alarms[alarm.node, alarm.what]
            self._changed("acknowledged", alarm)
        return done

    def lose(self, device: str, text: str, now_s: float) -> None:
        """Take the watched channels of a device for unknown; faults of axes end with the process that had them."""
        for alarm in [alarm for alarm in self._alarms.values() if alarm.device == device]:
            if alarm.what == "fault":
                self.take(alarm.node, device, "fault", 0, "", now_s)
            elif alarm.what not in ("link", "driver") and alarm.severity:
                self.take(alarm.node, device, alarm.what, Severity.INVALID, text, now_s)

    def restore(self, entries: Iterable[dict[str, Any]]) -> None:
        """Go on with what was kept; what holds no more is told by its driver.

        Raises:
            TypeError, ValueError: they were not kept by ``entries``.
        """
        for entry in entries:
            alarm = Alarm(**entry)
            for field, kind in Alarm.__annotations__.items():
                value = getattr(alarm, field)
                if type(value).__name__ != kind and not (kind == "float" and type(value) is int):
                    raise ValueError(f"{field} is {value!r}; want {kind}")
            self._alarms[alarm.node, alarm.what] = alarm

    def entries(self) -> list[dict[str, Any]]:
        """Return what is to be kept."""
        return [asdict(alarm) for alarm in self._alarms.values()]

    def _drop(self) -> None:
        if len(self._alarms) > MOST:
            first = min(self._alarms.values(), key=lambda alarm: (bool(alarm.severity), alarm.since))
            del self._alarms[first.node, first.what]


class AlarmFile:
    """Where alarms are kept over the daemon's end: a line of JSON, written over the one before.

    Args:
        path: of the file.
    """

    def __init__(self, path: str) -> None:
        self.path = path

    def load(self) -> list[dict[str, Any]]:
        """Return what was kept.

        Raises:
            OSError, ValueError: it cannot be read, or is damaged.
        """
        try:
            fd = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError:
            return []
        with open(fd, "rb") as file:
            line = file.read(LARGEST).partition(b"\n")[0]
        found = json.loads(line or b"[]")
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise ValueError("it is not a list of alarms")
        return found

    def keep(self, entries: list[dict[str, Any]]) -> None:
        """Keep alarms; without any there is no file.

        Raises:
            OSError: they cannot be written.
        """
        if not entries:
            with suppress(FileNotFoundError):
                os.unlink(self.path)
            return
        data = json.dumps(entries, separators=(",", ":")).encode() + b"\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        fd = os.open(self.path, flags, 0o600)
        try:
            os.pwrite(fd, data, 0)  # one line in one call: a kill leaves the old one or this one
            os.ftruncate(fd, len(data))
        finally:
            os.close(fd)
