"""The daemon's log under overload: a flood of one kind is cut short and counted, other lines are not."""

from __future__ import annotations

import pytest

from sioms.daemon.log import BURST, SPAN_S, Log


def test_a_flood_is_counted_and_hides_nothing_else(capfd: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    log = Log(clock=lambda: now[0])
    for i in range(1000):
        now[0] = i / 1000
        log("warning", "device late", device="mod0", reason=i)
    log("warning", "device late", device="mod1", reason="x")
    log("warning", "emergency stop", source="eva")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == BURST + 1 + 2
    assert "of these are counted only" in lines[BURST]
    assert "device=mod1" in lines[-2] and "emergency stop" in lines[-1]
    now[0] = SPAN_S + 1.0
    log("warning", "device late", device="mod0", reason="again")
    log("warning", "device late", device="mod0", reason="and again")
    lines = capfd.readouterr().err.splitlines()
    assert f"left_out={1000 - BURST - 1}" in lines[0] and "reason=again" in lines[0]
    assert "left_out" not in lines[1]
