"""Who may have what: exclusive opens, holders by name, waiting, races, bounds, foreign users."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from daemon_rig import WORKCELL, Client, Daemon, at_rest, raises, wait_for
from interrupt_rig import interrupted_everywhere

import sioms
import sioms.aio
from sioms.protocol.flags import Request


def test_second_open_is_refused_in_every_mode_and_names_the_holder(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    owner = client(daemon, "node = cell.open('mod0.xaxis', 'rw')\nsay('ready')\nhold()")
    for mode in ("r", "w", "rw"):
        with raises(errno.EBUSY, f"held by pid {owner.pid} (", "victim", " s;", "use mod0.xaxis.readonly"):
            cell.open("mod0.xaxis", mode)
    with raises(errno.EBUSY, f"pid {owner.pid}", "through mod0.xaxis"):  # the group that contains it
        cell.open("mod0", "r")
    readers = [cell.open(name) for name in ("mod0.readonly", "mod0.xaxis.readonly", "mod0.readonly")]
    for reader in readers:
        assert reader.read().position[0] == pytest.approx(0.0, abs=0.1)
    cell.open("mod0.yaxis", "rw").close()
    for reader in readers:
        reader.close()


def test_bit_and_byte_exclude_each_other(cell: sioms.Workcell) -> None:
    with cell.open("io0.bit3", "rw"):
        with raises(errno.EBUSY, "through io0.bit3"):
            cell.open("io0", "rw")
        with cell.open("io0.bit4", "rw") as other:
            other.set(1)
            with cell.open("io0.readonly") as byte:
                wait_for(lambda: byte.read().data[0] == 0x10, "bit 4 alone")
    with cell.open("io0", "rw"), raises(errno.EBUSY, "through io0;"):
        cell.open("io0.bit0", "r")


def test_readonly_shows_the_identical_records(cell: sioms.Workcell) -> None:
    with cell.open("mod0", "rw") as owned, cell.open("mod0.readonly") as seen:
        owned.move(0.02)
        owned.wait_until_idle(5.0)
        for _ in range(200):
            first, second = owned.read(), seen.read()
            if first.number == second.number:
                break
        assert first.number == second.number
        assert (first.stamp_ns, first.tick, list(first)) == (second.stamp_ns, second.tick, list(second))
        with raises(errno.EBADF, "not open for writing"):
            seen.command(position=0.0)
        for request in (Request.HOME, Request.CALIBRATE_DEVICE, Request.SET_LIMITS, Request.FLUSH):
            with raises(errno.EBADF, "mod0.readonly", "output node itself"):
                seen.ioctl(request)
        owned.move(0.0)
        owned.wait_until_idle(5.0)


def test_readonly_refuses_to_be_opened_for_writing(cell: sioms.Workcell) -> None:
    with raises(errno.EACCES, "read-only node"):
        cell.open("mod0.readonly", "rw")
    with raises(errno.EINVAL, "mode 'x'"):
        cell.open("mod0", "x")
    with raises(errno.ENOENT, "mod0.yaxi", "did you mean mod0.yaxis?"):
        cell.open("mod0.yaxi")


def test_waiting_open_gets_the_node_when_it_is_freed(
    daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    owner = client(daemon, "node = cell.open('mod0', 'rw')\nsay('ready')\nhold()")
    with raises(errno.ETIMEDOUT, "open mod0", "0.05 s", f"pid {owner.pid}"):
        cell.open("mod0", "rw", timeout=0.05)
    got: list[float] = []

    def wait() -> None:
        with daemon.cell() as mine, mine.open("mod0", "rw", timeout=10.0):
            got.append(time.monotonic())

    threads = [threading.Thread(target=wait, daemon=True) for _ in range(5)]
    for thread in threads:
        thread.start()
    wait_for(lambda: sum(s[2] for s in cell.status()["sessions"]) == 5, "five wait")
    owner.kill()
    for thread in threads:
        thread.join(10.0)
    assert len(got) == 5


def test_a_waiting_open_can_be_cancelled(daemon: Daemon, cell: sioms.Workcell) -> None:
    async def story() -> None:
        async with await sioms.aio.connect(daemon.socket) as other:
            task = asyncio.create_task(other.open("mod0", "rw", None))
            while not any(s[2] for s in (await other.status())["sessions"]):
                await asyncio.sleep(0.001)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task

    with cell.open("mod0", "rw"):
        asyncio.run(story())
    cell.open("mod0", "rw", timeout=1.0).close()


@pytest.mark.parametrize("is_read_first", [True, False])
def test_an_open_that_is_cancelled_when_its_answer_has_come_leaves_nothing_open(
    daemon: Daemon, is_read_first: bool
) -> None:
    """The answer is there, and who asked for it is cancelled before the loop has come to it, or to its task."""
    asked = {1: lambda other: other.open("mod0", "rw"), 3: lambda other: other.reserve_marker()}

    async def story() -> None:
        async with await sioms.aio.connect(daemon.socket) as other:
            before = len(os.listdir("/proc/self/fd"))
            for ask in asked.values():
                task = asyncio.create_task(ask(other))
                await asyncio.sleep(0)
                requests = other._waiter
                if not is_read_first:
                    task.cancel()
                while requests._futures:
                    requests._readable()
                if is_read_first:
                    task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task
            await asyncio.sleep(0.05)
            (mine,) = [s for s in (await other.status())["sessions"] if str(os.getpid()) in str(s[0])]
            assert [mine[row] for row in asked] == [0, 0], "no handle, no marker"
            assert len(os.listdir("/proc/self/fd")) == before

    asyncio.run(story())


def test_an_open_that_is_interrupted_leaves_nothing_open(daemon: Daemon, cell: sioms.Workcell) -> None:
    modules = ("sioms.client.channel", "sioms.client.local", "sioms.client.cell_verbs")
    with daemon.cell("interrupted") as mine:
        places = 0
        for at in interrupted_everywhere(lambda: mine.open("mod0", "rw"), modules, step=3):
            mine.status()
            cell.open("mod0", "rw", timeout=1.0).close()
            places = at
        assert places > 30


def test_race_of_second_writers_has_one_winner(daemon: Daemon) -> None:
    rounds, threads_n = 40, 4
    barrier = threading.Barrier(threads_n)
    winners = [0] * rounds
    refused = [0] * rounds
    lock = threading.Lock()

    def run() -> None:
        with daemon.cell() as mine:
            for i in range(rounds):
                barrier.wait(20.0)
                try:
                    node = mine.open("io0", "rw")
                except OSError as error:
                    assert error.errno == errno.EBUSY
                    with lock:
                        refused[i] += 1
                    barrier.wait(20.0)
                    continue
                with lock:
                    winners[i] += 1
                barrier.wait(20.0)
                node.close()

    threads = [threading.Thread(target=run, daemon=True) for _ in range(threads_n)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert winners == [1] * rounds and refused == [threads_n - 1] * rounds


def test_open_and_close_leave_nothing_behind(daemon: Daemon) -> None:
    driver = daemon.device("mod0")["pid"]

    def descriptors() -> list[int]:
        return [len(os.listdir(f"/proc/{pid}/fd")) for pid in (daemon.pid, driver, os.getpid())]

    with daemon.cell() as mine:
        mine.open("mod0", "rw", timeout=1.0).close()
        before = descriptors()
        for _ in range(300):
            mine.open("mod0.xaxis", "rw").close()
            mine.open("mod0.readonly").close()
        wait_for(lambda: descriptors() <= before, "descriptors as before")
        assert mine.status()["holders"] == []


def test_close_halts_and_empties_the_buffer_before_the_next_owner(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.write([sioms.command(0, position=x / 1e4) for x in range(100)])
        axis.command(velocity=0.3)
    with cell.open("mod0.xaxis", "rw", timeout=1.0) as axis:
        reading = axis.read()
        assert reading.buffered[0] == 0
        wait_for(lambda: not axis.read().in_motion[0], "rest")
        axis.move(0.0)
        axis.wait_until_idle(5.0)


def test_use_after_close_is_ebadf(cell: sioms.Workcell) -> None:
    node = cell.open("mod0", "rw")
    node.close()
    node.close()
    for call in (node.read, lambda: node.command(position=0.0), node.wait_until_idle):
        with raises(errno.EBADF, "mod0"):
            call()


def test_bounds_and_quotas(start_daemon: Callable[..., Daemon]) -> None:
    """The daemon's own user may have four times as much as the quotas say."""
    quotas = "[quota]\nhandles = 1\nmarkers = 2\nwaits = 1\nsilent = 1\ngreeting_s = 0.5\n"
    text = WORKCELL.replace('name = "test"', 'name = "test"\nmax_sessions = 6\n' + quotas)
    daemon = start_daemon(text)
    with daemon.cell() as cell:
        nodes = [cell.open("mod0.readonly") for _ in range(4)]
        with raises(errno.EMFILE, "has 4 nodes open, and at most 4 are allowed (handles of [quota], 4 times"):
            cell.open("mod1.readonly")
        nodes.pop().close()
        cell.open("mod1.readonly").close()
        with raises(errno.EINVAL, "want 1 to 1023"):
            cell.reserve_markers(1024)
        markers = cell.reserve_markers(6)
        with (
            daemon.cell() as second,
            raises(errno.EBUSY, "has 6 markers, and at most 8 are allowed (markers of [quota]"),
        ):
            second.reserve_markers(3)
        waiters = [
            threading.Thread(target=lambda: _quiet(lambda: markers[0].wait(20.0)), daemon=True) for _ in range(4)
        ]
        for waiter in waiters:
            waiter.start()
        wait_for(lambda: cell.status()["sessions"][0][2] == 4, "four wait")
        with raises(errno.EAGAIN, "has 4 requests that wait, and at most 4 are allowed (waits of [quota]"):
            markers[1].wait(1.0)
        markers[0].signal()
        others = [daemon.cell() for _ in range(5)]
        with raises(errno.EUSERS, "6 sessions are open; max_sessions of [workcell] allows 6"):
            daemon.cell()
        daemon.said('event="session refused".*6 sessions are open')
        others.pop().close()
        wait_for(lambda: len(cell.status()["sessions"]) == 5, "a session less")
        daemon.cell().close()
        for node in (*nodes, *others):
            node.close()
        for waiter in waiters:
            waiter.join(5.0)


def test_silent_connections_are_few_and_end(start_daemon: Callable[..., Daemon]) -> None:
    text = WORKCELL.replace('name = "test"', 'name = "test"\n[quota]\nsilent = 1\ngreeting_s = 0.5\n')
    daemon = start_daemon(text)
    silent = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(5)]
    with daemon.cell() as cell:
        for sock in silent:
            sock.connect(str(daemon.socket))
            sock.settimeout(5.0)
        assert b"4 connections without a Hello" in silent[4].recv(1000)
        assert b"no Hello within 0.5 s" in silent[0].recv(1000)
        assert silent[0].recv(1000) == b""
        wait_for(lambda: len(cell.status()["sessions"]) == 1, "the silent ones are gone, who has spoken is not")
        for sock in silent:
            sock.close()


def test_too_many_waits_at_a_device(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\n[quota]\nwaits = 16\n'))
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.01)
        calls = [axis._ioctl(Request.WAIT_UNTIL_IDLE, None, 30.0) for _ in range(65)]
        numbers = [axis._channel.send(call) for call in calls]
        with raises(errno.EAGAIN, "wait at this device already, as many as waits of [quota] allows"):
            axis._channel.wait(numbers[-1], calls[-1])
        axis.stop()
        for number, call in zip(numbers[:-1], calls[:-1], strict=True):
            with raises(errno.ECANCELED):
                axis._channel.wait(number, call)


FOREIGN = """
import errno, json, os, pwd, sys, sioms
from sioms.tools import sdev
[getattr(sioms, name) for name in sioms.__all__]  # nobody may not read the tree
os.environ['SIOMS_SOCKET'] = sys.argv[1]
nobody = pwd.getpwnam('nobody')
os.setgroups([]); os.setgid(nobody.pw_gid); os.setuid(nobody.pw_uid)
try:
    cell = sioms.Workcell(sys.argv[1], 'foreign')
except OSError as error:
    print(json.dumps(['connect', error.errno, error.strerror])); sys.exit()
def attempt(name, call):
    try:
        call()
        print(json.dumps([name, 0, '']))
    except OSError as error:
        print(json.dumps([name, error.errno, error.strerror]), flush=True)
attempt('list', lambda: print(json.dumps(['nodes', 0, [n.name for n in cell.nodes()]])))
attempt('read mod0', lambda: cell.open('mod0.readonly').read())
attempt('write mod0', lambda: cell.open('mod0', 'rw'))
attempt('write io0', lambda: cell.open('io0', 'rw').close())
attempt('read force0', lambda: cell.open('force0'))
attempt('stop mod0', lambda: cell.emergency_stop('mod0'))
attempt('sdev stop', lambda: sdev._work(['-e', 'mod0.xaxis']))
attempt('stop', lambda: cell.emergency_stop())
attempt('reset', lambda: cell.reset())
attempt('reload', lambda: cell.reload())
attempt('zero mod0', lambda: cell.open('mod0.readonly').ioctl(sioms.Request.ZERO_DEVICE))
attempt('ioctl stop mod0', lambda: cell.open('mod0.readonly').ioctl(sioms.Request.STOP))
print(json.dumps(['page', 0, cell._request is not None]))
attempt('stop file', lambda: os.close(os.open(sys.argv[1] + '.stop', os.O_WRONLY)))
attempt('taken file', lambda: os.close(os.open(sys.argv[1] + '.stopped', os.O_WRONLY)))
"""
GRANTS = """
[[grant]]
rights = ["read"]
users = ["nobody"]
nodes = ["mod*"]
[[grant]]
rights = ["read", "write"]
users = ["nobody"]
nodes = ["io0*"]
[[grant]]
rights = ["read", "write", "stop", "administer"]
groups = ["root"]
"""


def _foreign(daemon: Daemon, start: Callable[..., object]) -> dict[str, tuple[int, object]]:
    running = start([sys.executable, "-c", FOREIGN, daemon.socket])
    assert running.wait_exit() == 0, running.lines
    return {name: (number, text) for name, number, text in map(json.loads, running.lines)}


@pytest.mark.root
def test_foreign_user_is_kept_out_by_the_mode_of_the_socket(
    start_daemon: Callable[..., Daemon], start: Callable[..., object]
) -> None:
    daemon = start_daemon(WORKCELL)
    os.chmod(daemon.folder.parent, 0o755)
    assert os.stat(daemon.socket).st_mode & 0o777 == 0o660
    number, text = _foreign(daemon, start)["connect"]
    assert number == errno.EACCES and "group of the socket" in str(text)


STOPPER = """
[[grant]]
rights = ["stop"]
users = ["nobody"]
[[grant]]
rights = ["read", "write", "stop"]
groups = ["root"]
"""


@pytest.mark.root
def test_foreign_user_with_a_grant_to_stop_needs_no_daemon(
    start_daemon: Callable[..., Daemon], start: Callable[..., object]
) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\nsocket_mode = "0666"') + STOPPER)
    os.chmod(daemon.folder.parent, 0o755)
    said = _foreign(daemon, start)
    assert said["stop file"][0] == 0 and said["taken file"][0] == errno.EACCES
    allowed = {name for name, (number, _) in said.items() if number == 0}
    assert allowed == {"list", "nodes", "stop", "stop mod0", "sdev stop", "page", "stop file"}, (
        "a right to stop is enough"
    )
    with daemon.cell() as cell:
        status = cell.status()
    assert status["stopped_ns"] and [node for node, _ in status["node_stops"]] == ["mod0"]


@pytest.mark.root
def test_foreign_user_may_what_is_granted(start_daemon: Callable[..., Daemon], start: Callable[..., object]) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\nsocket_mode = "0666"') + GRANTS)
    os.chmod(daemon.folder.parent, 0o755)
    said = _foreign(daemon, start)
    names = said["nodes"][1]
    assert isinstance(names, list) and "mod0.xaxis.readonly" in names and "io0.bit1" in names
    assert not [name for name in names if name.startswith("force0")]
    allowed = {name for name, (number, _) in said.items() if number == 0}
    assert allowed == {"list", "nodes", "read mod0", "write io0", "page"}
    assert said["page"][1] is False, "who may not stop gets no stop-request file"
    assert said["stop file"][0] == errno.EACCES, "and cannot open it either"
    assert said["write mod0"][0] == errno.EACCES and "nobody has no right to write it" in str(said["write mod0"][1])
    assert said["read force0"][0] == errno.EACCES
    for name in ("stop", "stop mod0", "reset", "reload", "ioctl stop mod0"):
        assert said[name][0] == errno.EPERM, (name, said[name])
    assert said["zero mod0"][0] in (errno.EBADF, errno.EPERM)
    with daemon.cell() as cell:
        assert not cell.status()["stopped_ns"]


@pytest.mark.root
def test_foreign_user_without_any_grants_may_read_write_and_stop_but_not_administer(
    start_daemon: Callable[..., Daemon], start: Callable[..., object]
) -> None:
    daemon = start_daemon(WORKCELL.replace('name = "test"', 'name = "test"\nsocket_mode = "0666"'))
    os.chmod(daemon.folder.parent, 0o755)
    said = _foreign(daemon, start)
    assert said["write mod0"][0] == 0 and said["stop"][0] == 0 and said["reset"][0] == 0
    assert said["reload"][0] == errno.EPERM


HOLDING = """
import os, pwd, sys, time, sioms
[getattr(sioms, name) for name in sioms.__all__]
nobody = pwd.getpwnam('nobody')
os.setgroups([]); os.setgid(nobody.pw_gid); os.setuid(nobody.pw_uid)
cell = sioms.Workcell(sys.argv[1], 'foreign')
axis, watch = cell.open('mod0.xaxis', 'rw'), cell.open('io0.readonly')
axis.command(velocity=0.1)
while not axis.read().in_motion[0]:
    time.sleep(0.001)
print('moving', flush=True)
try:
    while True:
        axis.ioctl(sioms.Request.GET_LIMITS)
        time.sleep(0.005)
except OSError as error:
    print(error.errno, error.strerror, flush=True)
watch.read()
print('still reads', flush=True)
"""


@pytest.mark.root
def test_a_right_that_a_reload_takes_away_ends_what_was_open(
    start_daemon: Callable[..., Daemon], start: Callable[..., Any]
) -> None:
    text = WORKCELL.replace('name = "test"', 'name = "test"\nsocket_mode = "0666"')
    grant = '[[grant]]\nusers = ["nobody"]\nrights = ["read", "write"]\n'
    daemon = start_daemon(text + grant)
    os.chmod(daemon.folder.parent, 0o755)
    client = start([sys.executable, "-c", HOLDING, daemon.socket])
    client.wait_line("moving")
    daemon.configure(text + grant.replace('"read", "write"', '"read"'))
    with daemon.cell() as cell, cell.open("mod0.xaxis.readonly") as watch:
        pid = daemon.device("mod0")["pid"]
        cell.reload()
        at_rest(watch)
        assert client.wait_exit() == 0, client.lines
        assert any(f"{errno.EACCES} mod0.xaxis: the right to write it" in line for line in client.lines), client.lines
        assert client.lines[-1] == "still reads"
        assert daemon.device("mod0")["pid"] == pid, "the device was not touched"


def _quiet(call: Callable[[], object]) -> None:
    try:
        call()
    except OSError:
        return


def test_the_end_of_a_session_closes_its_read_only_nodes_too(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("mod0.readonly") as watch:
        before = watch.statistics(1)["handles"]
        session = sioms.Workcell(daemon.socket)
        nodes = [session.open("mod0.readonly") for _ in range(3)]
        assert watch.statistics(1)["handles"] == before + 3
        session.close()
        wait_for(lambda: watch.statistics(1)["handles"] == before, "handles of the closed session gone")
        for node in nodes:
            with raises(errno.EBADF, "closed"):
                node.read()
