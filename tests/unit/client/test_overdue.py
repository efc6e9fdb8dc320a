"""How long an overdue answer is waited for, by what its process does."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

from sioms.client.channel import FIRST_LOOK_S
from sioms.client.overdue import GRACE_S, LOOK_S, MOST_S, Overdue, look_at

if TYPE_CHECKING:
    from sioms.client.overdue import Seen


def waited(does: Callable[[float], Seen], pid: int = 7, enough: Callable[[], bool] | None = None) -> float:
    """Return how long after its time-out a request is given up, with a process that does this at each instant."""
    now_s = FIRST_LOOK_S
    overdue = Overdue(pid, 0.0, enough, lambda _: does(now_s))
    while until_s := overdue.until(now_s):
        assert until_s > now_s, "no time passes between two looks"
        now_s = until_s
    return now_s


@pytest.mark.parametrize("state", ["T", "t", "Z", "X"])
def test_one_that_is_stopped_gets_the_grace(state: str) -> None:
    assert waited(lambda s: (state, int(s * 1000), 0)) == GRACE_S


def test_one_that_sleeps_and_does_nothing_gets_the_grace() -> None:
    assert waited(lambda _: ("S", 5, 6)) == GRACE_S


@pytest.mark.parametrize("state", ["R", "D"])
def test_one_that_waits_for_the_processor_is_waited_for(state: str) -> None:
    assert waited(lambda _: (state, 5, 6)) == MOST_S


@pytest.mark.parametrize("place", [0, 1])
def test_one_that_gets_on_between_two_looks_is_waited_for(place: int) -> None:
    """Asleep whenever it is looked at, but its times go up."""
    times = (lambda s: (int(s * 100), 0), lambda s: (0, int(s * 100)))[place]
    assert waited(lambda s: ("S", *times(s))) == MOST_S


def test_one_that_is_stopped_later_is_given_up_at_the_next_look() -> None:
    assert 10.0 <= waited(lambda s: ("R" if s < 10.0 else "T", 0, 0)) <= 10.0 + LOOK_S


def test_one_that_goes_to_sleep_later_gets_the_grace_from_then_on() -> None:
    assert waited(lambda s: ("R" if s < 10.0 else "S", 0, 0)) == pytest.approx(10.0 + GRACE_S, abs=2 * LOOK_S)


def test_one_that_nobody_knows_or_may_see_gets_the_grace() -> None:
    def hidden(_: float) -> Seen:
        raise FileNotFoundError

    assert waited(lambda _: ("R", 0, 0), pid=0) == GRACE_S
    assert waited(hidden) == GRACE_S


def test_an_answer_that_is_not_needed_any_more_is_not_waited_for() -> None:
    assert waited(lambda _: ("R", 0, 0), enough=lambda: True) == FIRST_LOOK_S
    looks = iter((False, False, True))
    assert waited(lambda _: ("R", 0, 0), enough=lambda: next(looks)) == FIRST_LOOK_S + 2 * LOOK_S, (
        "it is asked again soon"
    )


@pytest.fixture
def child() -> Iterator[Callable[[str], int]]:
    """Start a process that runs this text of Python."""
    children = []

    def start(text: str) -> int:
        process = subprocess.Popen([sys.executable, "-c", f"print(flush=True)\n{text}"], stdout=subprocess.PIPE)
        children.append(process)
        assert process.stdout is not None
        process.stdout.readline()
        return process.pid

    yield start
    for process in children:
        process.kill()
        process.communicate()


def test_what_a_process_does_is_seen(child: Callable[[str], int]) -> None:
    busy = child("while True: pass")
    first = look_at(busy)
    while look_at(busy)[1] == first[1]:
        os.sched_yield()
    assert first[0] == "R"
    asleep = child("import signal; signal.pause()")
    while (seen := look_at(asleep))[0] != "S":
        os.sched_yield()
    assert look_at(asleep) == seen
    os.kill(busy, signal.SIGSTOP)
    while look_at(busy)[0] != "T":
        os.sched_yield()
    with pytest.raises(OSError):
        look_at(2**22 + 1)


def _together(first: Seen, other: Callable[[float], Seen]) -> float:
    now_s = FIRST_LOOK_S
    overdue = Overdue(7, 0.0, None, lambda pid: first if pid == 7 else other(now_s), through=8)
    while until_s := overdue.until(now_s):
        now_s = until_s
    return now_s


def test_one_that_waits_for_another_process_is_waited_for_while_that_gets_on() -> None:
    """A daemon that closes a node sleeps until the driver, which may be in the run queue, has halted it."""
    asleep = ("S", 5, 6)
    assert _together(asleep, lambda _: ("R", 0, 0)) == MOST_S
    assert _together(asleep, lambda s: ("S", int(s * 100), 0)) == MOST_S
    assert _together(asleep, lambda _: asleep) == GRACE_S
    assert _together(asleep, lambda _: ("T", 0, 0)) == GRACE_S
    assert _together(("T", 5, 6), lambda _: ("R", 0, 0)) == GRACE_S, "one that is stopped answers nobody"
