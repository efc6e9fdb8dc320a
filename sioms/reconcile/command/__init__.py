"""``sioms reconcile``: find where simulation and measurement disagree, name it, add it, show the gap shrink.

``add_parser`` and ``run`` are called by the ``sioms`` command; nothing heavy is imported before ``run``.
Exit status: 0 named or nothing missing, 3 unexplained, 4 ambiguous, 2 bad input, 1 the experiment was stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sioms.arguments import positive, whole
from sioms.reconcile.command.sensors import add_parsers as add_sensors
from sioms.reconcile.command.sensors import run_sensor

if TYPE_CHECKING:
    from sioms.reconcile.axis_verdict import AxisVerdict

EXIT_BAD_INPUT, EXIT_STOPPED = 2, 1
SUFFIXES = (".csv", ".npz", ".mat", ".txt")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add ``reconcile`` to the ``sioms`` command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "reconcile", help="find where simulation and measurement disagree and name the missing effect"
    )
    kinds = parser.add_subparsers(dest="subject", required=True, metavar="SUBJECT")
    axis = kinds.add_parser("axis", help="a motor axis, from recordings or live")
    axis.add_argument(
        "data", type=Path, metavar="DATA", help="file or folder of recordings, or the node of an axis"
    )
    axis.add_argument(
        "--model", type=Path, metavar="FILE", help="nominal model (TOML; default: DATA/nominal.json)"
    )
    axis.add_argument(
        "--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)"
    )
    axis.add_argument("--out", type=Path, default=Path("report"), metavar="DIR", help="where the report goes")
    axis.add_argument("--seed", type=whole(), default=1, help="of permutations and bootstrap")
    axis.add_argument("--jobs", type=whole(), default=0, help="cores to use (default: all)")
    axis.add_argument(
        "--resample",
        type=whole(),
        default=None,
        metavar="SEED",
        help="draw the blocks of time anew: does the verdict stand?",
    )
    axis.add_argument("--quiet", action="store_true", help="no progress")
    _live_arguments(axis)
    add_sensors(kinds)
    test = kinds.add_parser("selftest", help="blind test on generated axes or sensors with hidden effects")
    test.add_argument(
        "kind",
        nargs="?",
        choices=("axis", "tactile", "force"),
        default="axis",
        help="what is generated (default axis)",
    )
    test.add_argument("--axes", "--count", type=whole(1), default=20, help="number of axes or sensors")
    test.add_argument("--seed", type=whole(), default=1, help="of the generator")
    test.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="keep what was generated and the answers here"
    )
    test.add_argument(
        "--jobs", type=whole(), default=0, help="solvers at a time (default: one for each core)"
    )
    test.add_argument(
        "--replicates",
        type=whole(),
        default=0,
        help="solve each so many times more with its blocks drawn anew",
    )
    effects = kinds.add_parser("effects", help="print the library of effects")
    effects.add_argument(
        "of", nargs="?", choices=("axis", "sensors"), default="axis", help="whose (default axis)"
    )
    effects.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="write page and pictures there instead"
    )
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Do what the command line asks; return the exit status."""
    # matrices are small: more threads only wait for each other, and badly so on a busy machine
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if args.subject == "effects":
        from sioms.reconcile.report import effects, effects_sensors

        library = effects_sensors if args.of == "sensors" else effects
        if args.out is None:
            print(library.page(), end="")
        else:
            library.write(args.out)
        return 0
    _say_when_plain()
    if args.subject == "selftest":
        if args.kind != "axis":
            from sioms.reconcile.command.selftest_sensors import selftest as sensors

            return sensors(args.kind, args.axes, args.seed, args.out, args.jobs)
        from sioms.reconcile.command.selftest import selftest

        return selftest(args.axes, args.seed, args.out, args.jobs, args.replicates)
    if args.subject in ("tactile", "force", "score"):
        return run_sensor(args)
    return run_axis(args)


def _say_when_plain() -> None:
    from sioms.reconcile.jit import numba

    if numba() is None and "SIOMS_PLAIN" not in os.environ:
        print(
            "sioms reconcile: numba is not installed, and without it this takes ten times as long and more; "
            "run: pip install 'sioms[fast]'",
            file=sys.stderr,
        )


def _live_arguments(axis: argparse.ArgumentParser) -> None:
    group = axis.add_argument_group("with a node")
    group.add_argument("--yes", action="store_true", help="move without asking")
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
        help="what is run before anything is decided",
    )
    group.add_argument(
        "--install", type=Path, metavar="FILE", help="write the model there, for a simulated twin, and reload"
    )
    group.add_argument("--socket", metavar="PATH", help="the daemon's socket")


def run_axis(args: argparse.Namespace) -> int:
    """Reconcile one axis from recordings, or live."""
    from sioms.reconcile.verdict import EXIT, BadInputError

    say = (lambda text: None) if args.quiet else _progress
    try:
        if args.data.exists() or args.data.suffix in SUFFIXES or len(args.data.parts) > 1:
            with ThreadPoolExecutor(args.jobs or os.cpu_count() or 1) as pool:
                options = {"seed": args.seed, "progress": say, "mapper": pool.map, "resample": args.resample}
                verdict, seconds = reconcile_axis(args.data, args.model, args.columns, **options)
            write(verdict, seconds, args.out)
            return EXIT[verdict.outcome]
        return run_node(args, say)
    except BadInputError as e:
        print(f"bad input: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT


def run_node(args: argparse.Namespace, say: Any) -> int:
    """Reconcile the axis behind a node."""
    from sioms.reconcile.files.axis import read_model
    from sioms.reconcile.live.axis import Live, install, live, save
    from sioms.reconcile.live.record import ExperimentStopped
    from sioms.reconcile.verdict import EXIT, BadInputError

    node = str(args.data)
    if args.model is None:
        raise BadInputError(
            f"reconcile {node}: it is no file, and for a node --model is needed: the nominal model"
        )
    settings = Live(args.travel, args.lap, args.first, args.yes, args.socket, args.seed)
    try:
        verdict, session, seconds = live(node, read_model(args.model), settings, say)
    except FileNotFoundError as e:
        raise BadInputError(f"{e.strerror}; nor is there a file or folder {node}") from None
    except (ExperimentStopped, OSError) as e:
        print(f"stopped: {getattr(e, 'strerror', None) or e}", file=sys.stderr)
        return EXIT_STOPPED
    except KeyboardInterrupt:
        print(f"stopped: interrupted; {node} is halted", file=sys.stderr)
        return EXIT_STOPPED
    save(session, args.out / "records")
    write(verdict, seconds, args.out)
    if args.install is not None:
        print(install(verdict, args.install, args.socket))
    return EXIT[verdict.outcome]


def reconcile_axis(
    data: Path, model: Path | None, columns: Path | None = None, **options: Any
) -> tuple[AxisVerdict, float]:
    """Read, analyse and time one axis.

    Args:
        options: of ``sioms.reconcile.axis.Options``.

    Returns:
        The verdict and the seconds it took.

    Raises:
        BadInputError: data or model cannot be used.
    """
    from sioms.reconcile.axis import analyse
    from sioms.reconcile.files.axis import read_data, read_model
    from sioms.reconcile.prepare import Options

    start = time.monotonic()
    nominal = read_model(model or data / "nominal.json")
    session = read_data(data, nominal, columns)
    verdict = analyse(session, nominal, Options(**options))
    return verdict, time.monotonic() - start


def write(verdict: AxisVerdict, seconds: float, out: Path) -> None:
    """Write report.html, verdict.json, model.toml and, where one is proposed, the experiment; print the summary."""
    from sioms.reconcile.model_file import write_model
    from sioms.reconcile.report.page import page
    from sioms.reconcile.report.words import as_json, summary

    out.mkdir(parents=True, exist_ok=True)
    page(verdict, seconds).write(out / "report.html")
    (out / "verdict.json").write_text(as_json(verdict, seconds))
    (out / "model.toml").write_text(write_model(verdict.model))
    if verdict.experiment is not None:
        lines = ["command", *(f"{x:.9g}" for x in verdict.experiment.command)]
        (out / "experiment.csv").write_text("\n".join(lines) + "\n")
    print("\n".join(summary(verdict, str(out / "report.html"))))


def _progress(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    """Run by itself, as ``python -m sioms.reconcile``."""
    parser = argparse.ArgumentParser(prog="reconcile")
    add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["reconcile", *(sys.argv[1:] if argv is None else argv)])
    return int(args.run(args))
