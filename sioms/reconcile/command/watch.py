"""``sioms reconcile watch``: watch axes in production, tell drifts, and write what would make up for them."""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sioms.arguments import positive

if TYPE_CHECKING:
    from sioms.reconcile.live.watch import Watched

#: State of axes of a running cell. A recording has none unless it is given: its axes may have the same names.
STATE = Path("watch.json")
#: Exit status: nothing has drifted; a part of the recording is lost; something has, with a name; its cause is open.
NORMAL, DAMAGED, NAMED, OPEN_CAUSE = 0, 1, 3, 4


def add_parser(kinds: Any) -> None:
    """Add the command."""
    one = kinds.add_parser(
        "watch",
        help="watch axes in production for drift: cause, size and onset",
        description="Learn the normal behaviour of axes from their moves in production, and report drifts as alarms: "
        "friction, play, mass, force, place. Nothing is moved and nothing is changed.",
    )
    one.add_argument("nodes", nargs="*", metavar="NODE", help="nodes of single axes (with --recording: default all)")
    one.add_argument("--recording", type=Path, metavar="FILE", help="analyse a recording instead of a running cell")
    one.add_argument("--model", action="append", default=[], metavar="NODE=FILE", help="model file of an axis")
    one.add_argument(
        "--reference", action="append", default=[], metavar="NODE=BIT",
        help="node of one bit that changes at a fixed position of the axis's load, such as a light beam",
    )  # fmt: skip
    one.add_argument("--learn", type=positive, default=2.0, metavar="H", help="length of commissioning [h] (2)")
    one.add_argument(
        "--state", type=Path, metavar="FILE", help="state file (watch.json; of a recording none unless given)"
    )
    one.add_argument("--relearn", action="store_true", help="learn the named axes again from now on")
    one.add_argument("--time", type=positive, metavar="S", help="stop after this time [s]")
    one.add_argument(
        "--out", type=Path, default=Path("report"), metavar="DIR", help="folder of the report (default: report)"
    )
    one.add_argument("--propose", action="store_true", help="write corrected twins and gains from the state, and exit")
    one.add_argument(
        "--install", type=Path, metavar="FILE", help="like --propose, and also write the twin of the one NODE to FILE"
    )
    one.add_argument("--socket", metavar="PATH", help="the daemon's socket")


def run(args: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Do it; return the exit status.

    Raises:
        BadInputError: a node, a model or a file cannot be used.
    """
    from sioms.reconcile.errors import BadInputError

    if not args.nodes and args.recording is None and not args.propose:
        raise BadInputError("watch: no node is given; want the nodes of axes, as mod0.xaxis")
    if args.install is not None and len(args.nodes) != 1:
        raise BadInputError(f"watch --install {args.install}: {len(args.nodes)} nodes; want the one whose twin it is")
    try:
        if args.propose or args.install is not None:
            return _propose(args, say)
        return _over_recording(args, say) if args.recording is not None else _beside(args, say)
    except OSError as error:
        raise BadInputError(error.strerror or str(error)) from None


def _models(args: argparse.Namespace) -> dict[str, Any]:
    from sioms.reconcile.files.axis import read_model
    from sioms.reconcile.live.watch import names_of

    return {node: read_model(Path(file)) for node, file in names_of(args.model, "--model").items()}


def _maker(args: argparse.Namespace) -> Callable[[Any], Watched]:
    from sioms.reconcile.live.watch import names_of, watched
    from sioms.reconcile.watch.axis import Settings

    models = _models(args)
    references = names_of(args.reference, "--reference")
    settings = Settings(3600.0 * args.learn)

    def make(info: Any) -> Watched:
        return watched(info, models.get(info.name), references.get(info.name, ""), settings)

    return make


def _over_recording(args: argparse.Namespace, say: Callable[[str], None]) -> int:
    from sioms.reconcile.live.watch import from_recording, keep
    from sioms.recording.reader import Recording

    with Recording(args.recording) as recording:
        offset_s = recording.offset_ns * 1e-9
    told: dict[str, str] = {}

    def judged(axis: Watched) -> None:
        drift, name = axis.watch.drift, axis.watch.about.name
        text = "" if drift is None else drift.text(axis.watch.about)
        if (drift is None) != (not told.get(name)) or (drift is not None and drift.name != told.get(name, " ")):
            say(f"{name}: {text or 'as it was'}")
        told[name] = "" if drift is None else drift.name or " "

    axes, lost = from_recording(args.recording, args.nodes, _maker(args), judged)
    keep(args.state, axes, offset_s)
    status = _report(args, axes, offset_s)
    for text in lost:
        say(f"{args.recording}: {text}")
    return DAMAGED if lost else status


def _beside(args: argparse.Namespace, say: Callable[[str], None]) -> int:
    import sioms
    from sioms.reconcile.live.watch import Beside

    ended = False

    def end(_number: int, _frame: object) -> None:
        nonlocal ended
        ended = True

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    until_s = time.monotonic() + (args.time or float("inf"))
    beside = Beside(
        lambda: sioms.Workcell(args.socket, "reconcile watch"), args.nodes, _maker(args), say,
        lambda axis: _write(args, beside.axes, beside.offset_s), args.state or STATE, args.relearn,
    )  # fmt: skip
    try:
        beside.open()
        say(f"watching {', '.join(args.nodes)}")
        beside.run(lambda: ended or time.monotonic() > until_s)
        return _report(args, beside.axes, beside.offset_s)
    finally:
        beside.release()


def _write(args: argparse.Namespace, axes: dict[str, Watched], offset_s: float) -> None:
    """Write report.html and watch.json."""
    from sioms.documents import json_text
    from sioms.reconcile.live.watch import as_json
    from sioms.reconcile.report.watch import write
    from sioms.whole_file import write_whole

    args.out.mkdir(parents=True, exist_ok=True)
    write(axes, args.out / "report.html", offset_s)
    write_whole(args.out / "watch.json", json_text(as_json(axes, offset_s)))


def _report(args: argparse.Namespace, axes: dict[str, Watched], offset_s: float) -> int:
    """Write the report, print the summary, and return the exit status."""
    from sioms.reconcile.report.watch import summary

    _write(args, axes, offset_s)
    print("\n".join(summary(axes, offset_s)), flush=True)
    drifts = [axis.watch.drift for axis in axes.values() if axis.watch.drift is not None]
    return OPEN_CAUSE if any(not d.name for d in drifts) else NAMED if drifts else NORMAL


def _propose(args: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Write corrected twins and gains from what is kept."""
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.live.watch import kept_axes
    from sioms.reconcile.model_file import write_model
    from sioms.reconcile.report.watch import proposal_of, proposal_text
    from sioms.reconcile.watch.propose import corrected
    from sioms.whole_file import write_whole

    axes = kept_axes(args.state or STATE, args.nodes, _models(args))
    args.out.mkdir(parents=True, exist_ok=True)
    for name, axis in axes.items():
        if axis.watch.normal is None:
            raise BadInputError(f"watch {name}: it is still learning; there is nothing to correct yet")
        model = write_model(corrected(axis.model, axis.watch.about, axis.watch.normal, axis.watch.drift))
        write_whole(args.out / f"{name}.model.toml", model)
        if args.install is not None:
            write_whole(args.install, model)
            say(f"{name}: the corrected twin is written to {args.install}; a reload takes it up")
        proposal = proposal_of(axis)
        text = proposal_text(axis, proposal)
        write_whole(args.out / f"{name}.settings.toml", text)
        print(text, end="")
    return NORMAL


def progress(text: str) -> None:
    """Say something on the way."""
    print(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}", file=sys.stderr, flush=True)
