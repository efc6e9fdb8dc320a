"""What live runs have in common: ask before anything moves, keep records aside until a run is over, decide by rounds,
install.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, TypeVar

import sioms
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.sensors.verdict import Proposal, SensorVerdict
from sioms.reconcile.verdict import Outcome, Verdict
from sioms.whole_file import write_whole

V = TypeVar("V", bound=Verdict)
E = TypeVar("E", bound="Named")


class Named(Protocol):
    """An experiment: what it is called, and what is said of it."""

    @property
    def name(self) -> str: ...
    @property
    def text(self) -> str: ...


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
    """Give an empty folder beside ``folder`` that takes its place at the end; what was there before
    stays until then.
    """
    fresh = folder.with_name(folder.name + ".new")
    shutil.rmtree(fresh, ignore_errors=True)
    fresh.mkdir(parents=True)
    yield fresh
    shutil.rmtree(folder, ignore_errors=True)
    fresh.replace(folder)


def decide(
    analyse: Callable[[], V],
    run: Callable[[E], None],
    deciding: Callable[[V], E | None],
    rounds: int,
    say: Say,
) -> tuple[V, float]:
    """Analyse; while effects look alike, make what separates them and analyse anew, no experiment twice.

    Args:
        run: makes an experiment that was proposed.
        deciding: the experiment that would decide where effects look alike.
        rounds: experiments at most.

    Returns:
        The verdict and the seconds of analysis.
    """
    done: set[str] = set()
    spent = 0.0
    while True:
        began = time.monotonic()
        verdict = analyse()
        spent += time.monotonic() - began
        best = deciding(verdict) if verdict.outcome is Outcome.AMBIGUOUS else None
        if best is None or best.name in done or len(done) >= rounds:
            return verdict, spent
        done.add(best.name)
        sets = ["+".join(e.name for e in verdict.effects), *("+".join(a) for a in verdict.alternatives)]
        say(f"not told apart: {' or '.join(sets)}; deciding by {best.text}")
        run(best)


def able(names: Collection[str], effort: Callable[[str], float]) -> Callable[[SensorVerdict], Proposal | None]:
    """Return the choice of the experiment that decides best, of those that can be made and were not made yet.

    Args:
        names: of those that can be made; effort: what one of them takes.
    """
    made: set[str] = set()

    def deciding(verdict: SensorVerdict) -> Proposal | None:
        open_ = [p for p in verdict.experiments if p.name in names and p.name not in made and p.separation > LEAST]
        near = [p for p in open_ if p.separation > NEARLY * open_[0].separation]
        best = min(near, key=lambda p: effort(p.name), default=None)
        if best is not None:
            made.add(best.name)
        return best

    return deciding


def install(text: str, path: Path, socket: str | None, what: str, take_up: Callable[[sioms.Workcell], str]) -> str:
    """Write a corrected model where its reader finds it, and have that take it up.

    Args:
        take_up: lets the workcell take it up, and says so.

    Returns:
        A sentence on what was done.
    """
    write_whole(path, text)
    try:
        with sioms.Workcell(socket, "reconcile") as cell:
            return f"{what} installed as {path}{take_up(cell)}"
    except OSError as error:
        return f"{what} written to {path}; not taken up: {error.strerror or error}"


def reload(cell: sioms.Workcell) -> str:
    """Let the daemon take up what has changed: a simulated device becomes the twin."""
    cell.reload()
    return ""
