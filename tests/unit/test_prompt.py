"""Threads that a busy machine must not keep waiting."""

from __future__ import annotations

import os
import threading
from typing import Any

import pytest

from sioms import prompt
from sioms.gateway import stops, zenoh
from sioms.prompt import BoundedPrompt, be_prompt


def test_one_thread_is_ahead_of_ordinary_ones_and_no_other() -> None:
    found: list[object] = []

    def run() -> None:
        if be_prompt():
            found.extend((os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(0).sched_priority))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if not found:
        pytest.skip("no right to a real-time class here")
    assert found == [os.SCHED_FIFO, 1] and os.sched_getscheduler(0) == os.SCHED_OTHER


@pytest.mark.parametrize("run", [stops.Stops._run, zenoh.Zenoh._run_stops])
def test_stops_of_a_gateway_are_passed_on_by_such_a_thread(run: object, monkeypatch: pytest.MonkeyPatch) -> None:
    class Asked(Exception):
        pass

    def ask() -> bool:
        raise Asked

    for module in (stops, zenoh):
        monkeypatch.setattr(module, "be_prompt", ask)
    with pytest.raises(Asked):
        run(object())  # type: ignore[operator]


def test_threads_that_others_keep_busy_are_ordinary_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns, ran_ns, classes = [0], {11: 5}, list[int]()
    monkeypatch.setattr(prompt, "be_prompt", lambda: True)
    monkeypatch.setattr(prompt, "_ran_ns", lambda thread: ran_ns.get(thread, -1))
    monkeypatch.setattr(prompt.time, "monotonic_ns", lambda: now_ns[0])
    monkeypatch.setattr(prompt.threading, "get_native_id", lambda: 11)
    monkeypatch.setattr(prompt.os, "sched_setscheduler", lambda thread, policy, _: classes.append(policy))
    bounded: Any = BoundedPrompt()

    def look(took: float) -> list[int]:
        now_ns[0] += 100_000_000
        ran_ns[11] += int(took * 100_000_000)
        classes.clear()
        bounded.look()
        return list(classes)

    bounded.enter()
    bounded.enter()
    assert look(0.2) == []
    assert look(0.9) == [os.SCHED_OTHER]
    assert all(look(0.0) == [] for _ in range(10)), "not at once again"
    assert look(0.0) == [os.SCHED_FIFO | os.SCHED_RESET_ON_FORK]
    ran_ns.clear()
    ran_ns[12] = 0
    now_ns[0] += 100_000_000
    bounded.look()
    assert not bounded._ran_ns, "a thread that has ended is none"


def test_a_thread_that_begins_while_the_others_are_ordinary_is_so_too(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns, thread, classes = [0], [11], list[tuple[int, int]]()
    monkeypatch.setattr(prompt, "_ran_ns", lambda _: now_ns[0])
    monkeypatch.setattr(prompt.time, "monotonic_ns", lambda: now_ns[0])
    monkeypatch.setattr(prompt.threading, "get_native_id", lambda: thread[0])
    monkeypatch.setattr(prompt.os, "sched_setscheduler", lambda who, policy, _: classes.append((who, policy)))
    bounded, real_time = BoundedPrompt(), os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    bounded.enter()
    now_ns[0] = 100_000_000  # and it ran all that time
    bounded.look()
    thread[0] = 12
    bounded.enter()
    assert classes == [(0, real_time), (11, os.SCHED_OTHER)]
    monkeypatch.setattr(prompt, "_ran_ns", lambda _: 0)
    now_ns[0] += int(prompt.ORDINARY_S * 1.1e9)
    bounded.look()
    assert classes[2:] == [(11, real_time), (12, real_time)]
