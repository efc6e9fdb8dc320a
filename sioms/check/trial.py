"""Trials and what came of them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from .held_up import Waits
from .station import Station, Unanswered


class Verdict(Enum):
    """How a trial ended."""

    PASSED = "passed"
    FAILED = "FAILED"
    NOT_APPLICABLE = "n/a"


class Failed(Exception):
    """The driver did not do what it must.

    Args:
        expected: what it must do.
        seen: what it did.
        traffic: messages concerned, as lines.
    """

    def __init__(self, expected: str, seen: str, traffic: list[str] | None = None) -> None:
        super().__init__(f"expected {expected}; saw {seen}")
        self.expected, self.seen, self.traffic = expected, seen, traffic


class Disturbed(Failed):
    """The device went into fault by itself before anything was done to it: mostly its dead-man, of a host held up."""


class NotApplicable(Exception):
    """The trial has nothing to try here; the text says why."""


TRIES = 3
"""Of a trial that was disturbed, by its device or by a machine that held up what it needs; what disturbed it is told
also when a later one passes."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial.

    Attributes:
        name: short, as given to ``--only``.
        text: what is done, in words.
        run: does it; returns what is worth telling.
        wire: needs a wire.
        quick: is also in the quick selection.
    """

    name: str
    text: str
    run: Callable[[Station, bool], str]
    wire: bool = True
    quick: bool = True


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a trial.

    Attributes:
        name, text: of the trial.
        verdict: how it ended.
        seen: what was seen, or why it does not apply.
        expected: what should have been, of a failed one.
        traffic: messages concerned.
        took_s: how long it took [s].
    """

    name: str
    text: str
    verdict: Verdict
    seen: str
    expected: str = ""
    traffic: list[str] = field(default_factory=list)
    took_s: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        names = ("name", "text", "seen", "expected", "traffic", "took_s")
        return {"verdict": self.verdict.value, **{name: getattr(self, name) for name in names}}


def attempt(trial: Trial, station: Station, full: bool) -> Result:
    """Carry out a trial; whatever happens becomes its result."""
    began = time.monotonic()

    def result(verdict: Verdict, seen: str, expected: str = "", traffic: list[str] | None = None) -> Result:
        return Result(
            trial.name, trial.text, verdict, seen, expected, traffic or [], round(time.monotonic() - began, 3)
        )

    if trial.wire and not station.wires:
        return result(Verdict.NOT_APPLICABLE, "the driver has no line")
    try:
        seen = _run(trial, station, full)
    except NotApplicable as error:
        return result(Verdict.NOT_APPLICABLE, str(error))
    except Failed as error:
        traffic = _traffic(station) if error.traffic is None else error.traffic
        return result(Verdict.FAILED, error.seen, error.expected, traffic)
    except (OSError, Unanswered, RuntimeError) as error:  # a time-out is an OSError
        return result(Verdict.FAILED, _seen(error), "the trial to end by itself", _traffic(station))
    return result(Verdict.PASSED, seen)


def _run(trial: Trial, station: Station, full: bool) -> str:
    """Run a trial, again after calm where it was disturbed."""
    told = ""
    for _ in range(TRIES - 1):
        waits = Waits(station.processes())
        try:
            return trial.run(station, full) + told
        except (Failed, OSError, Unanswered, RuntimeError) as error:
            held_up = waits.longest(station.processes())
            if not (held_up or isinstance(error, Disturbed)):
                raise
            told += f"; tried again after {_seen(error)}" + (f" ({held_up})" if held_up else "")
        station.settle()
    return trial.run(station, full) + told


def _seen(error: Exception) -> str:
    if isinstance(error, Failed):
        return error.seen
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def _traffic(station: Station) -> list[str]:
    try:
        return station.exchanges(10)
    except Unanswered as error:
        return [str(error)]
