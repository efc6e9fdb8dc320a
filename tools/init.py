"""``sioms init``: write a starter configuration, of simulated devices and of what is plugged in."""

from __future__ import annotations

import argparse
import errno
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sioms.whole_file import write_whole
from sioms.wording import did_you_mean

from .driver import drivers, page_of
from .ports import Port, found, stanza

_HERE = Path(__file__).parent
ON_AXES = ("sim-force", "sim-io", "sim-tactile")
"""Simulated drivers that look at simulated axes, so that they come with some."""
NAMES = {
    "modbus-axis": "drive",
    "modbus-io": "io",
    "gpio": "gpio",
    "iio": "adc",
    "tmcl": "stage",
    "odrive": "joint",
}


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    one = subparsers.add_parser("init", help="write a starter configuration")
    one.description = (
        "Writes a starter configuration: simulated devices that work immediately, and a block for everything that is "
        "plugged "
        "in, as a comment unless its USB identity leaves no doubt. With --driver the device is a real one instead."
    )
    one.add_argument(
        "file",
        metavar="FILE",
        nargs="?",
        default="workcell.toml",
        help="output file (default: workcell.toml)",
    )
    one.add_argument("--driver", metavar="NAME", default="", help="a device of this driver, see `sioms driver list`")
    one.add_argument("--port", metavar="PORT", default="", help="serial port, host:port, GPIO chip or IIO device of it")
    one.add_argument("--name", metavar="NAME", default="", help="name of the workcell (default: that of the folder)")
    one.add_argument("--force", action="store_true", help="overwrite an existing file")


def run(args: argparse.Namespace) -> int:
    """Write the file and check it; return the exit status."""
    path = Path(args.file)
    if path.exists() and not args.force:
        raise OSError(errno.EEXIST, f"write {path}: it already exists; --force overwrites it, or give another FILE")
    known = {entry.name: entry for entry in drivers()}
    if args.driver and args.driver not in known:
        text = f"no driver {args.driver}{did_you_mean(args.driver, known)}"
        raise OSError(errno.EINVAL, f"{text}; there are: {', '.join(known)}")
    if args.port and not args.driver:
        raise OSError(errno.EINVAL, "--port needs --driver")
    name = _name(args.name or path.resolve().parent.name)
    text = (_HERE / "starter.toml").read_text().replace("{name}", name)
    if not args.driver or args.driver in ON_AXES:
        text += (_HERE / "starter_simulated.toml").read_text()
    if args.driver:
        port = Port(args.port, "", (args.driver,)) if args.port else None
        text += "\n" + stanza(example(args.driver), port, "device0").replace('"mod0.plant.', '"arm0.plant.') + "\n"
        told = f": a device of the driver {args.driver}, with the values of its page; put in yours"
    else:
        ports = found()
        text += "".join(_block(port, i) for i, port in enumerate(ports))
        told = _told(ports)
    try:
        write_whole(path, text)
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}; give a FILE in an existing folder with room for it") from None
    print(f"{path} written{told}")
    status = check(path)
    if status == 0:
        print(f"next:\n  siomsd --config {path} &\n  sioms monitor")
    return status


def example(driver: str) -> str:
    """Return the configuration that the page of a driver's module shows; TOML with one device."""
    text = page_of(driver)
    start = re.search(r"^( *)\[device\.[\w-]+\]$", text, re.MULTILINE)
    if start is None:
        raise OSError(errno.EINVAL, f"the driver {driver} has no example; see its page in drivers/README.md")
    indent, lines = start[1], []
    for line in text[start.start() :].splitlines():
        if not line.strip() or not line.startswith(indent):
            break
        lines.append(line.removeprefix(indent))
    return "\n".join(lines)


def _name(folder: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", folder).strip("-") or "workcell"


def _block(port: Port, number: int) -> str:
    """Return the block of something that is plugged in, as a comment unless it can be nothing else."""
    head = f"\n# --- {port.path}: {port.text} ---\n"
    if len(port.drivers) > 1:
        head += (
            f"# It may be for {', '.join(port.drivers[:-1])} or {port.drivers[-1]} (`sioms init --driver NAME --port "
            f"{port.path}`).\n"
        )
    device = f"{NAMES.get(port.drivers[0], port.drivers[0].replace('-', '_'))}{number}"
    text = stanza(example(port.drivers[0]), port, device)
    if not port.sure:
        text = "\n".join(f"# {line}".rstrip() for line in text.splitlines())
    return head + text + "\n"


def _told(ports: list[Port]) -> str:
    if not ports:
        return ": simulated devices; nothing that a driver could be for is plugged in"
    sure = sum(port.sure for port in ports)
    return f": simulated devices, {sure} found and recognised, {len(ports) - sure} found as comments to choose from"


def check(path: Path) -> int:
    """Let the daemon check the file, another program by design: tools know no daemon."""
    if find_spec("sioms.daemon") is None:
        return 0
    command = [sys.executable, "-P", "-m", "sioms.daemon.main", "--check", "--config", os.fspath(path)]
    return subprocess.run(command, check=False).returncode
