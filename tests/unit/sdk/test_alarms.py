"""Alarm limits of analog channels: bits at the limits, hysteresis, severity, and what the configuration may say."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.daemon.config import parse
from sioms.protocol.flags import AnalogStatus as A
from sioms.protocol.flags import AxisStatus as S
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.alarm_watch import AlarmWatch
from sioms.sdk.alarms import Alarms
from sioms.sdk.blocks import AnalogBlock, BinaryBlock, BlockSpec

INF = math.inf
DEVICE = '[device.d]\ndriver = "sim-force"\n'


def block_of(n):
    return AnalogBlock(BlockSpec("", NodeClass.ANALOG, tuple(ChannelInfo(f"c{i}", "N") for i in range(n))))


def rule(channel, bit=-1, column="data", block=0, stops=(0, 0, 0), **limits):
    at = {"lolo": -INF, "low": -INF, "high": INF, "hihi": INF, "hysteresis": 0.0, **limits}
    return [block, channel, bit, column, *at.values(), *stops, "node", [channel]]


class Watched:
    """A block with alarms, what is told of it, and what is to be stopped."""

    def __init__(self, block, *rules):
        self.block, self.told, self.stopped = block, [], []
        self.watch = AlarmWatch(
            [block], rules, lambda message: self.told.append(message),
            lambda reaction, _block, rule, why: self.stopped.append((reaction.name, rule.channel, why)),
        )  # fmt: skip

    def publish(self, values, now_s=0.0):
        self.block.data[:] = values
        self.block.payload()
        self.watch.look(self.block, int(now_s * 1e9))
        self.watch.react()
        told, self.told = [(m.channel, m.bit, m.severity, m.text) for m in self.told], []
        return told


def test_a_change_is_told_once_and_its_end_when_it_has_lasted():
    w = Watched(block_of(2), rule(0, high=1.0, hihi=2.0), rule(1, low=-1.0))
    assert [told[:3] for told in w.publish([0.0, 0.0])] == [(0, -1, 0), (1, -1, 0)], (
        "the daemon learns what is good, too"
    )
    assert w.publish([0.5, 0.0]) == []
    assert w.publish([1.5, 0.0], 1.00) == [(0, -1, 1, "data 1.5 N has reached 1 N")]
    assert w.publish([2.5, -2.0], 1.01) == [
        (0, -1, 2, "data 2.5 N has reached 2 N"),
        (1, -1, 1, "data -2 N has reached -1 N"),
    ]
    for i in range(20):
        assert w.publish([2.5 * (i % 2), -2.0], 2.0 + i * 1e-3) == [], "it trembles at the limit"
    assert w.publish([0.0, -2.0], 3.0) == [] and w.publish([0.0, -2.0], 3.09) == []
    assert [told[:3] for told in w.publish([0.0, -2.0], 3.11)] == [(0, -1, 0)]
    assert w.stopped == []


def test_a_reaction_comes_with_each_step_upwards_and_only_then():
    w = Watched(block_of(1), rule(0, high=1.0, hihi=2.0, stops=(1, 3, 2)))
    w.publish([0.0])
    w.publish([1.5])
    w.publish([2.5])
    w.publish([2.5])
    assert [each[:2] for each in w.stopped] == [("STOP_NODE", 0), ("STOP_WORKCELL", 0)]
    w.publish([math.nan])
    assert w.stopped[2][0] == "STOP_DEVICE" and "no valid measurement" in w.stopped[2][2]
    w.publish([1.5], 1.0)
    assert [told[2] for told in w.publish([1.5], 2.0)] == [1], "it eases"
    assert len(w.stopped) == 3


def test_each_alarm_eases_by_a_time_of_its_own():
    w = Watched(block_of(2), rule(0, high=1.0), rule(1, high=1.0))
    w.publish([2.0, 2.0], 1.0)
    assert w.publish([0.0, 0.0], 1.05) == []
    assert w.publish([0.0, 2.0], 1.10) == [], "the second is back, while the first still eases"
    assert [told[:3] for told in w.publish([0.0, 0.0], 1.20)] == [(0, -1, 0)], "the second has begun to ease anew"
    assert [told[:3] for told in w.publish([0.0, 0.0], 1.35)] == [(1, -1, 0)]


@pytest.mark.parametrize("sign", [1, -1])
def test_within_the_hysteresis_a_limit_stays_reached(sign):
    alarms = Alarms(1)
    alarms.watch([0], -2.0, -1.0, 1.0, 2.0, 0.5)
    reached = [int(alarms.look(np.array([sign * value]))[0]) for value in (0.9, 1.0, 0.6, 2.1, 1.6, 1.4, 0.4)]
    inner, outer = (int(A.HIGH), int(A.HIHI)) if sign > 0 else (int(A.LOW), int(A.LOLO))
    assert reached == [0, inner, inner, inner | outer, inner | outer, inner, 0]


def test_what_cannot_be_read_is_invalid():
    w = Watched(block_of(2), rule(0, high=1.0, stops=(0, 0, 3)), rule(1, high=1.0))
    w.publish([0.0, 0.0])
    w.watch.lose([w.block], PageState.STARTING, "")
    assert w.told == []
    w.watch.lose([w.block], PageState.LINK_LOST, "unplugged")
    assert [(m.channel, m.severity, m.text) for m in w.told] == [(c, 3, "it cannot be read: unplugged") for c in (0, 1)]
    assert [each[0] for each in w.stopped] == ["STOP_WORKCELL"]
    w.told.clear()
    w.watch.lose([w.block], PageState.LINK_LOST, "unplugged")
    assert w.told == [] and w.publish([0.0, 0.0], 5.0) == [] and len(w.publish([0.0, 0.0], 6.0)) == 2
    w.block.flags[1] = int(A.INVALID)
    assert [told[:3] for told in w.publish([0.0, 0.0], 7.0)] == [(1, -1, 3)]


def test_bits_of_a_port():
    ports = BinaryBlock(BlockSpec("di", NodeClass.BINARY, (ChannelInfo("port", width=8),)))
    w = Watched(ports, rule(0, 3, hihi=1), rule(0, 0, low=0))
    assert [told[:3] for told in w.publish([0b0001])] == [(0, 3, 0), (0, 0, 0)]
    assert w.publish([0b1001]) == [(0, 3, 2, "it reads 1")]
    assert w.publish([0b1000]) == [(0, 0, 1, "it reads 0")]


def shown(block):
    return np.frombuffer(block.payload(), np.int64).reshape(2, -1)[1].tolist()


def test_what_is_published_is_watched_and_joins_the_drivers_flags():
    block = block_of(3)
    AlarmWatch([block], [rule(channel, high=1.0, hihi=2.0, low=-1.0) for channel in (0, 2)], print, print)
    block.offset[0] = 5.0
    block.data[:] = [6.0, 9.0, -1.5]
    block.flags[:] = [0, int(A.SATURATED), int(A.OVERRUN)]
    assert shown(block) == [A.HIGH, A.SATURATED, A.LOW | A.OVERRUN]
    block.data[:] = [7.0, 9.0, math.nan]
    assert shown(block) == [A.HIGH | A.HIHI, A.SATURATED, A.OVERRUN]
    assert block.flags.tolist() == [0, int(A.SATURATED), int(A.OVERRUN)], "the driver's own stay his"


@given(
    st.lists(st.integers(-26, 26).map(lambda n: n / 10 + 0.01), min_size=1, max_size=30),
    st.sampled_from([0.0, 0.3, 0.5]),
)
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
        ('node = "d"\nstate = 1\nhigh = 1.0', "a state and limits"),
        ('node = "d"\nhigh = 1.0\non_major = "stop"', "stop_workcell"),
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
