"""The table of ``devin --record``: the reading's own stamp, and columns that tell what they are."""

from __future__ import annotations

from tool_rig import AXES, node_info, snapshot

from sioms.protocol.flags import NodeClass
from sioms.tools.recording import Table

MODULE = snapshot(
    NodeClass.AXIS, 4, position=[0.0, 0.25, 0.0, 0.0], velocity=[0.0, -0.5, 0.0, 0.0], force=[0.0, 3.0, 0.0, 0.0],
    commanded_position=[0.0, 0.125, 0.0, 0.0],
)  # fmt: skip


def test_a_row_has_the_stamp_that_the_driver_gave_the_reading():
    table = Table(node_info(NodeClass.AXIS, AXES), [1], None)
    assert table.head == "time [s]\tposition [m]\tvelocity [m/s]\tforce [N]\tcommand [m]\n"
    assert table.row(MODULE) == "1.000000000\t0.25\t-0.5\t3\t0.125\n"


def test_several_axes_are_told_apart_and_digits_are_those_asked_for():
    table = Table(node_info(NodeClass.AXIS, AXES, unit="rad"), [1, 3], 2)
    assert table.head.split("\t")[1:4] == [
        "yaxis position [rad]",
        "yaxis velocity [rad/s]",
        "yaxis force [N m]",
    ]
    assert table.row(MODULE).split("\t")[:3] == ["1.000000000", "2.50e-01", "-5.00e-01"]


def test_values_have_the_name_of_their_channel():
    table = Table(node_info(NodeClass.ANALOG, ["fx"], unit="N"), [0], None)
    assert table.head == "time [s]\tfx [N]\n"
    assert table.row(snapshot(NodeClass.ANALOG, 1, data=[-3.5])) == "1.000000000\t-3.5\n"
