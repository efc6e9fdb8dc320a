"""The daemon's log under overload: a flood of one kind is cut short and counted, other lines are not."""

from __future__ import annotations

import pytest

from sioms.daemon.log import BURST, MOST, SPAN_S, Log
from sioms.daemon.rights import Peer


def test_a_flood_is_counted_and_hides_nothing_else(capfd: pytest.CaptureFixture[str]) -> None:
    now = [0.0]
    log = Log(clock=lambda: now[0])
    for i in range(1000):
        now[0] = i / 1000
        log("warning", "device late", device="mod0", reason=i)
    log("warning", "device late", device="mod1", reason="x")
    log("warning", "emergency stop", source="eva")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == BURST + 2
    assert "device=mod1" in lines[-2] and "emergency stop" in lines[-1]
    now[0] = SPAN_S + 2.0
    log("warning", "device late", device="mod0", reason="again")
    log("warning", "device late", device="mod0", reason="and again")
    lines = capfd.readouterr().err.splitlines()
    assert f"{1000 - BURST} lines suppressed" in lines[0] and "reason=999" in lines[0]
    assert "reason=again" in lines[1] and "suppressed" not in lines[2]


def test_one_users_flood_hides_no_line_about_another_and_its_end_is_told(
    capfd: pytest.CaptureFixture[str],
) -> None:
    now = [0.0]
    log = Log(clock=lambda: now[0])
    for pid in range(100):
        log("warning", "session ended", peer=Peer(pid, 1000, "eva", frozenset()), why="nonsense")
    log("warning", "session ended", peer=Peer(7, 1001, "ben", frozenset()), why="nonsense")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == BURST + 1 and "ben" in lines[-1]
    log.tell_suppressed()
    assert not capfd.readouterr().err
    now[0] = SPAN_S + 1.0
    log.tell_suppressed()
    (line,) = capfd.readouterr().err.splitlines()
    assert f"{100 - BURST} lines suppressed" in line and "eva" in line


def test_sources_that_are_told_apart_are_bounded(capfd: pytest.CaptureFixture[str]) -> None:
    log = Log(clock=lambda: 0.0)
    for uid in range(5000):
        log("warning", "session ended", peer=Peer(1, uid, f"u{uid}", frozenset()), why="nonsense")
    assert len(log._spans) <= MOST + 1
