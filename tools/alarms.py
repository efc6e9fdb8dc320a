"""``sioms alarms``: list what is wrong or was, and acknowledge it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from time import gmtime, strftime
from typing import Any

from sioms.client.workcell import Workcell
from sioms.protocol.flags import Severity

from .cell import print_json, table


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        "alarms",
        help="list alarms; acknowledge them",
        description="List active alarms, and past alarms that have not been acknowledged.",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    actions = parser.add_subparsers(dest="action", metavar="ACTION")
    one = actions.add_parser("ack", help="acknowledge alarms under your own name; does not reset a stop")
    one.add_argument("nodes", metavar="NODE", nargs="*", help="nodes or devices, with all their parts")
    one.add_argument("-a", "--all", action="store_true", help="all alarms that you may acknowledge")
    one.add_argument("-m", "--message", metavar="TEXT", default="", help="a note for others")


def run(args: argparse.Namespace) -> int:
    """Run the command; return the exit status."""
    with Workcell(name="sioms alarms") as cell:
        if args.action is None:
            alarms = cell.alarms()
            if args.json:
                print_json([{**a, **{key: word(a[key]) for key in ("severity", "worst")}} for a in alarms])
            else:
                print("\n".join(listed(alarms)))
            return 0
        if bool(args.nodes) == args.all:
            raise OSError("ack: want the nodes whose alarms are to be acknowledged, or --all")
        done = [alarm for node in args.nodes or [""] for alarm in cell.acknowledge(node, args.message)]
    for alarm in done:
        print(f"acknowledged: {alarm['node']} {alarm['what']}: {alarm['text']}")
    if not done:
        print("nothing to acknowledge")
    return 0


def word(severity: int) -> str:
    """Return a severity as a word."""
    return Severity(severity).name.lower()


def ordered(alarms: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return alarms in the order in which they want attention: not acknowledged, severe, recent."""
    return sorted(alarms, key=lambda a: (a["state"] == "acknowledged", -a["severity"], -a["since"]))


def listed(alarms: Iterable[dict[str, Any]]) -> list[str]:
    """Return the lines of the list."""
    rows = [
        (
            a["state"], word(a["severity"] or a["worst"]), a["node"], a["what"], str(a["times"]),
            strftime("%Y-%m-%dT%H:%M:%SZ", gmtime(a["since"])), a["text"] + acknowledged(a),
        )
        for a in ordered(alarms)
    ]  # fmt: skip
    return table(("state", "severity", "node", "what", "times", "since", "why"), rows) if rows else ["no alarms"]


def acknowledged(alarm: dict[str, Any]) -> str:
    """Return who has acknowledged an alarm, in words, '' when nobody has."""
    said = f": {alarm['note']}" if alarm["note"] else ""
    return f" [acknowledged by {alarm['by']}{said}]" if alarm["by"] else ""
