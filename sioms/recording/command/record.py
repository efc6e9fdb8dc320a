"""``sioms record``: record everything, or some nodes."""

from __future__ import annotations

import argparse
import re
import sys
import time
from typing import Any

from sioms.arguments import LARGEST, positive
from sioms.client.workcell import Workcell
from sioms.ending import on_end
from sioms.prompt import be_prompt
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder


def size(text: str) -> int:
    """Return the bytes that a size in words means, as 500M or 2G.

    Raises:
        argparse.ArgumentTypeError: it is none.

    Example:
        >>> size("2k"), size("1.5M")
        (2000, 1500000)
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", text)
    bytes_ = float(match[1]) * 1000.0 ** (" kMGT".index(match[2]) if match[2] else 0) if match else 0.0
    if not 1.0 <= bytes_ <= LARGEST:
        raise argparse.ArgumentTypeError(f"{text!r}: want a size, as 500M or 2G")
    return int(bytes_)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    one = subparsers.add_parser(
        "record",
        help="record readings, commands and events",
        description="Record every publication of every node, and commands, refusals, markers, stops, faults and log "
        "lines, until interrupted. What has been recorded survives if the recorder is killed.",
    )
    one.add_argument("nodes", metavar="NODE", nargs="*", help="nodes to record (default: all)")
    one.add_argument("-o", "--output", metavar="FILE", required=True, help="MCAP file to write")
    one.add_argument("-t", "--time", type=positive, metavar="SECONDS", help="stop after SECONDS")
    rotation = "begin a new file after"
    one.add_argument("--rotate-size", type=size, default=0, metavar="SIZE", help=f"{rotation} SIZE, as 500M or 2G")
    one.add_argument("--rotate-time", type=positive, default=0.0, metavar="SECONDS", help=f"{rotation} SECONDS")
    one.add_argument("--no-pack", action="store_true", help="do not compress and index files at the end")
    one.add_argument("-v", "--verbose", action="store_true", help="print the amount recorded once a second")


def run(args: argparse.Namespace) -> int:
    """Record; return the exit status: 1 if the recording ended before it was to."""
    ended = False

    def end() -> None:
        nonlocal ended
        ended = True

    sink = LiveFile(args.output, args.rotate_size, args.rotate_time, pack=not args.no_pack)
    name = "sioms record"
    try:
        recorder = Recorder(sink, lambda: Workcell(name=name), args.nodes, log=_say)
    except OSError:
        sink.drop()
        raise
    on_end(end)
    be_prompt()
    began_s = told_s = time.monotonic()

    def until() -> bool:
        nonlocal told_s
        now_s = time.monotonic()
        if args.verbose and now_s >= told_s + 1:
            told_s = now_s
            print(f"{now_s - began_s:.0f} s: {_sum(recorder)}", flush=True)
        return ended or (args.time is not None and now_s - began_s >= args.time)

    status = 0
    try:
        recorder.run(until)
    except OSError as error:
        status = 1
        why = error.strerror or str(error)
        print(f"sioms record: {why}; the recording has ended, what came before is whole", file=sys.stderr)
        alarm(recorder, f"recording has ended: {why}")
    recorder.close()
    print(f"{sink.path}: {_sum(recorder)}", file=sys.stderr)
    return status


def _say(text: str) -> None:
    print(f"sioms record: {text}", file=sys.stderr)


def alarm(recorder: Recorder, text: str) -> None:
    """Report a problem in the daemon's log and status."""
    try:
        if recorder.cell is not None:
            recorder.cell.report("error", text)
    except OSError as error:
        print(f"sioms record: the daemon could not be told: {error.strerror}", file=sys.stderr)


def _sum(recorder: Recorder) -> str:
    lost = {name: count for name, count in recorder.lost.items() if count}
    rest = "none lost" if not lost else "lost: " + ", ".join(f"{count} of {name}" for name, count in lost.items())
    nodes = "1 node" if len(recorder.recorded) == 1 else f"{len(recorder.recorded)} nodes"
    return f"{sum(recorder.recorded.values())} snapshots of {nodes}, {rest}"
