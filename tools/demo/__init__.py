"""``sioms demo``: a workcell at work, told step by step, with a table and a picture at the end.

Uses the public client library and the pipe tools only.
"""

from __future__ import annotations

import argparse
from typing import Any


def add_parser(subparsers: Any) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser("demo", help="show the simulated workcell at work")
    parser.add_argument("--out", default="out", metavar="FOLDER", help="where the picture goes (default: out)")
    parser.add_argument("--quick", action="store_true", help="fewer trials of the latency measurements")
    parser.add_argument("--no-wire", action="store_true", help="leave out the devices on pty and TCP ports")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo."""
    from .story import tell

    return tell(arguments.out, quick=arguments.quick, wire=not arguments.no_wire)
