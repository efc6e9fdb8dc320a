"""Alarm limits of analog channels: bits at the limits, hysteresis, severity, and what the configuration may say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.daemon.config import parse
from sioms.protocol.flags import AnalogStatus as A
from sioms.protocol.flags import AxisStatus as S
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.alarms import Alarms
from sioms.sdk.blocks import AnalogBlock, BlockSpec, set_alarms

INF = math.inf
DEVICE = '[device.d]\ndriver = "sim-force"\n'


def block_of(n):
    return AnalogBlock(BlockSpec("", NodeClass.ANALOG, tuple(ChannelInfo(f"c{i}", "N") for i in range(n))))


def shown(block):
    return np.frombuffer(block.payload(), np.int64).reshape(2, -1)[1].tolist()


def test_what_is_published_is_watched_and_joins_the_drivers_flags():
    block = block_of(3)
    set_alarms([block], [[0, [0, 2], -INF, -1.0, 1.0, 2.0, 0.0]])
    block.offset[0] = 5.0
    block.data[:] = [6.0, 9.0, -1.5]
    block.flags[:] = [0, int(A.SATURATED), int(A.OVERRUN)]
    assert shown(block) == [A.HIGH, A.SATURATED, A.LOW | A.OVERRUN]
    block.data[:] = [7.0, 9.0, math.nan]
    assert shown(block) == [A.HIGH | A.HIHI, A.SATURATED, A.OVERRUN]
    assert block.flags.tolist() == [0, int(A.SATURATED), int(A.OVERRUN)], "the driver's own stay his"


@given(st.lists(st.floats(-3, 3), min_size=1, max_size=30), st.floats(0, 0.5))
def test_a_limit_is_left_by_more_than_the_hysteresis(values, hysteresis):
    alarms = Alarms(1)
    alarms.watch([0], -2.0, -1.0, 1.0, 2.0, hysteresis)
    limits = {
        A.LOLO: lambda v: -2.0 - v,
        A.LOW: lambda v: -1.0 - v,
        A.HIGH: lambda v: v - 1.0,
        A.HIHI: lambda v: v - 2.0,
    }
    was = dict.fromkeys(limits, False)
    for value in values:
        bits = int(alarms.look(np.array([value]))[0])
        for bit, beyond in limits.items():
            by = beyond(value)
            if abs(by) > 1e-9 and abs(by + hysteresis) > 1e-9:
                assert bool(bits & bit) == (by > 0 or (was[bit] and by > -hysteresis))
            was[bit] = bool(bits & bit)


def test_severities():
    assert [A(0).severity, A.HIGH.severity, A.HIHI.severity, A.INVALID.severity] == [0, 1, 2, 2]
    assert (A.HIGH | A.HIHI).severity == 2
    assert [
        S(0).severity,
        (S.MOVING | S.HOMED).severity,
        S.MISSED_TARGET.severity,
        S.LIMIT_PLUS.severity,
    ] == [0, 0, 1, 1]
    assert [S.FAULT.severity, (S.STALLED | S.SATURATED).severity, S.EMERGENCY_STOP.severity] == [2, 2, 2]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('node = "d"', "want at least one of lolo"),
        ('node = "d"\nlow = 2.0\nhigh = 1.0', "limits 2, 1; want"),
        ('node = "d"\nhigh = 1.0\nhysteresis = -1.0', "hysteresis"),
        ('node = "d"\nhih = 1.0', "hih"),
    ],
)
def test_alarms_that_cannot_be_are_told(table, words):
    errors = parse(f"{DEVICE}[[alarm]]\n{table}\n", "/")[1]
    assert len(errors) == 1 and words in errors[0] and "[[alarm]] number 1" in errors[0]


def test_the_folder_of_the_state_is_configured_or_that_of_the_service():
    named = parse(f'[workcell]\nstate_folder = "state"\n{DEVICE}', "/etc/cell")[0]
    unnamed = parse(DEVICE, "/etc/cell")[0]
    assert named.state_folder({"STATE_DIRECTORY": "/var/lib/sioms"}) == "/etc/cell/state"
    assert unnamed.state_folder({"STATE_DIRECTORY": "/var/lib/sioms:/x"}) == "/var/lib/sioms"
    assert unnamed.state_folder({}) == ""
