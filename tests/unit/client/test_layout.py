"""Columns of snapshots: the channels that a node shows, its bit, instants by this machine's clock."""

from __future__ import annotations

import sys
from struct import pack

import pytest

from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.clock import Clock
from sioms.protocol.flags import NodeClass
from sioms.protocol.records import READ

CHANNELS = 3


def _raw(node_class: NodeClass) -> bytes:
    """A snapshot in which column i of channel j is 10 i + j."""
    columns = READ[node_class].values()
    rows = [
        pack(f"<{CHANNELS}{column.code}", *[10 * row + j for j in range(CHANNELS)])
        for row, column in enumerate(columns)
    ]
    return pack("<4Q", 7, 10**9, 3, 5) + b"".join(rows)


@pytest.mark.parametrize("node_class", NodeClass)
@pytest.mark.parametrize("channels", ([0, 1, 2], [1, 2], [2], [2, 0], [0, 2], [1, 1]), ids=str)
def test_each_column_is_of_the_channels_that_the_node_shows(node_class: NodeClass, channels: list[int]) -> None:
    shown = SNAPSHOT[node_class](_raw(node_class), Layout(node_class, CHANNELS, channels, -1))
    for row, name in enumerate(READ[node_class]):
        assert getattr(shown, name) == tuple(10 * row + j for j in channels)
        assert [getattr(shown[i], name) for i in range(len(shown))] == list(getattr(shown, name))
        assert shown.array(name).tolist() == list(getattr(shown, name))


@pytest.mark.parametrize("bit", range(6))
def test_a_node_of_one_bit_shows_that_alone(bit: int) -> None:
    port = 1
    word = 10 * list(READ[NodeClass.BINARY]).index("data") + port
    shown = SNAPSHOT[NodeClass.BINARY](_raw(NodeClass.BINARY), Layout(NodeClass.BINARY, CHANNELS, [port], bit))
    assert shown.data == (word >> bit & 1,) == tuple(shown.array("data")) == (shown[0].data,)
    assert shown.edges[0] == 10 * list(READ[NodeClass.BINARY]).index("edges") + port


class _Ahead(Clock):
    """A clock of a cell that shows a millisecond more."""

    @property
    def offset_ns(self) -> int:
        return 10**6


def test_instants_are_by_the_clock_of_this_machine() -> None:
    clock = _Ahead()
    there = SNAPSHOT[NodeClass.BINARY](_raw(NodeClass.BINARY), Layout(NodeClass.BINARY, CHANNELS, [0, 1], -1))
    here = SNAPSHOT[NodeClass.BINARY](
        _raw(NodeClass.BINARY), Layout(NodeClass.BINARY, CHANNELS, [0, 1], -1, clock=clock)
    )
    assert here.changed_ns == tuple(clock.here(each) for each in there.changed_ns) != there.changed_ns
    assert here.edges == there.edges


def test_a_column_is_taken_by_one_function_of_python() -> None:
    """What a control loop runs cold: the property, and what C does."""
    shown = SNAPSHOT[NodeClass.AXIS](_raw(NodeClass.AXIS), Layout(NodeClass.AXIS, CHANNELS, [0, 1, 2], -1))
    called = []
    sys.setprofile(lambda frame, event, _: called.append(frame.f_code.co_name) if event == "call" else None)
    try:
        values = shown.position
    finally:
        sys.setprofile(None)
    assert (called, len(values)) == (["get"], CHANNELS)
