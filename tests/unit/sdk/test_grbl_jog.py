"""Grbl's jogs: moves that share a line, the chain of a velocity, and positions out of every form of report; pure."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.grbl.codec import parse_report
from sioms.drivers.grbl.jog import JogChain, straight_jog
from sioms.drivers.grbl.machine import MachinePosition, compare_limits
from sioms.sdk.exchange import DeviceError

MOVES = st.dictionaries(
    st.integers(0, 2), st.tuples(st.floats(-500, 500), st.floats(1.0, 200.0)), min_size=1, max_size=3
)


@given(st.lists(st.floats(-500, 500), min_size=3, max_size=3), MOVES)
def test_no_axis_of_a_shared_line_passes_its_own_speed(
    here: list[float], moves: dict[int, tuple[float, float]]
) -> None:
    line = straight_jog("XYZ", np.array(here), moves)
    feed = float(re.fullmatch(r"\$J=G53G90G21.*F([\d.]+)", line)[1]) / 60  # type: ignore[index]
    length = math.hypot(*(target - here[axis] for axis, (target, _) in moves.items()))
    for axis, (target, speed) in moves.items():
        if length > 0.01:
            assert feed * abs(target - here[axis]) / length <= speed * 1.01 + 0.02


WIDE = np.full(2, 1e9)


def test_a_chain_is_gapless_and_reaches_as_far_as_braking_needs() -> None:
    chain = JogChain("XY", np.array([500.0, 500.0]), 20.0)
    chain.start(0, 50.0, 7.0)
    now_ns, ends = 10**9, [7.0]
    for _ in range(40):
        now_ns += 50_000_000
        found = chain.next(now_ns, -WIDE, WIDE)
        assert found is not None
        line, targets, until_ns = found
        assert line.startswith("$J=G53G90G21X") and "Y" not in line and line.endswith("F3000")
        chain.sent(targets, until_ns)
        ends.append(float(targets[0]))
        # three polls ahead, and far enough to brake from 50 at 500: 50 ms and two polls
        assert until_ns - now_ns == pytest.approx(0.15e9, abs=1e3)
        assert chain.next(now_ns, -WIDE, WIDE) is None, "long enough"
    assert np.diff(ends[1:]) == pytest.approx(50.0 * 0.05, rel=1e-6)


def test_a_chain_ends_at_the_soft_limit_and_goes_on_from_where_it_came_to_rest() -> None:
    chain = JogChain("XY", np.array([500.0, 500.0]), 20.0)
    chain.start(0, 50.0, 0.0)
    low, high = np.array([-1.0, -1.0]), np.array([5.0, 5.0])
    line, targets, until_ns = chain.next(10**9, low, high) or ("", low, 0)
    assert targets[0] == 5.0
    chain.sent(targets, until_ns)
    assert chain.next(2 * 10**9, low, high) is None
    chain.restart(np.array([3.0, 1.0]))
    line, targets, _ = chain.next(3 * 10**9, low, high) or ("", low, 0)
    assert (targets == [5.0, 1.0]).all() and "X5F" in line


def test_positions_of_any_form_of_report() -> None:
    place = MachinePosition([2, 0], "mod0")
    work = parse_report("<Idle|WPos:1.000,2.000,3.000|FS:0,0>")
    with pytest.raises(DeviceError, match="the report tells 0 machine positions; 3 are needed"):
        place.of(work)
    assert not place.note(work)
    assert place.note(parse_report("<Idle|WPos:1.000,2.000,3.000|WCO:10.000,20.000,30.000>"))
    assert place.of(work).tolist() == [33.0, 11.0]
    place.in_report = 25.4
    assert place.of(parse_report("<Idle|MPos:1.000,2.000,3.000>")) == pytest.approx([76.2, 25.4])
    with pytest.raises(DeviceError, match="check the letters of the axes"):
        place.of(parse_report("<Idle|MPos:1.000,2.000>"))


def test_limits_are_compared() -> None:
    found = {110: 6000.0, 120: 500.0}
    assert compare_limits(found, 0, 1000.0, 0.1, 0.5) and not compare_limits(found, 1, 1000.0, 0.1, 0.5)
    with pytest.raises(DeviceError, match=r"velocity_max = 0.2, but \$110 of the controller is 0.1; want at most"):
        compare_limits(found, 0, 1000.0, 0.2, 0.5)
    with pytest.raises(DeviceError, match=r"acceleration_max = 0.4, but \$120 of the controller is 0.5; want that"):
        compare_limits(found, 0, 1000.0, 0.1, 0.4)
