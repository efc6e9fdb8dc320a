"""``sioms driver trace`` and ``sioms driver replay``."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sioms.children import ends_with_us
from sioms.documents import toml_text

from .daemon import Daemon
from .rigs import LINES
from .station import Peer, wait_for
from .traces import BadTrace, Trace, read_trace

SLOWER = 3.0
"""A replay may take so many times the trace's time before it is ended."""
LEAST_S = 8.0
START_S = 60.0


def run_trace(args: argparse.Namespace) -> int:
    """Run a daemon with a configuration and record a device's line until interrupted; return the exit status."""
    out = args.output or Path(f"{args.device}.trace")
    out.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="sioms-trace-") as folder:
        path = args.socket or str(Path(folder) / "siomsd.sock")
        environment = {**os.environ, "SIOMS_TRACE": f"{args.device}={out.resolve()}"}
        command = [
            sys.executable,
            "-P",
            "-m",
            "sioms.daemon.main",
            "--config",
            str(args.config),
            "--socket",
            path,
        ]
        daemon = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, preexec_fn=ends_with_us())
        print(f"recording {args.device} to {out}; commands reach it with SIOMS_SOCKET={path}", flush=True)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt, subprocess.TimeoutExpired):
            wait_for(lambda: out.exists() or daemon.poll() is not None, START_S, 0.02)
            daemon.wait(args.seconds)
            return daemon.returncode or 1  # it ended by itself
        with contextlib.suppress(KeyboardInterrupt, subprocess.TimeoutExpired):
            daemon.terminate()
            daemon.wait(10.0)
    return _told(out)


def _told(out: Path) -> int:
    if not out.exists():
        print(f"sioms driver trace: {out} was not written; is there a device of this name", file=sys.stderr)
        return 1
    messages = read_trace(out).messages
    sizes = [sum(len(m.data) for m in messages if m.way == way) for way in "><"]
    print(f"{len(messages)} messages, {sizes[0]} bytes to the device, {sizes[1]} from it")
    return 0


def run_replay(args: argparse.Namespace) -> int:
    """Let the driver of a trace speak with the trace; return 0 when it asked nothing that the trace does not hold."""
    try:
        trace = read_trace(args.trace)
        text, kind = configuration(trace)
    except BadTrace as error:
        print(f"sioms driver replay: {error}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="sioms-replay-") as folder:
        command = [
            sys.executable,
            "-P",
            "-m",
            "sioms.check.replaying",
            str(args.trace),
            "--kind",
            kind,
        ]
        command += ["--link", str(Path(folder) / "port"), "--ignore", args.ignore]
        peer = Peer(command, "replaying peer")
        try:
            with Daemon(text.replace("{port}", peer.port)) as daemon, daemon.cell("replay") as cell:
                report = _watch(peer, trace)
                link = next(d for d in cell.status()["devices"] if d["name"] == trace.header["device"])
        finally:
            peer.close()
    return _judged(report, link)


def _watch(peer: Peer, trace: Trace) -> dict[str, Any]:
    times = [m.t_ns for m in trace.messages] or [0, 0]
    limit_s = max(LEAST_S, SLOWER * (times[-1] - times[0]) / 1e9)
    report: dict[str, Any] = {}

    def ended() -> bool:
        nonlocal report
        report = peer.tell("report")
        return bool(report["finished"] or report["mismatch"])

    wait_for(ended, limit_s, 0.05)
    time.sleep(0.2)  # let the driver publish what it read last
    return report


def _judged(report: Mapping[str, Any], status: Mapping[str, Any]) -> int:
    print(
        f"{report['matched']} requests in the order of the trace, {report['again']} asked again, "
        f"{report['passed_count']} of the trace not asked, {report['left']} left; link {status['link']}"
    )
    for text in report["passed"]:
        print(f"  not asked: {text}")
    if report["mismatch"]:
        print(f"MISMATCH at {report['mismatch']}")
        return 1
    if not report["matched"]:
        print("MISMATCH: the driver asked nothing")
        return 1
    return 0


def configuration(trace: Trace) -> tuple[str, str]:
    """Return the configuration that a trace was recorded with, ``{port}`` for its port, and the kind of its line.

    Raises:
        BadTrace: the header does not tell it.
    """
    header = trace.header
    try:
        table: dict[str, Any] = {**header["table"], "driver": header["driver"]}
        line = dict(table["line"])
        kind = next(kind for kind in LINES if kind in line)
    except (KeyError, TypeError, StopIteration):
        raise BadTrace(
            "read the trace's header: no device, driver, and table with a line on serial, tcp or udp"
        ) from None
    line[kind] = "{port}"
    table["line"] = line
    cell = {"workcell": {"name": "replay"}, "device": {str(header["device"]): table}}
    try:
        return toml_text(cell), kind
    except TypeError as error:
        raise BadTrace(f"read the trace's header: {error}") from None
