"""``sioms reconcile tactile`` and ``sioms reconcile force``: the command line of the sensors."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sioms.reconcile.sensors.verdict import SensorVerdict

EXIT_BAD_INPUT = 2


def add_parsers(kinds: Any) -> None:
    """Add the subjects to ``sioms reconcile``."""
    tactile = kinds.add_parser("tactile", help="a tactile finger, from recorded touches")
    tactile.add_argument(
        "data", type=Path, metavar="DATA", help="folder with one npz for each experiment (docs/tactile.md)"
    )
    tactile.add_argument(
        "--model", type=Path, metavar="FILE", help="nominal finger (TOML; default: nominal.json in DATA)"
    )
    force = kinds.add_parser("force", help="a force/torque sensor, from recorded known loads")
    force.add_argument(
        "data", type=Path, metavar="DATA", help="file or folder of recordings, columns.toml beside them"
    )
    force.add_argument("--model", type=Path, metavar="FILE", required=True, help="nominal sensor (TOML)")
    force.add_argument(
        "--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)"
    )
    for parser in (tactile, force):
        parser.add_argument(
            "--out", type=Path, default=Path("report"), metavar="DIR", help="where the report goes"
        )
        parser.add_argument("--seed", type=int, default=1, help="of permutations and bootstrap")
        parser.add_argument("--quiet", action="store_true", help="no progress")
    score = kinds.add_parser("score", help="solve a folder of fingers whose truth is known")
    score.add_argument("data", type=Path, metavar="PUBLIC", help="one folder for each finger")
    score.add_argument("truth", type=Path, metavar="TRUTH", help="NAME.json for each finger")


def run_sensor(args: argparse.Namespace) -> int:
    """Reconcile one sensor from recordings, or score many; return the exit status."""
    # matrices are small: more threads only wait for each other, and badly so on a busy machine
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if args.subject == "score":
        from sioms.tools.reconcile_score import score

        return score(args.data, args.truth)
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.verdict import EXIT

    progress = (lambda text: None) if args.quiet else _say
    try:
        verdict, seconds = _analysed(args, progress)
        _write(verdict, seconds, args)
    except BadInputError as e:
        print(f"bad input: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return EXIT[verdict.outcome]


def _analysed(args: argparse.Namespace, progress: Any) -> tuple[SensorVerdict, float]:
    if args.subject == "tactile":
        from sioms.tools.reconcile_finger import reconcile_tactile

        return reconcile_tactile(args.data, args.model, args.seed, progress)
    from sioms.tools.reconcile_force import reconcile_force

    return reconcile_force(args.data, args.model, args.columns, args.seed, progress)


def _write(verdict: SensorVerdict, seconds: float, args: argparse.Namespace) -> None:
    """Write report.html, verdict.json and the models; print the summary."""
    from sioms.tools.reconcile_sensor_report import as_json, page, summary

    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "report.html").write_text(page(verdict, seconds))
    (args.out / "verdict.json").write_text(as_json(verdict, seconds))
    if args.subject == "tactile":
        from sioms.tools.reconcile_finger import write_models

        write_models(verdict, args.model, args.out)
    else:
        from sioms.reconcile.force.model_file import to_toml

        (args.out / "model.toml").write_text(to_toml(verdict.model))
    print("\n".join(summary(verdict, str(args.out / "report.html"))))


def _say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)
