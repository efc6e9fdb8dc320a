"""The command line of ``sioms bench``: which sub-benches run, how long, and where the figures go."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from typing import Any

from sioms.arguments import whole

from .figures import Report
from .options import Options
from .tables import markdown

BENCHES: dict[str, tuple[str, str]] = {
    "read": ("reading", "read of 4 axes and of 48 analog channels, against a bare round trip"),
    "update": ("reading", "publication to awake subscriber at 100 Hz and 1 kHz, on one processor"),
    "write": ("writing", "write to acknowledgement: 1, 16 and 10,000 commands"),
    "paced": ("paced", "one read and one write in 10 ms, on one core and across cores, beside bare ones"),
    "peers": ("peers", "reads and writes beside those of EPICS and Tango, as far as these are installed"),
    "open": ("opening", "open and close, descriptors and memory gained by --soak N of them"),
    "stale": ("stale", "readings older than what was acknowledged: --trials N requests in random order"),
    "race": ("opening", "two writers racing for one output"),
    "start": ("starting", "daemon start to ready, memory of daemon and drivers"),
    "restart": ("starting", "driver killed to its node back"),
    "light": ("light", "100 light devices in one process on one core: start, processor, memory, stops"),
    "share": ("share", "processor of moving axes beside an empty loop; processor and memory of the idle demo"),
    "axes": ("axes", "axes that one core carries at 1, 2, 3 and 5 kHz, and where a tick's time goes"),
    "motion": ("motion", "idle wait against ideal end, start skew of two processes, marker to waiting axis"),
    "edge": ("motion", "edge of a light beam to a waiting client awake"),
    "client": ("deaths", "client killed, or hung with a lease, to its axes halting"),
    "daemon": ("deaths", "daemon killed to all axes halting"),
    "stop": (
        "stopping",
        "emergency stop to 16 axes in 4 processes acting on it, from Python and from the shell",
    ),
    "pipe": ("pipes", "start of devin; devin piped into devout as a 1 kHz loop"),
    "reach": ("reach", "through a gateway: requests, readings, stops; what fails to axes halting"),
    "clocks": ("clocks", "the stated error of a remote clock beside the truth, on simulated clocks and links"),
    "links": ("links", "clients, links and gateways that fail, many at a time: --trials N lost clients"),
    "zenohlinks": ("links", "the same over Zenoh"),
    "rights": ("rights", "attacks of a holder of a key on rights that it has not: --trials N of each"),
    "strangers": ("strangers", "frames of peers without an allowed key: --frames N; none is taken apart"),
    "blackbox": ("blackbox", "kills, stops and faults, and what the black box names as their cause: --trials N"),
    "recorder": ("recorder", "the recorder: share of a core, kills of it: --trials N, every value of a replay"),
    "crowd": ("crowd", "a hundred remote readers, one of which is stopped: local reads and writes beside them"),
    "fleet": ("fleet", "eight cells over Zenoh: stops, starts, reconnections, strangers"),
    "drivers": (
        "drivers",
        "drivers: cycle against the line's speed, streams without loss, stop on a busy line",
    ),
    "tactile": ("tactile", "shape from strain: time of a frame, errors against theory, convergence"),
    "watch": (
        "drifts",
        "the watch of axes in production: drifts named, false alarms, following errors, processor time",
    ),
    "attack": ("attack", "floods by one user beside victims of another"),
    "hand": ("hand", "the hand's acceptance in a simulated plane: kinematics, rolls, regrasps, force, friction cone"),
    "holding": (
        "hand_deaths",
        "program, drivers, world, sensor and daemon killed and stopped while a hand holds: --trials N rounds",
    ),
    "deaths": (
        "killing",
        "processes killed and stopped at random points, alone and together: --trials N kills",
    ),
    "flat": ("flat", "memory and descriptors of daemon, fork server and driver over --trials N deaths of clients"),
    "compounds": (
        "compounds",
        "the same round a device made of devices: its client, its driver, what it holds: --trials N rounds",
    ),
    "fuzz": (
        "fuzzing",
        "malformed frames and files: to each decoder, and on the sockets of daemon and drivers",
    ),
}
"""Name of a sub-bench: the module that holds it, as a function of its name, and what it measures."""


def add_parser(subparsers: Any) -> None:
    """Add ``bench`` to the subcommands of ``sioms``."""
    parser = subparsers.add_parser(
        "bench", help="measure latencies and throughput on this machine", description=__doc__
    )
    add_arguments(parser)
    parser.set_defaults(run=run)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the bench."""
    names = "\n".join(f"  {name:10} {text}" for name, (_, text) in BENCHES.items())
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.description = f"Measure the guarantees of SIOMS on this machine.\n\nsub-benches:\n{names}"
    parser.add_argument("names", nargs="*", metavar="NAME", help="sub-benches to run; all when none is named")
    parser.add_argument("--quick", action="store_true", help="fewer trials: seconds instead of minutes")
    parser.add_argument("--trials", type=whole(1), metavar="N", help="trials of each kill, hang and stop")
    parser.add_argument(
        "--soak", type=whole(1), metavar="N", help="opens and closes of open; seconds that recorder replays"
    )
    parser.add_argument("--frames", type=whole(1), metavar="N", help="frames of the sub-bench fuzz")
    parser.add_argument("--files", type=whole(1), metavar="N", help="files of the sub-bench fuzz")
    parser.add_argument(
        "--target",
        action="append",
        metavar="NAME",
        help="target of the sub-bench fuzz; all when none is named",
    )
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="of random frames")
    parser.add_argument(
        "--picture",
        metavar="FILE",
        default="",
        help="draw the results of the sub-bench tactile (png, pdf or svg)",
    )
    parser.add_argument("--json", metavar="FILE", help="write all figures to a file")
    parser.add_argument("--append", metavar="FILE", help="append them to a file, as one line of JSON")
    parser.add_argument("--tables", metavar="FILE", help="write them as Markdown tables")


def run(args: argparse.Namespace) -> int:
    """Run the sub-benches; return 0, 1 when one of them could not be carried out, or 2 for a name that is none.

    A missed bar is reported and is no failure: the figures are this machine's, not the code's alone.
    """
    wrong = [name for name in args.names if name not in BENCHES]
    if wrong:
        print(f"sioms bench: no sub-bench {wrong[0]}; there are: {', '.join(BENCHES)}", file=sys.stderr)
        return 2
    # What is installed has its bytecode: without it, each process that a bench starts compiles all that it imports.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # However we are ended, our daemons end with us.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = Options(
        args.quick, args.trials, args.soak, args.frames, args.files, tuple(args.target or ()), args.seed, args.picture
    )  # fmt: skip
    report, failed = Report(), []
    try:
        for name in args.names or BENCHES:
            module, text = BENCHES[name]
            report.begin(name, text)
            try:
                getattr(importlib.import_module(f".{module}", __package__), f"bench_{name}")(options, report)
            except (OSError, RuntimeError) as error:
                failed.append(f"{name}: {error}")
            _write(args, report)
    except KeyboardInterrupt:
        report.note("interrupted: what follows is not complete")
    report.summary()
    _write(args, report)
    if args.append:
        report.append(args.append, benches=args.names, seed=args.seed, failed=failed)
    for text in failed:
        print(f"sioms bench: {text}", file=sys.stderr)
    return 1 if failed else 0


def _write(args: argparse.Namespace, report: Report) -> None:
    """Write what there is so far: a long run may be interrupted."""
    if args.json:
        report.write(args.json, quick=args.quick)
    if args.tables:
        with open(args.tables, "w", encoding="utf-8") as file:
            file.write(markdown(report.figures))
