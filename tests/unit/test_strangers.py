"""What a gateway takes apart of strangers is counted from when it has done with a client that was let in."""

from __future__ import annotations

from typing import Any

import pytest

from sioms.bench import strangers


def test_frames_of_a_client_that_was_let_in_are_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    left, now = [30], [0.0]

    class Gateway:
        taken = 0

    gateway: Any = Gateway()

    def sleep(for_s: float) -> None:
        now[0] += for_s
        step = min(left[0], int(10 * for_s))
        left[0] -= step
        gateway.taken += step

    monkeypatch.setattr(strangers.time, "sleep", sleep)
    monkeypatch.setattr(strangers.time, "monotonic", lambda: now[0])
    strangers._settle(gateway)
    assert not left[0] and gateway.taken == 30
    left[0] = 10**9
    strangers._settle(gateway)
    assert left[0], "a gateway that goes on for ever is not waited for"
