"""What live runs of sensors have in common: ask before anything moves, keep records aside until a run is over, decide by rounds."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.sensors.verdict import Proposal, SensorVerdict
from sioms.reconcile.verdict import Outcome

Say = Callable[[str], None]

#: Separating experiments after the first records; they must tell rivals apart by so many times the noise.
ROUNDS, LEAST = 2, 2.0
#: Of experiments that tell rivals apart nearly as well as the best, the one with the least to do is made.
NEARLY = 0.95


def agree(what: str, told: Sequence[str], question: str, yes: bool) -> None:
    """Say what will be done and ask.

    Raises:
        BadInputError: the answer is not yes, or there is nobody to ask.
    """
    print("\n".join(told), flush=True)
    if yes:
        return
    if not sys.stdin.isatty():
        raise BadInputError(f"{what}: nobody to ask; give --yes to move unattended")
    if input(f"{question} [yes/no] ").strip().lower() != "yes":
        raise BadInputError(f"{what}: the answer was not yes; nothing was moved")


def have_done(text: str, without: str) -> None:
    """Ask somebody to do something by hand and wait for Enter.

    Raises:
        BadInputError: there is nobody to ask; ``without`` says what can be done then.
    """
    print(f"{text}, then press Enter", flush=True)
    if not sys.stdin.readline():
        raise BadInputError(f"{text}: nobody to ask; {without}")


@contextmanager
def kept(folder: Path) -> Iterator[Path]:
    """Give an empty folder beside ``folder`` that takes its place at the end; what was there before stays until then."""
    fresh = folder.with_name(folder.name + ".new")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    yield fresh
    shutil.rmtree(folder, ignore_errors=True)
    fresh.replace(folder)


def decide(
    analyse: Callable[[], SensorVerdict],
    run: Callable[[Proposal], None],
    known: Collection[str],
    effort: Callable[[str], float],
    say: Say,
) -> tuple[SensorVerdict, float]:
    """Analyse; while effects look alike, make what separates them and analyse anew.

    Args:
        run: makes an experiment that was proposed.
        known: names of those that can be made; effort: what one of them takes.

    Returns:
        The verdict and the seconds of analysis.
    """
    done: set[str] = set()
    spent = 0.0
    while True:
        began = time.monotonic()
        verdict = analyse()
        spent += time.monotonic() - began
        best = _deciding(verdict, [n for n in known if n not in done], effort)
        if best is None or len(done) >= ROUNDS:
            return verdict, spent
        done.add(best.name)
        sets = ["+".join(e.name for e in verdict.effects), *("+".join(a) for a in verdict.alternatives)]
        say(f"not told apart: {' or '.join(sets)}; deciding by {best.text}")
        run(best)


def _deciding(
    verdict: SensorVerdict, known: Collection[str], effort: Callable[[str], float]
) -> Proposal | None:
    """Return the experiment that would decide, of those that can be made."""
    if verdict.outcome is not Outcome.AMBIGUOUS:
        return None
    open_ = [p for p in verdict.experiments if p.name in known and p.separation > LEAST]
    near = [p for p in open_ if p.separation > NEARLY * open_[0].separation]
    return min(near, key=lambda p: effort(p.name), default=None)
