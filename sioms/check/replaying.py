"""The device of a trace as a process: ``python -m sioms.check.replaying TRACE --kind serial --link PATH``.

It says ``ready PORT`` and obeys ``report`` on standard input: the state of the replay as JSON.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from sioms.descriptors import readable
from sioms.simulation.control import obey

from .ends import Host, TcpHost, make_ends
from .traces import Replay, read_trace

LONGEST_S = 0.05


def main() -> int:
    """Serve until standard input ends."""
    parser = argparse.ArgumentParser(description="device that answers out of a trace")
    parser.add_argument("trace", type=Path)
    parser.add_argument("--kind", choices=("serial", "tcp", "udp"), required=True)
    parser.add_argument("--link", type=Path, default=Path("/nonexistent"))
    parser.add_argument("--line", type=int, default=0)
    parser.add_argument("--ignore", default="", help="places of a request that need not agree: 0:2,7:8")
    options = parser.parse_args()
    replay = Replay(read_trace(options.trace), options.line, places(options.ignore))
    host, _ = make_ends(options.kind, "" if options.kind == "tcp" else "127.0.0.1:9", options.link)
    print(f"ready {host.name}", flush=True)
    while _turn(host, replay):
        pass
    host.unplug()
    return 0


def places(text: str) -> list[tuple[int, int]]:
    """Return the places in ``0:2,7:8``."""
    pairs = [part.partition(":") for part in text.split(",") if part]
    return [(int(low), int(high)) for low, _, high in pairs]


def _turn(host: Host, replay: Replay) -> bool:
    now_ns = time.monotonic_ns()
    for data in replay.due(now_ns):
        host.write(data)
    wait_s = LONGEST_S if replay.next_ns is None else min(LONGEST_S, max(0, replay.next_ns - now_ns) / 1e9)
    for fd in readable([0, *host.fds()], wait_s):
        if fd == 0:
            line = sys.stdin.readline()
            if not line:
                return False
            print(obey(line, {"report": replay.report}), flush=True)
            continue
        asked = host.read(fd)
        if asked is None and isinstance(host, TcpHost):
            host.hang_up()
        if asked:
            replay.take(asked, time.monotonic_ns())
    return True


if __name__ == "__main__":
    sys.exit(main())
