"""Reading the wall clock beside CLOCK_MONOTONIC, on a machine that gives the reader no processor in between."""

from __future__ import annotations

import pytest

from sioms.client import wall

AHEAD_NS = 10**18
WAIT_NS = 80_000_000


@pytest.mark.parametrize("waits", [0, 1, 5])
def test_what_comes_between_the_clocks_is_in_no_offset(waits: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording's UTC is right by more than a busy machine lets a process wait."""
    now, read = 10**12, 0

    def monotonic_ns() -> int:
        nonlocal now
        now += 100
        return now

    def time_ns() -> int:
        nonlocal now, read
        read += 1
        now += 100
        utc_ns = now + AHEAD_NS
        now += WAIT_NS if read <= waits else 0
        return utc_ns

    monkeypatch.setattr("sioms.client.wall.time.monotonic_ns", monotonic_ns)
    monkeypatch.setattr("sioms.client.wall.time.time_ns", time_ns)
    found = wall.wall()
    assert abs(found.ahead_ns - AHEAD_NS) < 1000 and read == waits + 1
