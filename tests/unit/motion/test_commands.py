"""Every field is checked, every refusal has its errno and names what would be accepted."""

import errno

import numpy as np
import pytest
from motion_rig import MODE, Rig, axis, records

from sioms.motion import AxisKind, CommandError, EventKind
from sioms.motion.commands import QUANTITIES, RULES

NAN = float("nan")


@pytest.fixture
def rig():
    return Rig([axis(), axis(name="s", kind=AxisKind.STEPPER, k=None)])


BAD = [
    ({"mode": 0}, errno.EINVAL, "control_mode"),
    ({"mode": MODE.POSITION | MODE.FORCE}, errno.EINVAL, "control_mode"),
    ({"mode": MODE.POSITION | MODE.ACCELERATION}, errno.EINVAL, "control_mode"),
    ({"mode": 0x10000 | MODE.POSITION}, errno.EINVAL, "control_mode"),
    ({"mode": MODE.VELOCITY | MODE.RELATIVE}, errno.EINVAL, "control_mode"),
    ({"mode": MODE.POSITION, "axis": 2}, errno.EINVAL, "0 to 1"),
    ({"mode": MODE.POSITION, "axis": -1}, errno.EINVAL, "0 to 1"),
    ({"mode": MODE.POSITION, "position": NAN}, errno.EINVAL, "position"),
    ({"mode": MODE.POSITION, "position": 3.001}, errno.ERANGE, "-3 to 3 m"),
    ({"mode": MODE.POSITION | MODE.RELATIVE, "position": 3.001}, errno.ERANGE, "-3 to 3"),
    ({"mode": MODE.VELOCITY, "velocity": -2.1}, errno.ERANGE, "-2 to 2 m/s"),
    ({"mode": MODE.VELOCITY, "velocity": float("inf")}, errno.EINVAL, "velocity"),
    ({"mode": MODE.ACCELERATION, "acceleration": 5.1}, errno.ERANGE, "m/s^2"),
    ({"mode": MODE.JERK, "jerk": 101.0}, errno.ERANGE, "m/s^3"),
    ({"mode": MODE.FORCE, "force": -10.5}, errno.ERANGE, "-10 to 10 N"),
    ({"mode": MODE.FORCE, "force": 1.0, "axis": 1}, errno.EINVAL, "cannot do FORCE"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_MAX_FORCE, "max_force": 1.0, "axis": 1}, errno.EINVAL, "cannot do"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_MAX_FORCE, "max_force": 0.0}, errno.ERANGE, "above 0 to 10 N"),
    (
        {"mode": MODE.POSITION | MODE.SPECIFIED_MAX_VEL_ACC, "max_velocity": 3.0, "max_acceleration": 1.0},
        errno.ERANGE,
        "2",
    ),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_GAINS, "k": NAN}, errno.EINVAL, "k is nan"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_GAINS, "kp": 1.0}, errno.ERANGE, "unstable"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_TIME, "time": 0.0}, errno.EINVAL, "more than 0"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_TIME, "time": NAN}, errno.EINVAL, "time"),
    ({"mode": MODE.POSITION | MODE.VELOCITY | MODE.SPECIFIED_TIME, "time": -1.0}, errno.EINVAL, "not with"),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_TIME, "position": 1.0, "time": 0.1}, errno.ERANGE, "at least"),
    (
        {"mode": MODE.POSITION | MODE.VELOCITY | MODE.SPECIFIED_TIME, "position": 1.0, "time": 0.1},
        errno.ERANGE,
        "needs",
    ),
    ({"mode": MODE.POSITION | MODE.SPECIFIED_WAIT_MARKER, "wait_marker_number": 7}, errno.EINVAL, "not reserved"),
]


@pytest.mark.parametrize(("fields", "code", "words"), BAD)
def test_one_bad_record_refuses_all_and_says_why(rig, fields, code, words):
    good = records(mode=[MODE.POSITION] * 3, axis=[0, 1, 0], position=[0.1, 0.1, 0.2])
    with pytest.raises(CommandError) as caught:
        rig.bank.append(np.concatenate((good, records(**fields), good)), rig.axes, rig.now_ns)
    assert caught.value.errno == code
    assert words in str(caught.value)
    assert "record" in str(caught.value)
    rig.tick(50)
    assert rig.bank.is_idle(rig.axes)
    assert not np.any(rig.trace("commanded_position"))
    assert rig.field("buffered") == 0


def test_fields_without_their_flag_are_ignored(rig):
    rig.write(mode=MODE.POSITION, position=0.2, velocity=NAN, time=NAN, force=1e9, k=NAN, max_velocity=-1.0)
    rig.run()
    assert rig.field("commanded_position") == pytest.approx(0.2, abs=1e-12)


def test_marker_keys(rig):
    token = rig.markers.reserve(5)
    with pytest.raises(CommandError) as caught:
        rig.write(mode=MODE.POSITION | MODE.SPECIFIED_SIGNAL_MARKER, signal_marker_number=5)
    assert caught.value.errno == errno.EPERM
    rig.write(mode=MODE.POSITION | MODE.SPECIFIED_SIGNAL_MARKER, position=0.1, signal_marker_number=token)
    rig.run()
    assert [number for number, _ in rig.markers.signals] == [5]


def test_full_buffer_is_refused_whole():
    rig = Rig([axis()], capacity=10)
    rig.write(mode=[MODE.POSITION] * 8, position=[0.1] * 8)
    room = rig.bank.room([0])
    with pytest.raises(CommandError) as caught:
        rig.write(mode=[MODE.POSITION] * (room + 1), position=[0.2] * (room + 1))
    assert caught.value.errno == errno.EAGAIN
    assert rig.bank.room([0]) == room
    rig.write(mode=[MODE.POSITION] * room, position=[0.2] * room)
    assert rig.bank.room([0]) == 0
    rig.run()
    assert rig.kinds().count(EventKind.ENDED) == 8 + room


def test_known_infeasible_piece_deep_in_an_array_is_refused(rig):
    times = [0.5] * 40
    times[30] = 0.01
    positions = [0.1 * (i % 2) for i in range(40)]
    with pytest.raises(CommandError) as caught:
        rig.write(mode=[MODE.POSITION | MODE.SPECIFIED_TIME] * 40, position=positions, time=times)
    assert caught.value.errno == errno.ERANGE
    assert "record 30" in str(caught.value)
    rig.tick(5)
    assert rig.bank.is_idle([0])


def test_limits_in_force_count_for_feasibility(rig):
    timed = MODE.POSITION | MODE.SPECIFIED_TIME
    rig.write(mode=timed, position=1.0, time=1.2)
    rig.run()
    slow = MODE.POSITION | MODE.SPECIFIED_MAX_VEL_ACC
    with pytest.raises(CommandError, match="too short"):
        rig.write(mode=[slow, timed], position=[0.9, 0.0], max_velocity=0.1, max_acceleration=1.0, time=[0, 1.2])


def test_not_before_the_first_measurement():
    from sioms.motion import AxisBank

    bank = AxisBank([axis()], tick_s=1e-3, markers=Rig([axis()]).markers)
    with pytest.raises(CommandError) as caught:
        bank.append(records(mode=MODE.POSITION, position=0.1), [0], 1)
    assert caught.value.errno == errno.EIO


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.field)
def test_a_refusal_says_what_is_wanted(rule):
    """Of every column of the table, for what is no number and for what is too much."""
    rig = Rig([axis()])
    mode = rule.flag if rule.flag & QUANTITIES else rule.flag | MODE.POSITION
    for value in (np.nan, np.inf, *([1e9, -1e9] if rule.bound or rule.field in ("time", "kp") else [])):
        given = {"k": 1.0, "time": 1.0, "max_velocity": 1.0, "max_acceleration": 1.0, rule.field: value}
        if rule.field == "time" and value == -1e9:
            continue  # until the next command
        with pytest.raises(CommandError, match="; want "):
            rig.write(mode=mode, **given)


@pytest.mark.parametrize("position", [np.nan, np.inf, 1e9])
def test_a_refusal_of_a_place_says_what_is_wanted(position):
    rig = Rig([axis()])
    for ask in (
        lambda: rig.write(mode=MODE.POSITION, position=position),
        lambda: rig.write(mode=MODE.POSITION | MODE.RELATIVE, position=position),
        lambda: rig.bank.calibrate([0], [position]),
        lambda: rig.bank.set_limits([0], position_max=np.nan),
        lambda: rig.bank.set_limits([0], velocity_max=1e9),
        lambda: rig.bank.set_limits([0], speed=1.0),
        lambda: rig.bank.append(records(mode=MODE.POSITION, axis=7), [0], rig.now_ns),
    ):
        with pytest.raises(CommandError, match="; want "):
            ask()
