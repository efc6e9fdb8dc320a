"""A step of the wall clock changes nothing that moves, waits or runs out: who uses it is listed here, with what for."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]
SHOWN = {
    "daemon/alarm_keeper.py": "since when there has been an alarm, and when it was acknowledged",
    "daemon/log.py": "the stamp of a line",
    "daemon/stops.py": "since when something has been stopped, as text",
    "daemon/stop_record.py": "since when something has been stopped",
    "drivers/iio/driver.py": "stamps of a kernel that refuses the monotonic clock, brought to that as they come",
    "drivers/iio/simulator.py": "the clock of a simulated converter",
    "sioms/bridges/bluesky/flying.py": "the name of a recording",
    "sioms/bridges/mount/filesystem.py": "times of files, and of lines of their log",
    "sioms/bridges/ros2.py": "stamps of messages, which ROS 2 counts in UTC",
    "sioms/check/other_clock.py": "what stated uncertainties of UTC are compared with",
    "sioms/client/certificates.py": "whether a certificate has expired, to say so; TLS judges by itself",
    "sioms/client/wall.py": "the wall clock of a reading, for who asks for it",
    "sioms/gateway/certificates.py": "from when until when a certificate is valid",
    "sioms/reconcile/live/watch.py": "since when an axis drifts, as text",
    "sioms/reconcile/report/watch.py": "since when an axis drifts, as text",
    "sioms/recording": "the names and the beginning of recordings",
    "sioms/sdk/resets.py": "since when something has been stopped",
    "sioms/timestamps.py": "the age of packets; where the clock has been set, they are refused",
    "tools": "what a person reads",
}
"""Files and folders that look at the wall clock, and what for: none of it decides when something happens."""
TIME = {"time", "time_ns", "localtime", "gmtime", "ctime"}
DATE = {"now", "today", "utcnow", "fromtimestamp"}
SUSPECT = re.compile(r"\btime\s*\.\s*\w*time|from\s+time\b|\bdate(time)?\s*\.|CLOCK_(REALTIME|TAI)")
"""A text without any of these needs no reading."""


def wall_clocks(text: str) -> list[int]:
    """Return the lines in which a text asks for the time of day, or names the clock that can be set."""
    lines = []
    for node in ast.walk(ast.parse(text if SUSPECT.search(text) else "")):
        match node:
            case ast.Attribute(value=ast.Name("time"), attr=name) if name in TIME:
                lines.append(node.lineno)
            case ast.Attribute(value=ast.Name("datetime" | "date"), attr=name) if name in DATE:
                lines.append(node.lineno)
            case ast.Attribute(attr="CLOCK_REALTIME" | "CLOCK_TAI") | ast.Name(id="CLOCK_REALTIME" | "CLOCK_TAI"):
                lines.append(node.lineno)
            case ast.ImportFrom(module="time", names=names) if TIME & {name.name for name in names}:
                lines.append(node.lineno)
    return lines


@pytest.mark.parametrize(
    "text", ["time.time()", "from time import time", "clock = time.time_ns", "time.clock_gettime(time.CLOCK_REALTIME)"]
)
def test_a_wall_clock_is_seen(text: str) -> None:
    assert wall_clocks(text) == [1]


def test_only_what_is_shown_comes_from_the_wall_clock() -> None:
    found = {
        str(path.relative_to(TREE)): lines
        for folder in ("daemon", "drivers", "sioms", "tools")
        for path in sorted((TREE / folder).rglob("*.py"))
        if (lines := wall_clocks(path.read_text(encoding="utf-8")))
    }
    assert not {
        path: lines for path, lines in found.items() if not any(path == s or path.startswith(f"{s}/") for s in SHOWN)
    }


def test_timers_count_on_the_monotonic_clock() -> None:
    from sioms.sdk.rt import TimerFd

    timer = TimerFd()
    try:
        about = Path(f"/proc/self/fdinfo/{timer.fd}").read_text()
    finally:
        timer.close()
    assert "clockid: 1\n" in about
