"""``sioms driver``: what is installed, and the author's tools check, trace and replay."""

from __future__ import annotations

import argparse
import ast
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sioms.arguments import positive, whole

from .cell import print_json, table

ABOUT = (
    "check runs drivers under their own daemon against the simulator given by their rig, over a wire that "
    "damages and loses messages and is disconnected and reconnected; it stops axes in every state and kills client, "
    "driver and daemon in motion. trace records the traffic on a device's line, replay runs its driver against the "
    "record."
)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    actions = subparsers.add_parser("driver", help="list and check drivers, record and replay their lines")
    actions = actions.add_subparsers(dest="action", metavar="ACTION", required=True)
    one = actions.add_parser("list", help="list the installed drivers")
    one.add_argument("--json", action="store_true", help="print JSON")
    one = actions.add_parser("check", help="test drivers with noise, loss, unplugging, stops and process deaths")
    one.add_argument("drivers", metavar="DRIVER", nargs="*", help="registered name, register map, or a Python file")
    one.add_argument("--all", action="store_true", help="all shipped drivers and register maps")
    one.add_argument("--full", action="store_true", help="longer trials and all combinations: minutes per driver")
    one.add_argument("--only", metavar="TRIAL,...", default="", help="only these trials; an unknown name lists all")
    one.add_argument(
        "--simulator",
        "--counterpart",
        metavar="COMMAND",
        default="",
        help="module or file of the simulator, and its options",
    )
    one.add_argument("--config", metavar="FILE", type=Path, help="TOML of the device; {port} stands for its port")
    one.add_argument("--report", metavar="FILE", type=Path, help="write the report, as HTML when it ends in .html")
    one.add_argument("--json", metavar="FILE", type=Path, help="write all results as JSON")
    one.add_argument("-j", "--jobs", metavar="N", type=whole(1), default=1, help="drivers checked at the same time")
    one = actions.add_parser("trace", help="record the traffic on a device's line")
    one.add_argument("config", metavar="CONFIG", type=Path, help="configuration (TOML)")
    one.add_argument("device", metavar="DEVICE", help="name of the device in it")
    one.add_argument("-o", "--output", metavar="FILE", type=Path, help="output file (default: DEVICE.trace)")
    one.add_argument("--seconds", metavar="N", type=positive, help="duration (default: until interrupted)")
    one.add_argument("--socket", metavar="PATH", default="", help="socket of the daemon (default: a temporary path)")
    one = actions.add_parser("replay", help="run a driver against a recorded trace")
    one.add_argument("trace", metavar="TRACE", type=Path, help="file of sioms driver trace")
    one.add_argument("--ignore", metavar="A:B,...", default="", help="bytes of a request to ignore, e.g. 0:2")


def run(args: argparse.Namespace) -> int:
    """Run one of the actions; return the exit status."""
    match args.action:
        case "list":
            head, rows = ("driver", "module", "what it is"), [_driver(e) for e in drivers()]
            if args.json:
                print_json([dict(zip(("driver", "module", "description"), row, strict=True)) for row in rows])
            else:
                print("\n".join(table(head, rows)))
            return 0
        case "check":
            from sioms.check.command import run_check

            return run_check(args)
        case "trace":
            from sioms.check.trace_command import run_trace

            return run_trace(args)
        case "replay":
            from sioms.check.trace_command import run_replay

            return run_replay(args)
    raise ValueError(f"sioms driver: no action {args.action}")


# --- list ----------------------------------------------------------------------------------------


def drivers() -> list[EntryPoint]:
    """Return the installed drivers by name."""
    return sorted(entry_points(group="sioms.drivers"), key=lambda entry: entry.name)


def page_of(name: str) -> str:
    """Return what shows the configuration of an installed driver: the TOML file beside its module that is called as
    the module is, or else the module's docstring, which is read and not imported; '' when there is none.
    """
    found = [entry for entry in drivers() if entry.name == name]
    if not found:
        return ""
    source = _source(found[0])
    example = source.with_suffix(".toml") if source else None
    return example.read_text(encoding="utf-8") if example and example.is_file() else _docstring(found[0])


def _source(entry: EntryPoint) -> Path | None:
    spec = find_spec(entry.module)
    return Path(spec.origin) if spec and spec.origin else None


def _docstring(entry: EntryPoint) -> str:
    source = _source(entry)
    return ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or "" if source else ""


def _driver(entry: EntryPoint) -> tuple[str, str, str]:
    """Describe a driver by the first line of its module."""
    try:
        text = _docstring(entry)
    except (ImportError, OSError, SyntaxError) as error:
        text = f"cannot be read: {error}"
    return entry.name, entry.module, text.partition("\n")[0]
