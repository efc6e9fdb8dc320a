"""DriveBank against a drive of a few lines that makes its own trapezoid and confirms with a delay."""

import errno

import numpy as np
import pytest
from motion_rig import DRIVE_MODES, MODE, POLL_NS, Cell, Markers, axis, records

from sioms.motion import ActionKind, CommandError, DriveBank, EventKind
from sioms.protocol.flags import AxisStatus as S


def test_commands_run_in_order_each_after_the_drive_is_done():
    cell = Cell()
    cell.write(mode=[MODE.POSITION, MODE.POSITION | MODE.RELATIVE], position=[0.5, 0.25])
    assert cell.drives[0].log == [ActionKind.START]
    cell.poll(20)
    assert cell.drives[0].log == [ActionKind.START]
    cell.poll(60)
    assert cell.drives[0].position == pytest.approx(0.75)
    assert cell.bank.is_idle([0])
    kinds = [e.kind for e in cell.events]
    assert kinds.count(EventKind.ENDED) == 2 and kinds[-1] is EventKind.IDLE


def test_modes_that_the_drive_lacks_are_refused_before_anything_moves():
    cell = Cell()
    with pytest.raises(CommandError) as caught:
        cell.write(mode=[MODE.POSITION, MODE.JERK], position=0.5, jerk=1.0)
    assert caught.value.errno == errno.EINVAL and "JERK" in str(caught.value)
    cell.poll(5)
    assert cell.drives[0].log == []


def test_a_position_that_is_to_be_passed_is_refused_before_anything_moves():
    cell = Cell()
    with pytest.raises(CommandError, match="record 1: this axis cannot pass a position") as caught:
        cell.write(mode=[MODE.POSITION, MODE.POSITION | MODE.VELOCITY], position=0.5, velocity=0.1)
    assert caught.value.errno == errno.EINVAL
    cell.poll(5)
    assert cell.drives[0].log == []


def test_timed_velocity_stops_when_nothing_follows():
    cell = Cell()
    cell.write(mode=MODE.VELOCITY | MODE.SPECIFIED_TIME, velocity=1.0, time=0.5)
    cell.poll(80)
    assert cell.drives[0].log == [ActionKind.START, ActionKind.STOP]
    assert cell.drives[0].position == pytest.approx(0.5, abs=0.02)
    assert cell.bank.is_idle([0])


def test_velocity_lasts_until_the_next_command():
    cell = Cell()
    cell.write(mode=MODE.VELOCITY, velocity=0.5)
    cell.poll(50)
    assert not cell.bank.is_idle([0])
    cell.write(mode=MODE.POSITION, position=0.0)
    cell.poll(60)
    assert cell.drives[0].position == pytest.approx(0.0) and cell.bank.is_idle([0])


def test_synch_and_markers_hold_and_release():
    cell = Cell()
    token = cell.markers.reserve(3)
    cell.write(mode=[MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH | MODE.SPECIFIED_SIGNAL_MARKER,
                     MODE.POSITION | MODE.SPECIFIED_WAIT_MARKER], axis=[0, 1], position=0.3,
               signal_marker_number=token, wait_marker_number=3)  # fmt: skip
    cell.poll(5)
    assert cell.status(0) & S.WAITING_SYNCH and cell.status(1) & S.WAITING_MARKER
    start = cell.now_ns + 25_000_000
    assert cell.bank.synch([0, 1], start, cell.now_ns) == (0,)
    assert cell.bank.due_ns == start
    cell.bank.advance(start)
    cell.now_ns = start
    cell.send()
    assert cell.starts == [(start, 0)]
    cell.poll(60)
    assert cell.markers.signals[0][0] == 3
    assert cell.drives[1].position == pytest.approx(0.3)
    assert cell.bank.is_idle([0, 1])


def test_emergency_stop_latches_and_is_the_fastest_stop():
    cell = Cell()
    cell.write(mode=[MODE.POSITION] * 2, position=[1.0, 2.0])
    cell.poll(10)
    cell.bank.emergency_stop([0], cell.now_ns)
    cell.send()
    assert cell.drives[0].log[-1] is ActionKind.QUICK_STOP
    cell.poll(5)
    place = cell.drives[0].position
    with pytest.raises(CommandError) as caught:
        cell.write(mode=MODE.POSITION, position=0.0)
    assert caught.value.errno == errno.EPERM
    cell.bank.reset([0])
    cell.poll(50)
    assert cell.drives[0].position == place and cell.bank.is_idle([0])


def test_fault_of_the_drive_drops_the_buffer_and_is_cleared_by_reset():
    cell = Cell()
    cell.write(mode=[MODE.POSITION] * 2, position=[1.0, 2.0])
    cell.poll(5)
    cell.drives[0].fault = "overcurrent (0x0E0)"
    cell.poll(2)
    assert cell.status() & S.FAULT and cell.bank.fault_text(0) == "overcurrent (0x0E0)"
    assert [e.errno for e in cell.events if e.kind is EventKind.DROPPED] == [errno.EIO]
    cell.poll(3)
    cell.bank.reset([0])
    cell.poll(2)
    assert cell.drives[0].log[-1] is ActionKind.RESET
    assert not cell.status() & S.FAULT
    cell.write(mode=MODE.POSITION, position=0.0)
    cell.poll(60)
    assert cell.drives[0].position == pytest.approx(0.0)


def test_a_refused_start_is_a_fault_and_the_axis_is_stopped():
    cell = Cell()
    cell.bank.append(records(mode=MODE.POSITION, position=1.0), cell.axes, cell.now_ns)
    (action,) = cell.bank.take_actions()
    cell.bank.action_failed(action, "illegal data value", cell.now_ns)
    assert "illegal data value" in cell.bank.fault_text(0)
    (stop,) = cell.bank.take_actions()
    assert stop.kind is ActionKind.QUICK_STOP


def test_done_of_the_command_before_does_not_end_the_new_one():
    cell = Cell(1)
    cell.bank.append(records(mode=MODE.POSITION, position=1.0), [0], cell.now_ns)
    actions = cell.bank.take_actions()
    still = np.zeros(1, dtype=bool)
    for _ in range(20):  # the command is on the line, the drive still says done
        cell.now_ns += POLL_NS
        cell.bank.poll(cell.now_ns, np.zeros(1), np.zeros(1), still, ~still)
        assert not cell.bank.is_idle([0])
    cell.bank.action_done(actions[0], cell.now_ns)
    cell.now_ns += POLL_NS
    cell.bank.poll(cell.now_ns, np.zeros(1), np.zeros(1), still, ~still)
    assert not cell.bank.is_idle([0])


def test_homing_is_the_drives_own():
    from sioms.motion import Homing

    cell = Cell(1)
    cell.bank = DriveBank([axis(modes=DRIVE_MODES, homing=Homing(0.1, 0.01, required=True))], markers=cell.markers)
    cell.poll()
    with pytest.raises(CommandError, match="home required"):
        cell.write(mode=MODE.POSITION, position=0.1)
    cell.bank.home([0], cell.now_ns)
    cell.send()
    assert cell.drives[0].log == [ActionKind.HOME]
    cell.drives[0].target, cell.drives[0].wish = -0.1, 0.1
    cell.poll(5)
    assert cell.status() & S.HOMING
    cell.poll(200)
    assert cell.status() & S.HOMED and cell.bank.is_idle([0])


def test_a_report_that_was_asked_for_before_the_start_does_not_end_the_move():
    """The reply was taken before the drive got the start, and a busy machine hands it on long after that."""
    bank = DriveBank([axis(modes=MODE.POSITION)], markers=Markers(), settle_s=0.05)
    still, no, yes = np.zeros(1), np.array([False]), np.array([True])
    now = 1_000_000_000
    bank.poll(now, still, still, no, yes, asked_ns=now)
    bank.append(records(mode=MODE.POSITION, position=0.1), [0], now)
    for action in bank.take_actions():
        bank.action_done(action, now + 1_000_000)
    for asked_ns in (now, now + 2_000_000):
        bank.poll(now + 200_000_000, still, still, no, yes, asked_ns=asked_ns)
        assert not bank.is_idle([0])
    bank.poll(now + 260_000_000, still, still, no, yes, asked_ns=now + 250_000_000)
    assert bank.is_idle([0])


def test_a_soft_limit_that_ends_a_run_or_a_force_is_told():
    for mode, bits in ((MODE.VELOCITY, 0), (MODE.FORCE, S.FORCE_ENDED)):
        bank = DriveBank([axis(modes=MODE.VELOCITY | MODE.FORCE | MODE.POSITION)], markers=Markers(), settle_s=0.0)
        still, moves = np.zeros(1), np.array([0.5])
        no, yes = np.array([False]), np.array([True])
        now = 1_000_000_000
        bank.poll(now, still, still, no, yes)
        bank.append(records(mode=mode, velocity=0.5, force=1.0), [0], now)
        for action in bank.take_actions():
            bank.action_done(action, now)
        bank.poll(now + 10_000_000, np.array([0.005]), moves, yes, no)
        status = int(bank.rows["status"][0])
        assert bool(status & S.FORCE_MODE) == (mode is MODE.FORCE)
        bank.stop_at_limit([0], S.LIMIT_PLUS, "the soft limit is near", now + 11_000_000)
        assert [a.is_stop for a in bank.take_actions()] == [True]
        bank.poll(now + 20_000_000, np.array([0.006]), still, no, yes)
        status = S(int(bank.rows["status"][0]))
        assert status & S.LIMIT_PLUS and status.severity == 1
        assert status & S.FORCE_ENDED == bits and not status & S.FORCE_MODE
        told = [e for e in bank.take_events() if e.kind is EventKind.DROPPED]
        assert [(e.errno, e.text) for e in told] == [(errno.ERANGE, "the soft limit is near")]


def _waiting_for_a_start() -> Cell:
    cell = Cell()
    cell.write(mode=[MODE.VELOCITY | MODE.WAIT_FOR_EXTERNAL_SYNCH] * 2, axis=[0, 1], velocity=0.5)
    cell.poll(2)
    return cell


def _is_told_late(cell: Cell) -> None:
    assert cell.status() & S.FAULT and "after the common start; at most 100 ms" in cell.bank.fault_text(0)
    assert {e.errno for e in cell.events if e.kind is EventKind.DROPPED} <= {errno.ETIME}
    assert not cell.status() & S.WAITING_SYNCH


def test_a_common_start_that_was_slept_through_is_a_fault_and_moves_nothing():
    cell = _waiting_for_a_start()
    cell.bank.synch([0, 1], cell.now_ns + 25_000_000, cell.now_ns)
    cell.now_ns += 25_000_000 + 183_000_000  # the process was held up, or the line
    cell.poll(20)
    assert ActionKind.START not in cell.drives[0].log and cell.drives[0].position == 0.0
    _is_told_late(cell)


def test_a_common_start_that_the_drive_confirms_too_late_is_stopped_and_told():
    cell = _waiting_for_a_start()
    start_ns = cell.now_ns + 25_000_000
    cell.bank.synch([0, 1], start_ns, cell.now_ns)
    cell.bank.advance(start_ns)
    (first, _) = cell.bank.take_actions()
    cell.drives[first.axis].take(first)
    cell.now_ns = start_ns + 183_000_000
    cell.bank.action_done(first, cell.now_ns)
    cell.poll(50)
    assert cell.drives[0].velocity == 0.0 and cell.drives[0].log[-1] is ActionKind.QUICK_STOP
    _is_told_late(cell)


def test_what_follows_a_common_start_is_late_for_nothing():
    cell = _waiting_for_a_start()
    cell.bank.synch([0, 1], cell.now_ns + 25_000_000, cell.now_ns)
    cell.poll(50)
    cell.write(mode=[MODE.VELOCITY] * 2, axis=[0, 1], velocity=-0.5)
    cell.poll(50)
    assert not cell.status() & S.FAULT and cell.drives[0].log == [ActionKind.START, ActionKind.START]
