"""What every axis must do, whichever driver it belongs to.

What a driver adds to the kit is tried on the axes of all: places, velocities, and what is refused. What the kit does
alone is tried once for each kind of bank, on a simulated axis, whose loop is closed here, and on a drive with a loop of
its own. The stops of every driver with a line, from more states and in more ways, are trials of ``sioms driver check``:
docs/decisions/0730-every-driver.md.
"""

from __future__ import annotations

import errno
import math
import threading
import time
from typing import Any

import pytest
from daemon_rig import Daemon, Waiting, at_rest, raises, wait_for
from device_rigs import RIGS, Axis

import sioms
from sioms.protocol.flags import AxisStatus, ControlMode

AXES = [axis for rig in RIGS for axis in rig.axes]
every_axis = pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.node)
BANKS = [axis for axis in AXES if axis.node in ("sim_axes.servo", "tmcl")]
every_bank = pytest.mark.parametrize("axis", BANKS, ids=lambda axis: axis.node)
UNCHECKED = [axis for rig in RIGS if not rig.line for axis in rig.axes]
every_unchecked_axis = pytest.mark.parametrize("axis", UNCHECKED, ids=lambda axis: axis.node)


def home(node: sioms.AxisNode) -> None:
    """Bring an axis to 0 and to rest."""
    node.move(0.0)
    node.wait_until_idle(20.0)


def has_velocity(node: sioms.AxisNode) -> bool:
    return bool(node.info.channels[0].modes & ControlMode.VELOCITY)


def run(node: sioms.AxisNode, axis: Axis) -> None:
    """Let an axis go on for a while: at a velocity, or where it has none, to a far position."""
    if has_velocity(node):
        node.command(velocity=axis.velocity)
    else:
        node.move(0.9, max_velocity=axis.velocity, max_acceleration=0.2)


def test_both_kinds_of_bank_are_tried() -> None:
    assert len(BANKS) == 2, "an axis of the rigs is called otherwise"


@every_axis
def test_a_move_ends_where_it_should_and_idle_means_idle(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        node.move(axis.reach)
        node.wait_until_idle(20.0)
        reading = node.wait_new(node.read().number, 5.0)[0]
        assert reading.position == pytest.approx(axis.reach, abs=axis.tolerance)
        assert not reading.in_motion and not reading.status & AxisStatus.MOVING and reading.buffered == 0
        node.move(-axis.reach / 2, relative=True)
        node.wait_until_idle(20.0)
        wait_for(lambda: abs(node.read().position[0] - axis.reach / 2) < axis.tolerance, "the half", 2.0)
        home(node)


@every_axis
def test_what_it_cannot_do_is_refused_and_moves_nothing(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        modes = ControlMode(node.info.channels[0].modes)
        before = node.wait_new(node.read().number, 5.0).position[0]
        if axis.beyond is not None:
            with raises(errno.ERANGE, f"{axis.beyond:g}"):
                node.move(axis.beyond)
        fast: dict[str, Any] = (
            {"velocity": 1e6} if has_velocity(node) else {"position": 0.0, "max_velocity": 1e6, "max_acceleration": 0.1}
        )
        for word, value in (("position", math.nan), ("velocity", math.inf), ("velocity", 1e6)):
            if word == "velocity" and not has_velocity(node):
                continue
            with raises(errno.EINVAL if not math.isfinite(value) else errno.ERANGE, word):
                node.command(0, **{word: value})
        for word in ("jerk", "acceleration", "velocity", "position", "force", "force_velocity"):
            if not modes & ControlMode[word.upper()]:
                with raises(errno.EINVAL, word.upper()):
                    node.command(0, **{word: 0.0})
        with raises(errno.EINVAL, "axis 1"):
            node.move(0.0, axis=1)
        with raises(errno.ERANGE if axis.beyond is not None else errno.EINVAL):
            node.write([sioms.command(0, position=axis.reach), sioms.command(0, **fast)])
        after = node.wait_new(node.read().number + 3, 5.0)
        assert after.position[0] == pytest.approx(before, abs=axis.tolerance) and not after.in_motion[0]


@every_axis
def test_a_velocity_runs_until_stopped(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        if not has_velocity(node):
            pytest.skip("it has no velocity mode, which another test sees refused")
        home(node)
        node.command(velocity=axis.velocity)
        wait_for(lambda: node.read().position[0] > axis.velocity * 0.15, "running")
        assert node.read().velocity[0] == pytest.approx(axis.velocity, rel=0.3)
        waiting = Waiting(node.wait_until_idle, node)
        node.stop()
        at_rest(node)
        assert waiting.errno() == errno.ECANCELED
        home(node)


@every_unchecked_axis
def test_close_halts(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(f"{axis.node}.readonly") as seen:
        with cell.open(axis.node, "rw", timeout=2.0) as node:
            home(node)
            run(node, axis)
            wait_for(lambda: seen.read().position[0] > axis.velocity * 0.05, "running")
        at_rest(seen, 3.0)
        place = seen.read().position[0]
        seen.wait_new(seen.read().number + 10, 5.0)
        assert seen.read().position[0] == pytest.approx(place, abs=axis.tolerance)
        assert seen.read().buffered[0] == 0


@every_unchecked_axis
def test_emergency_stop_latches_and_nothing_resumes(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        for i in range(20):
            node.move(axis.reach if i % 2 else -axis.reach)
        waiting = Waiting(node.wait_until_idle, node)
        wait_for(lambda: node.read().in_motion[0], "moving")
        cell.emergency_stop(why="suite")
        at_rest(node, 5.0)
        assert waiting.errno() == errno.ECANCELED
        reading = wait_for(lambda: _latched(node), "the latch shows")
        assert reading.buffered[0] == 0
        with raises(errno.EPERM, axis.node, "suite"):
            node.move(0.0)
        cell.reset()
        wait_for(lambda: not node.read().status[0] & AxisStatus.EMERGENCY_STOP, "the reset shows")
        place = node.read().position[0]
        node.wait_new(node.read().number + 10, 5.0)
        assert node.read().position[0] == pytest.approx(place, abs=axis.tolerance), "nothing resumes"
        home(node)


def _latched(node: sioms.AxisNode) -> sioms.client.snapshot.AxisSnapshot | None:
    reading = node.read()
    return reading if reading.status[0] & AxisStatus.EMERGENCY_STOP else None


@every_bank
def test_markers_hold_and_signal(cell: sioms.Workcell, axis: Axis) -> None:
    first, second = cell.reserve_markers(2)
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        node.move(axis.reach, wait=first, signal=second)
        wait_for(lambda: node.read().status[0] & AxisStatus.WAITING_MARKER, "waiting for the marker")
        node.wait_new(node.read().number + 5, 5.0)
        assert node.read().position[0] == pytest.approx(0.0, abs=axis.tolerance), "held"
        with raises(errno.ETIMEDOUT):
            second.wait(0.01)
        first.signal()
        second.wait(20.0)
        node.wait_until_idle(5.0)
        assert node.wait_new(node.read().number, 5.0).position[0] == pytest.approx(axis.reach, abs=axis.tolerance)
        home(node)


@every_bank
def test_a_synch_releases(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        node.move(axis.reach, synch=True)
        wait_for(lambda: node.read().status[0] & AxisStatus.WAITING_SYNCH, "waiting for the synch")
        with raises(errno.ETIMEDOUT):
            node.wait_until_idle(0.05)
        node.synch()
        node.wait_until_idle(20.0)
        assert node.wait_new(node.read().number, 5.0).position[0] == pytest.approx(axis.reach, abs=axis.tolerance)
        home(node)


@every_bank
def test_commands_run_in_order_and_flush_leaves_the_first(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        markers = cell.reserve_markers(3)
        order: list[int] = []
        threads = [
            threading.Thread(target=lambda i=i, m=m: (m.wait(30.0), order.append(i)), daemon=True)
            for i, m in enumerate(markers)
        ]
        for thread in threads:
            thread.start()
        places = (axis.reach, axis.reach / 2, 0.0)
        node.write([sioms.command(0, position=p, signal=m) for p, m in zip(places, markers, strict=True)])
        node.wait_until_idle(30.0)
        for thread in threads:
            thread.join(5.0)
        stamps = [marker.wait(0.0) for marker in markers]
        assert stamps == sorted(stamps) and len(set(stamps)) == 3 and len(order) == 3
        node.move(axis.reach)
        node.move(-axis.reach)
        wait_for(lambda: node.read().in_motion[0], "moving")
        node.flush()
        node.wait_until_idle(20.0)
        assert node.wait_new(node.read().number, 5.0).position[0] == pytest.approx(axis.reach, abs=axis.tolerance)
        home(node)
        for marker in markers:
            marker.free()


@every_bank
def test_calibration_moves_nothing(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        node.calibrate(axis.reach)
        wait_for(lambda: node.read().position[0] == pytest.approx(axis.reach, abs=axis.tolerance), "calibrated")
        assert not node.read().in_motion[0]
        node.zero()
        wait_for(lambda: node.read().position[0] == pytest.approx(0.0, abs=axis.tolerance), "zeroed")


@every_bank
def test_tweaks_add_up_also_in_coordinates_of_ones_own(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        user = node.user(direction=-1, offset=0.3)
        low, high = user.limits()
        assert (low, high) == (pytest.approx(0.3 - node.limits()["position_max"][0]), pytest.approx(1.3))
        user.tweak(-axis.reach / 4)
        user.tweak(-axis.reach / 4)  # appended while the first still runs
        node.wait_until_idle(20.0)
        node.wait_new(node.read().number, 5.0)
        assert node.read().position[0] == pytest.approx(axis.reach / 2, abs=axis.tolerance)
        assert user.position == pytest.approx(0.3 - axis.reach / 2, abs=axis.tolerance)
        user.call_here(0.0)
        user.move(axis.reach / 2)
        node.wait_until_idle(20.0)
        node.wait_new(node.read().number, 5.0)
        assert node.read().position[0] == pytest.approx(0.0, abs=2 * axis.tolerance)


@every_bank
def test_limits_are_told_and_narrowed(cell: sioms.Workcell, axis: Axis) -> None:
    with cell.open(axis.node, "rw", timeout=2.0) as node:
        home(node)
        limits = node.limits()
        assert limits["velocity_max"][0] == pytest.approx(node.info.channels[0].limits["velocity"])
        node.set_limits(position_max=axis.reach / 2)
        with raises(errno.ERANGE, "position"):
            node.move(axis.reach)
        node.set_limits(position_max=limits["position_max"][0])
        node.move(axis.reach)
        node.wait_until_idle(20.0)
        home(node)


@every_bank
def test_a_frozen_client_with_a_lease_is_halted(workcell: Daemon, cell: sioms.Workcell, axis: Axis) -> None:
    node = cell.open(axis.node, "rw", timeout=2.0, lease=0.15)
    node.move(0.0)
    run(node, axis)
    with cell.open(f"{axis.node}.readonly") as seen:
        wait_for(lambda: seen.read().in_motion[0], "moving")
        began = time.monotonic()
        at_rest(seen, 5.0)
        assert time.monotonic() - began < 3.0
        with raises(errno.ETIMEDOUT, "lease of 0.15 s"):
            node.move(0.0)
    node.close()
