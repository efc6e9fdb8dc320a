"""``sioms reconcile tactile`` and ``sioms reconcile force``: the command line of the sensors."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sioms.arguments import positive, whole

if TYPE_CHECKING:
    from sioms.reconcile.sensors.verdict import SensorVerdict

EXIT_BAD_INPUT, EXIT_STOPPED = 2, 1


def add_parsers(kinds: Any) -> None:
    """Add the subjects to ``sioms reconcile``."""
    tactile = kinds.add_parser("tactile", help="a tactile finger, from recorded touches or live")
    tactile.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="folder with one npz for each experiment (docs/tactile.md), or the node of a finger",
    )
    tactile.add_argument(
        "--model", type=Path, metavar="FILE", help="nominal finger (TOML; default: nominal.json in DATA)"
    )
    _live_arguments(tactile)
    force = kinds.add_parser("force", help="a force/torque sensor, from recorded known loads or live")
    force.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="file or folder of recordings, columns.toml beside them, or the node of a sensor",
    )
    force.add_argument("--model", type=Path, metavar="FILE", required=True, help="nominal sensor (TOML)")
    force.add_argument(
        "--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)"
    )
    _loading_arguments(force)
    for parser in (tactile, force):
        parser.add_argument(
            "--out", type=Path, default=Path("report"), metavar="DIR", help="where the report goes"
        )
        parser.add_argument("--seed", type=whole(), default=1, help="of permutations and bootstrap")
        parser.add_argument("--quiet", action="store_true", help="no progress")
    score = kinds.add_parser("score", help="solve a folder of fingers whose truth is known")
    score.add_argument("data", type=Path, metavar="PUBLIC", help="one folder for each finger")
    score.add_argument("truth", type=Path, metavar="TRUTH", help="NAME.json for each finger")


def _live_arguments(tactile: argparse.ArgumentParser) -> None:
    group = tactile.add_argument_group("with a node")
    group.add_argument("--yes", action="store_true", help="move without asking")
    group.add_argument(
        "--place", default="prober.place", metavar="NODE", help="axis round the finger (prober.place)"
    )
    group.add_argument(
        "--press",
        default="prober.radial",
        metavar="NODE",
        help="axis that presses, deeper with larger positions (prober.radial)",
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
        type=float,
        nargs="+",
        default=[0.0],
        metavar="R",
        help="radii at hand in m, 0 an edge, inf a flat; the first is mounted, the others are asked for (0)",
    )
    group.add_argument("--load", type=positive, default=200.0, metavar="N/M", help="usual load (200)")
    group.add_argument("--most-load", type=positive, default=250.0, metavar="N/M", help="largest load (250)")
    group.add_argument("--step", type=positive, default=2.0, metavar="DEG", help="from place to place (2)")
    group.add_argument(
        "--first",
        choices=("full", "one_place"),
        default="full",
        help="what is recorded before anything is decided",
    )
    group.add_argument(
        "--install",
        type=Path,
        metavar="FILE",
        help="write the corrected finger there and have the driver load it",
    )
    group.add_argument("--socket", metavar="PATH", help="the daemon's socket")


def _loading_arguments(force: argparse.ArgumentParser) -> None:
    group = force.add_argument_group("with a node")
    group.add_argument("--yes", action="store_true", help="move without asking")
    group.add_argument("--stand", type=Path, metavar="FILE", help="how the sensor can be loaded (TOML)")
    group.add_argument(
        "--first", choices=("full", "one"), default="full", help="what is applied before anything is decided"
    )
    group.add_argument(
        "--rest",
        type=positive,
        default=120.0,
        metavar="S",
        help="time without a load, where that decides (120)",
    )
    group.add_argument(
        "--install", type=Path, metavar="FILE", help="write the model there, for a simulated twin, and reload"
    )
    group.add_argument("--socket", metavar="PATH", help="the daemon's socket")


def run_sensor(args: argparse.Namespace) -> int:
    """Reconcile one sensor from recordings, or score many; return the exit status."""
    if args.subject == "score":
        from sioms.reconcile.command.score import score

        return score(args.data, args.truth)
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.verdict import EXIT

    progress = (lambda text: None) if args.quiet else _say
    try:
        if not args.data.exists() and len(args.data.parts) == 1 and not args.data.suffix:
            return run_node(args, progress)
        began = time.monotonic()
        verdict = _analysed(args, progress)
        _write(verdict, time.monotonic() - began, args)
    except BadInputError as e:
        print(f"bad input: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return EXIT[verdict.outcome]


def run_node(args: argparse.Namespace, progress: Any) -> int:
    """Reconcile the sensor behind a node; return the exit status."""
    from sioms.lab.stopping import ExperimentStopped
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.verdict import EXIT

    if args.model is None:
        raise BadInputError(
            f"reconcile {args.data}: it is no file or folder, and for a node --model is needed: what it should be"
        )
    run, install = _touching(args) if args.subject == "tactile" else _loading(args)
    try:
        verdict, seconds = run(args.out / "records", progress)
    except FileNotFoundError as e:
        raise BadInputError(f"{e.strerror}; nor is there a file or folder {args.data}") from None
    except (ExperimentStopped, OSError) as e:
        print(f"stopped: {getattr(e, 'strerror', None) or e}", file=sys.stderr)
        return EXIT_STOPPED
    except KeyboardInterrupt:
        print("stopped: interrupted; what pressed is clear or halted", file=sys.stderr)
        return EXIT_STOPPED
    _write(verdict, seconds, args)
    if args.install is not None:
        print(install())
    return EXIT[verdict.outcome]


def _touching(args: argparse.Namespace) -> tuple[Any, Any]:
    """Return what probes a finger, and what installs its model."""
    from math import radians

    from sioms.reconcile.live.finger import Probe, install, live
    from sioms.tactile.live.prober import Rig

    node = str(args.data)
    rig = Rig(args.place, args.press, node, args.force, args.length, args.most_load)
    radii, full = tuple(dict.fromkeys(args.indenters)), args.first == "full"
    asked = Probe(rig, radii, args.load, radians(args.step), full, args.yes, args.socket, args.seed)

    def put() -> str:
        return install(
            (args.out / "finger.toml").read_text(encoding="utf-8"), args.install, node, args.socket
        )

    return lambda folder, say: live(args.model, asked, folder, say), put


def _loading(args: argparse.Namespace) -> tuple[Any, Any]:
    """Return what loads a force sensor, and what installs its model."""
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.live.force import Load, install, live

    if args.stand is None:
        raise BadInputError(f"reconcile {args.data}: for a node --stand is needed: how it can be loaded")
    asked = Load(str(args.data), args.stand, args.first, args.rest, args.yes, args.socket, args.seed)

    def put() -> str:
        return install((args.out / "model.toml").read_text(encoding="utf-8"), args.install, args.socket)

    return lambda folder, say: live(args.model, asked, folder, say), put


def _analysed(args: argparse.Namespace, progress: Any) -> SensorVerdict:
    if args.subject == "tactile":
        from sioms.reconcile.files.finger import reconcile_tactile

        return reconcile_tactile(args.data, args.model, args.seed, progress)
    from sioms.reconcile.files.force import reconcile_force

    return reconcile_force(args.data, args.model, args.columns, args.seed, progress)


def _write(verdict: SensorVerdict, seconds: float, args: argparse.Namespace) -> None:
    """Write report.html, verdict.json and the models; print the summary."""
    from sioms.reconcile.report.page import page
    from sioms.reconcile.report.words import as_json, summary

    args.out.mkdir(parents=True, exist_ok=True)
    page(verdict, seconds).write(args.out / "report.html")
    (args.out / "verdict.json").write_text(as_json(verdict, seconds))
    if args.subject == "tactile":
        from sioms.reconcile.files.finger import write_models

        write_models(verdict, args.model, args.out)
    else:
        from sioms.reconcile.force.model_file import to_toml

        (args.out / "model.toml").write_text(to_toml(verdict.model))
    print("\n".join(summary(verdict, str(args.out / "report.html"))))


def _say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)
