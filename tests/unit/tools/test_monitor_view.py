"""The picture of the monitor on screens of every size."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tool_rig import AXES, node_info, snapshot

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass
from sioms.tools import monitor
from sioms.tools.monitor_events import History
from sioms.tools.monitor_view import JOG_KEYS, KEYS, NodeView, Style, View, body, head, page, screen

SECOND = 1_000_000_000


def status(stopped_ns: int = 0, **device: Any) -> dict[str, Any]:
    one = {
        "name": "mod0",
        "state": "up",
        "link": "good",
        "deaths": 0,
        "reason": "",
        "link_reason": "",
        **device,
    }
    return {
        "workcell": "demo",
        "pid": 42,
        "stopped_ns": stopped_ns,
        "stop_source": "eva: hand",
        "devices": [one],
        "sessions": [],
    }


def node(node_class: NodeClass, names: list[str], reading: Any, **rest: Any) -> NodeView:
    info = node_info(node_class, names, width=8)
    given = {
        "name": "mod0",
        "device": "mod0",
        "info": info,
        "snapshot": reading,
        "why": "",
        "holder": "",
        "rate_hz": None,
    }
    return NodeView(**{**given, **rest})


AXIS = node(
    NodeClass.AXIS, list(AXES),
    snapshot(NodeClass.AXIS, 4, position=[0.1, 0, 0, 0], velocity=[0.05, 0, 0, 0], in_motion=[1, 0, 0, 0],
             status=[AxisStatus.MOVING, 0, AxisStatus.FAULT, 0], buffered=[3, 0, 0, 0]),
    holder="pid 7 (eva) devout", rate_hz=999.6,
)  # fmt: skip
ANALOG = node(
    NodeClass.ANALOG, [f"e{i}" for i in range(16)],
    snapshot(NodeClass.ANALOG, 16, data=[float(i) for i in range(16)], flags=[0] * 15 + [AnalogStatus.SATURATED]),
)  # fmt: skip
BINARY = node(NodeClass.BINARY, ["out"], snapshot(NodeClass.BINARY, 1, data=[5], edges=[9]))
VIEW = View(status(), [AXIS, ANALOG, BINARY], "", "", 5 * SECOND)


def test_everything_is_there():
    text = "\n".join(page(VIEW, 140))
    for part in (
        "held by pid 7 (eva) devout",
        "1000/s",
        "0.100000 m",
        "moving",
        "fault",
        "buffer     3",
        "00000101  = 5  9 edges",
        "saturated",
    ):
        assert part in text


def test_styles_tell_what_matters():
    axes = body(VIEW, 140)[1:5]
    assert [line.style for line in axes] == [Style.GOOD, Style.PLAIN, Style.WARN, Style.PLAIN]


def test_a_stop_and_a_lost_device_stand_at_the_top():
    lines = head(View(status(2 * SECOND, state="restarting", reason="killed"), [], "", "", 5 * SECOND))
    assert lines[1].style is Style.ALARM
    assert "EMERGENCY STOP for 3.0 s: eva: hand" in lines[1].text
    assert "mod0: restarting" in lines[2].text
    assert "killed" in lines[2].text
    assert head(View({}, [], "it has gone", "", 0))[0].text == "NO DAEMON: it has gone"


def test_why_a_node_cannot_be_read():
    lost = node(NodeClass.AXIS, ["xaxis"], None, why="its driver is gone")
    assert body(View(status(), [lost], "", "", 0), 80)[1].text.strip() == "its driver is gone"


@pytest.mark.parametrize("width", [60, 80, 109])
def test_flags_stay_on_a_narrow_screen(width):
    lines, _ = screen(VIEW, width, 40, 0)
    assert any(line.text.rstrip().endswith("moving") for line in lines)


@given(st.integers(1, 200), st.integers(1, 60), st.integers(-5, 500))
def test_a_screen_of_any_size_is_filled_exactly(width, height, scroll):
    lines, done = screen(VIEW, width, height, scroll)
    assert len(lines) == height
    assert all(len(line.text) <= width for line in lines)
    assert done >= 0
    assert lines[-1].text[:20] == KEYS[:20][:width]


def test_scrolling_ends_at_the_last_line():
    lines, done = screen(VIEW, 140, 8, 10_000)
    assert "out" in lines[-2].text
    assert screen(VIEW, 140, 8, done) == (lines, done)


def many_faults(count: int) -> View:
    reading = snapshot(
        NodeClass.AXIS, 4, status=[AxisStatus.FAULT | AxisStatus.STALLED, 0, 0, AxisStatus.FOLLOWING_ERROR]
    )
    nodes = [node(NodeClass.AXIS, list(AXES), reading, name=f"mod{i}") for i in range(count)]
    return View(status(), nodes, "", "", 5 * SECOND, clock="12:34:56")


@pytest.mark.parametrize("scroll", [0, 20, 1000])
def test_a_fault_is_at_the_top_wherever_the_body_is(scroll):
    lines, _ = screen(many_faults(6), 80, 24, scroll)
    text = " ".join(line.text for line in lines if line.style is Style.ALARM)
    for i in range(6):
        assert f"mod{i}.{AXES[0]}: " in text and f"mod{i}.{AXES[3]}: " in text


@given(st.integers(20, 120), st.integers(6, 40), st.integers(1, 40))
def test_faults_that_do_not_fit_are_counted(width, height, count):
    lines, _ = screen(many_faults(count), width, height, 0)
    text = " ".join(line.text for line in lines)
    shown = sum(f"mod{i}.{AXES[axis]}: " in text for i in range(count) for axis in (0, 3))
    assert shown == 2 * count or "more lines of errors"[:width] in text or width < 45


def test_the_head_has_a_clock():
    assert "12:34:56" in head(many_faults(1))[0].text
    assert "12:34:56" in head(View({}, [], "gone", "", 0, clock="12:34:56"))[0].text


def test_units_stand_on_a_screen_of_80_columns():
    lines, _ = screen(VIEW, 80, 40, 0)
    (line,) = [line.text for line in lines if line.text.endswith("moving")]
    assert " m " in line and " m/s " in line and " N " in line


def test_last_values_stay_after_the_daemons_death():
    old = node(NodeClass.AXIS, list(AXES), AXIS.snapshot, why="the daemon has gone", age_s=3.25)
    text = [line.text for line in body(View({}, [old], "it has gone", "", 0), 100)]
    assert "LAST SEEN 3.2 s AGO: the daemon has gone" in text[0]
    assert "0.10000 m" in text[1]
    assert {line.style for line in body(View({}, [old], "gone", "", 0), 100)[1:]} == {Style.DIM}


def test_the_keys_fit_on_80_columns():
    assert max(len(KEYS), len(JOG_KEYS)) <= 80


def test_history_tells_what_came_and_what_went_but_not_of_what_cannot_be_seen():
    history = History()
    good = node(NodeClass.AXIS, list(AXES), snapshot(NodeClass.AXIS, 4))
    bad = many_faults(1).nodes[0]
    bad = replace(bad, name="mod0")
    gone = replace(good, snapshot=None, info=None)
    for i, (found, lost) in enumerate([(good, ""), (bad, ""), (bad, ""), (gone, "it has gone"), (good, "")]):
        history.look(View({} if lost else status(), [found], lost, "", 0, clock=str(i)))
    assert set(history.lines) == {
        f"1 mod0.{AXES[0]}: fault, stalled",
        f"1 mod0.{AXES[3]}: following error",
        "3 no daemon: it has gone",
        "4 daemon: good again",
        f"4 mod0.{AXES[0]}: good again",
        f"4 mod0.{AXES[3]}: good again",
    }
    assert len(history.lines) == 6


@pytest.mark.parametrize(("term", "paints"), [("xterm", True), ("dumb", False)])
def test_a_dumb_terminal_is_not_painted(monkeypatch: pytest.MonkeyPatch, term: str, paints: bool) -> None:
    terminal = SimpleNamespace(isatty=lambda: True)
    monkeypatch.setattr("sioms.tools.monitor.sys", SimpleNamespace(stdout=terminal, stdin=terminal))
    monkeypatch.setenv("TERM", term)
    assert monitor._can_paint() is paints


def test_alarms_stand_in_the_head_those_first_that_want_attention():
    alarm = {"node": "mod0.xaxis", "what": "force", "text": "force 12 N has reached 10 N", "since": 1.0, "by": "",
             "note": "", "worst": 2, "severity": 2, "state": "unacknowledged"}  # fmt: skip
    alarms = [
        {**alarm, "state": "acknowledged", "by": "eva", "note": "seen"},
        {**alarm, "what": "fault"},
        {**alarm, "what": "position", "severity": 0, "state": "returned"},
        alarm,
    ]
    lines = head(View(status(), [], "", "", 0, alarms=alarms))[1:-1]
    assert [line.text for line in lines] == [
        "unacknowledged major alarm of mod0.xaxis force: force 12 N has reached 10 N",
        "returned major alarm of mod0.xaxis position: force 12 N has reached 10 N",
        "acknowledged major alarm of mod0.xaxis force: force 12 N has reached 10 N [acknowledged by eva: seen]",
    ]
    assert [line.style for line in lines] == [Style.ALARM, Style.WARN, Style.WARN]
