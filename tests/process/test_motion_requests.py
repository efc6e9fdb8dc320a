"""What a client asks of axes: buffers, all-or-nothing writes, synch over processes, markers over processes, limits."""

from __future__ import annotations

import errno
import math
import threading
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from daemon_rig import Client, Daemon, Waiting, raises, wait_for

import sioms
from sioms.protocol.flags import AxisStatus, Request
from sioms.protocol.records import AXIS_WRITE


@pytest.fixture(autouse=True)
def at_zero(cell: sioms.Workcell) -> None:
    """Every test begins with the axes at 0."""
    for name, count in (("mod0", 2), ("mod1", 1)):
        with cell.open(name, "rw", timeout=2.0) as node:
            for axis in range(count):
                node.move(0.0, axis)
            node.wait_until_idle(10.0)


def _idle(axis: sioms.AxisNode) -> None:
    axis.stop()
    axis.wait_until_idle(5.0)
    axis.move(0.0)
    axis.wait_until_idle(5.0)


def test_ten_thousand_commands_in_one_write(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        records = b"".join([sioms.command(0, velocity=0.05 * (-1) ** i, time=0.01) for i in range(10_000)])
        assert len(records) > 1 << 20, "goes in many packets"
        began = time.monotonic()
        axis.write(records)
        took = time.monotonic() - began
        print(f"10,000 commands in one write: {took * 1e3:.1f} ms")
        assert took < 2.0
        wait_for(lambda: axis.read().buffered[0] > 9_000, "buffered")
        _idle(axis)


def _doubtful(count: int) -> list[bytes]:
    """Return timed moves each of which has to be planned to be judged."""
    return [sioms.command(0, position=0.02 * (-1) ** i, time=0.14) for i in range(count)]


def test_a_long_write_that_is_hard_to_judge_delays_no_tick(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        records = b"".join(_doubtful(axis.info.buffer_capacity))
        skipped = axis.ioctl(Request.GET_STATISTICS, 1)["skipped"]
        began = time.monotonic()
        axis.write(records)
        took = time.monotonic() - began
        ticks = axis.ioctl(Request.GET_STATISTICS, int(took * 900))
        print(f"judging {axis.info.buffer_capacity} trial profiles: {took:.2f} s; {ticks}")
        assert took > 0.1, "long enough to show"
        assert ticks["skipped"] - skipped < took * 1000 / 4, "a tick is 1 ms"
        assert not axis.read().status[0] & AxisStatus.FAULT
        _idle(axis)


@pytest.mark.parametrize("end", ["stop", "emergency stop", "replace", "close"])
def test_a_write_that_is_being_judged_ends_with_what_it_is_for(cell: sioms.Workcell, end: str) -> None:
    axis = cell.open("mod0.xaxis", "rw")
    refused: list[OSError] = []
    records = b"".join(_doubtful(axis.info.buffer_capacity))

    def write() -> None:
        try:
            axis.write(records)
        except OSError as error:
            refused.append(error)

    thread = threading.Thread(target=write)
    thread.start()
    time.sleep(0.05)
    if end == "stop":
        axis.stop()
    elif end == "emergency stop":
        axis.ioctl(Request.EMERGENCY_STOP)
    elif end == "replace":
        axis.move(0.05, replace=True)
    else:
        axis.close()
    thread.join(10.0)
    assert not thread.is_alive()
    assert refused and refused[0].errno in (errno.ECANCELED, errno.EBADF, errno.EIO), refused
    with cell.open("mod0.xaxis" if end == "close" else "mod0.xaxis.readonly", timeout=5.0) as reader:
        assert reader.read().buffered[0] <= 1, "nothing of it was taken"
        if end == "emergency stop":
            axis.ioctl(Request.RESET)
        if end != "close":
            axis.wait_until_idle(5.0)
            axis.close()


def test_writes_keep_their_order_behind_one_that_is_being_judged(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        long = threading.Thread(target=axis.write, args=(b"".join(_doubtful(4000)),))
        long.start()
        time.sleep(0.02)
        axis.command(position=0.3)
        long.join(10.0)
        reading = axis.read()
        assert reading.buffered[0] > 3900 and abs(reading.position[0]) < 0.1, "the short one comes after"
        _idle(axis)


def test_a_write_is_all_or_nothing(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as axes:
        good = sioms.command(0, position=0.1)
        for bad, number, words in (
            (sioms.command(1, position=1.5), errno.ERANGE, ("position 1.5 m", "-1 to 1", "yaxis")),
            (sioms.command(2, position=0.0), errno.EINVAL, ("axis 2", "0 to 1")),
            (sioms.command(0, velocity=2.0), errno.ERANGE, ("velocity 2 m/s", "xaxis")),
            (sioms.command(0, position=0.0, time=math.inf), errno.EINVAL, ("time",)),
            (sioms.command(0, position=0.0, wait=999), errno.EINVAL, ("marker 999", "not reserved")),
            (bytes(AXIS_WRITE.size), errno.EINVAL, ("control_mode",)),
        ):
            with raises(number, "record 5", *words):
                axes.write([good] * 5 + [bad] + [good] * 5)
            reading = axes.read()
            assert not any(reading.buffered) and not any(reading.in_motion)
            assert abs(reading.position[0]) < 2e-3


def test_timed_wait_for_room(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        capacity = axis.info.buffer_capacity
        axis.command(velocity=0.0, time=0.3)
        wait_for(lambda: axis.read().in_motion[0], "running")
        axis.write([sioms.command(0, velocity=0.0, time=0.001)] * capacity)
        with raises(errno.EAGAIN):
            axis.command(velocity=0.0, time=0.001)
        with raises(errno.ETIMEDOUT, "mod0.xaxis"):
            axis.command(velocity=0.0, time=0.001, timeout=0.02)
        began = time.monotonic()
        axis.write([sioms.command(0, velocity=0.0, time=0.001)] * 50, timeout=10.0)
        assert time.monotonic() - began > 0.04, "50 commands of 1 ms had to go first"
        with raises(errno.EINVAL, str(capacity)):
            axis.write([sioms.command(0, velocity=0.0, time=0.001)] * (capacity + 1), timeout=1.0)
        axis.stop()


def test_writes_that_wait_keep_their_order(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        capacity = axis.info.buffer_capacity
        axis.command(velocity=0.0, time=0.2)
        wait_for(lambda: axis.read().in_motion[0], "running")
        axis.write([sioms.command(0, velocity=0.0, time=0.001)] * capacity)
        calls = [axis._write([sioms.command(0, velocity=0.0, time=0.001)] * n, 20.0, False) for n in (200, 1)]
        numbers = [axis._channel.send(call) for call in calls]
        first = axis._channel.wait(numbers[0], calls[0]).value
        second = axis._channel.wait(numbers[1], calls[1]).value
        assert second >= first, "a small write must not overtake the large one before it"
        axis.stop()


def test_replace_retargets_without_a_jump(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.move(0.3)
        axis.move(-0.3)
        wait_for(lambda: axis.read().position[0] > 0.02, "on its way")
        axis.move(0.05, replace=True)
        axis.wait_until_idle(5.0)
        for before, after in pairwise(axis.history(0)):
            step_s = (after.stamp_ns - before.stamp_ns) / 1e9
            change = abs(after.commanded_velocity[0] - before.commanded_velocity[0])
            assert change < 10.0 * step_s * 1.01 + 1e-9, "no jump"
        assert axis.read().position[0] == pytest.approx(0.05, abs=2e-3)
        _idle(axis)


def test_flush_leaves_the_running_command(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.move(0.05, max_velocity=0.05, max_acceleration=1.0)
        for _ in range(10):
            axis.move(0.5)
        wait_for(lambda: axis.read().in_motion[0], "moving")
        axis.flush()
        axis.wait_until_idle(5.0)
        assert axis.read().position[0] == pytest.approx(0.05, abs=2e-3)
        _idle(axis)


def test_limits_are_narrowed_and_enforced(cell: sioms.Workcell) -> None:
    with cell.open("mod1", "rw") as axis:
        assert axis.limits()["position_max"] == [1.0]
        axis.set_limits(position_max=0.2)
        with raises(errno.ERANGE, "0.3 m", "0.2"):
            axis.move(0.3)
        for value in (5.0, math.nan, "far"):
            with raises(errno.EINVAL if value != 5.0 else errno.ERANGE, "position_max"):
                axis.set_limits(position_max=value)  # type: ignore[arg-type]
        with raises(errno.EINVAL, "speed"):
            axis.set_limits(speed=1.0)
        axis.command(velocity=0.5)  # runs into the narrowed limit and stops there by itself
        wait_for(lambda: axis.read().status[0] & AxisStatus.LIMIT_PLUS, "at the limit")
        wait_for(lambda: abs(axis.read().velocity[0]) < 0.05, "rest")
        assert axis.read().position[0] < 0.21
        axis.stop()
        axis.wait_until_idle(5.0)
        axis.set_limits(position_max=1.0)
        axis.move(0.0)
        axis.wait_until_idle(5.0)


def _began(axis: sioms.AxisNode, after_ns: int) -> float:
    """Return when a motion with a jerk of 2000 m/s^3 to 0.5 m/s^2 began [ns], by two set-points of its even part."""

    def moving() -> list[Any]:
        return [s for s in axis.history(0) if s.stamp_ns > after_ns and s.commanded_velocity[0] > 0.001]

    wait_for(lambda: len(moving()) > 1, "moving")
    first, second = moving()[:2]
    slow, fast = first.commanded_velocity[0], second.commanded_velocity[0]
    assert slow < fast < 0.3, "it accelerates"
    from_rest_ns = slow * (second.stamp_ns - first.stamp_ns) / (fast - slow)
    return float(first.stamp_ns - from_rest_ns - 0.5 * 1e9 * 0.5 / 2000.0)


def test_synch_starts_two_processes_at_one_instant(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as first, cell.open("mod1", "rw") as second:
        for axis in (first, second):
            axis.move(0.2, synch=True, max_velocity=0.4, max_acceleration=0.5)  # for 0.63 s it accelerates
            wait_for(lambda axis=axis: axis.read().status[0] & AxisStatus.WAITING_SYNCH, "waiting for the synch")
        number = first.read().number
        first.wait_new(number + 50, 2.0)
        assert not first.read().in_motion[0] or first.read().commanded_velocity[0] == 0.0
        start_ns = cell.synch(first, second, lead=0.1)
        for axis in (first, second):
            assert abs(_began(axis, start_ns) - start_ns) < 2_000, "at the instant, not in the next tick"
        for axis in (first, second):
            axis.wait_until_idle(5.0)
        with raises(errno.ETIME, "ms ago", "lead"):
            first.synch(time.monotonic_ns() - 50_000_000)
        for axis in (first, second):
            axis.move(0.0)
            axis.wait_until_idle(5.0)


def test_a_marker_carries_over_from_one_process_to_another(cell: sioms.Workcell) -> None:
    marker = cell.reserve_marker()
    with cell.open("mod0.xaxis", "rw") as first, cell.open("mod1", "rw") as second:
        second.move(0.02, wait=marker)
        wait_for(lambda: second.read().status[0] & AxisStatus.WAITING_MARKER, "waiting")
        number = second.read().number
        first.move(0.02, signal=marker)
        stamp_ns = marker.wait(5.0)
        second.wait_until_idle(5.0)
        moved = next(s for s in second.history(number) if s.commanded_velocity[0] > 0)
        print(f"marker to the other process' motion: {(moved.stamp_ns - stamp_ns) / 1e6:.3f} ms")
        assert -2.0 <= (moved.stamp_ns - stamp_ns) / 1e6 < 100.0
        assert cell.wait_marker(marker.number, 1.0) == stamp_ns, "later waits return at once"
        marker.signal()
        assert marker.wait(0.0) == stamp_ns, "later signals have no effect"
        for axis in (first, second):
            axis.move(0.0)
            axis.wait_until_idle(5.0)


def test_a_freed_marker_ends_what_waits_for_it(cell: sioms.Workcell, daemon: Daemon) -> None:
    with daemon.cell("owner") as owner, cell.open("mod1", "rw") as axis:
        marker = owner.reserve_marker()
        axis.move(0.1, wait=marker.number)
        axis.move(0.2)
        idle = Waiting(axis.wait_until_idle, axis)
        waiting = Waiting(lambda: cell.wait_marker(marker.number), cell)
        wait_for(lambda: sum(s[2] for s in cell.status()["sessions"]), "the client waits")
        owner.close()  # the end of the session frees its markers
        assert waiting.errno() == errno.EPIPE
        assert idle.errno() == errno.EPIPE
        assert axis.read().buffered[0] == 0, "nothing of what came after it runs"
        assert abs(axis.read().position[0]) < 2e-3
        axis.move(0.0)
        axis.wait_until_idle(5.0)


def test_only_who_has_the_key_may_free_and_signal(cell: sioms.Workcell, daemon: Daemon) -> None:
    marker = cell.reserve_marker()
    wrong = marker.token ^ (1 << 20)
    with daemon.cell("thief") as thief, thief.open("mod1", "rw") as axis:
        for call in (thief.free_marker, thief.signal_marker):
            with raises(errno.EPERM, f"marker {marker.number}", "key is missing or wrong"):
                call(marker.number)
            with raises(errno.EINVAL, "not reserved"):
                call(wrong)
        with raises(errno.EPERM, f"marker {marker.number}"):
            axis.move(0.0, signal=marker.number)
        with raises(errno.EPERM, f"marker {marker.number}"):
            axis.move(0.0, wait=wrong)
        assert not axis.read().buffered[0]
        axis.move(0.0, signal=marker.token)  # who has been told the token may
        assert marker.wait(5.0) > 0
    marker.free()
    with raises(errno.EINVAL, "not reserved"):
        marker.free()
    with raises(errno.EINVAL, "not reserved"):
        cell.wait_marker(1 << 60)
    for odd in (0, -1, 1023, 1 << 60):
        with raises(errno.EINVAL, "not reserved"):
            cell.signal_marker(odd)


def test_persisting_markers_outlive_their_session(cell: sioms.Workcell, daemon: Daemon) -> None:
    with daemon.cell() as other:
        tokens = [marker.token for marker in other.reserve_markers(3, persist=True)]
    for token in tokens:
        cell.signal_marker(token)
        assert cell.wait_marker(token, 1.0) > 0
        cell.free_marker(token)


def test_all_markers_taken(cell: sioms.Workcell, daemon: Daemon) -> None:
    sessions = [daemon.cell() for _ in range(5)]
    try:
        taken = 0
        with raises(errno.EBUSY, "user", "has 480 markers, and at most 512 are allowed"):
            for session in sessions:
                taken += len(session.reserve_markers(120))
    finally:
        for session in sessions:
            session.close()
    wait_for(lambda: len(cell.status()["sessions"]) == 1, "sessions ended")
    assert taken == 4 * 120, "all or none: the fifth got nothing"
    cell.reserve_markers(128)


def test_many_threads_on_one_node(cell: sioms.Workcell) -> None:
    """Each request has its own answer, also while others wait."""
    errors: list[BaseException] = []
    with cell.open("mod0", "rw") as axes:
        axes.command(1, velocity=0.01, time=1.0)

        def run(i: int) -> None:
            try:
                for j in range(100):
                    match (i + j) % 4:
                        case 0:
                            assert axes.limits()["position_max"] == [1.0, 1.0]
                        case 1:
                            assert axes.ioctl(Request.GET_STATISTICS)["ticks"] > 0
                        case 2:
                            assert axes.command(0, position=0.0) > 0
                        case 3:
                            assert len(axes.read()) == 2
            except BaseException as error:
                errors.append(error)

        waiting = Waiting(lambda: axes.wait_until_idle(30.0), axes)
        threads = [threading.Thread(target=run, args=(i,), daemon=True) for i in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
        assert errors == []
        assert waiting.errno() is None


def test_closing_ends_the_requests_of_other_threads(cell: sioms.Workcell) -> None:
    axis = cell.open("mod0.xaxis", "rw")
    axis.command(velocity=0.01)
    waits = [Waiting(axis.wait_until_idle, axis) for _ in range(3)]
    wait_for(lambda: axis._channel._waiting or axis._channel._reading, "threads wait")
    axis.close()
    assert {wait.errno() for wait in waits} == {errno.EBADF}


def test_calibrate_and_zero_move_nothing(cell: sioms.Workcell, client: Callable[..., Client]) -> None:
    with cell.open("mod1", "rw") as axis:
        axis.move(0.03)
        axis.wait_until_idle(5.0)
        axis.calibrate(0.5)
        wait_for(lambda: axis.read().position[0] == pytest.approx(0.5, abs=2e-3), "calibrated")
        axis.zero()
        wait_for(lambda: axis.read().position[0] == pytest.approx(0.0, abs=2e-3), "zeroed")
        for bad in ([math.nan], [1.0, 2.0], ["x"], [True]):
            with raises(errno.EINVAL, "position"):
                axis.ioctl(Request.CALIBRATE_DEVICE, bad)
        axis.move(-0.03)
        axis.wait_until_idle(5.0)
        axis.calibrate(0.0)


def test_what_commands_have_set_ends_with_their_client(cell: sioms.Workcell) -> None:
    """Gains of nothing, and a speed of nearly nothing, are not the next client's."""
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.write(
            sioms.command(0, position=0.0, k=0.0, kz=0.0, kp=0.0, kb=0.0, max_velocity=1e-4, max_acceleration=0.1)
        )
        axis.wait_until_idle(5.0)
        assert axis.read().k[0] == 0.0
    with cell.open("mod0.xaxis", "rw", timeout=2.0) as axis:
        configured = axis.read().k[0]
        assert configured > 0.0
        axis.move(0.05)
        axis.wait_until_idle(5.0)
        assert abs(axis.read().position[0] - 0.05) < 1e-3
        assert axis.read().k[0] == configured
