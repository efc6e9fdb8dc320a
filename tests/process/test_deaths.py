"""What dies or hangs in mid-motion: client, driver, daemon, fork server. Motion ends, nodes reopen, nobody reads old
data as new.
"""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from daemon_rig import WORKCELL, Client, Daemon, at_rest, axes, has_ended, jog, raises, wait_for

import sioms


def test_killed_client_halts_its_axes_and_frees_the_node(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    victim = client(daemon, jog("mod0.xaxis", 0.2))
    with cell.open("mod0.readonly") as seen:
        before = seen.read().position[0]
        victim.kill()
        killed = time.monotonic()
        with cell.open("mod0.xaxis", "rw", timeout=2.0) as axis:
            assert time.monotonic() - killed < 1.0
            assert axis.read().buffered[0] == 0
            at_rest(axis, 1.0)
            # 0.2 m/s at 10 m/s^2 is 2 mm; a loaded machine may be late, a motion that goes on would run 200 mm/s
            assert axis.read().position[0] - before < 0.15
            rest = axis.read().position[0]
            axis.wait_new(axis.read().number + 50, 2.0)
            assert abs(axis.read().position[0] - rest) < 2e-3  # 0.2 m/s would be 10 mm


def test_killed_client_with_a_child_that_holds_the_sockets_open(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    fork = "marker = cell.reserve_marker()\nif os.fork() == 0: hold()\nsay('token', marker.token)\nhold()\n"
    victim = client(daemon, jog("mod0.xaxis", 0.2) + fork)
    token = int(victim.wait_line(r"token (\d+)").group(1))
    victim.kill()
    with cell.open("mod0.xaxis", "rw", timeout=3.0) as axis:
        at_rest(axis, 1.0)
    with raises(errno.EINVAL, "not reserved"):  # its marker went with it
        cell.wait_marker(token & 1023, 0.0)


@pytest.mark.parametrize("child", [False, True])
def test_killed_client_halts_its_axes_while_the_daemon_hangs(
    start_daemon: Callable[..., Daemon], client: Callable[..., Client], child: bool
) -> None:
    """The driver sees the death itself: by the end of file, or by the process when a child holds the socket open."""
    daemon = start_daemon("[workcell]\ndaemon_lease_s = 60\n" + axes("mod0", "xaxis"))
    with daemon.cell() as cell, cell.open("mod0.readonly") as seen:
        fork = "if os.fork() == 0: hold()\nsay('forked')\nhold()\n" if child else "hold()\n"
        victim = client(daemon, jog("mod0", 0.2) + fork)
        if child:
            victim.wait_line("forked")
        with daemon.frozen(daemon.pid):
            victim.kill()
            assert at_rest(seen, 3.0) < 1.0


def test_killed_client_drops_outputs_to_safe(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    with cell.open("io0.readonly") as seen:
        victim = client(daemon, "io = cell.open('io0', 'rw')\nio.set(0b101)\nsay('ready')\nhold()")
        wait_for(lambda: seen.read().data[0] == 0b101, "outputs set")
        victim.kill()
        wait_for(lambda: seen.read().data[0] == 0, "outputs safe", 2.0)


def test_hung_client_with_a_lease_loses_its_axes(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    keep = "while True:\n    node.keepalive(); time.sleep(0.02)\n"
    victim = client(daemon, jog("mod0.xaxis", 0.1, lease=0.2) + keep)
    with cell.open("mod0.readonly") as seen:
        seen.wait_new(seen.read().number + 500, 5.0)
        assert seen.read().in_motion[0], "a client that keeps its lease keeps its motion"
        with daemon.frozen(victim.pid):
            assert at_rest(seen, 3.0) < 1.5
            with cell.open("mod0.xaxis", "rw", timeout=1.0):
                pass
        victim.wait_line("TimeoutError|silent for longer than its lease of 0.2 s|process behind it has gone")


def test_killed_driver_gives_eio_with_reason_and_comes_back_at_rest(daemon: Daemon, cell: sioms.Workcell) -> None:
    before = daemon.device("mod0")
    others = {name: daemon.device(name)["pid"] for name in ("mod1", "io0", "force0")}
    axis = cell.open("mod0.xaxis", "rw")
    axis.command(velocity=0.1)
    last = axis.read()
    os.kill(before["pid"], signal.SIGKILL)
    wait_for(lambda: _errno(axis.read) == errno.EIO, "reads are refused", 2.0)
    with raises(errno.EIO, "read mod0.xaxis", "driver"):
        axis.read()
    with raises(errno.EIO, "mod0.xaxis"):
        axis.command(velocity=0.1)
    after = daemon.wait_up("mod0", before["generation"] + 1)
    assert after["pid"] != before["pid"]
    with raises(errno.EIO):  # the old handle stays dead: a new process has new numbers
        axis.read()
    axis.close()
    with cell.open("mod0.xaxis", "rw", timeout=2.0) as again:
        reading = again.read()
        assert not reading.in_motion[0] and reading.buffered[0] == 0
        assert reading.number != last.number
        again.move(0.01)
        again.wait_until_idle(5.0)
    assert {name: daemon.device(name)["pid"] for name in others} == others


def test_hung_driver_is_stale_then_killed_and_restarted(daemon: Daemon, cell: sioms.Workcell) -> None:
    before = daemon.device("force0")
    with cell.open("force0") as node:
        node.read()
        with daemon.frozen(before["pid"]):
            wait_for(lambda: _errno(node.read) == errno.EIO, "stale", 2.0)
            with raises(errno.EIO, "has not ticked for"):
                node.read()
            daemon.wait_up("force0", before["generation"] + 1)
    daemon.said('event="device lost" device=force0 .*hung for')
    with cell.open("force0") as node:
        assert node.read().data[2] == pytest.approx(3.0)


def test_the_lease_of_readings_can_be_configured(start_daemon: Callable[..., Daemon]) -> None:
    text = 'driver = "sim-io"\noutputs = 1\nhang_s = 30.0\n'
    daemon = start_daemon(f"[device.short]\n{text}lease_s = 0.5\n[device.long]\n{text}lease_s = 20.0\n")
    pids = [daemon.device(name)["pid"] for name in ("short", "long")]
    with (
        daemon.cell("reader") as cell, cell.open("short") as short, cell.open("long") as long,
        daemon.frozen(pids[0]), daemon.frozen(pids[1]),
    ):  # fmt: skip
        wait_for(lambda: _errno(short.read) == errno.EIO, "stale", 5.0)
        with raises(errno.EIO, "lease 0.500 s"):
            short.read()
        time.sleep(1.2)  # beyond the driver's own lease
        long.read()


def test_killed_fork_server_harms_no_driver_and_a_new_one_restarts_them(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("mod1", "rw") as axis:
        axis.command(velocity=0.05)
        os.kill(daemon.fork_server(), signal.SIGKILL)
        number = axis.read().number
        axis.wait_new(number + 300, 3.0)
        assert axis.read().in_motion[0]
        axis.stop()
    before = daemon.device("io0")
    os.kill(before["pid"], signal.SIGKILL)
    driver = daemon.wait_up("io0", before["generation"] + 1)["pid"]
    held = [os.readlink(link) for link in Path(f"/proc/{driver}/fd").iterdir()]
    foreign = [what for what in held if "memfd" in what and any(f":mod{i}" in what for i in range(3))]
    assert not foreign, "the new fork server had nothing of other devices to hand on"


def test_five_deaths_in_a_minute_are_a_fault_until_reset(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon('[device.io0]\ndriver = "sim-io"\ninputs = 1\n')
    for generation in range(1, 6):
        pid = daemon.wait_up("io0", generation)["pid"]
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda pid=pid: daemon.device("io0")["pid"] != pid, "death noticed")
    wait_for(lambda: daemon.device("io0")["state"] == "fault", "fault")
    with daemon.cell() as cell:
        with raises(errno.EIO, "5 deaths within a minute, so it waits for a reset"):
            cell.open("io0")
        cell.reset("io0")
        daemon.wait_up("io0", 6)
        cell.open("io0").close()


def test_killed_daemon_stops_all_drivers(start_daemon: Callable[..., Daemon], client: Callable[..., Client]) -> None:
    daemon = start_daemon()
    pids = [daemon.device(name)["pid"] for name in ("mod0", "mod1", "io0", "force0")]
    cell = daemon.cell()
    axis, other = cell.open("mod0.xaxis", "rw"), cell.open("mod1", "rw")
    axis.command(velocity=0.3)
    other.command(velocity=0.3)
    wait_for(lambda: axis.read().velocity[0] > 0.2 and other.read().velocity[0] > 0.2, "speed")
    os.kill(daemon.pid, signal.SIGKILL)
    killed = time.monotonic()
    for node in (axis, other):
        last = _last(node)
        assert not any(last.in_motion) and abs(last.velocity[0]) < 0.02, "the last thing published is rest"
        with raises(errno.EIO, node.name):
            node.read()
        with raises(errno.EIO, node.name):
            node.command(velocity=0.1)
    wait_for(lambda: all(has_ended(pid) for pid in pids), "drivers ended", 5.0)
    print(f"daemon SIGKILL to all drivers gone: {(time.monotonic() - killed) * 1e3:.0f} ms")
    wait_for(lambda: not daemon.running._reader.is_alive(), "nobody holds its pipes open", 5.0)
    with raises(errno.EIO):
        cell.status()


def test_hung_daemon_costs_the_writers_their_axes_only(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\ndaemon_lease_s = 0.3'))
    with daemon.cell() as cell:
        seen = cell.open("mod0.readonly")
        axis = cell.open("mod0.xaxis", "rw")
        axis.command(velocity=0.2)
        wait_for(lambda: seen.read().velocity[0] > 0.1, "motion")
        with daemon.frozen(daemon.pid):
            assert at_rest(seen, 3.0) < 2.0
            with raises(errno.ETIMEDOUT, "the daemon has been silent for more than 0.3 s"):
                axis.command(velocity=0.1)
            seen.read()
        cell.open("mod0.xaxis", "rw", timeout=3.0).close()
        seen.close()


def test_loss_of_a_device_stops_the_workcell_where_configured(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL.replace("[device.force0]\n", '[device.force0]\non_loss = "stop"\n'))
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.2)
        os.kill(daemon.device("force0")["pid"], signal.SIGKILL)
        at_rest(axis, 3.0)
        assert "device force0 lost" in wait_for(lambda: cell.status()["stop_source"], "latched")
        with raises(errno.EPERM, "emergency stop"):
            axis.command(velocity=0.1)
        daemon.wait_up("force0", 2)
        cell.reset()
        axis.move(0.0)
        axis.wait_until_idle(5.0)


def test_sigterm_while_axes_move_ends_in_rest_and_leaves_nothing(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon()
    pids = [daemon.device(name)["pid"] for name in ("mod0", "mod1", "io0", "force0")]
    cell = daemon.cell()
    axis = cell.open("mod0.xaxis", "rw")
    axis.command(velocity=0.5)
    wait_for(lambda: axis.read().velocity[0] > 0.4, "moving")
    daemon.running.signal(signal.SIGTERM)
    last = _last(axis)
    assert not last.in_motion[0] and abs(last.velocity[0]) < 0.1
    assert daemon.running.wait_exit(10.0) == 0
    assert not os.path.exists(daemon.socket)
    wait_for(lambda: all(has_ended(pid) for pid in pids), "drivers ended", 5.0)


def _errno(call: Callable[[], object]) -> int | None:
    try:
        call()
    except OSError as error:
        return error.errno
    return None


def _last(node: sioms.Node) -> sioms.client.snapshot.Snapshot:
    """Wait until reads are refused; return what was published last, which no read shows any more."""
    wait_for(lambda: _errno(node.read) == errno.EIO, f"{node.name} is refused", 5.0)
    raw = wait_for(lambda: node._page.numbered(node._page.head), "the last snapshot")
    return node._snapshot(raw, node._layout)


@pytest.mark.root
def test_only_drivers_that_ask_run_in_a_real_time_class(start_daemon: Callable[..., Daemon]) -> None:
    asked = axes("mod1", "xaxis").replace('driver = "sim-axes"', 'driver = "sim-axes"\nrealtime_priority = 5')
    daemon = start_daemon('[workcell]\nname = "test"\n' + axes("mod0", "xaxis") + asked, real_time=False)
    classes = {d: os.sched_getscheduler(int(daemon.device(d)["pid"])) for d in ("mod0", "mod1")}
    assert classes == {"mod0": os.SCHED_OTHER, "mod1": os.SCHED_FIFO}
    own = os.sched_getparam(daemon.pid).sched_priority
    assert own >= 5, "the daemon must get its turn beside its drivers"


@pytest.mark.root
def test_sigterm_is_obeyed_on_a_full_core(start_daemon: Callable[..., Daemon]) -> None:
    """Drivers that ask for real time and for more than a core has; the daemon takes it away and ends when told to."""
    text = '[workcell]\nname = "test"\n'
    for i in range(6):
        many = axes(f"mod{i}", "xaxis").replace(
            'driver = "sim-axes"', 'driver = "sim-axes"\nrealtime_priority = 50\ntick_hz = 8000.0'
        )
        text += many.replace('name = "xaxis"', 'name = "xaxis"\ncount = 300').replace("history = 4096", "history = 64")
    daemon = start_daemon(text, ready=False)
    os.sched_setaffinity(daemon.pid, {0})
    for child in Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split():
        os.sched_setaffinity(int(child), {0})  # the fork server: drivers inherit it
    daemon.running.wait_line("event=ready", 60.0)
    with daemon.cell() as cell, ExitStack() as opened:
        pids = [d["pid"] for d in cell.status()["devices"]]
        assert all(os.sched_getaffinity(pid) == {0} for pid in pids)
        for i in range(6):  # whom nobody reads ticks seldom
            opened.enter_context(cell.open(f"mod{i}"))
        daemon.running.wait_line("real time given up|gave up real-time scheduling", 30.0)
    time.sleep(1.0)
    began = time.monotonic()
    daemon.running.signal(signal.SIGTERM)
    daemon.running.wait_line("event=shutdown", 5.0)
    heard_s = time.monotonic() - began
    assert daemon.running.wait_exit(10.0) == 0
    print(f"SIGTERM heard after {heard_s:.3f} s, ended after {time.monotonic() - began:.3f} s")
    assert heard_s < 1.0


def test_a_client_that_is_stopped_loses_its_axes_without_a_lease(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    """As by Ctrl-Z; one that goes on at once does not."""
    victim = client(
        daemon,
        jog("mod0.xaxis", 0.02) + "while True:\n    time.sleep(0.05)\n    node.limits()\n",
    )
    with cell.open("mod0.readonly") as seen:
        wait_for(lambda: seen.read().in_motion[0], "moving")
        with daemon.frozen(victim.pid):
            time.sleep(0.01)
        time.sleep(0.3)
        assert seen.read().in_motion[0], "stopped for a moment only"
        with daemon.frozen(victim.pid):
            assert at_rest(seen, 2.0) < 1.0
            with cell.open("mod0.xaxis", "rw", timeout=1.0):
                pass
        victim.wait_line("its client was stopped, as by Ctrl-Z")


FREEZERS = (
    ("/sys/fs/cgroup", "cgroup.freeze", "1", "0"), ("/sys/fs/cgroup/unified", "cgroup.freeze", "1", "0"),
    ("/sys/fs/cgroup/freezer", "freezer.state", "FROZEN", "THAWED"),
)  # fmt: skip


@pytest.mark.parametrize(("root", "file", "freeze", "thaw"), FREEZERS)
def test_a_client_that_is_frozen_loses_its_axes_without_a_lease(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client], root: str, file: str, freeze: str, thaw: str
) -> None:
    """As by ``systemctl freeze`` or ``docker pause``: the process sleeps, as far as its state tells."""
    outer = Path(root, f"sioms-test-{os.getpid()}")
    group = outer / "inner"
    try:
        group.mkdir(parents=True)
    except OSError as error:
        pytest.skip(f"no control group can be made: {error}")
    try:
        if not (outer / file).exists():
            pytest.skip("no freezer there")
        victim = client(daemon, jog("mod0.xaxis", 0.02) + "while True:\n    time.sleep(0.05)\n    node.limits()\n")
        with cell.open("mod0.readonly") as seen:
            wait_for(lambda: seen.read().in_motion[0], "moving")
            (group / "cgroup.procs").write_text(str(victim.pid))
            time.sleep(0.3)
            assert seen.read().in_motion[0], "it is in a group that is not frozen"
            (outer / file).write_text(freeze)
            try:
                assert at_rest(seen, 2.0) < 1.0
            finally:
                (outer / file).write_text(thaw)
        victim.wait_line("or frozen")
        victim.kill()
        wait_for(lambda: not (group / "cgroup.procs").read_text(), "gone")
    finally:
        group.rmdir()
        outer.rmdir()
