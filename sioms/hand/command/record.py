"""``sioms hand record``: grasp a known object in many ways, and write what ``sioms reconcile hand`` reads.

On the hand of a running workcell, or with ``--plane`` on a simulated hand in this process, which may hide effects;
``--from`` takes the grasps that a recording of the workcell holds instead of making any:

    [finger1]
    link_m = 0.142           # keys of `sioms.plant.planar.Mount`
    turned_rad = 0.026       # by which the finger is turned on its link
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sioms.arguments import positive, whole
from sioms.hand.command.arguments import add_beside, add_hand

if TYPE_CHECKING:
    from sioms.hand.survey import Setting, Survey, Thing

GRASPS = 20
MOST_S = 24 * 3600.0
FINGERS = ("finger1", "finger2")
CLAMPED_KG, CLAMPED = 50.0, 5.0  # mass and coefficient on the platen of an object that no finger moves


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="recording to write (CSV)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--disk", type=positive, metavar="M", help="the object is a disk of this radius in metres")
    what.add_argument("--bar", type=positive, metavar="M", help="the object is a bar of this width in metres")
    parser.add_argument("--thing", type=whole(), default=1, metavar="N", help="number of the object (default 1)")
    parser.add_argument(
        "--grasps", type=whole(1), default=GRASPS, metavar="N", help=f"number of grasps (default {GRASPS})"
    )
    parser.add_argument(
        "--forces", type=positive, nargs="+", metavar="N",
        help="internal forces of each grasp in newtons (default 0.5 1 1.8; with --slips 0.4 0.8 1.2 1.8)",
    )  # fmt: skip
    parser.add_argument(
        "--slips", action="store_true",
        help="the bar is clamped to the platen: drag both fingers along it and record what friction holds against that",
    )  # fmt: skip
    parser.add_argument("--append", action="store_true", help="continue FILE: another object in the same session")
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="seed of the grasps (default 1)")
    parser.add_argument(
        "--from", dest="recording", type=Path, metavar="MCAP",
        help="take the holds of this recording of the workcell (sioms record); without --disk and --bar the object is "
        "an unknown one",
    )  # fmt: skip
    parser.add_argument("--plane", action="store_true", help="use a simulated hand in this process")
    parser.add_argument(
        "--hidden", type=Path, metavar="FILE", help="with --plane: what the simulated hand hides (TOML)"
    )
    add_hand(parser)
    add_beside(parser)


def run(args: argparse.Namespace) -> int:
    """Make the grasps and write them; return 1 if it was broken off, with what was recorded until then written.

    Raises:
        ValueError: no object, a file that is there, or one that cannot be continued.
        OSError: a node that is not there, or a hand that was stopped.
    """
    from sioms.hand.survey import LOADS_N, SLIPS_N, continued, next_grasp, settings, text_of
    from sioms.hand.touch import Failed
    from sioms.whole_file import write_whole

    if len(args.wrists) not in (0, 2):
        raise ValueError(f"record grasps: {len(args.wrists)} wrists; want two, or --wrists without a name")
    unknown = args.disk is None and args.bar is None
    if args.recording is not None:
        return _from_recording(args, None if unknown else _thing(args))
    if unknown:
        raise ValueError("record grasps: nothing is said of the object; want --disk RADIUS or --bar WIDTH")
    if args.slips and (args.bar is None or not (args.wrists or args.plane)):
        raise ValueError("record slips: want --bar WIDTH, clamped to the platen, and both --wrists")
    if args.hidden is not None and not args.plane:
        raise ValueError("record grasps: --hidden is for a simulated hand; want --plane with it")
    thing = _thing(args)
    past = earlier(args.output, args.append)
    plan = settings(args.grasps, args.forces or (SLIPS_N if args.slips else LOADS_N), seed=args.seed)
    surveys: list[Survey] = []
    try:
        (_in_plane if args.plane else _in_cell)(args, thing, plan, next_grasp(past), surveys)
    except (Failed, OSError, KeyboardInterrupt) as failed:
        if not (surveys and surveys[0].rows) and not isinstance(failed, Failed):
            raise
        print(f"sioms hand record: broken off: {str(failed) or 'interrupted'}", file=sys.stderr)
    rows = surveys[0].rows if surveys else []
    for event in surveys[0].events if surveys else []:
        print(f"{event.time_s:8.2f} s  {event.text}", file=sys.stderr)
    if rows:
        write_whole(args.output, text_of(continued(past, rows)))
    grasps = len({row[1] for row in rows})
    print(f"{grasps} of {len(plan)} grasps recorded, {len(rows)} rows: {args.output}{_more([*past, *rows])}")
    return 0 if grasps == len(plan) else 1


def _thing(args: argparse.Namespace) -> Thing:
    from sioms.hand.survey import BAR, DISK, Thing

    return Thing(DISK, args.disk, args.thing) if args.bar is None else Thing(BAR, args.bar, args.thing)


def _from_recording(args: argparse.Namespace, thing: Thing | None) -> int:
    """Write the grasps that a recording holds."""
    from sioms.hand.command.recorded import rows_from
    from sioms.hand.survey import OTHER, continued, next_grasp, text_of
    from sioms.whole_file import write_whole

    if args.plane or args.slips or args.forces:
        raise ValueError("record grasps: --from makes none; want it without --plane, --slips and --forces")
    past = earlier(args.output, args.append)
    first = next_grasp(past)
    what = (OTHER, args.thing, math.nan) if thing is None else (thing.kind, thing.number, thing.size_m)
    rows = rows_from(args.recording, what, args.node, args.fingers, args.modules, args.wrists, first)
    write_whole(args.output, text_of(continued(past, rows)))
    print(f"{len({row[1] for row in rows})} grasps found, {len(rows)} rows: {args.output}{_more([*past, *rows])}")
    return 0


def _more(rows: Sequence[Sequence[float]]) -> str:
    """Say what this recording lacks to be judged by itself."""
    from sioms.hand.survey import missing

    more = missing(len(rows), len({row[1] for row in rows}))
    return f"; sioms reconcile hand wants {more}: go on with --append, or record another file beside it" if more else ""


def tell(text: str) -> None:
    """Say how far it is."""
    print(text, file=sys.stderr, flush=True)


def earlier(path: Path, append: bool) -> list[list[float]]:
    """Return the rows of a recording that is continued.

    Raises:
        ValueError: it is there and not to be continued, or cannot be.
    """
    from sioms.hand.survey import rows_of

    if not path.exists():
        return []
    if not append:
        raise ValueError(f"write {path}: it is there; want another name, or --append to continue the same session")
    try:
        return rows_of(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"continue {path}: {error}; want a recording of sioms hand record") from None


def _in_plane(
    args: argparse.Namespace, thing: Thing, plan: Sequence[Setting], first: int, surveys: list[Survey]
) -> None:
    """Survey in a simulated plane."""
    from sioms.hand.plane import PlaneHand, Rig
    from sioms.hand.survey import DISK, Survey
    from sioms.plant.outline import disk, rectangle
    from sioms.plant.planar import Body

    mounts, turned = hidden(args.hidden)
    outline = disk(thing.size_m) if thing.kind == DISK else rectangle(thing.size_m, 0.08, 2e-3)
    body, pose = Body(outline), (1e-3, -2e-3, 0.02)
    if args.slips:
        body, pose = Body(outline, CLAMPED_KG, CLAMPED), (1e-3, -2e-3, 0.0)
    hand = PlaneHand(body, pose, Rig(turned_rad=turned), mounts, args.seed)
    survey = Survey(hand.hand, hand.reading, thing)
    survey.progress = tell
    surveys.append(survey)
    hand.run((survey.slide if args.slips else survey.carry_out)(plan, hand.beside, first), MOST_S)


def hidden(path: Path | None) -> tuple[Any, tuple[float, float]]:
    """Return the mounts of both fingers, and by which they are turned, of a file; the nominal ones without.

    Raises:
        ValueError: it cannot be read, or a key is not known.
    """
    from sioms.documents import read_bytes, toml_of
    from sioms.plant.planar import Mount

    table: dict[str, Any] = {}
    if path is not None:
        try:
            table = toml_of(read_bytes(path))
        except OSError as error:
            raise ValueError(f"read {path}: {error.strerror}") from None
    odd = sorted(set(table) - set(FINGERS))
    if odd:
        raise ValueError(f"read {path}: nobody reads {', '.join(odd)}; known are {', '.join(FINGERS)}")
    mounts, turned = [], []
    for name in FINGERS:
        try:
            keys = dict(table.get(name, {}))
            turned.append(float(keys.pop("turned_rad", 0.0)))
            mounts.append(Mount(**keys))
        except (TypeError, ValueError) as error:
            raise ValueError(f"read {path}, {name}: {error}") from None
        if not abs(turned[-1]) <= math.pi:
            raise ValueError(f"read {path}, {name}: turned_rad is {turned[-1]:g}; want an angle within pi")
    return (mounts[0], mounts[1]), (turned[0], turned[1])


def _in_cell(
    args: argparse.Namespace, thing: Thing, plan: Sequence[Setting], first: int, surveys: list[Survey]
) -> None:
    """Survey with the hand of a running workcell."""
    from sioms.client.workcell import Workcell
    from sioms.hand.live.surveying import Nodes, surveying

    nodes = Nodes(args.node, tuple(args.fingers), tuple(args.modules), tuple(args.wrists))
    with Workcell(name="hand") as cell, surveying(cell, nodes, thing, args.slips) as (survey, carry):
        survey.progress = tell
        surveys.append(survey)
        carry(plan, first)
