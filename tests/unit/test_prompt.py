"""Threads that a busy machine must not keep waiting."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from sioms import prompt
from sioms.client.channel import Call
from sioms.client.fleet import _Together
from sioms.gateway import stops, zenoh
from sioms.prompt import BoundedPrompt, Briefly, Hurry, be_prompt
from sioms.protocol import verbs


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
    assert look(0.9) == [os.SCHED_OTHER | os.SCHED_RESET_ON_FORK]
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
    assert classes == [(0, real_time), (11, prompt.ORDINARY)]
    monkeypatch.setattr(prompt, "_ran_ns", lambda _: 0)
    now_ns[0] += int(prompt.ORDINARY_S * 1.1e9)
    bounded.look()
    assert classes[2:] == [(11, real_time), (12, real_time)]


@pytest.fixture
def in_a_thread() -> Iterator[None]:
    """Skip where a thread has no right to a real-time class; what a test does to this one is undone."""
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, before, os.sched_param(0))
    except PermissionError:
        pytest.skip("no right to a real-time class here")
    yield
    os.sched_setscheduler(0, before, os.sched_param(0))


@pytest.mark.usefixtures("in_a_thread")
def test_who_is_not_privileged_may_make_them_ordinary(monkeypatch: pytest.MonkeyPatch) -> None:
    child = os.fork()
    if not child:
        status = 1
        try:
            bounded: Any = BoundedPrompt()
            bounded.enter()
            os.setresuid(65534, 65534, 65534)  # as a gateway's user, whom its unit allows the class
            monkeypatch.setattr(prompt, "_ran_ns", lambda thread: 1 << 60)
            bounded.look()
            status = 0 if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.usefixtures("in_a_thread")
def test_a_thread_is_prompt_for_a_block_only_and_keeps_a_class_of_its_own() -> None:
    def which() -> int:
        return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK

    with Briefly():
        assert (which(), os.sched_getparam(0).sched_priority) == (os.SCHED_FIFO, 1)
    assert which() == os.SCHED_OTHER
    os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(7))
    with Briefly():
        assert which() == os.SCHED_RR
    assert (which(), os.sched_getparam(0).sched_priority) == (os.SCHED_RR, 7)


@pytest.mark.usefixtures("in_a_thread")
def test_an_interrupted_thread_is_not_left_prompt(monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.sched_setscheduler

    def interrupted(thread: int, policy: int, param: os.sched_param) -> None:
        real(thread, policy, param)
        if policy & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO:
            raise KeyboardInterrupt  # of a signal whose handler runs here

    monkeypatch.setattr(prompt.os, "sched_setscheduler", interrupted)
    with pytest.raises(KeyboardInterrupt), Briefly():
        pass
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER


@pytest.mark.usefixtures("in_a_thread")
def test_threads_of_a_library_are_prompt_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry, met, ends = Hurry(), threading.Event(), threading.Event()

    def run() -> None:
        hurry.meet()
        met.set()
        ends.wait(10)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert met.wait(10) and thread.native_id is not None

        def which() -> int:
            return os.sched_getscheduler(thread.native_id or 0) & ~os.SCHED_RESET_ON_FORK

        now_ns = [10**9]
        monkeypatch.setattr(prompt.time, "monotonic_ns", lambda: now_ns[0])
        hurry.begin()
        assert which() == os.SCHED_FIFO
        now_ns[0] += prompt.MOMENT_NS - 1
        hurry.look()
        assert which() == os.SCHED_FIFO, "too soon"
        now_ns[0] += 1
        hurry.look()
        assert which() == os.SCHED_OTHER
    finally:
        ends.set()
        thread.join()
    hurry.begin()  # of a thread that has ended: nothing


@pytest.mark.usefixtures("in_a_thread")
@pytest.mark.parametrize(
    ("message", "wanted"), [(verbs.EmergencyStop("", "why", False, 0), True), (verbs.Reset(""), False)]
)
def test_a_fleet_tells_all_of_a_stop_before_who_hears_takes_its_processor(message: Any, wanted: bool) -> None:
    seen = []

    class Cell:
        class _channel:
            @staticmethod
            def send(call: Call) -> int:
                seen.append(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO)
                return 1

    calls: Any = [(Cell, Call("tell", message))] * 3
    assert _Together()._send(calls, None) == [1, 1, 1]
    assert seen == [wanted] * 3
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
