"""How much real time drivers may have together, and that a flood leaves the daemon's timers on time."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sioms.daemon.loop import Loop
from sioms.daemon.realtime import Budget, make_ordinary, realtime_use


def test_the_greediest_yields_when_together_they_take_too_much() -> None:
    said: list[str] = []
    budget = Budget(lambda *_, **values: said.append(f"{values['device']}: {values['why']}"), processors=2)
    used = {"a": 0.0, "b": 0.0, "c": 0.0}

    def look(second: int, **worked: float) -> tuple[str, int] | None:
        for name, value in worked.items():
            used[name] += value
        return budget.look(second, {name: (i, used[name]) for i, name in enumerate(used, 100)})

    assert look(0) is None
    for second in range(1, 10):  # 1.35 of two processors: under 70 %
        assert look(second, a=0.5, b=0.5, c=0.35) is None
    assert look(10, a=0.9, b=0.5, c=0.5) is None  # one busy second is no trouble
    assert look(11, a=0.3, b=0.3, c=0.3) is None
    yielded = [look(second, a=0.5, b=0.9, c=0.3) for second in range(12, 15)]
    assert yielded == [None, None, ("b", 101)]
    assert said == [
        "b: drivers in real-time classes use 1.70 of 2 processors, this one 0.90; at most 0.7 of the machine may be "
        "theirs"
    ]


def test_only_real_time_processes_count() -> None:
    assert realtime_use({"me": os.getpid(), "none": 0, "gone": 2**22 + 1}) == {}
    make_ordinary(2**22 + 1)  # has ended: nothing to do


def test_timers_are_served_between_the_requests_of_a_crowd() -> None:
    loop = Loop()
    late: list[float] = []

    def tick() -> None:
        late.append(time.monotonic())
        loop.after(0.02, tick)

    pairs = [socket.socketpair() for _ in range(40)]
    try:
        for ours, theirs in pairs:
            theirs.send(b"x")
            loop.watch(ours.fileno(), lambda: time.sleep(0.01))  # always readable, and slow to serve
        tick()
        for _ in range(2):
            loop.step()
        gaps = [b - a for a, b in itertools.pairwise(late)]
        assert len(gaps) > 15 and sorted(gaps)[len(gaps) // 2] < 0.1  # one round takes 0.4 s
    finally:
        for pair in pairs:
            for each in pair:
                each.close()
        loop.close()


THREADS = """
import os, sys, threading
from sioms.daemon.loop import Loop
from sioms.daemon.service import _become_prompt
from sioms.daemon.stop_record import StopRecord
from sioms.daemon.users import Users

early = StopRecord(sys.argv[1])
told = []
_become_prompt(Loop(), lambda *words, **more: told.append(words))
if told:
    sys.exit(77)  # it may not
late = StopRecord(sys.argv[1] + "2")
Users(0.2)._ask(lambda: threading.Event().wait(0.4))
if not late._flusher._thread.is_alive():
    sys.exit("the record has no thread any more")
classes = {t: os.sched_getscheduler(int(t)) & ~os.SCHED_RESET_ON_FORK for t in os.listdir("/proc/self/task")}
print(len(classes), set(classes.values()) == {os.SCHED_FIFO})
os._exit(0)
"""


def test_every_thread_of_the_daemon_has_the_class_of_its_loop(tmp_path: Path) -> None:
    """A killed daemon is dead, and its drivers halt, when its last thread has had a processor to end on."""
    command = [sys.executable, "-c", THREADS, str(tmp_path / "stops")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    if done.returncode == 77:
        pytest.skip("needs the right to real-time classes")
    assert done.stdout == "4 True\n", done.stdout + done.stderr
