"""``sioms reconcile``: find where simulation and measurement disagree, name it, add it, show the gap shrink.

``add_parser`` and ``run`` are called by the ``sioms`` command; nothing heavy is imported before ``run``.
Exit status: 0 named or nothing missing, 3 unexplained, 4 ambiguous, 2 bad input.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sioms.reconcile.verdict import Verdict

EXIT_BAD_INPUT = 2


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add ``reconcile`` to the ``sioms`` command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "reconcile", help="find where simulation and measurement disagree and name the missing effect")
    kinds = parser.add_subparsers(dest="subject", required=True, metavar="SUBJECT")
    axis = kinds.add_parser("axis", help="a motor axis, from recordings")
    axis.add_argument("data", type=Path, metavar="DATA", help="file or folder of recordings")
    axis.add_argument("--model", type=Path, metavar="FILE", help="nominal model (TOML; default: DATA/nominal.json)")
    axis.add_argument("--columns", type=Path, metavar="FILE", help="column description (default: columns.toml beside DATA)")
    axis.add_argument("--out", type=Path, default=Path("report"), metavar="DIR", help="where the report goes")
    axis.add_argument("--seed", type=int, default=1, help="of permutations and bootstrap")
    axis.add_argument("--quiet", action="store_true", help="no progress")
    test = kinds.add_parser("selftest", help="blind test on generated axes with hidden effects")
    test.add_argument("--axes", type=int, default=20, help="number of axes")
    test.add_argument("--seed", type=int, default=1, help="of the generator")
    test.add_argument("--out", type=Path, default=None, metavar="DIR", help="keep axes and answers here")
    test.add_argument("--jobs", type=int, default=0, help="solvers at a time (default: one for each core)")
    kinds.add_parser("effects", help="print the library of effects")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Do what the command line asks; return the exit status."""
    if args.subject == "effects":
        from sioms.tools.reconcile_effects import page

        print(page(), end="")
        return 0
    if args.subject == "selftest":
        from sioms.tools.reconcile_selftest import selftest

        return selftest(args.axes, args.seed, args.out, args.jobs)
    return run_axis(args)


def run_axis(args: argparse.Namespace) -> int:
    """Reconcile one axis from recordings."""
    from sioms.reconcile.verdict import EXIT, BadInputError

    try:
        verdict, seconds = reconcile_axis(args.data, args.model, args.columns, args.seed,
                                          (lambda text: None) if args.quiet else _progress)
    except BadInputError as e:
        print(f"bad input: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT
    write(verdict, seconds, args.out)
    return EXIT[verdict.outcome]


def reconcile_axis(data: Path, model: Path | None, columns: Path | None = None, seed: int = 1,
                   progress: Any = lambda text: None) -> tuple[Verdict, float]:
    """Read, analyse and time one axis.

    Returns:
        The verdict and the seconds it took.

    Raises:
        BadInputError: data or model cannot be used.
    """
    from sioms.reconcile.axis import Options, analyse
    from sioms.tools.reconcile_input import read_data, read_model, with_resolution

    start = time.monotonic()
    nominal = read_model(model or data / "nominal.json")
    session = read_data(data, nominal, columns)
    nominal = with_resolution(nominal, session)
    verdict = analyse(session, nominal, Options(seed=seed, progress=progress))
    return verdict, time.monotonic() - start


def write(verdict: Verdict, seconds: float, out: Path) -> None:
    """Write report.html, verdict.json, model.toml and, where one is proposed, the experiment; print the summary."""
    from sioms.reconcile.model_file import write_model
    from sioms.tools.reconcile_report import as_json, page, summary

    out.mkdir(parents=True, exist_ok=True)
    (out / "report.html").write_text(page(verdict, seconds))
    (out / "verdict.json").write_text(as_json(verdict, seconds))
    (out / "model.toml").write_text(write_model(verdict.model))
    if verdict.experiment is not None:
        lines = ["command", *(f"{x:.9g}" for x in verdict.experiment.command)]
        (out / "experiment.csv").write_text("\n".join(lines) + "\n")
    print("\n".join(summary(verdict, str(out / "report.html"))))


def _progress(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    """Run by itself, as ``python -m sioms.tools.reconcile``."""
    parser = argparse.ArgumentParser(prog="reconcile")
    add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["reconcile", *(sys.argv[1:] if argv is None else argv)])
    return int(args.run(args))


if __name__ == "__main__":
    sys.exit(main())
