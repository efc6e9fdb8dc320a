"""Commands of ``sioms`` that ask the daemon, or about it: list, info, status, wait, stop, reset, reload, check."""

from __future__ import annotations

import argparse
import errno
import os
import sys
from collections.abc import Iterable, Sequence
from time import monotonic, monotonic_ns, sleep
from typing import Any

from sioms.arguments import positive
from sioms.client.stopping import emergency_stop
from sioms.client.undisturbed import Undisturbed
from sioms.client.workcell import NodeEntry, Workcell, is_part
from sioms.protocol.flags import READONLY, ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo


def add_parser(subparsers: Any) -> None:
    """Add the commands of this module."""
    one = subparsers.add_parser("list", help="list the nodes of the workcell")
    one.add_argument("-v", "--verbose", action="store_true", help="include channels, bits and read-only companions")
    one.add_argument(
        "--names", action="store_true", help="print names only, one per line; nothing if no daemon is running"
    )
    one.add_argument("--json", action="store_true", help="print JSON")
    one.add_argument("--all", action="store_true", help="nodes of all cells of the fleet, as CELL:NODE")
    one = subparsers.add_parser("info", help="describe a node: channels, units, limits")
    one.add_argument("node", metavar="NODE")
    one.add_argument("--json", action="store_true", help="print JSON")
    one = subparsers.add_parser("status", help="print the state of devices, sessions and the emergency stop")
    one.add_argument("--json", action="store_true", help="print JSON")
    subparsers.add_parser("reload", help="make the daemon reload its configuration")
    one = subparsers.add_parser("stop", help="emergency stop, latched until `sioms reset`; not a safety-rated function")
    one.add_argument("nodes", metavar="NODE", nargs="*", help="a node; default: the whole workcell")
    one.add_argument("--all", action="store_true", help="all cells of the fleet")
    one = subparsers.add_parser(
        "wait", help="wait until the daemon is ready: all devices have started, or are in fault"
    )
    one.add_argument(
        "-t",
        "--timeout",
        type=positive,
        default=60.0,
        metavar="SECONDS",
        help="time-out (default: 60)",
    )
    one = subparsers.add_parser("reset", help="clear a latched stop or fault; no motion is resumed")
    one.add_argument("node", metavar="NODE", nargs="?", default="", help="a node; default: the whole workcell")
    one = subparsers.add_parser("check", help="check a configuration; exit status 2 if it has errors")
    one.add_argument("config", metavar="CONFIG", help="configuration (TOML)")


def run(args: argparse.Namespace) -> int:
    """Run one of the commands; return the exit status."""
    match args.command:
        case "list":
            return _list_all(args) if args.all else _list(args.verbose, args.names, args.json)
        case "info":
            with Workcell(name="sioms") as cell:
                info, status = cell.info(args.node), cell.status()
            if args.json:
                print_json(info_fields(info))
            else:
                print("\n".join(describe(info) + troubles(status, info.device, info.name)))
        case "status":
            with Workcell(name="sioms") as cell:
                status = cell.status()
            if args.json:
                print_json({**status, "now_ns": monotonic_ns()})
            else:
                print("\n".join(status_lines(status, monotonic_ns())))
        case "reload":
            with Workcell(name="sioms") as cell:
                cell.reload()
        case "wait":
            _wait(args.timeout)
        case "stop":
            _stop_all(args.nodes) if args.all else _stop(args.nodes)
        case "reset":
            with Workcell(name="sioms") as cell:
                cell.reset(args.node)
        case "check":
            # Another program by design: tools know no daemon.
            os.execv(
                sys.executable,
                [sys.executable, "-P", "-m", "sioms.daemon.main", "--check", "--config", args.config],
            )
    return 0


def _wait(timeout_s: float) -> None:
    """Wait until the daemon is there and no device is starting."""
    deadline = monotonic() + timeout_s
    while True:
        try:
            with Workcell(name="sioms") as cell:
                late = [d["name"] for d in cell.status()["devices"] if d["state"] in ("down", "starting")]
            why = f"starting: {', '.join(late)}"
            if not late:
                return
        except OSError as error:
            if error.errno not in (
                errno.ENOENT,
                errno.ECONNREFUSED,
                errno.EAGAIN,
                errno.EIO,
                errno.ETIMEDOUT,
            ):
                raise
            why = error.strerror or str(error)
        if monotonic() > deadline:
            raise TimeoutError(errno.ETIMEDOUT, f"the daemon is not ready after {timeout_s:g} s: {why}")
        sleep(0.05)


def _stop(nodes: Sequence[str]) -> None:
    if nodes:
        failed: list[OSError] = []
        with Workcell(name="sioms") as cell, Undisturbed():
            for node in nodes:
                try:
                    cell.emergency_stop(node, "sioms stop")
                except OSError as error:
                    failed.append(error)
        if failed:
            raise failed[0]
    elif unheard := emergency_stop("sioms stop", name="sioms"):
        print(f"sioms stop: stopped and latched by the drivers; {unheard}", file=sys.stderr)


def _stop_all(nodes: Sequence[str]) -> None:
    from sioms.client.fleet import Fleet

    with Fleet(name="sioms", partial=True) as fleet:
        fleet.emergency_stop("sioms stop --all")
    if nodes:
        raise OSError(
            errno.EINVAL, f"stop {' '.join(nodes)}: --all has stopped every cell as a whole; leave out one of both"
        )


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return lines with aligned columns.

    Example:
        >>> table(("a", "b"), [("10", "x"), ("7", "yy")])
        ['a   b', '10  x', '7   yy']
    """
    cells = [tuple(head), *[tuple(row) for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in cells]


def print_json(value: object) -> None:
    """Print a value as JSON; what is not a number becomes null."""
    from sioms.documents import json_text

    print(json_text(value))


def info_fields(info: NodeInfo) -> dict[str, Any]:
    """Return what a node is, under the names of its attributes."""
    channels = [
        {
            "name": c.name, "unit": c.unit, "minimum": c.minimum, "maximum": c.maximum, "width": c.width,
            "modes": [m.name.lower() for m in ControlMode if m & c.modes and m.name], "limits": c.limits,
            "description": c.description,
        }
        for c in info.channels
    ]  # fmt: skip
    return {
        "name": info.name, "class": info.node_class.name.lower(), "read_only": info.read_only, "bit": info.bit,
        "device": info.device, "driver": info.driver, "tick_hz": info.tick_hz,
        "buffer_capacity": info.buffer_capacity, "channels": channels,
    }  # fmt: skip


def entry_fields(entry: NodeEntry) -> dict[str, Any]:
    """Return a line of the node list under the names of its attributes."""
    return {
        "name": entry.name, "class": entry.node_class.name.lower(), "channels": entry.channels,
        "read_only": entry.read_only, "device": entry.device, "state": entry.state, "held_by": entry.holder,
    }  # fmt: skip


def _list(verbose: bool, names_only: bool, as_json: bool) -> int:
    if names_only:  # what completion asks: it must never get in the way of somebody typing
        try:
            with Workcell(name="sioms") as cell:
                print("\n".join(entry.name for entry in cell.nodes() if not entry.name.endswith(READONLY)))
        except OSError:
            return 0
        return 0
    with Workcell(name="sioms") as cell:
        entries, status = cell.nodes(), cell.status()
    _print_entries(entries, verbose, as_json, troubles(status))
    return 0


def _list_all(args: argparse.Namespace) -> int:
    """List the nodes of all cells; those that are missing are told, and the exit status is 1 then."""
    from sioms.client.fleet import Fleet

    with Fleet(name="sioms", partial=True) as fleet:
        entries = fleet.nodes()
        lines = [f"{name}: {line}" for name, status in fleet.status().items() for line in troubles(status)[1:]]
    if args.names:
        print("\n".join(entry.name for entry in entries if not entry.name.endswith(READONLY)))
    else:
        _print_entries(entries, args.verbose, args.json, ["", *lines] if lines else [])
    for name, error in fleet.missing.items():
        print(f"sioms list: {name}: {error.strerror}", file=sys.stderr)
    return 1 if fleet.missing else 0


def _print_entries(entries: list[NodeEntry], verbose: bool, as_json: bool, more: list[str]) -> None:
    shown = entries if verbose else [entry for entry in entries if not is_part(entry, entries)]
    if as_json:
        print_json([entry_fields(entry) for entry in shown])
        return
    rows = [
        (e.name, e.node_class.name.lower(), str(e.channels), "read" if e.read_only else "read, write", e.device,
         e.state, e.holder)
        for e in shown
    ]  # fmt: skip
    print("\n".join(table(("node", "class", "channels", "access", "device", "state", "held by"), rows) + more))


def troubles(status: dict[str, Any], device: str = "", node: str = "") -> list[str]:
    """Return what is stopped or in fault, by whom or why, and which command clears it; of one node's device, or of
    all.
    """
    lines = []
    if status["stopped_ns"]:
        lines.append(f"EMERGENCY STOP by {status['stop_source']}; `sioms reset` clears it")
    lines += [f"{who}: {text} ({age_s:.0f} s ago)" for who, age_s, text in status.get("reports", ())]
    for name, source in status["node_stops"]:
        if not node or _touch(name, node):
            lines.append(f"{name}: emergency stop by {source}; `sioms reset {name}` clears it")
    for each in status["devices"]:
        if device not in ("", each["name"]):
            continue
        if each["state"] == "fault":
            lines.append(
                f"{each['name']}: device in fault: {each['reason'].removeprefix(each['name'] + ': ')}; `sioms reset` "
                "tries it again"
            )
        elif each["trouble"]:
            lines.append(
                f"{each['name']}: {each['trouble'].removeprefix(each['name'] + ': ')}; `sioms reset "
                f"{node or each['name']}` clears it"
            )
    return ["", *lines] if lines else []


def _touch(one: str, other: str) -> bool:
    """Tell whether of two nodes one is the other or a part of it."""
    one, other = one.removesuffix(READONLY), other.removesuffix(READONLY)
    return one == other or one.startswith(other + ".") or other.startswith(one + ".")


def describe(info: NodeInfo) -> list[str]:
    """Return what a node is, in lines."""
    access = "read only" if info.read_only else "read and write; exclusive, observe through .readonly"
    lines = [
        f"node:      {info.name}",
        f"class:     {info.node_class.name.lower()}",
        f"access:    {access}",
        f"device:    {info.device} (driver {info.driver}, {info.tick_hz:g} Hz)",
        f"structs:   {info.number_structs}; {info.read_struct_size} bytes read, {info.write_struct_size} written",
    ]
    if info.buffer_capacity:
        lines.append(f"buffer:    {info.buffer_capacity} commands an axis")
    lines.append("")
    rows = [_channel(i, channel, info.node_class) for i, channel in enumerate(info.channels)]
    return lines + table(("#", "channel", "unit", "from", "to", "further limits", "modes", "description"), rows)


def _channel(index: int, channel: ChannelInfo, node_class: NodeClass) -> tuple[str, ...]:
    low = "" if channel.minimum is None else f"{channel.minimum:g}"
    high = "" if channel.maximum is None else f"{channel.maximum:g}"
    limits = ", ".join(f"{name} {value:g}" for name, value in channel.limits.items())
    modes = ""
    if node_class is NodeClass.AXIS:
        quantities = [m.name.lower().replace("_", " ") for m in ControlMode if m & 0x3F & channel.modes and m.name]
        modes = ", ".join(quantities)
    elif node_class is NodeClass.BINARY:
        limits = f"{channel.width} bit{'s' * (channel.width != 1)}"
    return str(index), channel.name, channel.unit, low, high, limits, modes, channel.description


def status_lines(status: dict[str, Any], now_ns: int) -> list[str]:
    """Return devices, sessions, holders and the emergency stop in lines."""
    stopped = status["stopped_ns"]
    lines = [f"workcell {status['workcell']}, daemon pid {status['pid']}"]
    if stopped:
        lines.append(
            f"EMERGENCY STOP for {(now_ns - stopped) / 1e9:.1f} s: {status['stop_source']}; `sioms reset` clears it"
        )
    rows = [
        (
            d["name"],
            d["driver"],
            d["state"],
            d["link"],
            str(d["pid"] or ""),
            f"{d['tick_hz']:g} Hz",
            f"{d['age_s']:.0f} s",
            str(d["deaths"]),
            d["reason"] or d["link_reason"] or d["trouble"],
        )
        for d in status["devices"]
    ]
    head = ("device", "driver", "state", "link", "pid", "rate", "up for", "deaths", "why")
    lines += ["", *table(head, rows), ""]
    lines += [f"{line}" for line in troubles({**status, "stopped_ns": 0})[1:]]
    holders = [(name, who, f"{held_s:.1f} s") for name, who, held_s in status["holders"]]
    sessions = [(who, str(handles), str(waits), str(markers)) for who, handles, waits, markers in status["sessions"]]
    lines += [*table(("held node", "by", "for"), holders), ""] if holders else []
    return lines + table(("session", "handles", "waits", "markers"), sessions)
