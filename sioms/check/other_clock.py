"""A client whose machine has another clock than the cell's: a process in a time namespace of Linux, which knows the
true offset that the library has to find out.

    python -m sioms.check.other_clock ADDRESS OFFSET_S SESSIONS

prints one line of JSON: how far what it was told is from the truth, beside the errors that were stated.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any

from sioms.children import ends_with_us
from sioms.client.command import command
from sioms.client.workcell import Workcell

OFFSET_S = 100_000
"""What the clock of the client shows more than that of the cell."""


def available() -> bool:
    """Tell whether this user may make time namespaces here."""
    words = ["unshare", "--time", "--monotonic", str(OFFSET_S), "true"]
    try:
        return subprocess.run(words, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


def seen(address: str, sessions: int = 1, timeout_s: float = 600.0) -> dict[str, Any]:
    """Return what a client in a time namespace of its own has found.

    Args:
        address: of a gateway to a cell with the nodes of ``look``.
        sessions: how many it opens, one after the other.
        timeout_s: how long it may take [s].

    Returns:
        ``off``: of each instant it was told how far it is from the truth, and ``error``, what was stated [ns]; of UTC
        ``utc_off`` [ns]; ``instants``: the others, by name [ns].
    """
    words = [sys.executable, "-P", "-m", "sioms.check.other_clock", address, str(OFFSET_S), str(sessions)]
    done = subprocess.run(
        ["unshare", "--time", "--monotonic", str(OFFSET_S), *words], stdout=subprocess.PIPE, timeout=timeout_s,
        check=True, preexec_fn=ends_with_us(),
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def look(cell: Workcell, offset_ns: int, found: dict[str, Any]) -> None:
    """Compare what a session tells of ``mod0`` with the truth."""
    with cell.open("mod0", "rw", lease=5.0) as node:
        for snapshot in (node.read(), *node.history(node.read().number - 5)):
            ahead_ns = time.time_ns() - (time.monotonic_ns() - offset_ns)
            found["off"].append(snapshot.stamp_ns - snapshot.cell_stamp_ns - offset_ns)
            found["error"].append(snapshot.stamp_error_ns)
            found["utc_off"].append(snapshot.utc.ns - snapshot.cell_stamp_ns - ahead_ns)
        found["age"] = time.monotonic_ns() - node.read().stamp_ns


def instants(cell: Workcell) -> dict[str, int]:
    """Return how long ago each kind of instant of a session is, that of a start how far ahead [ns]."""
    found = {}
    marker = cell.reserve_marker()
    marker.signal()
    found["marker"] = time.monotonic_ns() - marker.wait(2.0)
    with cell.open("mod0", "rw", lease=5.0) as node:
        node.write(command(0, position=node.read().position[0], synch=True))
        found["synch"] = cell.synch(node) - time.monotonic_ns()
    with cell.open("io0.bit0", "rw", lease=5.0) as output, cell.open("io0.in.bit0") as wired:
        before = wired.read()
        output.set(1 - before.data[0])
        event = wired.wait_event(last=before, timeout=2.0)
        found["edge"] = time.monotonic_ns() - event.stamp_ns
        found["column"] = time.monotonic_ns() - wired.read().changed_ns[0]
    cell.emergency_stop_workcell("clocks")
    found["stop"] = time.monotonic_ns() - cell.status()["stopped_ns"]
    cell.reset()
    return found


def main(words: list[str]) -> None:
    """Be that client."""
    address, offset_s, sessions = words
    found: dict[str, Any] = {"off": [], "error": [], "utc_off": []}
    for _ in range(int(sessions)):
        with Workcell(address, "other") as cell:
            look(cell, int(offset_s) * 10**9, found)
    if int(sessions) == 1:
        with Workcell(address, "other") as cell:
            found["instants"] = instants(cell)
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
