"""``sioms``: the front door. Each command is a module, loaded only when it is called.

A module of commands has ``add_parser(subparsers)``, which adds one or more of them, and
``run(args) -> int``, the exit status. A module that is not there makes no command.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NoReturn

from sioms.ending import leave
from sioms.protocol.text import printable
from sioms.safe_path import leave_working_directory


@dataclass(frozen=True, slots=True)
class Command:
    """A command: the module that has it, and one line for the overview."""

    module: str
    text: str


COMMANDS: dict[str, Command] = {
    "demo": Command("sioms.tools.demo", "demonstrate the simulated workcell"),
    "init": Command("sioms.tools.init", "write a starter configuration with the devices that are connected"),
    "list": Command("sioms.tools.cell", "list the nodes of the workcell"),
    "info": Command("sioms.tools.cell", "describe a node: channels, units, limits"),
    "status": Command("sioms.tools.cell", "print the state of devices, sessions and the emergency stop"),
    "wait": Command("sioms.tools.cell", "wait until the daemon is ready"),
    "monitor": Command("sioms.tools.monitor", "display all nodes live; stop, reset and jog by key"),
    "stop": Command("sioms.tools.cell", "emergency stop of a node or of the whole workcell"),
    "reset": Command("sioms.tools.cell", "clear a latched stop or fault"),
    "supervise": Command("sioms.tools.supervise", "supervise the cells of a fleet, which stop without a supervisor"),
    "reload": Command("sioms.tools.cell", "make the daemon reload its configuration"),
    "alarms": Command("sioms.tools.alarms", "list alarms; acknowledge them"),
    "record": Command("sioms.recording.command.record", "record readings, commands and events"),
    "log": Command("sioms.recording.command.log", "inspect, plot, export, cut and merge recordings"),
    "replay": Command("sioms.recording.command.replay", "serve a recording as read-only nodes"),
    "blackbox": Command(
        "sioms.recording.command.blackbox", "explain what went wrong; keep the last minute of everything"
    ),
    "check": Command("sioms.tools.cell", "check a configuration"),
    "service": Command("sioms.tools.service", "install the daemon as a service of this machine"),
    "serve": Command("sioms.gateway.command", "gateway for clients on other machines"),
    "metrics": Command("sioms.bridges.metrics", "serve values, states and alarms to Prometheus"),
    "epics": Command("sioms.bridges.epics", "serve nodes to EPICS clients, which may stop and move axes"),
    "mount": Command("sioms.bridges.mount.command", "mount device nodes as files, for cat, echo, dd and any program"),
    "ros2": Command("sioms.bridges.ros2", "publish axes, wrenches and diagnostics as ROS 2 topics over Zenoh"),
    "key": Command("sioms.gateway.command", "create, allow, list and revoke keys of remote clients"),
    "cert": Command("sioms.gateway.cert_command", "create an authority, and certificates for gateways and clients"),
    "driver": Command("sioms.tools.driver", "list, check, trace and replay drivers"),
    "bench": Command("sioms.bench", "measure latencies and throughput on this machine"),
    "hand": Command("sioms.hand.command", "grasp, regrasp, roll and hold unknown objects by touch"),
    "tactile": Command("sioms.tactile.command", "design, calibrate and measure elastic fingers"),
    "reconcile": Command("sioms.reconcile.command", "identify missing effects of a model from measurements"),
}
DESCRIPTION = "Operate the devices of a workcell. See `sioms COMMAND --help`."


def main(words: Sequence[str] | None = None) -> int:
    """Run a command; return its exit status."""
    if as_program := words is None:
        words = sys.argv[1:]
        leave_working_directory()
        _begin()
    parser = argparse.ArgumentParser(prog="sioms", description=DESCRIPTION)
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required="--version" not in words)
    there = installed()
    wanted = next((word for word in words if not word.startswith("-")), "")
    module: Any = None
    if wanted in there:
        try:
            module = import_module(there[wanted].module)
        except ModuleNotFoundError as error:
            return _lacks(wanted, error)
        module.add_parser(subparsers)
    else:
        for name, command in there.items():
            subparsers.add_parser(name, help=command.text)
        if wanted and wanted == words[0]:
            from sioms.wording import did_you_mean  # slow to import

            parser.error(f"no command {printable(wanted, 80)}{did_you_mean(wanted, there)}; `sioms --help` lists all")
    try:
        args, rest = parser.parse_known_args(words)
        if rest:
            _innermost(parser, words).error(f"unrecognized arguments: {' '.join(rest)}")
    except SystemExit as end:
        if end.code == USAGE and wanted == "stop":
            _stop_all_the_same()
        raise
    if args.version:
        from .manual import answer

        return answer("sioms", "version")
    if as_program and signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # the command may have something to put in order
    if as_program and wanted in LEAVES:
        _run_and_leave(wanted, module, args)
    return _guarded(wanted, module, args)


USAGE = 2
"""Exit status of a command line that cannot be read."""
LEAVES = ("serve",)
"""Commands whose libraries keep threads that would run on while the interpreter ends, whatever ends the command."""
EXTRAS = {
    "bluesky": "bluesky", "cryptography": "net", "gpiod": "gpio", "matplotlib": "report", "mfusepy": "mount",
    "numba": "fast", "p4p": "epics", "prometheus_client": "metrics", "pyarrow": "parquet", "zenoh": "net",
    "zstandard": "record",
}  # fmt: skip
"""Packages that not everybody needs, and the extra of SIOMS that brings each."""


def _begin() -> None:
    """Be a program: one that is told to end leaves nothing behind, an interrupt while modules are imported is the end
    and no traceback, a closed output an error.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)
    if sys.stdout is None:  # what is printed fails then, and commands that print nothing work
        sys.stdout = open(os.open(os.devnull, os.O_RDONLY), "w", encoding="utf-8")  # noqa: SIM115


def _end(number: int, _frame: object) -> None:
    """End in order: what a command has started ends with it."""
    sys.exit(128 + number)


def _innermost(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of the innermost command that the words name, whose usage helps."""
    for word in words:
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction) and word in action.choices:
                parser = action.choices[word]
                break
    return parser


def installed() -> dict[str, Command]:
    """Return the commands whose modules are there."""
    found = {}
    for name, command in COMMANDS.items():
        try:
            there = find_spec(command.module) is not None
        except ModuleNotFoundError:  # of a package that is not there
            there = False
        if there:
            found[name] = command
    return found


def _guarded(name: str, module: Any, args: argparse.Namespace) -> int:
    """Run a command; what a user can mend becomes one line, what he interrupts no line."""
    try:
        status = int(module.run(args))
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # Whoever read our output has enough. Nothing may be flushed into the broken pipe at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 128 + signal.SIGPIPE
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except ModuleNotFoundError as error:
        return _lacks(name, error)
    except OSError as error:
        plain = error.strerror == os.strerror(error.errno or 0)  # else a command has said what it could not write
        if error.errno in (errno.EBADF, errno.ENOSPC) and not error.filename and plain:
            error.strerror = f"write standard output: {(error.strerror or '').lower()}"
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # nothing is flushed at exit
        text = error.strerror or str(error)
        if error.filename:  # what the system has refused
            text = f"{error.filename}: {text.lower()}"
        print(f"sioms {name}: {text}", file=sys.stderr)
        return 1


def _stop_all_the_same() -> None:
    """Stop the workcell: whoever mistypes the options of a stop wants less motion, not more."""
    from sioms.client.stopping import emergency_stop

    try:
        emergency_stop("sioms stop, with options that there are not", name="sioms")
    except OSError as error:
        print(f"sioms stop: {error.strerror}", file=sys.stderr)
    else:
        print("sioms stop: the whole workcell has been stopped", file=sys.stderr)


def _run_and_leave(name: str, module: Any, args: argparse.Namespace) -> NoReturn:
    """Run a command, and leave whatever ended it, a mistake of ours, too."""
    status = 1
    try:
        status = _guarded(name, module, args)
    except Exception:
        traceback.print_exc()
    leave(status)


def _lacks(name: str, error: ModuleNotFoundError) -> int:
    """Say which extra brings what is not installed; return the exit status."""
    package = (error.name or "").partition(".")[0]
    if package not in EXTRAS:
        raise error
    print(f"sioms {name}: {package} is not installed; run: pip install 'sioms[{EXTRAS[package]}]'", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
