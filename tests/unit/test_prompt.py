"""Threads that a busy machine must not keep waiting."""

from __future__ import annotations

import os
import threading

import pytest

from sioms.gateway import stops, zenoh
from sioms.prompt import be_prompt


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
