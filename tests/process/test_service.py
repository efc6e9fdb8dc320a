"""The daemon as a service: configuration errors, reload, sd_notify and watchdog, sockets, its end."""

from __future__ import annotations

import errno
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import FORCE, IO, WORKCELL, Daemon, axes, raises, wait_for

BAD = """
[workcell]
max_session = 3
[workcel]
name = "x"
[device.mod0]
driver = "sim-axis"
[device.mod1]
driver = "sim-axes"
tick_hx = 500.0
[[device.mod1.axis]]
name = "x"
velocity_max = -1.0
motor = { mass = 1.0 }
[device.mod2]
driver = "sim-axes"
[[device.mod2.axis]]
name = "x"
motor = { mas = 1.0 }
[device.io0]
driver = "sim-io"
[device.scale0]
driver = "ascii-stream"
line = { serial = "/dev/ttyNONE7" }
columns = ["a"]
rate_hz = 100.0
[device.scale1]
driver = "ascii-stream"
line = { serial = "/dev/../dev/ttyNONE7" }
columns = ["a"]
rate_hz = 100.0
[device."5x"]
driver = "sim-io"
[[grant]]
rights = ["reed"]
[[emergency_stop]]
nod = "io0"
"""


def check(path: Path, text: str) -> tuple[int, list[str]]:
    """Run siomsd --check; return its status and what it said on stderr, without the path."""
    path.write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "sioms.daemon.main", "--config", path, "--check"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    lines = (done.stderr or done.stdout).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines), done.stderr
    return done.returncode, [line.removeprefix(f"{path}: ") for line in lines]


def test_all_errors_of_all_devices_come_at_once(tmp_path: Path) -> None:
    status, said = check(tmp_path / "bad.toml", BAD)
    assert status == 2
    for pattern in (
        r"^\[workcell\]: unknown key max_session; did you mean max_sessions\?",
        r"^\[workcel\]: unknown section; did you mean workcell\?",
        r"^\[device.mod0\]: driver = sim-axis: no such driver; did you mean sim-axes\?",
        r"^\[device.mod1\]: unknown key tick_hx; did you mean tick_hz\?",
        r"^\[device.mod2\].*unknown key mas; did you mean mass\?",
        r"^\[device.io0\]: outputs and inputs are both 0",
        r"^\[device.scale1\]: serial port /dev/ttyNONE7 is already used by device scale0; want another",
        r"^\[device.5x\]: not a device name; want letters",
        r"^\[\[grant\]\] number 1.*reed",
        r"^\[\[emergency_stop\]\] number 1: unknown key nod",
    ):
        assert any(re.search(pattern, re.sub(r"^line \d+: ", "", line)) for line in said), (pattern, said)
    assert any("velocity_max" in line for line in said), said


def test_errors_of_names_come_at_once(tmp_path: Path) -> None:
    text = WORKCELL + (
        '[node.gripper]\nof = "io"\n[node.xy]\nof = "mod0"\nchannels = ["xaxis", "zaxis"]\n'
        '[node."mod0.xaxis"]\nof = "mod1"\n[[emergency_stop]]\nnode = "force0"\n'
        '[[device.force0.contact]]\nnode = "mod9.plant"\ndirection = [0, 0, 1]\n'
    )
    status, said = check(tmp_path / "bad.toml", text)
    assert status == 2
    for pattern in (
        r"^\[node.gripper\]: of = io, which does not exist",
        r"^\[node.xy\]: mod0 has no channel zaxis; did you mean (x|y)axis\?",
        r"^\[node.mod0.xaxis\]: node name mod0.xaxis is already taken by device mod0",
        r"^\[\[emergency_stop\]\] number 1: node = force0; want the name of one binary input",
        r"^\[device.force0\]: reads node mod9.plant, which does not exist",
    ):
        assert any(re.search(pattern, re.sub(r"^line \d+: ", "", line)) for line in said), (pattern, said)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grant = 3\n" + IO, "grant"),
        (IO + 'user = "nobody-of-that-name"', "user"),
        (
            axes("m", "x").replace("-1.0", "0.0").replace("_max = 1.0", "_max = 0.0"),
            "position_min 0 is not below",
        ),
        (axes("m", "x").replace("acceleration_max = 10.0", "acceleration_max = nan"), "acceleration_max"),
    ],
)
def test_odd_configurations_are_refused_in_a_sentence(tmp_path: Path, text: str, words: str) -> None:
    status, said = check(tmp_path / "odd.toml", text)
    assert status == 2 and any(words in line for line in said), said
    assert not any("Traceback" in line for line in said)


def test_a_daemon_with_a_bad_configuration_ends_with_all_errors(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(BAD, ready=False)
    assert daemon.running.wait_exit(30.0) == 2
    assert sum("level=error event=configuration" in line for line in daemon.running.lines) >= 9
    assert not os.path.exists(daemon.socket)


def test_a_missing_configuration_is_said(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sioms.daemon.main", "--config", tmp_path / "none.toml", "--socket", tmp_path / "s"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2 and "no such file or directory" in done.stderr and "Traceback" not in done.stderr


def pids(daemon: Daemon) -> dict[str, int]:
    with daemon.cell() as cell:
        return {d["name"]: d["pid"] for d in cell.status()["devices"]}


def test_reload_takes_up_changes_and_touches_nothing_else(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL)
    before = pids(daemon)
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis, cell.open("io0.in") as inputs:
        axis.command(velocity=0.05)
        wait_for(lambda: axis.read().in_motion[0], "moving")
        number, seen = axis.read().number, inputs.read().number
        # force0 removed, mod1 changed, mod2 and a name added
        changed = axes("mod1", "xaxis").replace("velocity_max = 1.0", "velocity_max = 0.5")
        added = axes("mod2", "zaxis") + '[node.lift]\nof = "mod2"\n'
        daemon.configure('[workcell]\nname = "test"\n' + axes("mod0", "xaxis", "yaxis") + changed + IO + added)
        cell.reload()
        for name in ("mod1", "mod2"):
            daemon.wait_up(name)
        after = pids(daemon)
        assert after.keys() == {"mod0", "mod1", "io0", "mod2"}
        assert (after["mod0"], after["io0"]) == (before["mod0"], before["io0"])
        assert after["mod1"] != before["mod1"]
        reading = axis.read()
        assert reading.in_motion[0] and reading.velocity[0] == pytest.approx(0.05, abs=0.02)
        numbers = [s.number for s in axis.history(number)]
        assert numbers == list(range(numbers[0], numbers[-1] + 1)), "no publication was lost"
        assert inputs.read().number > seen
        with raises(errno.ENOENT, "force0"):
            cell.open("force0")
        with cell.open("lift", "rw") as lift:
            lift.move(0.01)
            lift.wait_until_idle(5.0)
        assert cell.info("mod1").channels[0].limits["velocity"] == 0.5
        assert axis.read().in_motion[0]
        axis.stop()
    assert wait_for(lambda: not os.path.exists(f"/proc/{before['force0']}"), "the removed driver ended")


def test_reload_with_errors_keeps_everything(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL)
    before = pids(daemon)
    with daemon.cell() as cell, cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.05)
        daemon.configure(WORKCELL.replace("velocity_max", "velocity_maxi") + "[nodes]\n")
        with raises(errno.EINVAL, "nothing taken up", "velocity_maxi", "[nodes]: unknown section", "device.mod1"):
            cell.reload()
        daemon.config.unlink()
        with raises(errno.EINVAL, "nothing taken up", "no such file"):
            cell.reload()
        assert pids(daemon) == before
        assert axis.read().in_motion[0]
        axis.stop()
        daemon.configure(WORKCELL)
        cell.reload()
        assert pids(daemon) == before


def test_sighup_reloads(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon('[device.io0]\ndriver = "sim-io"\ninputs = 1\n')
    daemon.configure('[device.io0]\ndriver = "sim-io"\ninputs = 1\n[device.io1]\ndriver = "sim-io"\ninputs = 2\n')
    daemon.running.signal(signal.SIGHUP)
    daemon.said("event=reload errors=0")
    daemon.wait_up("io1")
    assert 'event="does not fit"' not in "\n".join(daemon.running.lines)
    daemon.configure(
        '[device.io0]\ndriver = "sim-io"\ninputs = 1\n[device.io1]\ndriver = "sim-tactile"\ntick_hz = 20000\n'
    )
    daemon.running.signal(signal.SIGHUP)
    daemon.said('event="does not fit" why="device io1 needs about 1.')
    daemon.configure("[device.io0]\n")
    daemon.running.signal(signal.SIGHUP)
    daemon.said("event=reload errors=1")
    wait_for(lambda: pids(daemon).keys() == {"io0", "io1"}, "the new io1 in the place of the old, which ends first")


def test_holders_of_a_changed_device_are_told(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(WORKCELL)
    with daemon.cell() as cell:
        node = cell.open("force0")
        daemon.configure(WORKCELL.replace("1.0, 2.0, 3.0", "4.0, 5.0, 6.0"))
        cell.reload()
        with raises(errno.EIO, "force0"):
            wait_for(lambda: node.read() and False, "refused")
        node.close()
        daemon.wait_up("force0")
        with cell.open("force0") as node:
            assert node.read().data[0] == pytest.approx(4.0)


@pytest.fixture
def manager(short_folder: Path) -> Iterator[tuple[socket.socket, str]]:
    """The socket of a service manager."""
    path = str(short_folder / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(path)
        sock.settimeout(20.0)
        yield sock, path


def _until(sock: socket.socket, wanted: str) -> list[str]:
    heard: list[str] = []
    while not any(wanted in state for state in heard):
        heard.append(sock.recv(4096).decode())
    return heard


@pytest.mark.parametrize("abstract", [False, True])
def test_the_service_manager_is_told(
    start_daemon: Callable[..., Daemon], manager: tuple[socket.socket, str], abstract: bool
) -> None:
    sock, path = manager
    if abstract:
        path = f"@sioms-test-{os.getpid()}"
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        sock.bind("\0" + path[1:])
        sock.settimeout(20.0)
    daemon = start_daemon(IO, {"NOTIFY_SOCKET": path})
    assert _until(sock, "READY=1") == ["READY=1"]
    with daemon.cell() as cell:
        cell.reload()
    assert re.match(r"RELOADING=1\nMONOTONIC_USEC=\d+", _until(sock, "READY=1")[0])
    daemon.running.signal(signal.SIGTERM)
    _until(sock, "STOPPING=1")
    assert daemon.running.wait_exit() == 0
    if abstract:
        sock.close()


def test_the_watchdog_is_fed_by_the_loop_alone(
    start_daemon: Callable[..., Daemon], manager: tuple[socket.socket, str]
) -> None:
    sock, path = manager
    daemon = start_daemon(IO, {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "200000"})
    began = time.monotonic()
    for _ in range(6):
        _until(sock, "WATCHDOG=1")
    assert time.monotonic() - began < 5.0
    with daemon.frozen(daemon.pid):
        sock.settimeout(0.5)
        with pytest.raises(TimeoutError):
            while True:
                sock.recv(4096)  # what it sent before
    sock.settimeout(20.0)
    _until(sock, "WATCHDOG=1")


def test_a_watchdog_for_another_process_is_left_alone(
    start_daemon: Callable[..., Daemon], manager: tuple[socket.socket, str]
) -> None:
    sock, path = manager
    start_daemon(IO, {"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "100000", "WATCHDOG_PID": "1"})
    heard = _until(sock, "READY=1")
    sock.settimeout(0.4)
    with pytest.raises(TimeoutError):
        heard.append(sock.recv(4096).decode())
    assert not any("WATCHDOG" in state for state in heard)


def test_a_second_daemon_on_one_socket_is_refused(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(IO)
    second = subprocess.run(
        [sys.executable, "-m", "sioms.daemon.main", "--config", daemon.config, "--socket", daemon.socket],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert second.returncode == 1
    assert (
        second.stderr
        == f"siomsd: listen: another daemon (pid {daemon.pid}) serves {daemon.socket}; stop it or choose another path\n"
    )
    daemon.cell().close()


def test_a_stale_socket_is_taken_over_and_a_file_is_not(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(IO)
    os.kill(daemon.pid, signal.SIGKILL)
    daemon.running.wait_exit()
    assert os.path.exists(daemon.socket)
    with raises(errno.ECONNREFUSED, "siomsd --config FILE"):
        daemon.cell()
    again = Daemon(daemon.folder, IO)
    again.cell().close()
    assert again.terminate() == 0
    again.end()
    with raises(errno.ENOENT, "SIOMS_SOCKET"):
        again.cell()
    Path(daemon.socket).write_text("mine")
    third = subprocess.run(
        [sys.executable, "-m", "sioms.daemon.main", "--config", daemon.config, "--socket", daemon.socket],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert third.returncode == 1 and "is not a socket" in third.stderr
    assert Path(daemon.socket).read_text() == "mine"


def test_a_driver_that_fails_to_start_does_not_hold_up_the_others(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    driver = tmp_path / "broken.py"
    driver.write_text(
        "from sioms.drivers.sim.io import SimIo\n"
        "class Broken(SimIo):\n"
        "    def tick(self, now_ns):\n"
        "        raise RuntimeError('bad day')\n"
        "DRIVER = Broken\n"
    )
    daemon = start_daemon(IO + f'[device.bad]\ndriver = "{driver}"\ninputs = 1\n')
    daemon.said("driver failed: RuntimeError\\('bad day'\\)")
    with daemon.cell() as cell:
        cell.open("io0", "rw").close()
        with raises(errno.EIO, "bad"):
            cell.open("bad").read()
    wait_for(lambda: daemon.device("bad")["state"] == "fault", "fault")
    wait_for(lambda: daemon.device("io0")["state"] == "up", "the other is up")


def test_a_driver_file_is_found_beside_the_configuration_and_its_faults_are_said(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from sioms.drivers.sim.io import SimIo\nDRIVER = SimIo\n")
    (tmp_path / "syntax.py").write_text("def\n")
    (tmp_path / "none.py").write_text("X = 1\n")
    head = '\n[device.{0}]\ndriver = "./{0}.py"\ninputs = 1\n'
    status, said = check(tmp_path / "cell.toml", head.format("mine"))
    assert status == 0, said
    status, said = check(tmp_path / "cell.toml", "".join(head.format(n) for n in ("mine", "syntax", "none", "gone")))
    assert status == 2 and len(said) == 3
    assert "SyntaxError" in said[0] and "defines no DRIVER" in said[1] and "no such file" in said[2]


def test_an_open_that_comes_before_its_device_is_up_waits_for_it(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(ready=False)
    wait_for(lambda: os.path.exists(daemon.socket), "the socket")
    with daemon.cell() as cell, cell.open("force0") as node:
        assert len(node.read().data) == 6


def test_a_daemon_told_to_end_while_it_starts_ends_without_a_traceback(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(ready=False)
    wait_for(lambda: os.path.exists(daemon.socket), "the socket")
    daemon.running.signal(signal.SIGINT)
    assert daemon.running.wait_exit() in (0, -signal.SIGINT)  # the latter before it listens to signals
    assert "Traceback" not in "".join(daemon.running.lines)


def test_force_is_still_there(start_daemon: Callable[..., Daemon]) -> None:
    """A workcell of one sensor alone: nothing else is needed."""
    daemon = start_daemon(FORCE)
    with daemon.cell() as cell, cell.open("force0") as node:
        assert node.read().data == pytest.approx((1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
