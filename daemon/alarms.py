"""The alarms of a workcell: what is wrong or was, who has acknowledged it, and what of that is kept. Pure but for
``AlarmFile``.

An alarm is latched: it stays in the list until the condition is over and somebody has acknowledged it, as in ISA-18.2.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any

from sioms.protocol.flags import Severity
from sioms.protocol.text import printable

OF_CLIENTS = ("drift",)
"""What clients watch and tell: no driver knows it, so none ends it, and its death changes nothing about it."""
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
        what: the column that is watched, "fault", "link" or "driver", or one of OF_CLIENTS.
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
            elif alarm.what not in ("link", "driver", *OF_CLIENTS) and alarm.severity:
                self.take(alarm.node, device, alarm.what, Severity.INVALID, text, now_s)

    def restore(self, entries: Iterable[object]) -> str:
        """Go on with what was kept; what holds no more is told by its driver.

        Returns:
            Why entries were left out that ``entries`` has not made, '' for none.
        """
        why = ""
        for number, entry in enumerate(entries):
            try:
                alarm = _checked(entry)
            except (TypeError, ValueError) as error:
                why = why or f"entry {number}: {error}"
                continue
            self._alarms[alarm.node, alarm.what] = alarm
            self._drop()
        return why

    def entries(self) -> list[dict[str, Any]]:
        """Return what is to be kept."""
        return [asdict(alarm) for alarm in self._alarms.values()]

    def _drop(self) -> None:
        if len(self._alarms) > MOST:
            first = min(self._alarms.values(), key=lambda alarm: (bool(alarm.severity), alarm.since))
            del self._alarms[first.node, first.what]


_WHOLE = {"severity": max(Severity), "worst": max(Severity), "times": 1 << 53}
"""Greatest values of the whole numbers of an alarm."""
_TEXTS = {"node": 256, "device": 256, "what": 64, "text": 400, "by": 256, "note": 200}
"""Characters of its texts at most."""
_LAST_S = 1e11


def _checked(entry: object) -> Alarm:
    """Return the alarm that an entry of a file says.

    Raises:
        TypeError, ValueError: it is none.
    """
    if not isinstance(entry, dict):
        raise TypeError(f"a {type(entry).__name__}; want a table")
    alarm = Alarm(**entry)
    for field in Alarm.__annotations__:
        value = getattr(alarm, field)
        if field in _TEXTS:
            good = type(value) is str and len(value) <= _TEXTS[field] and value.isprintable()
        elif field in _WHOLE:
            good = type(value) is int and 0 <= value <= _WHOLE[field]
        else:
            good = type(value) in (int, float) and 0 <= value < _LAST_S
        if not good:
            raise ValueError(f"{field} is {printable(repr(value)[:200], 80)}")
    if not (alarm.node and alarm.what):
        raise ValueError("no node, or nothing that is watched")
    return alarm


class AlarmFile:
    """Where alarms are kept over the daemon's end: a line of JSON, replaced as a whole by the next one.

    Args:
        path: of the file.
    """

    def __init__(self, path: str) -> None:
        self.path = path

    def load(self) -> list[object]:
        """Return what was kept.

        Raises:
            OSError, ValueError: it cannot be read, or is damaged.
        """
        try:
            fd = self._open(os.O_RDONLY)
        except FileNotFoundError:
            return []
        try:
            line = os.read(fd, LARGEST + 1).partition(b"\n")[0]
        finally:
            os.close(fd)
        if len(line) > LARGEST:
            raise ValueError(f"it is larger than {LARGEST >> 20} MiB")
        try:
            found = json.loads(line)
        except RecursionError:
            raise ValueError("lists nested too deep") from None
        if not isinstance(found, list):
            raise ValueError("it is not a list of alarms")
        return found

    def _open(self, how: int) -> int:
        """Open the file, waiting for nobody."""
        fd = os.open(self.path, how | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o600)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise OSError(errno.EINVAL, "it is not a regular file", self.path)
        return fd

    def keep(self, entries: list[dict[str, Any]]) -> None:
        """Keep alarms; without any there is no file. What is kept is on the disk when this returns.

        Raises:
            OSError: they cannot be written; what was kept before is there still.
        """
        with suppress(FileNotFoundError):
            os.close(self._open(os.O_RDONLY))  # what is not a file is not replaced
        if entries:
            self._replace(json.dumps(entries, separators=(",", ":")).encode() + b"\n")
        else:
            with suppress(FileNotFoundError):
                os.unlink(self.path)
        folder = os.open(os.path.dirname(self.path) or ".", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _replace(self, data: bytes) -> None:
        fresh = f"{self.path}.new"
        with suppress(FileNotFoundError):
            os.unlink(fresh)  # of a daemon that was killed
        fd = os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with open(fd, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(fd)
            os.replace(fresh, self.path)
        except OSError:
            os.unlink(fresh)
            raise
