"""Axes and channels by name, nodes of a stated class, representations that tell, and time-outs of the asyncio face."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
from typing import Any

import pytest
from daemon_rig import Daemon, raises

import sioms
import sioms.aio
from sioms.protocol.flags import AxisStatus, Request


def test_axes_are_chosen_by_name(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw", kind=sioms.AxisNode) as arm:
        second = arm.info.channels[1].name
        arm.move(0.03, axis=second, time=0.2)
        arm.wait_until_idle(timeout=5.0)
        assert arm.read()[second].position == pytest.approx(0.03, abs=1e-3)
        assert arm[second].position == pytest.approx(arm[1].position, abs=1e-4)
        assert arm.read()[0].position == pytest.approx(0.0, abs=1e-3)
        arm[second].move(0.0)
        arm.wait_until_idle(timeout=5.0)
        assert f"mod0['{second}']" in repr(arm[second]) and " m>" in repr(arm[second])


def test_one_axis_is_stopped_while_the_others_go_on(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as arm:
        first, second = arm[0], arm[1]
        arm.move(0.4, axis=1, time=3.0)
        first.jog(0.05)
        first.stop()
        first.wait_until_idle(timeout=2.0)
        assert not first.in_motion and AxisStatus.MOVING not in first.status
        assert second.in_motion and "status=MOVING" in repr(arm.read()[1]), "the other went on"
        with raises(errno.ETIMEDOUT, "WAIT_UNTIL_IDLE"):
            arm.wait_until_idle(timeout=0.05)
        first.move(0.0)
        first.wait_until_idle(timeout=5.0)
        assert first.position == pytest.approx(0.0, abs=1e-3) and second.in_motion
        arm.stop(arm.info.channels[1].name)
        second.wait_until_idle(timeout=2.0)
        assert second.position < 0.39


def test_a_stop_of_an_axis_that_is_none_stops_them_all(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as arm:
        for wrong in (7, -1, [0, 9], "x", []):
            arm[0].jog(0.05)
            arm[1].jog(0.05)
            with raises(errno.EINVAL, "STOP on mod0", "want indices from 0 to"):
                arm.ioctl(Request.STOP, wrong)
            arm.wait_until_idle(timeout=2.0)
        named: Any = ("misspelt", errno.EINVAL, "it has"), (1.5, None, "want its index or name")
        for wrong, number, words in named:
            arm[0].jog(0.05)
            arm[1].jog(0.05)
            with pytest.raises((OSError, TypeError), match=words) as caught:
                arm.stop(wrong)
            assert getattr(caught.value, "errno", None) == number
            arm.wait_until_idle(timeout=2.0)
        for request in (Request.HOME, Request.ZERO_DEVICE, Request.WAIT_UNTIL_IDLE):
            with raises(errno.EINVAL, request.name, "axis 7"):
                arm.ioctl(request, 7)


def test_one_axis_is_calibrated_and_the_others_keep_their_places(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as arm:
        arm.wait_until_idle(timeout=2.0)
        before = arm.read().position
        arm[0].calibrate(0.1)
        after = arm.read().position
        assert after[0] == pytest.approx(0.1) and after[1:] == pytest.approx(before[1:], abs=1e-5)
        turned = arm.user(0, offset=0.5, direction=-1)
        turned.zero()
        assert turned.position == pytest.approx(0.0, abs=1e-9) and arm.read().position[0] == pytest.approx(0.5)
        arm[0].zero()
        with raises(errno.EINVAL, "CALIBRATE_DEVICE", "1 values"):
            arm.calibrate(0.1)
        with raises(errno.ERANGE, "CALIBRATE_DEVICE"):
            arm[0].calibrate(1e6)
        assert arm.read().position[1:] == pytest.approx(before[1:], abs=1e-5) and arm.read().position[0] == 0.0


def test_an_unknown_axis_is_refused_with_those_that_there_are(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as arm:
        names = [channel.name for channel in arm.info.channels]
        with raises(errno.EINVAL, "'nosuch'", *names):
            arm.move(0.1, axis="nosuch")
        with raises(errno.EINVAL, "9", *names):
            arm[9]
        with pytest.raises(KeyError, match=names[0]):
            arm.read()["nosuch"]
        assert not arm.read().in_motion[0]


def test_a_node_of_another_class_is_refused_and_free_again(cell: sioms.Workcell) -> None:
    with raises(errno.EINVAL, "mod0", "AxisNode", "BinaryNode"):
        cell.open("mod0", "rw", kind=sioms.BinaryNode)
    cell.open("mod0", "rw", timeout=1.0).close()


def test_representations_tell_what_it_is(cell: sioms.Workcell, daemon: Daemon) -> None:
    arm = cell.open("mod0", "rw")
    assert cell.name in repr(cell) and "mod0 open" in repr(cell)
    assert "AxisNode mod0: " in repr(arm) and "[m]" in repr(arm)
    (entry,) = [e for e in cell.nodes() if e.name == "mod0"]
    assert "device mod0 up, held by" in repr(entry)
    arm.close()
    assert "closed" in repr(arm)


def test_asyncio_takes_names_too(daemon: Daemon) -> None:
    async def session() -> None:
        async with await sioms.aio.connect(daemon.socket) as cell:
            assert cell.name in repr(cell)
            async with await cell.open("mod0", "rw", timeout=2.0) as arm:
                second = arm.info.channels[1].name
                await arm.move(0.02, axis=second, time=0.2)
                await arm.wait_until_idle(timeout=5.0)
                assert arm.read()[second].position == pytest.approx(0.02, abs=1e-3)
                with raises(errno.EINVAL, "nosuch"):
                    await arm.move(0.0, axis="nosuch")
                await arm.move(0.0, axis=second)
                await arm.wait_until_idle(timeout=5.0)

    asyncio.run(session())


def test_asyncio_does_not_wait_for_a_daemon_that_hangs(daemon: Daemon) -> None:
    async def session() -> None:
        async with await sioms.aio.connect(daemon.socket) as cell:
            os.kill(daemon.pid, signal.SIGSTOP)
            try:
                with raises(errno.ETIMEDOUT, "get status", "hung"):
                    await asyncio.wait_for(cell.status(), 8.0)
            finally:
                os.kill(daemon.pid, signal.SIGCONT)
            assert (await cell.status())["pid"] == daemon.pid

    asyncio.run(session())
