"""What has happened in a workcell, told from one look at it to the next. Pure."""

from __future__ import annotations

from collections import deque
from typing import Any

from .monitor_view import View, faults, name_of

MOST = 500
"""Events that are kept."""


class History:
    """Events, each a line with the time of day, oldest first.

    What lasts shorter than the time between two looks is not seen; the daemon's log has it.

    Example:
        >>> history = History()
        >>> history.look(View({}, [], "", "", 0, clock="12:00:00"))
        >>> history.look(View({}, [], "it has gone", "", 0, clock="12:00:01"))
        >>> list(history.lines)
        ['12:00:01 no daemon: it has gone']
    """

    def __init__(self) -> None:
        self.lines: deque[str] = deque(maxlen=MOST)
        self._before: dict[str, str] | None = None

    def look(self, view: View) -> None:
        """Note what has come, gone or changed since the last look."""
        now = _conditions(view)
        before, self._before = self._before, now
        if before is None:
            for text in now.values():
                self.add(view.clock, text)
            return
        for key, text in now.items():
            if key not in before or before[key] != text:
                self.add(view.clock, text)
        known = _known(view)  # of what cannot be seen nothing is known to have ended
        for key in [key for key in before if key not in now]:
            if key in known:
                self.add(view.clock, f"{key}: good again")
            else:
                now[key] = before[key]

    def add(self, clock: str, text: str) -> None:
        """Add an event."""
        self.lines.append(f"{clock} {text}".strip())


def _known(view: View) -> set[str]:
    """Return the keys of all that can be seen now, good or not."""
    known = set() if view.lost else {"daemon"}
    if view.status:
        known |= {
            "emergency stop",
            *(f"device {device['name']}" for device in view.status.get("devices", ())),
        }
    for node in view.nodes:
        if node.info is not None and node.snapshot is not None and node.age_s is None:
            known |= {name_of(node, channel) for channel in node.info.channels}
    return known


def _conditions(view: View) -> dict[str, str]:
    """Return what is wrong now: who to what, in words that do not change while it lasts."""
    found: dict[str, str] = {}
    if view.lost:
        found["daemon"] = f"no daemon: {view.lost}"
    status: dict[str, Any] = view.status
    if status.get("stopped_ns"):
        found["emergency stop"] = f"emergency stop: {status['stop_source']}"
    for device in status.get("devices", ()):
        if device["state"] != "up" or device["link"] != "good":
            why = device["reason"] or device["link_reason"]
            name = f"device {device['name']}"
            found[name] = f"{name}: {device['state']}, link {device['link']}{': ' if why else ''}{why}"
    for who, what in faults(view):
        found[who] = f"{who}: {what}"
    return found
