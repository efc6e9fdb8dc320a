"""The subjects of ``sioms reconcile``: what each asks on the command line, how it is analysed, live too, and what is
written of it.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Any

from sioms.arguments import positive, radius, whole
from sioms.whole_file import write_whole

Say = Callable[[str], None]
Args = argparse.Namespace


@dataclass(frozen=True, slots=True)
class Subject:
    """One kind of subject; nothing heavy is imported before a function is called.

    Attributes:
        text: for the list of subjects.
        arguments: adds its own and returns the group of those for a node.
        analyse: DATA to a verdict.
        live: NODE to a verdict and the seconds of analysis; records go to the folder. None where only recordings are
            analysed.
        write: writes the corrected model and what else belongs to it.
        install: puts it to work, and says so.
        halted: what an interrupted experiment leaves.
    """

    text: str
    arguments: Callable[[argparse.ArgumentParser], Any]
    analyse: Callable[[Args, Say], Any]
    live: Callable[[Args, Path, Say], tuple[Any, float]] | None
    write: Callable[[Args, Any], None]
    install: Callable[[Args, Any], str] | None
    halted: str = ""


def _axis_arguments(parser: argparse.ArgumentParser) -> Any:
    parser.add_argument("data", type=Path, metavar="DATA", help="file or folder of recordings, or the node of an axis")
    parser.add_argument("--model", type=Path, metavar="FILE", help="nominal model (TOML; default: DATA/nominal.json)")
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)"
    )
    parser.add_argument("--jobs", type=whole(), default=0, help="cores to use (default: all)")
    parser.add_argument(
        "--resample",
        type=whole(),
        default=None,
        metavar="SEED",
        help="resample the blocks of time, to test whether the verdict is stable",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="EFFECT",
        help="leave an effect out of the library: is it refused, or does another name take its place?",
    )
    group = parser.add_argument_group("with a node")
    group.add_argument(
        "--travel", type=positive, metavar="X", help="largest distance to either side of the present position"
    )
    group.add_argument(
        "--lap",
        type=positive,
        default=3.0,
        metavar="S",
        help="length of a lap of each experiment (default 3)",
    )
    group.add_argument(
        "--first",
        choices=("full", "one_speed"),
        default="full",
        help="experiments to run first",
    )
    group.add_argument(
        "--install",
        type=Path,
        metavar="FILE",
        help="write the corrected model to FILE, for a simulated twin, and reload",
    )
    return group


def _analyse_axis(args: Args, say: Say) -> Any:
    from sioms.reconcile.axis import analyse
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.files.axis import read_data, read_model
    from sioms.reconcile.prepare import Options

    if not args.data.exists():
        raise BadInputError(f"read {args.data}: no such file or folder")
    model = args.model or args.data / "nominal.json"
    if not (args.model or model.is_file()):
        text = "no nominal model of the axis was given; want --model FILE"
        raise BadInputError(f"{text}; `sioms reconcile describe {args.data}` drafts one")
    nominal = read_model(model)
    session = read_data(args.data, nominal, args.columns)
    with ThreadPoolExecutor(args.jobs or os.cpu_count() or 1) as pool:
        options = Options(
            seed=args.seed, progress=say, mapper=pool.map, resample=args.resample, without=tuple(args.without)
        )
        return analyse(session, nominal, options)


def _live_axis(args: Args, folder: Path, say: Say) -> tuple[Any, float]:
    from sioms.reconcile.files.axis import read_model
    from sioms.reconcile.live.axis import Live, live

    settings = Live(args.travel, args.lap, args.first, args.yes, args.socket, args.seed)
    return live(str(args.data), read_model(args.model), settings, folder, say)


def _write_axis(args: Args, verdict: Any) -> None:
    from sioms.reconcile.model_file import write_model

    write_whole(args.out / "model.toml", write_model(verdict.model, {c.name for c in verdict.candidates}))
    if verdict.experiment is not None:
        lines = ["command", *(f"{x:.9g}" for x in verdict.experiment.command)]
        write_whole(args.out / "experiment.csv", "\n".join(lines) + "\n")


def _install_model(args: Args, verdict: Any) -> str:
    from sioms.reconcile.live.experiments import install, reload

    return install((args.out / "model.toml").read_text(), args.install, args.socket, "model", reload)


def _tactile_arguments(parser: argparse.ArgumentParser) -> Any:
    parser.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="folder with one npz for each experiment (docs/tactile.md), or the node of a finger",
    )
    parser.add_argument(
        "--model", type=Path, metavar="FILE", help="nominal finger (TOML; default: nominal.json in DATA)"
    )
    group = parser.add_argument_group("with a node")
    group.add_argument("--place", default="prober.place", metavar="NODE", help="axis around the finger (prober.place)")
    group.add_argument(
        "--press",
        default="prober.radial",
        metavar="NODE",
        help="axis that presses, deeper at larger positions (prober.radial)",
    )
    group.add_argument("--force", default="force0.fz", metavar="NODE", help="force on the finger (force0.fz)")
    group.add_argument(
        "--length",
        type=positive,
        default=0.012,
        metavar="M",
        help="length of contact along the finger (0.012)",
    )
    group.add_argument(
        "--indenters",
        type=radius,
        nargs="+",
        default=[0.0],
        metavar="R",
        help="available radii in m, 0 an edge, inf a flat; the first is mounted, the others are requested (0)",
    )
    group.add_argument("--load", type=positive, default=200.0, metavar="N/M", help="usual load (200)")
    group.add_argument("--most-load", type=positive, default=250.0, metavar="N/M", help="largest load (250)")
    group.add_argument("--step", type=positive, default=2.0, metavar="DEG", help="distance between touches (2)")
    group.add_argument(
        "--first",
        choices=("full", "one_place"),
        default="full",
        help="touches to record first",
    )
    group.add_argument(
        "--install",
        type=Path,
        metavar="FILE",
        help="write the corrected finger to FILE and make the driver load it",
    )
    return group


def _analyse_tactile(args: Args, say: Say) -> Any:
    from sioms.reconcile.files.finger import reconcile_tactile

    return reconcile_tactile(args.data, args.model, args.seed, say)


def _live_tactile(args: Args, folder: Path, say: Say) -> tuple[Any, float]:
    from sioms.reconcile.live.finger import Probe, live
    from sioms.tactile.live.prober import Rig

    rig = Rig(args.place, args.press, str(args.data), args.force, args.length, args.most_load)
    radii, full = tuple(dict.fromkeys(args.indenters)), args.first == "full"
    asked = Probe(rig, radii, args.load, radians(args.step), full, args.yes, args.socket, args.seed)
    return live(args.model, asked, folder, say)


def _write_tactile(args: Args, verdict: Any) -> None:
    from sioms.reconcile.files.finger import write_models

    write_models(verdict, args.model, args.out)


def _install_finger(args: Args, verdict: Any) -> str:
    from sioms.reconcile.live.experiments import install
    from sioms.reconcile.live.finger import loads

    text = (args.out / "finger.toml").read_text(encoding="utf-8")
    return install(text, args.install, args.socket, "finger", loads(str(args.data), text))


def _force_arguments(parser: argparse.ArgumentParser) -> Any:
    parser.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="file or folder of recordings, columns.toml beside them, or the node of a sensor",
    )
    parser.add_argument("--model", type=Path, metavar="FILE", required=True, help="nominal sensor (TOML)")
    parser.add_argument(
        "--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)"
    )
    group = parser.add_argument_group("with a node")
    group.add_argument("--stand", type=Path, metavar="FILE", help="loads that can be applied to the sensor (TOML)")
    group.add_argument("--first", choices=("full", "one"), default="full", help="loads to apply first")
    group.add_argument(
        "--rest",
        type=positive,
        default=120.0,
        metavar="S",
        help="time without a load, if it is needed to decide (120)",
    )
    group.add_argument(
        "--install",
        type=Path,
        metavar="FILE",
        help="write the corrected model to FILE, for a simulated twin, and reload",
    )
    return group


def _analyse_force(args: Args, say: Say) -> Any:
    from sioms.reconcile.files.force import reconcile_force

    return reconcile_force(args.data, args.model, args.columns, args.seed, say)


def _live_force(args: Args, folder: Path, say: Say) -> tuple[Any, float]:
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.live.force import Load, live

    if args.stand is None:
        raise BadInputError(f"reconcile {args.data}: for a node --stand is needed: how it can be loaded")
    asked = Load(str(args.data), args.stand, args.first, args.rest, args.yes, args.socket, args.seed)
    return live(args.model, asked, folder, say)


def _write_force(args: Args, verdict: Any) -> None:
    from sioms.reconcile.force.model_file import to_toml

    write_whole(args.out / "model.toml", to_toml(verdict.model))


def _hand_arguments(parser: argparse.ArgumentParser) -> Any:
    from sioms.hand.command.arguments import add_beside, add_fingers

    parser.add_argument(
        "data", type=Path, metavar="DATA", help="file or folder of recorded grasps, or the node of a hand"
    )
    parser.add_argument("--model", type=Path, metavar="FILE", required=True, help="nominal hand (TOML)")
    group = parser.add_argument_group("with a node")
    group.add_argument(
        "--disks", type=positive, nargs="+", default=[], metavar="R",
        help="radii in m of the disks at hand; the first object lies between the fingers, the others are requested",
    )  # fmt: skip
    group.add_argument(
        "--bars", type=positive, nargs="+", default=[], metavar="W", help="widths in m of the bars at hand"
    )
    group.add_argument(
        "--clamped",
        type=positive,
        default=0.0,
        metavar="W",
        help="width in m of a bar that can be clamped",
    )
    group.add_argument("--grasps", type=whole(1), default=12, metavar="N", help="number of grasps of each object (12)")
    group.add_argument("--first", choices=("full", "one_object"), default="full", help="objects to grasp first")
    add_fingers(group)
    add_beside(group)
    group.add_argument(
        "--install",
        type=Path,
        metavar="FILE",
        help="write what the hand is known to be to FILE, the model_file of its driver, and reload",
    )
    return group


def _analyse_hand(args: Args, say: Say) -> Any:
    from sioms.reconcile.files.hand import reconcile_hand

    return reconcile_hand(args.data, args.model, args.seed, say)


def _live_hand(args: Args, folder: Path, say: Say) -> tuple[Any, float]:
    from sioms.hand.live.surveying import Nodes
    from sioms.reconcile.live.hand import Grasping, live

    nodes = Nodes(str(args.data), tuple(args.fingers), tuple(args.modules), tuple(args.wrists))
    objects = tuple(args.disks), tuple(args.bars), args.clamped, args.grasps
    asked = Grasping(nodes, *objects, args.first == "full", args.yes, args.socket, args.seed)
    return live(args.model, asked, folder, say)


def _write_hand(args: Args, verdict: Any) -> None:
    from sioms.hand import model
    from sioms.reconcile.files.hand import known, read_model
    from sioms.reconcile.hand.model_file import to_toml

    write_whole(args.out / "model.toml", to_toml(verdict.model, read_model(args.model)[1]))
    write_whole(args.out / "hand.toml", model.to_toml(known(verdict.model)))


def _install_hand(args: Args, verdict: Any) -> str:
    from sioms.reconcile.live.experiments import install, reload

    text = (args.out / "hand.toml").read_text(encoding="utf-8")
    return install(text, args.install, args.socket, "what the hand is known to be", reload)


SUBJECTS = {
    "axis": Subject(
        "a motor axis, from recordings or live",
        _axis_arguments,
        _analyse_axis,
        _live_axis,
        _write_axis,
        _install_model,
        "the axis is halted",
    ),
    "tactile": Subject(
        "a tactile finger, from recorded touches or live",
        _tactile_arguments,
        _analyse_tactile,
        _live_tactile,
        _write_tactile,
        _install_finger,
        "what pressed is clear or halted",
    ),
    "force": Subject(
        "a force/torque sensor, from recorded known loads or live",
        _force_arguments,
        _analyse_force,
        _live_force,
        _write_force,
        _install_model,
        "what pressed is clear or halted",
    ),
    "hand": Subject(
        "a two-fingered hand, from recorded grasps or live",
        _hand_arguments,
        _analyse_hand,
        _live_hand,
        _write_hand,
        _install_hand,
        "the hand stands",
    ),
}
