"""Emergency stop: it overtakes everything, needs no ownership, latches until reset, and does not need the daemon."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_rig import WORKCELL, Client, Daemon, Waiting, at_rest, has_ended, jog, raises, wait_for
from interrupt_rig import interrupted_everywhere

import sioms
import sioms.aio
from sioms.client.channel import Call
from sioms.client.stopping import emergency_stop
from sioms.protocol import verbs
from sioms.protocol.flags import AxisStatus, Request


def _fill(axis: sioms.AxisNode) -> None:
    """Fill the command buffer with slow moves."""
    capacity = axis.info.buffer_capacity
    axis.write([sioms.command(0, position=0.5 if i % 2 else -0.5, time=2.0) for i in range(capacity)])
    wait_for(lambda: axis.read().in_motion[0], "the first has left the buffer")
    axis.move(0.0, time=2.0)


def test_stop_of_the_workcell_overtakes_full_buffers_and_ends_waits(daemon: Daemon, cell: sioms.Workcell) -> None:
    with (
        cell.open("mod0.xaxis", "rw") as first,
        cell.open("mod1", "rw") as second,
        cell.open("io0", "rw") as io,
    ):
        io.set(0b11)
        for axis in (first, second):
            _fill(axis)
            with raises(errno.EAGAIN, axis.name, f"room for 0 of {axis.info.buffer_capacity}"):
                axis.move(0.0)
        idle = [Waiting(axis.wait_until_idle, axis) for axis in (first, second)]
        room = Waiting(lambda: first.move(0.0, timeout=30.0), first)
        wait_for(lambda: first.read().velocity[0] != 0 and second.read().velocity[0] != 0, "both move")
        with daemon.cell("stopper") as other:
            began = time.monotonic()
            other.emergency_stop(why="test")
            took = max(at_rest(first, 2.0), at_rest(second, 2.0))
            print(f"stop to rest of two processes: {took * 1e3:.1f} ms")
            assert time.monotonic() - began < 1.0
        assert [wait.errno() for wait in (*idle, room)] == [errno.ECANCELED] * 3
        assert "emergency stop by pid" in str(idle[0].error), "who stopped, as far as the drivers know by then"
        for axis in (first, second):
            reading = axis.read()
            assert reading.buffered[0] == 0 and reading.status[0] & AxisStatus.EMERGENCY_STOP
            for attempt in (lambda: axis.move(0.0), lambda: axis.command(velocity=0.1)):  # noqa: B023
                with raises(errno.EPERM, axis.name, "emergency stop"):
                    attempt()
        wait_for(lambda: io.read().data[0] == 0, "outputs safe")
        with raises(errno.EPERM, "io0", "stopper"):
            io.set(1)
        with raises(errno.EPERM, "whole workcell is stopped"):
            first.reset()
        status = cell.status()
        assert status["stopped_ns"] > 0 and "stopper: test" in status["stop_source"]
        where = first.read().position[0]
        cell.reset()
        wait_for(lambda: not first.read().status[0] & AxisStatus.EMERGENCY_STOP, "latch cleared")
        number = first.read().number
        first.wait_new(number + 200, 3.0)
        assert not first.read().in_motion[0], "nothing resumes"
        assert abs(first.read().position[0] - where) < 5e-3
        assert io.read().data[0] == 0, "outputs do not come back by themselves"
        first.move(0.0)
        second.move(0.0)
        first.wait_until_idle(5.0)
        second.wait_until_idle(5.0)


def test_stop_of_a_node_leaves_the_others_moving(cell: sioms.Workcell, daemon: Daemon) -> None:
    with cell.open("mod0.xaxis", "rw") as mine, cell.open("mod0.yaxis", "rw") as other:
        mine.command(velocity=0.1)
        other.command(velocity=0.1)
        waiting = Waiting(mine.wait_until_idle, mine)
        with daemon.cell("by") as stopper, stopper.open("mod0.xaxis.readonly") as seen:
            wait_for(lambda: seen.read().in_motion[0], "moving")
            seen.emergency_stop()
        at_rest(mine, 2.0)
        assert waiting.errno() == errno.ECANCELED
        with raises(errno.EPERM, "mod0.xaxis", "emergency stop by ", "; RESET first"):
            mine.move(0.0)
        number = other.read().number
        other.wait_new(number + 100, 3.0)
        assert other.read().in_motion[0]
        mine.reset()
        mine.move(0.0)
        mine.wait_until_idle(5.0)
        cell.emergency_stop("mod0.yaxis", "a hand is in it")  # through the daemon, without a handle
        at_rest(other, 2.0)
        with raises(errno.EPERM, "emergency stop by ", ": a hand is in it; RESET first"):
            other.move(0.0)
        cell.reset("mod0.yaxis")
        other.move(0.0, timeout=0.5)
        other.wait_until_idle(5.0)


def test_stop_through_the_request_page_while_the_daemon_hangs(daemon: Daemon, cell: sioms.Workcell) -> None:
    axes = [cell.open("mod0.xaxis", "rw"), cell.open("mod1", "rw")]
    for axis in axes:
        axis.command(velocity=0.2)
        wait_for(lambda axis=axis: axis.read().velocity[0] > 0.1, "moving")
    with daemon.frozen(daemon.pid):
        stopping = Waiting(lambda: cell.emergency_stop(why="the daemon hangs"))
        began = time.monotonic()
        for axis in axes:
            wait_for(lambda axis=axis: axis.read().status[0] & AxisStatus.EMERGENCY_STOP, "latched", 1.0)
        # well before the lease of the hung daemon would have stopped them
        print(f"request page to all latched: {(time.monotonic() - began) * 1e3:.1f} ms")
        for axis in axes:
            at_rest(axis, 1.0)
        assert stopping.errno() is None  # the drivers have said that they have latched it
    assert wait_for(lambda: cell.status()["stopped_ns"], "the daemon knows")
    for axis in axes:
        axis.close()
    cell.reset()


def waited(pid: int) -> float:
    """Return how long a process has waited for a processor [s], also when it has ended and nobody has looked."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


@pytest.mark.parametrize(("module", "words"), [("sdev", ["-e"]), ("front", ["stop"])])
def test_a_fresh_stop_while_the_daemon_hangs_stays_latched(
    daemon: Daemon, cell: sioms.Workcell, module: str, words: list[str]
) -> None:
    axis = cell.open("mod0.xaxis", "rw")
    axis.command(velocity=0.2)
    wait_for(lambda: axis.read().velocity[0] > 0.1, "moving")
    with daemon.frozen(daemon.pid):
        began = time.monotonic()
        tool = subprocess.Popen(
            [sys.executable, "-c", f"import sys; from sioms.tools.{module} import main; sys.exit(main({words}))"],
            env={**os.environ, "SIOMS_SOCKET": daemon.socket}, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        wait_for(lambda: axis.read().status[0] & AxisStatus.EMERGENCY_STOP, "latched", 20.0)
        latched_s, waited_s = time.monotonic() - began, waited(tool.pid)
        at_rest(axis, 1.0)
        os.waitid(os.P_PID, tool.pid, os.WEXITED | os.WNOWAIT)
        took_s = time.monotonic() - began
        # it imports the client library meanwhile, for which a busy machine gives it no processor
        waited_s = waited(tool.pid) - waited_s
        _, said = tool.communicate(timeout=20.0)
        assert tool.returncode == 0, said
        print(f"told {took_s - latched_s:.2f} s after it was latched, {waited_s:.2f} s without a processor")
        assert took_s - waited_s < latched_s + 1.5, "what is latched is told at once"
        assert "stopped and latched by the drivers; hello: the daemon does not answer" in said
    print(f"start of {module} to latched: {latched_s * 1e3:.0f} ms")
    wait_for(lambda: f"pid {tool.pid}" in cell.status()["stop_source"], "the daemon knows who")
    with raises(errno.EPERM, "emergency stop"), cell.open("mod1", "rw") as other:
        other.command(velocity=0.1)
    axis.close()
    cell.reset()


@pytest.mark.parametrize("line", ["sioms stop mod0.xaxsi", "sdev -e mod0.xaxsi", "emergency_stop('the arm is stuck')"])
def test_a_stop_by_a_name_that_no_node_has_stops_all(daemon: Daemon, cell: sioms.Workcell, line: str) -> None:
    """A misspelt name; or the reason in its place, where `sioms.Fleet` and `sioms.emergency_stop` have it."""
    with cell.open("mod0.xaxis", "rw") as axis, cell.open("mod1", "rw") as other:
        for each in (axis, other):
            each.jog(0.05)
        if line.startswith("emergency_stop"):
            with raises(errno.ENOENT, "no such node", "the whole workcell has been stopped"):
                cell.emergency_stop("the arm is stuck")
        else:
            tool, *words = line.split()
            module = "front" if tool == "sioms" else tool
            program = f"import sys; from sioms.tools.{module} import main; sys.exit(main({words}))"
            done = subprocess.run(
                [sys.executable, "-c", program], env={**os.environ, "SIOMS_SOCKET": daemon.socket},
                stderr=subprocess.PIPE, text=True, timeout=60, check=False,
            )  # fmt: skip
            assert done.returncode == 1 and "did you mean mod0.xaxis" in done.stderr, done.stderr
            assert "the whole workcell has been stopped" in done.stderr
        for each in (axis, other):
            assert each.read().status[0] & AxisStatus.EMERGENCY_STOP
            at_rest(each, 2.0)
    cell.reset()


@pytest.mark.parametrize(
    ("module", "words", "status"),
    [
        ("sdev", ["-e", "mod0", "mod1"], 2),
        ("sdev", ["-qe", "mod0"], 2),
        ("sdev", ["mod0", "--emergency-stop"], 2),
        ("front", ["stop", "-all"], 2),
        ("front", ["stop", "mod0", "mod1"], 0),
        ("front", ["stop", "mod0", "mod9", "mod1"], 1),
    ],
)
def test_a_stop_on_a_command_line_that_is_wrong_elsewhere_stops(
    daemon: Daemon, cell: sioms.Workcell, module: str, words: list[str], status: int
) -> None:
    program = f"import sys; from sioms.tools.{module} import main; sys.exit(main({words}))"
    with cell.open("mod0.xaxis", "rw") as axis, cell.open("mod1", "rw") as other:
        for each in (axis, other):
            each.jog(0.05)
        done = subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "SIOMS_SOCKET": daemon.socket},
            stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        )  # fmt: skip
        assert done.returncode == status, done.stderr
        assert ("the whole workcell has been stopped" in done.stderr) == bool(status)
        for each in (axis, other):
            assert each.read().status[0] & AxisStatus.EMERGENCY_STOP
            at_rest(each, 2.0)
    cell.reset()
    for name in ("mod0", "mod1"):
        cell.reset(name)


def test_a_stop_that_nobody_takes_is_an_error(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon()
    with daemon.cell() as cell:
        pids = [device["pid"] for device in cell.status()["devices"]]
    os.kill(daemon.pid, signal.SIGKILL)
    wait_for(lambda: all(map(has_ended, pids)), "the drivers have ended")
    assert os.path.exists(daemon.socket + ".stop")  # left behind by the kill
    with raises(errno.ECONNREFUSED, "the daemon that made this socket has ended"):
        emergency_stop("nobody there", daemon.socket)


def test_a_client_cannot_clear_a_stop_through_the_page(daemon: Daemon, cell: sioms.Workcell) -> None:
    cell.emergency_stop()
    page = cell._request
    assert page is not None
    for value in (0, 1, (1 << 63) - 1):
        page.request(value, 0)
        time.sleep(0.01)
        assert cell.status()["stopped_ns"]


def test_a_read_only_page_is_sealed(cell: sioms.Workcell) -> None:
    """A client gets the page of readings, and can neither write nor resize nor remap it."""
    import fcntl
    import mmap
    import os

    from sioms.client.cell_verbs import open_call

    answer = cell._channel.call(open_call("mod0.readonly", "r", 0.0, 0.0))
    page = answer.fds[0]
    try:
        with pytest.raises(PermissionError):
            mmap.mmap(page, 4096)
        with pytest.raises(PermissionError):
            os.pwrite(page, b"x", 0)
        with pytest.raises(PermissionError):
            os.ftruncate(page, 0)
        with pytest.raises(PermissionError):
            fcntl.fcntl(page, fcntl.F_ADD_SEALS, 0x2)
    finally:
        answer.fds.close()


def test_input_configured_as_stop_source(start_daemon: Callable[..., Daemon]) -> None:
    source = '\n[[emergency_stop]]\nnode = "io0.in.bit0"\nactive = 1\n'
    daemon = start_daemon(WORKCELL + source)
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis, cell.open("io0", "rw") as io:
        axis.command(velocity=0.1)
        io.set(0b10)
        wait_for(lambda: axis.read().in_motion[0], "moving")
        io.set(0b01)  # wired to input 0
        at_rest(axis, 2.0)
        assert "input io0 in in bit 0 reads 1" in wait_for(lambda: cell.status()["stop_source"], "latched")
        wait_for(lambda: io.read().data[0] == 0, "outputs safe, and with them the source")
        cell.reset()
        axis.move(0.0, timeout=0.5)
        axis.wait_until_idle(5.0)


def test_stop_source_that_is_still_active_stops_again_after_a_reset(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(WORKCELL + '\n[[emergency_stop]]\nnode = "io0.in.bit0"\n')  # active 0: a broken wire stops
    with daemon.cell() as cell:
        for _ in range(3):
            wait_for(lambda: cell.status()["stopped_ns"], "stopped, since the input reads 0")
            cell.reset()
        with cell.open("mod0.xaxis", "rw") as axis:
            wait_for(lambda: axis.read().status[0] & AxisStatus.EMERGENCY_STOP, "latched")
            with raises(errno.EPERM):
                axis.move(0.1)


def test_started_stopped_where_configured(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\nstart_stopped = true'))
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis:
        with raises(errno.EPERM, "started stopped, as configured"):
            axis.move(0.1)
        cell.reset()
        axis.move(0.01, timeout=0.5)
        axis.wait_until_idle(5.0)


def test_a_driver_that_restarts_during_a_stop_is_stopped(daemon: Daemon, cell: sioms.Workcell) -> None:
    import os
    import signal

    cell.emergency_stop()
    before = daemon.device("mod0")
    os.kill(before["pid"], signal.SIGKILL)
    daemon.wait_up("mod0", before["generation"] + 1)
    with cell.open("mod0.xaxis", "rw", timeout=2.0) as axis, raises(errno.EPERM, "emergency stop"):
        axis.move(0.1)


@pytest.mark.parametrize("after_s", [0.0, 0.1])
@pytest.mark.parametrize("how", ["workcell", "node", "limit"])
def test_a_motion_that_others_have_ended_is_told_to_a_wait_that_comes_later(
    daemon: Daemon, cell: sioms.Workcell, how: str, after_s: float
) -> None:
    """Between its write and its wait a program may be busy; that its axis rests does not mean that it has arrived."""
    with daemon.cell() as other, cell.open("mod0", "rw") as arm:
        expected: tuple[int, str] = (errno.ECANCELED, "emergency stop by")
        if how == "limit":
            arm.set_limits(position_max=[arm.read().position[0] + 0.02, 1.0])
            expected = errno.ERANGE, "limit"
        arm["xaxis"].jog(0.05)
        time.sleep(after_s)
        match how:
            case "workcell":
                other.emergency_stop()
            case "node":
                other.emergency_stop("mod0")
        wait_for(lambda: not any(arm.read().in_motion), "the axes at rest")
        with raises(expected[0], expected[1]):
            arm.wait_until_idle(timeout=5.0)
        arm.wait_until_idle(timeout=5.0)
        if how == "limit":
            arm.set_limits(position_max=None)
        else:
            other.reset(*["mod0"][how == "workcell" :])
        arm["xaxis"].move(arm.read().position[0] - 0.01)
        arm.wait_until_idle(timeout=5.0)
        arm["xaxis"].jog(-0.05)
        arm.stop()
        arm.wait_until_idle(timeout=5.0)
        arm["xaxis"].jog(0.05)
        arm.emergency_stop()
        arm.wait_until_idle(timeout=5.0)
        arm.reset()


def test_controlled_stop_is_not_latched(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        _fill(axis)
        waiting = Waiting(axis.wait_until_idle, axis)
        wait_for(lambda: axis.read().in_motion[0], "moving")
        axis.stop()
        at_rest(axis, 2.0)
        assert axis.read().buffered[0] == 0
        assert waiting.errno() == errno.ECANCELED
        axis.move(0.0)
        axis.wait_until_idle(5.0)


def test_waits_are_cancelled_by_another_session(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.01)
        waiting = Waiting(axis.wait_until_idle, axis)
        with daemon.cell("other") as other, other.open("mod0.xaxis.readonly") as seen:
            assert wait_for(seen.cancel_waits, "something to cancel") == 1
        assert waiting.errno() == errno.ECANCELED and "cancelled by" in str(waiting.error)
        assert axis.read().in_motion[0], "only the wait ended"


def test_stop_from_asyncio(daemon: Daemon, cell: sioms.Workcell) -> None:
    async def story() -> None:
        async with (
            await sioms.aio.connect(daemon.socket) as mine,
            await mine.open("mod0.xaxis", "rw") as axis,
        ):
            await axis.command(velocity=0.1)
            waiting = asyncio.create_task(axis.wait_until_idle())
            await asyncio.sleep(0.05)
            await mine.emergency_stop(why="asyncio")
            with raises(errno.ECANCELED, "emergency stop by"):
                await waiting
            assert "asyncio" in (await mine.status())["stop_source"]
            await mine.reset()

    asyncio.run(story())


def test_stop_from_asyncio_while_the_daemon_hangs(daemon: Daemon, cell: sioms.Workcell) -> None:
    async def story(axis: sioms.AxisNode) -> None:
        async with await sioms.aio.connect(daemon.socket) as mine:
            with daemon.frozen(daemon.pid):
                stopping = asyncio.create_task(mine.emergency_stop())
                deadline = time.monotonic() + 2.0
                while not axis.read().status[0] & AxisStatus.EMERGENCY_STOP:
                    assert time.monotonic() < deadline
                    await asyncio.sleep(0.001)
            await stopping

    with cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.1)
        asyncio.run(story(axis))
        at_rest(axis, 2.0)


def test_stop_needs_no_ownership(daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]) -> None:
    client(daemon, jog("mod0.xaxis", 0.1) + "hold()")
    with cell.open("mod0.xaxis.readonly") as seen:
        seen.ioctl(Request.STOP)
        at_rest(seen, 2.0)


@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")
def test_a_stop_by_a_wrong_name_that_is_interrupted_stops_all_or_has_not_been_sent(
    daemon: Daemon, cell: sioms.Workcell
) -> None:
    modules = ("sioms.client.cell_verbs", "sioms.client.channel", "sioms.client.faces")
    stopped = []

    def stop() -> None:
        with contextlib.suppress(FileNotFoundError):
            cell.emergency_stop("mod0.xaxsi")

    for _ in interrupted_everywhere(stop, modules):
        stopped.append(bool(cell.status()["stopped_ns"]))
        cell.reset()
    assert sum(stopped) > 5 and stopped == sorted(stopped), stopped
    cell.reset()


def test_a_client_that_dies_behind_a_stop_by_a_wrong_name_has_stopped_all(daemon: Daemon, cell: sioms.Workcell) -> None:
    with daemon.cell("doomed") as doomed, daemon.frozen(daemon.pid):
        doomed._channel.send(Call("stop", verbs.EmergencyStop("mod0.xaxsi", "", True, 0)))
    wait_for(lambda: cell.status()["stopped_ns"], "stopped")
    assert "of mod0.xaxsi, which there is not" in cell.status()["stop_source"]
    cell.reset()


@pytest.mark.parametrize("line", ["sioms stop mod0 mod1", "sdev -e /mod0 -e /mod1"])
def test_a_stop_of_several_nodes_that_is_interrupted_goes_through(
    daemon: Daemon, cell: sioms.Workcell, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sioms.tools import cell as cell_tool
    from sioms.tools import options, sdev

    monkeypatch.setenv("SIOMS_SOCKET", daemon.socket)
    tool, *words = line.split()

    def stop() -> None:
        if tool == "sioms":
            cell_tool._stop(words[1:])
        else:
            with daemon.cell("sdev") as own:
                sdev._stop(own, options.fold("sdev", words))

    stopped = []
    modules = ("sioms.tools.cell", "sioms.tools.sdev", "sioms.tools.pipe")
    for _ in interrupted_everywhere(stop, modules, is_signal=True):
        with cell.open("mod0.readonly") as first, cell.open("mod1.readonly") as second:
            found = {bool(each.read().status[0] & AxisStatus.EMERGENCY_STOP) for each in (first, second)}
        assert len(found) == 1
        stopped.append(found.pop())
        for name in ("mod0", "mod1"):
            cell.reset(name)
    assert any(stopped) and stopped == sorted(stopped), stopped
    for name in ("mod0", "mod1"):
        cell.reset(name)
