"""An observer of deaths: what it has heard counts only in the scheduling class of what it stands for."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest

from sioms.bench import killing
from sioms.bench.observer import Observer, Seen


class Forks:
    """What an observer needs of a daemon."""

    def __init__(self) -> None:
        self.pids: list[int] = []

    def fork(self, work: Any) -> int:
        if not (pid := os.fork()):
            try:
                work()
            finally:
                os._exit(0)
        self.pids.append(pid)
        return pid


@pytest.fixture
def observer() -> Iterator[Observer]:
    forks: Any = Forks()
    with closing(Observer(forks)) as found:
        yield found
    for pid in forks.pids:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def test_deaths_are_heard_in_the_class_of_another_process(observer: Observer) -> None:
    with subprocess.Popen(["sleep", "60"]) as victim:
        observer.watch([victim.pid], os.getpid())
        began = time.monotonic_ns()
        victim.kill()
        victim.wait()
        time.sleep(0.05)
        seen = observer.seen()
    assert seen.unlike == "" and seen.ended_ns[victim.pid] >= began


def test_an_observer_in_another_class_says_so(observer: Observer) -> None:
    with subprocess.Popen(["true"]) as gone:
        gone.wait()
    observer.watch([os.getpid()], gone.pid)
    assert f"scheduling class of process {gone.pid}" in observer.seen().unlike
    observer.watch([os.getpid()], os.getpid())
    assert observer.seen().unlike == "", "of each round by itself"


@pytest.mark.parametrize("unlike", ["", "take the scheduling class of process 7: no such process"])
def test_a_round_with_an_observer_in_another_class_is_not_compared(unlike: str) -> None:
    tally, late_ns = killing.Tally(), int(1e6 * (killing.BAR_MS + 5))
    seen = Seen({11: 1_000_000}, 0, unlike)
    killing._compare(seen, {"x.a0": late_ns}, {"x.a0": (11, 0)}, tally, False)
    assert (tally.heard, tally.late) == (([], []) if unlike else ([1_000_000], [late_ns - 1_000_000]))
    assert unlike in tally.notes[0]
