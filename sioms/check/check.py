"""Puts a driver through all trials. Each is followed by calm; one that leaves the station broken gets a new one."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from . import (
    death_trials,
    defect_trials,
    end_trials,
    golden,
    line_trials,
    motion_trials,
    refusal_trials,
    restart_trials,
)
from .rigs import Rig
from .station import Station, Unanswered
from .trial import TRIES, Result, Trial, Verdict, attempt

TRIALS: tuple[Trial, ...] = (
    *line_trials.TRIALS,
    *motion_trials.TRIALS,
    *end_trials.TRIALS,
    *restart_trials.TRIALS,
    *refusal_trials.TRIALS,
    *defect_trials.TRIALS,
    *death_trials.TRIALS,
)


@dataclass(frozen=True, slots=True)
class Subject:
    """What is checked: a driver, its rig, and the folder that its relative paths start from."""

    name: str
    rig: Rig
    folder: Path | None = None


def trial_names() -> list[str]:
    """Return the names that ``--only`` takes."""
    return [golden.NAME, *(trial.name for trial in TRIALS)]


def check(
    subject: Subject,
    *,
    full: bool = False,
    only: Sequence[str] = (),
    told: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """Put a driver through its trials.

    Args:
        subject: the driver.
        full: longer, and all combinations.
        only: names of trials; all without.
        told: called with each result as it comes.
    """
    results: list[Result] = []
    for result in _results(subject, full, only):
        results.append(result)
        told(result)
    return results


def _results(subject: Subject, full: bool, only: Sequence[str]) -> Iterator[Result]:
    if not only or golden.NAME in only:
        yield golden.check_frames(subject.rig, subject.folder)
    trials = [trial for trial in TRIALS if (trial.name in only if only else (full or trial.quick))]
    if not trials:
        return
    station: Station | None = None
    try:
        for trial in trials:
            if station is None:
                try:
                    station = Station(subject.rig, folder=subject.folder)
                    _prepare(station)
                except (OSError, RuntimeError) as error:
                    yield _no_start(trial, error)
                    return
            result = attempt(trial, station, full)
            try:
                station.settle()
            except (OSError, Unanswered, RuntimeError) as error:
                result = _not_calm(result, error)
                station.close()
                station = None
            yield result
    finally:
        if station is not None:
            with contextlib.suppress(OSError):
                station.close()


def _prepare(station: Station) -> None:
    """Bring axes to where trials begin; again after calm if the device falls into fault by itself, as in a trial."""
    for _ in range(TRIES - 1):
        try:
            return line_trials.prepare(station)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            station.settle()
    line_trials.prepare(station)


def _no_start(trial: Trial, error: Exception) -> Result:
    expected = "driver and simulator to come up with a good link"
    return Result("start", "driver, simulator and daemon start", Verdict.FAILED, str(error), expected)


def _not_calm(result: Result, error: Exception) -> Result:
    if result.verdict is Verdict.FAILED:
        return result
    expected = "the driver good again after the trial"
    return Result(result.name, result.text, Verdict.FAILED, str(error), expected, result.traffic, result.took_s)
