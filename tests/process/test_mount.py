"""Device nodes as files: the kernel, a mount and the daemon; and what becomes of a motion, whoever ends how."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import json
import os
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import WORKCELL, Daemon, Waiting, at_rest, raises, wait_for
from mount_rig import Mount, why_not

import sioms
from sioms import command
from sioms.bench.watching import Watch, halting_ns
from sioms.bridges.prompt import SETTLE_NS
from sioms.protocol.flags import Request

pytestmark = pytest.mark.skipif(bool(why_not()), reason=f"mounts: {why_not()}")
LEASE_S = 0.3
BUSY_NS = 150_000_000
"""More for a machine that runs other tests at the same time."""
JOG = """
import os, sys, time
fd = os.open(sys.argv[1], os.O_WRONLY | os.O_NONBLOCK)
os.write(fd, b'velocity=0.2')
print('ready', flush=True)
time.sleep(60)
"""
MOVE = """
import os, sys
fd = os.open(sys.argv[1], os.O_WRONLY)
print('ready', flush=True)
try:
    os.write(fd, b'velocity=0.2')
except OSError as error:
    print(error.errno, flush=True)
"""


@pytest.fixture(scope="module")
def mount(shared_daemon: Daemon) -> Iterator[Mount]:
    with Mount(shared_daemon.socket, "--lease", str(LEASE_S), "--allow-other") as mounted:
        yield mounted


@pytest.fixture
def files(daemon: Daemon, mount: Mount) -> Path:
    return mount.folder


@pytest.fixture
def axis(cell: sioms.Workcell) -> Iterator[sioms.AxisNode]:
    """What the axis does, seen past the mount; it stands at 0 in the beginning."""
    with cell.open("mod0.xaxis", "rw", timeout=5.0) as arm:
        arm.move(0.0)
        arm.wait_until_idle(5.0)
    with cell.open("mod0.xaxis.readonly") as seen:
        yield seen


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=60)


def program(script: str, path: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "ready\n"
    return process


def log(files: Path) -> str:
    return (files / ".log").read_text()


def stand_still(mount: Mount) -> None:
    """Stop a mount; each of its threads may still serve what it finds until the kernel has stopped it."""
    os.kill(mount.process.pid, signal.SIGSTOP)
    threads = Path(f"/proc/{mount.process.pid}/task").glob("*/stat")
    for stat in threads:
        wait_for(lambda stat=stat: stat.read_text().rpartition(")")[2].split()[0] == "T", "a thread to stop")


def test_the_shell_reads_and_moves(files: Path, axis: sioms.AxisNode, cell: sioms.Workcell) -> None:
    assert {"mod0", "mod0.all", "io0", "force0.all"} <= set(os.listdir(files)) and "xaxis" in os.listdir(files / "mod0")
    done = shell("echo 0.02 > mod0/xaxis && cat mod0/xaxis", files)
    assert done.returncode == 0, done.stderr
    index, moving, position, _, _ = map(float, done.stdout.split())
    assert (index, moving) == (0, 0) and position == pytest.approx(0.02, abs=1e-3), "it has waited for the end"
    record = command(1, position=0.01)
    dd = subprocess.run(["dd", f"of={files}/mod0.all.bin", "bs=144", "conv=notrunc"], input=record * 2, check=True)
    raw = subprocess.run(["dd", f"if={files}/mod0.all.bin", "bs=4096", "count=1"], capture_output=True, check=True)
    assert dd.returncode == 0 and len(raw.stdout) == 2 * 8 * 13
    positions = struct.unpack_from("<d", raw.stdout)[0], struct.unpack_from("<d", raw.stdout, 8 * 13)[0]
    assert positions == pytest.approx((0.02, 0.01), abs=1e-3)
    shell("echo 5 > io0.all", files)
    assert len(shell("cat force0.all", files).stdout.splitlines()) == 6
    refused = shell("echo 9 > mod0/xaxis", files)
    assert "Numerical result out of range" in refused.stderr and "9 m" in log(files)
    assert "Invalid argument" in shell("echo fast > mod0/xaxis", files).stderr and "no axis 'fast'" in log(files)
    assert shell("echo 1 > nothing", files).returncode and shell("echo 1 > force0.all", files).returncode


def test_a_number_that_a_block_cuts_is_one_number(files: Path, axis: sioms.AxisNode) -> None:
    """Programs write what they have in blocks: "0.15" must not become 0.1, and then 5."""
    first, last = b"0.05\n# ", b"\n0.1"
    with open(files / "mod0" / "xaxis", "wb", buffering=0) as file:
        assert file.write(first + b"x" * (4096 - len(first + last)) + last) == 4096
        assert axis.read().position[0] == pytest.approx(0.05, abs=1e-3)
        file.write(b"5\n")
        assert axis.read().position[0] == pytest.approx(0.15, abs=1e-3)
    with open(files / "mod0" / "xaxis", "wb", buffering=0) as file:
        file.write(b"0.1\n" * 127 + b"0.05")
    wait_for(lambda: "its last line has no end" in (files / ".log").read_text(), "what was left out is told")
    with open(files / "mod0" / "xaxis", "rb", buffering=0) as file:
        for number in (0x5401, ord("S") << 8 | 99):
            with raises(errno.ENOTTY):
                fcntl.ioctl(file, number)
    log = (files / ".log").read_text()
    assert "0x5401" not in log, "who asks whether this is a terminal is no news"
    assert "request 0x5363; want" in log
    assert axis.read().position[0] == pytest.approx(0.1, abs=1e-3)


def test_a_file_that_is_open_for_writing_is_held_and_closing_halts(
    files: Path, axis: sioms.AxisNode, cell: sioms.Workcell
) -> None:
    fd = os.open(files / "mod0/xaxis", os.O_WRONLY | os.O_NONBLOCK)
    with raises(errno.EBUSY, f"[{os.getpid()}] by sioms mount"):
        cell.open("mod0", "rw")
    for path in ("mod0/xaxis", "mod0.all", "mod0/xaxis.bin"):
        with pytest.raises(OSError, match="busy"):
            os.open(files / path, os.O_WRONLY)
    assert "held by" in log(files)
    os.write(fd, b"velocity=0.2\n")
    wait_for(lambda: axis.read().velocity[0] > 0.1, "motion")
    assert shell("cat mod0/xaxis", files).stdout.split()[1] == "1", "others may read"
    time.sleep(2 * LEASE_S)
    watch, begin = Watch(axis), time.monotonic_ns()
    assert axis.read().commanded_velocity[0] == pytest.approx(0.2), "who is alive keeps its motion"
    os.close(fd)
    assert halting_ns(watch, begin) - begin < BUSY_NS
    os.close(os.open(files / "mod0/xaxis", os.O_WRONLY))  # at once, though the kernel tells of a close a moment later


def test_poll_fsync_and_ioctl(files: Path, axis: sioms.AxisNode) -> None:
    fd = os.open(files / "mod0/xaxis", os.O_RDWR | os.O_NONBLOCK)
    try:
        poller = select.poll()
        poller.register(fd, select.POLLIN | select.POLLOUT)
        assert poller.poll(5000) == [(fd, select.POLLIN | select.POLLOUT)]
        poller.modify(fd, select.POLLIN)
        for _ in range(3):
            os.pread(fd, 100, 0)
            assert poller.poll(5000) == [(fd, select.POLLIN)], "a new snapshot wakes"
        os.write(fd, b"position=0.03\n")
        os.fsync(fd)
        assert axis.read().position[0] == pytest.approx(0.03, abs=1e-3), "fsync waits for the end of the motion"
        os.write(fd, b"velocity=-0.05\n")
        fcntl.ioctl(fd, ord("S") << 8 | Request.STOP)
        at_rest(axis)
        answer = bytearray(4096)
        fcntl.ioctl(fd, _iowr(Request.GET_IO_STRUCT_INFO, len(answer)), answer)
        told = json.loads(answer.split(b"\0")[0])
        assert told["name"] == "mod0.xaxis" and told["channels"][0]["unit"] == "m" and told["write_size"] == 144
        limits = b'[{"position_max": 0.5}]'.ljust(64, b"\0")
        fcntl.ioctl(fd, _iowr(Request.SET_LIMITS, 64), limits)
        assert axis.limits()["position_max"] == [0.5]
        fcntl.ioctl(fd, _iowr(Request.SET_LIMITS, 64), b'[{"position_max": 1.0}]'.ljust(64, b"\0"))
        for number, argument, code in (
            (_iowr(Request.SET_LIMITS, 64), b"{no json".ljust(64, b"\0"), errno.EINVAL),
            (ord("S") << 8 | 99, 0, errno.ENOTTY),
            (_iowr(Request.GET_IO_STRUCT_INFO, 8), bytes(8), errno.EMSGSIZE),
            (_iowr(Request.WAIT_UNTIL_IDLE, 64), b"[null, 5]".ljust(64, b"\0"), 0),
        ):
            try:
                fcntl.ioctl(fd, number, argument)
                got = 0
            except OSError as error:
                got = error.errno or -1
            assert got == code, hex(number)
    finally:
        os.close(fd)


def _iowr(request: Request, size: int) -> int:
    return 3 << 30 | size << 16 | ord("S") << 8 | request


@pytest.mark.parametrize("what", ["killed", "stopped", "killed in a write", "stopped in a write", "mount hung"])
def test_whatever_happens_to_a_writer_halts(what: str, files: Path, mount: Mount, axis: sioms.AxisNode) -> None:
    writer = program(MOVE if "write" in what else JOG, files / "mod0/xaxis")
    victim = mount.process.pid if what == "mount hung" else writer.pid
    try:
        wait_for(lambda: axis.read().commanded_velocity[0] == pytest.approx(0.2), "motion")
        time.sleep(2 * LEASE_S)
        watch, begin = Watch(axis), time.monotonic_ns()
        assert axis.read().commanded_velocity[0] == pytest.approx(0.2), "who is alive keeps its motion"
        os.kill(victim, signal.SIGKILL if "killed" in what else signal.SIGSTOP)
        limit_ns = BUSY_NS + (0 if "killed" in what else int(LEASE_S * 1e9))
        assert halting_ns(watch, begin) - begin < limit_ns
        os.kill(victim, signal.SIGCONT)
        time.sleep(0.2)
        assert not axis.read().commanded_velocity[0], "nothing resumes"
    finally:
        os.kill(victim, signal.SIGCONT)
        writer.kill()
        writer.wait()
    wait_for(lambda: shell("echo 0 > mod0/xaxis", files).returncode == 0, "it is free again")


def test_a_mount_that_is_killed_halts_and_another_takes_its_place(daemon: Daemon, axis: sioms.AxisNode) -> None:
    with Mount(daemon.socket) as first:
        writer = program(JOG, first.folder / "mod0/xaxis")
        wait_for(lambda: axis.read().commanded_velocity[0] == pytest.approx(0.2), "motion")
        watch, begin = Watch(axis), time.monotonic_ns()
        first.process.kill()
        assert halting_ns(watch, begin) - begin < BUSY_NS
        writer.kill()
        writer.wait()
        with raises(errno.ENOTCONN):
            os.listdir(first.folder)
        again = [sys.executable, "-P", "-m", "sioms.tools.front", "mount", str(first.folder)]
        env = {**os.environ, "SIOMS_CELL": daemon.socket}
        with subprocess.Popen(again, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as second:
            assert second.stdout is not None
            assert "mounted" in second.stdout.readline()
            assert "mod0.all" in os.listdir(first.folder)
            second.terminate()
            assert second.wait(20) == 0


def test_what_was_written_before_a_reset_is_not_carried_out_by_a_mount_that_is_held_up(
    daemon: Daemon, axis: sioms.AxisNode
) -> None:
    """It stands still for less than its lease, in which somebody writes, and somebody else stops and resets all."""
    ends: list[int | None] = []
    with Mount(daemon.socket, "--lease", "5") as mount, daemon.cell() as cell:
        while ends.count(errno.ECANCELED) < 2:
            time.sleep(0.3)  # nothing of the last time may still be waiting
            fd = os.open(mount.folder / "mod0/xaxis", os.O_WRONLY | os.O_NONBLOCK)
            try:
                os.write(fd, b"velocity=0.2\n")
                wait_for(lambda: axis.read().commanded_velocity[0] == pytest.approx(0.2), "motion")
                stand_still(mount)
                late = Waiting(functools.partial(os.write, fd, b"velocity=0.2\n"))
                time.sleep(0.03)
                cell.emergency_stop()
                cell.reset()
                os.kill(mount.process.pid, signal.SIGCONT)
                ends.append(late.errno())
                wait_for(lambda: axis.read().commanded_velocity[0] == 0.0, "rest")
            finally:
                os.close(fd)
            # On a busy machine it may have stood still for so long that what it holds has been taken away from it.
            assert ends[-1] in (errno.ECANCELED, errno.ETIMEDOUT) and len(ends) < 9, ends
        assert "sent before the last reset" in (mount.folder / ".log").read_text()


def test_a_mount_that_is_not_held_up_passes_on_what_is_written_right_behind_a_reset(
    daemon: Daemon, files: Path, axis: sioms.AxisNode
) -> None:
    """A busy machine holds it up now and then; what is written meanwhile, or for a moment after, may be refused."""

    def is_passed_on() -> bool:
        fd = os.open(files / "mod0/xaxis", os.O_WRONLY | os.O_NONBLOCK)
        try:
            cell.emergency_stop()
            cell.reset()
            return bool(os.write(fd, b"velocity=0.2\n"))
        except OSError as error:
            assert error.errno in (errno.ECANCELED, errno.ETIMEDOUT)
            time.sleep(2.0 * SETTLE_NS * 1e-9)
            return False
        finally:
            os.close(fd)

    with daemon.cell() as cell:
        wait_for(is_passed_on, "a write that is passed on")


def test_what_is_opened_when_a_mount_goes_on_is_of_after_that(daemon: Daemon, axis: sioms.AxisNode) -> None:
    """It is held up for longer than its lease, in which somebody stops and resets all."""
    with Mount(daemon.socket, "--lease", str(LEASE_S)) as mount, daemon.cell() as cell:
        stand_still(mount)
        cell.emergency_stop()
        cell.reset()
        time.sleep(1.5 * LEASE_S)
        os.kill(mount.process.pid, signal.SIGCONT)
        fd = os.open(mount.folder / "mod0/xaxis", os.O_WRONLY | os.O_NONBLOCK)
        try:
            os.write(fd, b"velocity=0.2\n")
            wait_for(lambda: axis.read().commanded_velocity[0] == pytest.approx(0.2), "motion")
        finally:
            os.close(fd)


def test_a_mount_outlives_its_daemon(start_daemon: Callable[..., Daemon]) -> None:
    """What is open is lost, and says so; what is opened is of the daemon that is there; nothing waits for ever."""
    daemon = start_daemon()
    with Mount(daemon.socket) as mount:
        files, path = mount.folder, mount.folder / "mod0/xaxis"
        reader, writer = os.open(path, os.O_RDONLY), os.open(path, os.O_RDWR)
        assert os.pread(reader, 200, 0)
        moving = Waiting(lambda: os.pwrite(writer, b"0.9\n", 0))
        with daemon.cell() as cell, cell.open("mod0.xaxis.readonly") as seen:
            wait_for(lambda: seen.read().in_motion[0], "motion")
        os.kill(daemon.pid, signal.SIGKILL)
        assert moving.errno() == errno.EIO

        def is_lost(fd: int) -> bool:
            try:
                return not os.pread(fd, 200, 0)
            except OSError as error:
                assert error.errno == errno.EIO, error
                return True

        def lost() -> None:
            look = select.poll()
            for fd in (reader, writer):
                wait_for(lambda fd=fd: is_lost(fd), "its driver has braked, and ended")
                look.register(fd, select.POLLIN | select.POLLOUT)
            assert {events & select.POLLERR for _, events in look.poll(5000)} == {select.POLLERR}
            with raises(errno.EIO):
                os.pwrite(writer, b"0.1\n", 0)

        lost()
        for line in ("cat mod0/xaxis", "echo 0 > mod1/xaxis"):
            done = shell(line, files)
            assert done.returncode and "Connection refused" in done.stderr
        assert "the daemon" in log(files)
        with contextlib.ExitStack() as stack:
            again = Daemon(daemon.folder, WORKCELL)
            stack.callback(again.end)
            wait_for(lambda: shell("cat mod0/xaxis", files).returncode == 0, "the mount has found the daemon")
            assert not float(shell("cat mod0/xaxis", files).stdout.split()[1]), "nothing resumes"
            lost()
            os.close(reader)
            os.close(writer)
            done = shell("echo 0.01 > mod0/xaxis && cat mod0/xaxis", files)
            assert float(done.stdout.split()[2]) == pytest.approx(0.01, abs=1e-3), done
            assert again.pid != daemon.pid


def test_the_stop_asks_no_daemon(files: Path, daemon: Daemon, axis: sioms.AxisNode, cell: sioms.Workcell) -> None:
    writer = program(JOG, files / "mod0/xaxis")
    try:
        wait_for(lambda: axis.read().commanded_velocity[0] == pytest.approx(0.2), "motion")
        watch = Watch(axis)
        with daemon.frozen(daemon.pid):
            begin = time.monotonic_ns()
            done = shell("echo smoke > .stop", files)
            assert done.returncode == 0, done.stderr
            assert halting_ns(watch, begin) - begin < 10 * BUSY_NS
    finally:
        writer.kill()
        writer.wait()
    assert "smoke, by bash[" in cell.status()["stop_source"]
    wait_for(lambda: shell("echo 0 > mod0/xaxis", files).returncode, "a refusal")
    assert "smoke" in log(files)
    cell.reset()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may act for other users")
def test_everybody_has_the_rights_of_his_own(start_daemon: Callable[..., Daemon]) -> None:
    grants = '[[grant]]\nusers = ["nobody"]\nnodes = ["mod1*", "io0*"]\nrights = ["read", "write"]\n'
    text = WORKCELL.replace('name = "test"\n', 'name = "test"\nsocket_mode = "0666"\n') + grants
    daemon = start_daemon(text)
    for folder in (daemon.folder, daemon.folder.parent):
        folder.chmod(0o755)
    nobody = "setpriv --reuid nobody --regid nogroup --clear-groups "
    with Mount(daemon.socket, "--allow-other") as mounted, daemon.cell() as cell:
        listed = shell(f"{nobody} ls", mounted.folder)
        there = listed.stdout.split()
        assert "mod1.all" in there and "mod0.all" not in there and "mod0.all" in os.listdir(mounted.folder), (
            listed.stderr + log(mounted.folder)
        )
        done = shell(f"{nobody} bash -c 'echo 0.01 > mod1.all && cat mod1.all'", mounted.folder)
        assert done.returncode == 0 and "0.01" in done.stdout, done.stderr
        assert shell(f"{nobody} bash -c 'echo 0.01 > mod0.all'", mounted.folder).returncode
        assert shell(f"{nobody} bash -c 'echo 1 > .stop'", mounted.folder).returncode, "he may not stop"
        assert not cell.status()["stopped_ns"]
        assert shell("echo 9 > mod1.all", mounted.folder).returncode
        theirs = shell(f"{nobody} cat .log", mounted.folder).stdout
        assert "right" in theirs and "9 m" not in theirs and "9 m" in log(mounted.folder)
        held = program(JOG, mounted.folder / "mod0/xaxis")
        try:
            (holder,) = cell.status()["holders"]
            assert holder[0] == "mod0.xaxis" and "root" in holder[1]
        finally:
            held.kill()
            held.wait()
