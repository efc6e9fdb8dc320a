"""The picture of the monitor on screens of every size."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tool_rig import AXES, node_info, snapshot

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass
from sioms.tools.monitor_view import KEYS, NodeView, Style, View, body, head, page, screen

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
        "workcell": "demo", "pid": 42, "stopped_ns": stopped_ns, "stop_source": "eva: hand", "devices": [one], "sessions": [],
    }  # fmt: skip


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
