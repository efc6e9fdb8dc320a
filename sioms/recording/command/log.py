"""``sioms log``: look at recordings, export, cut and merge them."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sioms.arguments import seconds
from sioms.documents import json_text
from sioms.recording.export import FORMATS, export
from sioms.recording.messages import Event
from sioms.recording.reader import Recording
from sioms.recording.rewrite import rewrite
from sioms.recording.story import happened, sentence, utc
from sioms.recording.tables import of_events, of_table

from .picture import draw

PICTURES = (".png", ".svg", ".pdf")


def add_parser(subparsers: Any) -> None:
    """Add the command with its actions."""
    log = subparsers.add_parser("log", help="inspect, plot, export, cut and merge recordings")
    actions = log.add_subparsers(dest="action", metavar="ACTION", required=True)
    one = actions.add_parser("info", help="print the contents of a recording, and what is missing")
    one.add_argument("file", metavar="FILE")
    one.add_argument("-e", "--events", action="store_true", help="print all that happened, in order")
    one.add_argument("--json", action="store_true", help="print JSON")
    one = actions.add_parser("plot", help="plot nodes over time")
    one.add_argument("file", metavar="FILE")
    one.add_argument("nodes", metavar="NODE", nargs="*", help="nodes (default: all that change)")
    one.add_argument("-c", "--column", default="", help="e.g. velocity (default: position of axes, data of others)")
    one.add_argument("-o", "--output", metavar="PICTURE", required=True, help="PNG, SVG or PDF to write")
    _add_span(one)
    one = actions.add_parser("export", help="write a node, or the events, as a table")
    one.add_argument("file", metavar="FILE")
    one.add_argument("node", metavar="NODE", nargs="?", help="node (default: the only one that is recorded)")
    one.add_argument("-e", "--events", action="store_true", help="write events instead of a node")
    one.add_argument("-o", "--output", metavar="TABLE", required=True, help=f"file that ends in {', '.join(FORMATS)}")
    one.add_argument("-c", "--column", action="append", help="e.g. position; may be repeated (default: all)")
    _add_span(one)
    one = actions.add_parser("cut", help="write part of a recording to a new recording")
    one.add_argument("file", metavar="FILE")
    one.add_argument("nodes", metavar="NODE", nargs="*", help="nodes (default: all); events are kept in any case")
    one.add_argument("-o", "--output", metavar="FILE", required=True, help="MCAP file to write")
    _add_span(one)
    one = actions.add_parser(
        "merge", help="write several recordings into one; a single one is packed, without its damaged parts"
    )
    one.add_argument("files", metavar="FILE", nargs="+")
    one.add_argument("-o", "--output", metavar="FILE", required=True, help="MCAP file to write")


def _add_span(parser: Any) -> None:
    parser.add_argument(
        "--from", dest="start", type=seconds, metavar="SECONDS", help="start, relative to its beginning"
    )
    parser.add_argument("--to", dest="end", type=seconds, metavar="SECONDS", help="end, relative to its beginning")


def run(args: argparse.Namespace) -> int:
    """Run an action; return the exit status: 1 if something of a recording was lost."""
    match args.action:
        case "info":
            lost = _info_json(args.file, args.events) if args.json else _info(args.file, args.events)
        case "plot":
            lost = _plot(args)
        case "export":
            with Recording(args.file) as recording:
                _export(recording, args)
                lost = recording.damage
        case "cut":
            with Recording(args.file) as recording:
                for name in args.nodes:
                    recording.node(name)
                start, end = _span(recording, args)
            lost = rewrite([args.file], str(_fresh(args.output)), start, end, args.nodes or None)
        case _:
            lost = rewrite(args.files, str(_fresh(args.output)))
    for text in lost:
        print(f"sioms log: {text}", file=sys.stderr)
    return 1 if lost else 0


def _export(recording: Recording, args: argparse.Namespace) -> None:
    path, offset_ns = _fresh(args.output, FORMATS), recording.offset_ns
    start_ns, end_ns = (each - offset_ns for each in _span(recording, args))
    if args.events:
        events = [event for event in recording.events() if start_ns <= event.stamp_ns < end_ns]
        stamps = np.array([event.stamp_ns for event in events], np.int64)
        export(of_events(events), path, stamps + offset_ns, recording.about)
        return
    name = args.node or (next(iter(recording.nodes)) if len(recording.nodes) == 1 else "")
    if not name:
        nodes = ", ".join(recording.nodes) or "none"
        raise OSError(errno.EINVAL, f"export {recording.path}: name one of its nodes, or --events; there are: {nodes}")
    info, table = recording.node(name).info, recording.table(name, args.column, start_ns, end_ns)
    about = recording.about | {"node": name, "device": info.device, "class": info.node_class.name.lower()}
    export(of_table(info, table), path, table.stamps_ns + offset_ns, about)


def _fresh(text: str, endings: Sequence[str] = ()) -> Path:
    """Return the path of a file that can be written and is not there yet, of one of some kinds if any are given."""
    path = Path(text)
    if not text or not path.parent.is_dir():
        folder = f"there is no folder {path.parent}; make it, or " if text else "want a path; "
        raise OSError(errno.ENOENT, f"write {text or repr(text)}: {folder}name another file")
    if os.path.exists(path):
        raise OSError(errno.EEXIST, f"write {path}: it is there already; name another file, or remove it")
    if endings and path.suffix not in endings:
        raise OSError(errno.EINVAL, f"write {path}: want a name that ends in {', '.join(endings)}")
    return path


def _span(recording: Recording, args: argparse.Namespace) -> tuple[int, int]:
    """Return from when until when [ns, UTC]."""
    if args.start is None and args.end is None:
        return 0, 1 << 62
    first, last, _ = recording.span()
    start = first if args.start is None else first + int(args.start * 1e9)
    end = last + 1 if args.end is None else first + int(args.end * 1e9)
    if start >= end:
        length_s = (last - first) / 1e9
        raise OSError(
            errno.EINVAL,
            f"read {recording.path}: nothing is between --from {args.start or 0.0:g} and --to "
            f"{length_s if args.end is None else args.end:g} s; it is {length_s:.3f} s long",
        )
    return start, end


def _info(path: str, with_events: bool) -> list[str]:
    with Recording(path) as recording:
        first, last, counts = recording.span()
        about, lost = recording.about, list(recording.damage)
        state = "packed" if recording.is_packed else "not packed: its recorder is at work, or was killed"
        print(f"{path}: {os.path.getsize(path) / 1e6:.1f} MB, {state}")
        print(f"workcell {about.get('workcell', '?')} on {about.get('host', '?')}")
        print(f"{utc(first)} to {utc(last)}: {(last - first) / 1e9:.3f} s" if last else "nothing was recorded, or left")
        events = recording.events()
        print(f"{len(events)} events")
        gaps = _gaps(events)
        for name, node in recording.nodes.items():
            channels = ", ".join(f"{c.name} [{c.unit}]" if c.unit else c.name for c in node.info.channels)
            missing = f", {gaps[name]} lost" if gaps.get(name) else ""
            kind = node.info.node_class.name.lower()
            print(f"  {name}: {kind}, {counts.get(node.channel, 0)} snapshots{missing}: {channels}")
        if with_events:
            for event in events:
                print(f"{utc(event.stamp_ns + recording.offset_ns)[11:]}  {sentence(event)}")
    return lost


def _info_json(path: str, with_events: bool) -> list[str]:
    with Recording(path) as recording:
        first, last, counts = recording.span()
        lost, events = list(recording.damage), recording.events()
        gaps = _gaps(events)
        nodes = [
            {
                "name": name, "class": node.info.node_class.name.lower(), "snapshots": counts.get(node.channel, 0),
                "lost": gaps.get(name, 0),
                "channels": [{"name": c.name, "unit": c.unit} for c in node.info.channels],
            }
            for name, node in recording.nodes.items()
        ]  # fmt: skip
        found: dict[str, object] = {
            "file": path, "bytes": recording.size, "packed": recording.is_packed, "about": recording.about,
            "begin_ns": first, "end_ns": last, "nodes": nodes, "event_count": len(events), "damage": lost,
        }  # fmt: skip
        if with_events:
            found["events"] = [happened(event, recording.offset_ns) for event in events]
    print(json_text(found))
    return lost


def _gaps(events: Iterable[Event]) -> dict[str, int]:
    """Return how many snapshots the recorder itself missed, by node."""
    gaps: dict[str, int] = {}
    for event in events:
        if event.source == "recorder" and event.kind == "lost":
            lacks = (event.data or {}).get("snapshots", 0)
            gaps[event.node] = gaps.get(event.node, 0) + (lacks if isinstance(lacks, int) else 0)
    return gaps


def _plot(args: argparse.Namespace) -> list[str]:
    picture = _fresh(args.output, PICTURES)
    with Recording(args.file) as recording:
        if not recording.nodes:
            raise OSError(errno.EINVAL, f"plot {args.file}: no nodes are recorded")
        start, end = (each - recording.offset_ns for each in _span(recording, args))
        draw(recording, args.nodes, args.column, start, end).savefig(picture)
        return list(recording.damage)
