"""What counts as stuck: processor time and time asleep, not time on the clock."""

from __future__ import annotations

import subprocess
import sys

import pytest

from sioms.daemon.patience import Patience
from sioms.daemon.stop_files import access_list


class Process:
    """A process of which a test says how much it has worked and what it does now."""

    def __init__(self) -> None:
        self.worked_s = 0.0
        self.state = "R"

    def patience(self) -> Patience:
        patience = Patience(1, 30.0, lambda _: self.worked_s, lambda _: self.state)
        patience.renew(0.0)
        return patience


def test_a_process_that_gets_no_processor_is_slow_for_ever() -> None:
    process = Process()
    patience = process.patience()
    for second in range(1, 1000):
        process.worked_s += 0.02
        assert patience.stuck(second) == ""
        process.state = "RD"[second % 2]


@pytest.mark.parametrize("state", ["R", "D"])
def test_a_process_that_gets_no_processor_or_disk_at_all_is_not_stuck(state: str) -> None:
    process = Process()
    process.state = state
    patience = process.patience()
    assert [patience.stuck(second) for second in range(1, 1000)] == [""] * 999


def test_a_process_that_works_without_an_end_is_stuck() -> None:
    process = Process()
    patience = process.patience()
    for second in range(1, 31):
        process.worked_s += 1.0
        assert patience.stuck(second) == ""
    process.worked_s += 1.0
    assert "31 s of processor time" in patience.stuck(31)
    patience.renew(31)
    assert patience.stuck(32) == ""


def test_a_process_that_sleeps_is_stuck() -> None:
    process = Process()
    process.state = "S"
    patience = process.patience()
    said = [patience.stuck(second) for second in range(1, 33)]
    assert said[:30] == [""] * 30 and "waited for something else for 31 s" in said[30]


def test_a_real_process_is_seen_to_work_and_to_sleep() -> None:
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        patience = Patience(busy.pid, 0.2)
        try:
            said = ""
            for _ in range(500):
                busy.poll()
                try:
                    busy.wait(0.02)
                except subprocess.TimeoutExpired:
                    said = said or patience.stuck(0.0)
                if said:
                    break
            assert "of processor time" in said
        finally:
            busy.kill()


def test_an_access_list_is_in_the_order_that_the_kernel_wants() -> None:
    packed = access_list({70, 5}, {9})
    assert packed[:4] == b"\x02\0\0\0" and len(packed) == 4 + 7 * 8
    tags = [int.from_bytes(packed[4 + 8 * i : 6 + 8 * i], "little") for i in range(7)]
    assert tags == [1, 2, 2, 4, 8, 0x10, 0x20]
    ids = [int.from_bytes(packed[8 + 8 * i : 12 + 8 * i], "little") for i in range(7)]
    assert ids[1:3] == [5, 70] and ids[4] == 9
