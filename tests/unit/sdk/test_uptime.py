"""Uptime: restarts are seen, a late host, a slow clock and a figure that is cut are not taken for one."""

from __future__ import annotations

import random

import pytest

from sioms.sdk.codec.uptime import Uptime

MS = 1_000_000


def test_a_restart_is_seen_however_soon_it_comes() -> None:
    for before_ms in (500, 5_000, 4_000_000_000):
        for passed_ms in (20, 300, 5_000):
            uptime = Uptime(0.001, 2**32, 9)
            shown = before_ms if before_ms < 10**9 else before_ms // 10
            assert uptime.judge(0, 5 * MS, shown) == ""
            told = uptime.judge(passed_ms * MS, (passed_ms + 5) * MS, min(passed_ms // 2, 100))
            assert "its time since the start was" in told, (before_ms, passed_ms)


def test_answers_that_stand_still_are_seen() -> None:
    uptime = Uptime(0.001, 2**32, 9)
    assert [bool(uptime.judge(t * MS, t * MS, 77_000)) for t in range(0, 400, 100)] == [
        False,
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("start_ms", [0, 999_995_000, 4_294_960_000])
def test_a_device_that_runs_on_is_believed(start_ms: int) -> None:
    chance, uptime, now_ns = random.Random(1), Uptime(0.001, 2**32, 9), 0
    for _ in range(20_000):
        asked_ns = now_ns + chance.randrange(1, 50 * MS)
        valid_ns = asked_ns + chance.randrange(0, 3_000 * MS if chance.random() < 0.01 else 20 * MS)
        now_ns = valid_ns + chance.randrange(0, 3_000 * MS if chance.random() < 0.01 else 20 * MS)
        count = (start_ms + int(valid_ns / 1e6 * 1.002)) % 2**32
        assert uptime.judge(asked_ns, now_ns, int(str(count)[:9])) == ""
