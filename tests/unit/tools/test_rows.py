"""The output of devin, character by character as in the examples of section F.4.1."""

from __future__ import annotations

import errno
import math

import pytest
from tool_rig import AXES, node_info, snapshot

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass
from sioms.tools.options import UsageError, fold
from sioms.tools.rows import Rows

MODULE = snapshot(
    NodeClass.AXIS, 4, position=[0.0, 0.0, 1.9920, -1.1096e-4], force=[256.0, 256.0, 0.0, 0.0],
    status=[0, AxisStatus.MOVING | AxisStatus.WAITING_MARKER, 0, 0],
)  # fmt: skip


def printed(line: str, reading=MODULE, node_class=NodeClass.AXIS, names=AXES, **rest) -> str:
    target = fold("devin", line.split()).targets[0]
    return Rows(target, node_info(node_class, names, width=8), **rest).text(reading)


def test_default_is_the_example():
    assert printed("mod0") == (
        "0 0 0.0000e+00 0.0000e+00 2.56e+02\n"
        "1 0 0.0000e+00 0.0000e+00 2.56e+02\n"
        "2 0 1.9920e+00 0.0000e+00 0.00e+00\n"
        "3 0 -1.1096e-04 0.0000e+00 0.00e+00\n"
    )
    assert printed("-pvfmN mod0") == printed("mod0")


def test_binary_and_analog_examples():
    assert printed("gripper0", snapshot(NodeClass.BINARY, 1), NodeClass.BINARY, ["out"]) == "0 0\n"
    analog = snapshot(NodeClass.ANALOG, 1, data=[-3.59])
    assert printed("atod0", analog, NodeClass.ANALOG, ["adc"]) == "0 -3.59e+00\n"


def test_without_n_there_is_no_newline():
    analog = snapshot(NodeClass.ANALOG, 1, data=[-3.6])
    assert printed("-p atod0", analog, NodeClass.ANALOG, ["adc"]) == "-3.60e+00 "
    assert printed("-l1h3v mod0") == "0.0000e+00 0.0000e+00 0.0000e+00 "


def test_number_and_newline_with_n():
    assert printed("-n0pN mod0") == "0 0.0000e+00\n"
    assert printed("-N mod0") == "0\n1\n2\n3\n"


def test_fields_come_in_one_order_whatever_the_order_of_the_flags():
    assert printed("-n2fvpm mod0") == printed("-n2mpvf mod0") == "0 1.9920e+00 0.0000e+00 0.00e+00 "


def test_a_binary_port_is_an_integer():
    reading = snapshot(NodeClass.BINARY, 2, data=[255, 3])
    assert printed("gripper0", reading, NodeClass.BINARY, ["a", "b"]) == "0 255\n1 3\n"


def test_timed_output_is_a_bare_stream():
    assert printed("-pN -n2 mod0", timed=True) == "1.9920e+00 "
    assert printed("-N -n2 mod0", timed=True) == "0 1.9920e+00 0.0000e+00 0.00e+00 "
    assert printed("-V -n2 mod0", timed=True) == "0 1.9920e+00 0.0000e+00 0.00e+00 "


def test_digits():
    assert printed("-n3p mod0", digits=9) == "-1.109600000e-04 "


def test_verbose_overrides_and_names_everything():
    text = printed("-V -v mod0")
    assert text.count("\n") == 4
    assert "mod0 1 yaxis: position 0.000000e+00 m" in text
    assert text.splitlines()[1].endswith("moving, waiting marker")


def test_a_structure_that_is_not_there():
    with pytest.raises(UsageError, match="structure 4; want 0 to 3"):
        printed("-n4 mod0")


def test_what_is_no_measurement_is_no_number():
    """A pipe acts on what it reads: an invalid value is none."""
    analog = snapshot(NodeClass.ANALOG, 3, data=[1.5, 2.5, 3.5], flags=[AnalogStatus.INVALID, AnalogStatus.HIHI, 0])
    names = ["fx", "fy", "fz"]
    assert printed("-p lord1", analog, NodeClass.ANALOG, names) == "nan 2.50e+00 3.50e+00 "
    assert printed("-n0pN lord1", analog, NodeClass.ANALOG, names) == "0 nan\n"
    assert "data 1.500000e+00" in printed("-V lord1", analog, NodeClass.ANALOG, names)


@pytest.mark.parametrize(
    ("data", "flags", "words"),
    [
        (1.0, AnalogStatus.INVALID, "1, invalid"),
        (2.0, AnalogStatus.SATURATED | AnalogStatus.OVERRUN, "2, saturated and overrun"),
        (math.nan, 0, "nan, flagged good"),
        (-math.inf, 0, "-inf, flagged good"),
    ],
)
def test_who_acts_on_a_value_is_told_that_it_is_none(data: float, flags: int, words: str) -> None:
    reading = snapshot(NodeClass.ANALOG, 2, data=[7.0, data], flags=[0, flags])
    assert reading.measured() == 7.0
    with pytest.raises(OSError, match=f"read channel 1: {words}; want a finite value") as caught:
        reading.measured(1)
    assert caught.value.errno == errno.EIO
