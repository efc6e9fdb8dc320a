"""A client whose machine has another monotonic clock than the cell's: each time that it is told is right."""

from __future__ import annotations

import pytest
from daemon_rig import Daemon

from sioms.check import other_clock
from sioms.check.remote import Gateway, Relay, ZenohGateway

pytestmark = pytest.mark.skipif(not other_clock.available(), reason="no right to make a time namespace")


@pytest.mark.parametrize("kind", [Gateway, ZenohGateway])
def test_both_clocks_and_utc_are_right(kind: type[Gateway], daemon: Daemon) -> None:
    with kind(daemon.socket) as gate, Relay(gate.port) as relay:
        relay.delay_s = 0.004
        found = other_clock.seen(gate.trusted(relay.port))
    assert len(found["off"]) > 1
    for off, error in zip(found["off"], found["error"], strict=True):
        assert abs(off) <= error < 1_000_000_000, "the truth lies within what is stated"
    assert max(map(abs, found["utc_off"])) < 5_000_000
    assert -found["error"][-1] < found["age"] < 5_000_000_000
    assert set(found["instants"]) == {"marker", "synch", "edge", "column", "stop"}
    for what, ago_ns in found["instants"].items():
        assert abs(ago_ns) < 5_000_000_000, f"{what}: {ago_ns / 1e9:g} s"
