"""Which numbers devout takes, and the records that it makes of them."""

from __future__ import annotations

import pytest
from tool_rig import AXES, node_info

from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import ANALOG_WRITE, AXIS_WRITE, BINARY_WRITE, WRITE
from sioms.tools.columns import Columns
from sioms.tools.options import UsageError, fold

NAMES = list(WRITE[NodeClass.AXIS])


def columns(line: str, node_class=NodeClass.AXIS, names=AXES) -> Columns:
    return Columns(fold("devout", line.split()).targets[0], node_info(node_class, names, width=8))


def axis_records(data: bytes) -> list[dict[str, float]]:
    return [dict(zip(NAMES, fields, strict=True)) for fields in AXIS_WRITE.iter_unpack(data)]


def test_default_is_one_position_an_axis():
    made = columns("mod0")
    assert (made.count, made.replace, made.has_end) == (4, True, True)
    records = axis_records(made.records([1, 2, 3, 4]))
    assert [(r["axis"], r["position"]) for r in records] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert {r["control_mode"] for r in records} == {ControlMode.POSITION}


def test_numbers_have_one_order_whatever_the_order_of_the_letters():
    made = columns("-n1smtoFfjavp mod0")
    assert made.count == 10
    (record,) = axis_records(made.records([1, 2, 3, 4, 5, 6, 7, 8, 9, 1 << 49]))
    order = [
        "position",
        "velocity",
        "acceleration",
        "jerk",
        "force",
        "force_velocity",
        "force_offset",
        "time",
    ]
    assert [record[name] for name in order] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert (record["axis"], record["wait_marker_number"], record["signal_marker_number"]) == (1, 9, 1 << 49)


def test_the_numbers_of_an_axis_stand_together():
    records = axis_records(columns("-l1h2vt mod0").records([0.1, 5, 0.2, 6]))
    assert [(r["axis"], r["velocity"], r["time"]) for r in records] == [(1, 0.1, 5), (2, 0.2, 6)]


def test_other_letters_leave_the_position():
    (record,) = axis_records(columns("-n0t mod0").records([0.5, 2.0]))
    assert record["control_mode"] == ControlMode.POSITION | ControlMode.SPECIFIED_TIME


@pytest.mark.parametrize(
    ("line", "replace", "has_end"),
    [
        ("-v m", True, False),
        ("-vt m", False, True),
        ("-p m", True, True),
        ("-pm m", False, True),
        ("-f m", True, False),
    ],
)
def test_what_takes_over_and_what_queues_up(line, replace, has_end):
    made = columns(line)
    assert (made.replace, made.has_end) == (replace, has_end)


def test_a_negative_time_has_no_end():
    made = columns("-l0h1vt mod0")
    assert made.open_ended([0.1, 1.0, 0.1, -1.0])
    assert not made.open_ended([0.1, 1.0, 0.1, 1.0])


def test_analog_and_binary_take_one_number_a_structure():
    assert columns("-n1 dac", NodeClass.ANALOG, ["a", "b"]).records([0.25]) == ANALOG_WRITE.pack(1, 0, 0.25)
    assert columns("io", NodeClass.BINARY, ["out"]).records([5.0]) == BINARY_WRITE.pack(0, 0, 5, 0)


def test_modes_are_for_axes():
    with pytest.raises(UsageError, match="class binary"):
        columns("-v gripper0", NodeClass.BINARY, ["out"])


@pytest.mark.parametrize("value", [0.5, 1e300])
def test_bits_and_markers_are_whole(value):
    with pytest.raises(ValueError, match="integer"):
        columns("io", NodeClass.BINARY, ["out"]).records([value])
    with pytest.raises(ValueError, match="wait marker number"):
        columns("-n0m mod0").records([0.0, value])
