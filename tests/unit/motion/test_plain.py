"""Short writes: judged one by one, worked in later, and yet the same as the general way."""

from __future__ import annotations

import errno

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import CommandError
from sioms.motion import plain as plain_module

VALUES = st.sampled_from([0.0, 1e-3, -0.05, 0.19, 0.21, 5.0, 1e9, np.inf, -np.inf, np.nan, -0.0])
PLAIN = st.sampled_from([MODE.POSITION, MODE.VELOCITY, MODE.ACCELERATION, MODE.JERK, MODE.FORCE, MODE.FORCE_VELOCITY])
BESIDE = st.sampled_from([MODE(0), MODE.SPECIFIED_MAX_VEL_ACC, MODE.SPECIFIED_MAX_FORCE, MODE.SPECIFIED_FORCE_OFFSET])
FIELDS = ("position", "velocity", "acceleration", "jerk", "force", "force_velocity", "max_velocity", "max_acceleration",
          "max_force", "force_offset")  # fmt: skip


def outcome(rig: Rig, written: np.ndarray, replace: bool) -> int:
    """Return the errno of a write, 0 when it was taken."""
    try:
        rig.bank.append(written, rig.axes, rig.now_ns, replace=replace)
    except CommandError as error:
        return error.errno
    return 0


def general(rig: Rig) -> None:
    """Let a rig judge and carry out every write the general way."""
    rig.bank._queue.admit_plain = lambda *_, **__: None


@settings(max_examples=300)
@given(st.lists(st.tuples(PLAIN, BESIDE, st.lists(VALUES, min_size=10, max_size=10), st.integers(-1, 2)), min_size=1, max_size=3),  # noqa: E501
       st.booleans())  # fmt: skip
def test_a_short_write_is_accepted_and_refused_as_the_general_way_does(commands, replace):
    rigs = [Rig([axis(), axis(jerk_max=None)]) for _ in range(2)]
    general(rigs[1])
    written = np.concatenate([
        records(mode=mode | beside, axis=index, **dict(zip(FIELDS, values, strict=True)))
        for mode, beside, values, index in commands
    ])  # fmt: skip
    assert outcome(rigs[0], written, replace) == outcome(rigs[1], written, replace)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(PLAIN, st.floats(-0.15, 0.15), st.integers(0, 1), st.booleans(), st.integers(1, 40)),
        max_size=8,
    )
)
def test_axes_move_as_they_do_by_the_general_way(commands):
    rigs = [Rig([axis(), axis()]) for _ in range(2)]
    general(rigs[1])
    for mode, value, index, replace, ticks in commands:
        fields = dict.fromkeys(FIELDS[:6], value)
        for rig in rigs:
            outcome(rig, records(mode=mode, axis=index, **fields), replace)
            rig.tick(ticks)
    by_force = any(mode in (MODE.FORCE, MODE.FORCE_VELOCITY) for mode, *_ in commands)
    for i in range(2):
        difference = rigs[0].trace("commanded_position", i) - rigs[1].trace("commanded_position", i)
        # What follows a force begins at the measured position, and a tick has measured in between: at most its motion.
        assert np.abs(difference).max(initial=0.0) <= (1e-3 if by_force else 1e-12)


def test_a_stop_drops_a_write_that_no_tick_has_seen():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION, position=0.1)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(50)
    assert rig.bank.is_idle(rig.axes)
    assert np.ptp(rig.trace("commanded_position")) == 0


def test_an_emergency_stop_drops_it_too_and_refuses_the_next():
    rig = Rig([axis()])
    rig.write(mode=MODE.VELOCITY, velocity=0.1)
    rig.bank.emergency_stop(rig.axes, rig.now_ns)
    with pytest.raises(CommandError) as refused:
        rig.write(mode=MODE.VELOCITY, velocity=0.1)
    assert refused.value.errno == errno.EPERM
    rig.tick(50)
    assert np.ptp(rig.trace("commanded_position")) == 0


def test_an_axis_is_not_idle_between_the_write_and_the_tick():
    rig = Rig([axis()])
    rig.write(mode=MODE.POSITION, position=0.1)
    assert not rig.bank.is_idle(rig.axes)


def test_a_full_buffer_counts_what_is_not_worked_in():
    rig = Rig([axis()], capacity=4)
    for _ in range(4):
        rig.write(mode=MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, position=0.1)
    with pytest.raises(CommandError) as refused:
        rig.write(mode=MODE.POSITION, position=0.1)
    assert refused.value.errno == errno.EAGAIN


def test_many_writes_between_two_ticks_are_all_taken_in_order():
    rig = Rig([axis()])
    for i in range(3 * plain_module.MOST):
        rig.write(mode=MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, position=1e-3 * i)
    rig.tick(1)
    assert rig.field("buffered") == 3 * plain_module.MOST
