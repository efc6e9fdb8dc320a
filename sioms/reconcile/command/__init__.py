"""``sioms reconcile``: find where simulation and measurement disagree, name it, add it, show the gap shrink.

``add_parser`` and ``run`` are called by the ``sioms`` command; nothing heavy is imported before ``run``.
Exit status: 0 named or nothing missing, 3 unexplained, 4 ambiguous, 2 bad input, 1 the experiment was stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

from sioms.arguments import whole
from sioms.reconcile.command import watch
from sioms.reconcile.command.subjects import SUBJECTS, Say, Subject

EXIT_BAD_INPUT, EXIT_STOPPED = 2, 1
SUFFIXES = (".csv", ".npz", ".mat", ".txt")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add ``reconcile`` to the ``sioms`` command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "reconcile", help="find where simulation and measurement disagree and name the missing effect"
    )
    kinds = parser.add_subparsers(dest="subject", required=True, metavar="SUBJECT")
    for name, subject in SUBJECTS.items():
        of = kinds.add_parser(name, help=subject.text)
        group = subject.arguments(of)
        of.add_argument(
            "--out", type=Path, default=Path("report"), metavar="DIR", help="folder of the report (default: report)"
        )
        of.add_argument("--seed", type=whole(), default=1, help="seed of permutations and bootstrap")
        of.add_argument("--quiet", action="store_true", help="do not show progress")
        of.add_argument("--no-pictures", action="store_true", help="write the report without pictures, in less time")
        if subject.live is not None:
            group.add_argument("--yes", action="store_true", help="move without asking")
            group.add_argument("--socket", metavar="PATH", help="the daemon's socket")
    draft = kinds.add_parser(
        "describe", help="inspect records, draft columns.toml and nominal.toml, and list open questions"
    )
    draft.add_argument("data", type=Path, metavar="DATA", help="file or folder of recordings of a motor axis")
    draft.add_argument(
        "--out", type=Path, default=None, metavar="DIR", help="write both drafts to DIR, never overwriting a file"
    )
    score = kinds.add_parser("score", help="diagnose a folder of fingers with known answers")
    score.add_argument("data", type=Path, metavar="PUBLIC", help="one folder for each finger")
    score.add_argument("truth", type=Path, metavar="TRUTH", help="NAME.json for each finger")
    test = kinds.add_parser("selftest", help="blind test on generated axes or sensors with hidden effects")
    test.add_argument(
        "kind",
        nargs="?",
        choices=("axis", "tactile", "force", "hand"),
        default="axis",
        help="subject to generate (default axis)",
    )
    test.add_argument("--axes", "--count", type=whole(1), default=20, help="number of axes or sensors")
    test.add_argument("--seed", type=whole(), default=1, help="seed of the generator")
    test.add_argument("--out", type=Path, default=None, metavar="DIR", help="keep generated data and answers in DIR")
    test.add_argument("--jobs", type=whole(), default=0, help="number of parallel processes (default: one per core)")
    test.add_argument(
        "--replicates",
        type=whole(),
        default=0,
        help="additional diagnoses of each with resampled blocks",
    )
    test.add_argument("--near", action="store_true", help="hide forms near those of the library; none may be named")
    test.add_argument("--damaged", action="store_true", help="damage the data in many ways; nothing may be named")
    watch.add_parser(kinds)
    effects = kinds.add_parser("effects", help="print the library of effects")
    effects.add_argument("of", nargs="?", choices=("axis", "sensors"), default="axis", help="subject (default axis)")
    effects.add_argument("--out", type=Path, default=None, metavar="DIR", help="write page and pictures to DIR instead")
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
    if args.subject != "watch":  # it compiles nothing
        _say_when_plain()
    if args.subject == "selftest" and args.damaged:
        from sioms.reconcile.command.damaged import damaged

        return damaged(args.seed, main)
    if args.subject == "selftest" and args.kind != "axis":
        from sioms.reconcile.command.selftest_sensors import selftest as sensors

        return sensors(args.kind, args.axes, args.seed, args.out, args.jobs)
    if args.subject == "selftest":
        from sioms.reconcile.command.selftest import selftest

        return selftest(args.axes, args.seed, args.out, args.jobs, args.replicates, args.near)
    if args.subject == "score":
        from sioms.reconcile.command.score import score

        return score(args.data, args.truth)
    from sioms.lab.stopping import ExperimentStopped
    from sioms.reconcile.errors import BadInputError

    try:
        if args.subject == "watch":
            return watch.run(args, watch.progress)
        if args.subject == "describe":
            return described(args.data, args.out)
        say = (lambda text: None) if args.quiet else _progress
        return reconcile(args, SUBJECTS[args.subject], say)
    except BadInputError as e:
        print(f"bad input: {e}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except ExperimentStopped as e:
        print(f"stopped: {e}", file=sys.stderr)
        return EXIT_STOPPED


def reconcile(args: argparse.Namespace, subject: Subject, say: Say) -> int:
    """Analyse data, or what is behind a node; write the report and return the exit status.

    Raises:
        BadInputError: data, model or node cannot be used.
        ExperimentStopped: the experiment was stopped; what moved is halted.
    """
    from sioms.reconcile.verdict import EXIT

    data: Path = args.data
    if node := not (subject.live is None or data.exists() or data.suffix in SUFFIXES or len(data.parts) > 1):
        verdict, seconds = _live(args, subject.live, subject.halted, say)
    else:
        began = time.monotonic()
        verdict = subject.analyse(args, say)
        seconds = time.monotonic() - began
    _write(args, subject, verdict, seconds)
    if node and args.install is not None:
        print(installed(args, subject, verdict))
    return EXIT[verdict.outcome]


def installed(args: argparse.Namespace, subject: Subject, verdict: Any) -> str:
    """Install the corrected model, unless something that has no name remains; return a sentence on what was done."""
    from sioms.reconcile.verdict import Outcome

    if subject.install is not None and verdict.outcome in (Outcome.NAMED, Outcome.NONE):
        return subject.install(args, verdict)
    left = f"{args.install} is as it was, and what was found is in {args.out}"
    return f"not installed: the verdict is {verdict.outcome.value}; {left}"


def described(data: Path, out: Path | None) -> int:
    """Print, or write, the drafts of both descriptions, and the questions.

    Raises:
        BadInputError: no file can be read, or a draft would replace a file.
    """
    from sioms.reconcile.errors import BadInputError
    from sioms.reconcile.files.describe import describe

    draft = describe(data)
    drafts = {"columns.toml": draft.columns, "nominal.toml": draft.model}
    if out is None:
        print("\n".join(f"--- {name}\n{text}" for name, text in drafts.items()))
    elif there := [name for name in drafts if (out / name).exists()]:
        raise BadInputError(f"write drafts to {out}: {', '.join(there)} is there; needs a folder without it")
    else:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in drafts.items():
            (out / name).write_text(text, encoding="utf-8")
    print("\n".join(["to be answered:", *(f"  {q}" for q in draft.questions)]) if draft.questions else "nothing to ask")
    return 0


def _live(args: argparse.Namespace, live: Any, halted: str, say: Say) -> tuple[Any, float]:
    """Reconcile what is behind a node."""
    from sioms.lab.stopping import ExperimentStopped
    from sioms.reconcile.errors import BadInputError

    if args.model is None:
        raise BadInputError(
            f"reconcile {args.data}: there is no such file or folder; a node needs --model, the nominal model"
        )
    try:
        found: tuple[Any, float] = live(args, args.out / "records", say)
        return found
    except FileNotFoundError as e:
        raise BadInputError(f"{e.strerror}; nor is there a file or folder {args.data}") from None
    except OSError as e:
        raise ExperimentStopped(e.strerror or str(e)) from e
    except KeyboardInterrupt:
        raise ExperimentStopped(f"interrupted; {halted}") from None


def _write(args: argparse.Namespace, subject: Subject, verdict: Any, seconds: float) -> None:
    """Write report.html, verdict.json and the models; print the summary."""
    from sioms.reconcile.report import write_report
    from sioms.reconcile.report.words import summary

    out: Path = args.out
    write_report(verdict, out, seconds, draw=not args.no_pictures)
    subject.write(args, verdict)
    print("\n".join(summary(verdict, str(out / "report.html"))))


def _progress(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def _say_when_plain() -> None:
    from sioms.reconcile.jit import numba

    if numba() is None and "SIOMS_PLAIN" not in os.environ:
        print(
            "sioms reconcile: numba is not installed, and without it this takes ten times as long and more; "
            "run: pip install 'sioms[fast]'",
            file=sys.stderr,
        )


def main(argv: list[str] | None = None) -> int:
    """Run by itself, as ``python -m sioms.reconcile``."""
    parser = argparse.ArgumentParser(prog="reconcile")
    add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["reconcile", *(sys.argv[1:] if argv is None else argv)])
    return int(args.run(args))
