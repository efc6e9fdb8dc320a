"""The pipe tools and the sioms command as processes, against a real daemon with simulated devices."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import Client, Daemon, daemons, wait_for
from shell_rig import BIN, CELL, Shell, environment, good, halted, refused

import sioms
from sioms.descriptors import is_readable

AXIS_LINE = r"[0-3] [01] -?\d\.\d{4}e[+-]\d\d -?\d\.\d{4}e[+-]\d\d -?\d\.\d\de[+-]\d\d"


@pytest.fixture(scope="module")
def shared_daemon() -> Iterator[Daemon]:
    with daemons() as start:
        yield start(CELL)


# --- the examples of section F.4 -----------------------------------------------------------------


def test_devin_of_a_module(shell: Shell) -> None:
    assert re.fullmatch(rf"({AXIS_LINE}\n){{4}}", good(shell("devin mod0")))


def test_devin_of_several_devices(shell: Shell) -> None:
    text = good(shell("devin mod0 gripper0 atod0"))
    assert re.fullmatch(rf"({AXIS_LINE}\n){{4}}0 0\n0 1\.00e\+00\n", text)


def test_devin_by_path_and_by_soft_link(shell: Shell) -> None:
    plain = good(shell("devin -p mod0"))
    assert good(shell("devin -p ~rws/dev/mod0")) == plain
    assert good(shell("ln -s ~rws/dev/mod0 m0; devin -p m0; rm m0")) == plain
    assert good(shell("ln -s ~rws/dev/mod0 m0; devin -p ./m0; rm m0")) == plain


def test_devin_of_single_values(shell: Shell) -> None:
    assert good(shell("devin -p atod0")) == "1.00e+00 "
    assert re.fullmatch(r"0 -?\d\.\d{4}e[+-]\d\d\n", good(shell("devin -n0pN mod0")))
    assert re.fullmatch(r"(-?\d\.\d{4}e[+-]\d\d ){3}", good(shell("devin -l1h3v mod0")))


def test_devin_timed(shell: Shell) -> None:
    assert good(shell("devin -t0.001 -n0 lord1")) == "1.00e+00 " * 100
    lines = good(shell("devin -t0.01 -L5 lord1 -N")).splitlines()
    assert [line.split()[2:4] for line in lines] == [["1.00e+00", "2.00e+00"]] * 5
    assert [float(line.split()[0]) for line in lines] == sorted(float(line.split()[0]) for line in lines)


def test_damper_in_a_pipe(shell: Shell, cell: sioms.Workcell) -> None:
    node = cell.open("mod0.readonly")
    before = node.read().position[0]
    good(shell("set -o pipefail; devin -t0.005 -n3 -L100 lord1 | devout -rv -L-1 -W mod0.xaxis"))
    # 0.1 N m make 0.1 m/s for 0.5 s, less by what devout takes to begin
    assert 0.005 < node.read().position[0] - before < 0.08
    halted(cell)


# --- filters -------------------------------------------------------------------------------------


def test_a_reader_that_has_enough_ends_devin(shell: Shell) -> None:
    result = shell("devin -t0.001 -L-1 -n0 lord1 | head -c 90; echo ${PIPESTATUS[0]}")
    assert good(result) == "1.00e+00 " * 10 + f"{128 + signal.SIGPIPE}\n"


def test_ctrl_c_ends_devin_without_a_word(daemon: Daemon) -> None:
    process = subprocess.Popen(
        [BIN / "devin", "-t0.001", "-L-1", "lord1"], env=environment(daemon.socket),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.read(10)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=5)
    assert (process.returncode, said) == (-signal.SIGINT, b"")


def test_each_sample_is_flushed(daemon: Daemon) -> None:
    process = subprocess.Popen(
        [BIN / "devin", "-t100", "-n0", "lord1"], env=environment(daemon.socket), stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert os.read(process.stdout.fileno(), 100) == b"1.00e+00 "
    process.kill()
    process.communicate()


def test_closed_and_full_standard_streams(shell: Shell) -> None:
    refused(shell("devin -p lord1 > /dev/full"), "write standard output: no space left")
    refused(shell("devin -p lord1 >&-"), "write standard output: bad file descriptor")
    refused(shell("devout gripper0 <&-"), "read standard input: bad file descriptor")
    assert shell("devin -p mod9 2>&-").returncode == 1


def test_a_drivers_death_ends_devin(daemon: Daemon, cell: sioms.Workcell) -> None:
    process = subprocess.Popen(
        [BIN / "devin", "-t0.01", "-L-1", "tactile0"], env=environment(daemon.socket),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.read(10)
    os.kill(daemon.device("tactile0")["pid"], signal.SIGKILL)
    _, said = process.communicate(timeout=10)
    assert process.returncode == 1
    assert said.startswith(b"devin: read tactile0: its driver is gone")
    daemon.wait_up("tactile0", generation=2)


# --- what is refused -----------------------------------------------------------------------------


def test_no_daemon(shell: Shell) -> None:
    for line in (
        "devin mod0",
        "devout mod0 1 2 3 4",
        "sdev -e",
        "smarkers -r",
        "sioms list",
        "sioms monitor",
    ):
        refused(shell(line, socket="/tmp/there-is-no-such.sock"), "no daemon listens there", "siomsd --config")


def test_unknown_node(shell: Shell) -> None:
    for line in ("devin mod9", "devout mod9 1", "sdev -w mod9", "sioms info mod9"):
        refused(shell(line), "mod9: no such node; did you mean mod")
    refused(shell("devout mod0.xaxis abc"), "abc: no such node", "nor is it a number")
    refused(shell("sdev -c mod0.xaxis 0.1 abc"), "abc: nothing to do", "nor is it a number", status=2)


def test_a_held_node_names_its_holder_and_can_be_read(
    shell: Shell, daemon: Daemon, client: Callable[..., Client]
) -> None:
    holder = client(daemon, "node = cell.open('mod0', 'rw'); say('ready'); hold()")
    refused(shell("devout mod0.xaxis 0.1"), f"held by pid {holder.pid}", "victim", "mod0.xaxis.readonly")
    assert re.fullmatch(rf"({AXIS_LINE}\n){{4}}", good(shell("devin mod0")))
    good(shell("sdev -w mod0"))
    refused(shell("sdev -z mod0"), f"held by pid {holder.pid}")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("devin", "no device given"),
        ("devin -h mod0", "for help use --help"),
        ("devin mod0 -v", "applies to the device that follows it"),
        ("devin -n4 mod0", "structure 4; want 0 to 3"),
        ("devout -v gripper0 1", "class binary"),
        ("devout -rvw mod0.xaxis 1", "add -t"),
        ("sdev mod0", "nothing to do"),
        ("sdev -z", "no device given"),
        ("sdev -c 1 2 3 4 5 mod0", "1 number too many"),
        ("sdev -g mod0", "class analog"),
        ("smarkers 5", "want -r alone"),
        ("smarkers -w foo", "want a marker"),
        ("smarkers -s", "no marker given"),
    ],
)
def test_wrong_command_lines(shell: Shell, line: str, words: str) -> None:
    refused(shell(line), words, status=2)


def test_values_that_a_device_cannot_take(shell: Shell) -> None:
    refused(shell("devout mod0.xaxis 5"), "position 5 m", "-1 to 1 m")
    refused(shell("devout gripper0 256"), "data 256; want 0 to 255")
    refused(shell("devout gripper0 1.5"), "integer")
    refused(shell("devout -t mod0.xaxis 0 0"), "time 0 s")
    refused(shell("devout -t mod0.xaxis", ""), "want 2 numbers for an iteration")
    refused(shell("devout mod0.xaxis", ""), "want 1 number for an iteration")
    refused(shell("sdev -c mod0", "1 2"), "want 4 numbers: there are 2")
    refused(shell("devout lord1 1"), "read-only node")


# --- sdev and smarkers ---------------------------------------------------------------------------


def test_sdev_calibrates_and_zeroes(shell: Shell, cell: sioms.Workcell) -> None:
    good(shell("sdev -c 0.1 0.2 -0.3 0.4 mod0"))
    assert good(shell("devin -p mod0")).split() == ["1.0000e-01", "2.0000e-01", "-3.0000e-01", "4.0000e-01"]
    good(shell("sdev -c mod0.xaxis -z mod0.yaxis", "0.5\n"))
    assert good(shell("devin -p -h1 mod0")).split() == ["5.0000e-01", "0.0000e+00"]
    good(shell("sdev -z mod0"))


def test_sdev_zeroes_a_sensor_and_sets_gains(shell: Shell) -> None:
    good(shell("sdev -z lord1"))
    assert good(shell("devin -n0p lord1")) == "0.00e+00 "
    good(shell("sdev -g tactile0", " ".join(["2 " + "0 " * 16] * 15) + " 2"))
    refused(shell("sdev -g tactile0", "1 2 3"), "want 256 numbers: there are 3")


def test_sdev_stops_the_workcell_and_writes_stay_refused_until_reset(shell: Shell, cell: sioms.Workcell) -> None:
    node = cell.open("mod0.xaxis", "rw")
    node.command(velocity=0.1)
    good(shell("sdev -e"))
    halted(cell)
    node.close()
    refused(shell("devout mod0.xaxis 0"), "emergency stop")
    assert "EMERGENCY STOP" in good(shell("sioms status"))
    good(shell("sioms reset"))
    good(shell("devout -v -W mod0.xaxis 0"))


def test_sdev_stops_one_node_that_somebody_else_holds(shell: Shell, cell: sioms.Workcell) -> None:
    held, other = cell.open("mod0.xaxis", "rw"), cell.open("mod1", "rw")
    held.command(velocity=0.05)
    other.command(velocity=0.05)
    good(shell("sdev -e mod0.xaxis"))
    wait_for(lambda: not held.read().in_motion[0], "the stop")
    assert other.read().in_motion[0]
    good(shell("sioms reset mod0.xaxis"))
    held.close()
    other.close()


def test_sdev_synchronises_two_devices(shell: Shell, cell: sioms.Workcell) -> None:
    nodes = [cell.open("mod0.xaxis", "rw"), cell.open("mod1", "rw")]
    for node in nodes:
        node.command(velocity=0.1, time=0.3, synch=True)
    before = [node.read().number for node in nodes]
    good(shell("sdev -s mod0.xaxis -s mod1"))
    starts = []
    for node, after in zip(nodes, before, strict=True):
        moved = wait_for(lambda n=node, a=after: [s for s in n.history(a) if s.in_motion[0]], "the start")
        starts.append(moved[0].stamp_ns)
    assert abs(starts[0] - starts[1]) < 20e6  # one instant; the ticks of two processes may be late on a busy machine
    good(shell("sdev -w mod0.xaxis -w mod1"))
    for node in nodes:
        assert not node.read().in_motion[0]
        node.close()


def test_markers_by_shell(shell: Shell) -> None:
    assert (
        good(shell("M=$(smarkers -r); (sleep 0.1; smarkers -s $M) & smarkers -w $((M % 1024)) && smarkers -f $M")) == ""
    )
    tokens = good(shell("smarkers -r 3")).split()
    assert len(set(tokens)) == 3
    good(shell(f"smarkers -sf {' '.join(tokens)}"))
    refused(shell(f"smarkers -w {tokens[0]}"), "not reserved")


def test_an_axis_signals_a_marker_of_the_shell(shell: Shell) -> None:
    good(
        shell(
            "M=$(smarkers -r); devout -ps -W mod0.taxis 0.01 $M; devout -ps mod0.taxis 0 $M; smarkers -w $M; smarkers "
            "-f $M"
        )
    )


# --- sioms ---------------------------------------------------------------------------------------


def test_sioms_tells_about_the_workcell(shell: Shell) -> None:
    listed = good(shell("sioms list"))
    assert re.search(r"^mod0 +axis +4 +read, write +mod0 +up$", listed, re.M)
    assert "mod0.xaxis" not in listed
    assert "mod0.xaxis.readonly" in good(shell("sioms list -v"))
    assert re.search(r"xaxis +m +-1 +1 +velocity 1", good(shell("sioms info mod0")))
    assert re.search(r"^mod0 +sim-axes +up +good", good(shell("sioms status")), re.M)
    assert re.search(r"^sim-axes +sioms.drivers.sim.axes +\S", good(shell("sioms driver list")), re.M)
    assert good(shell("sioms list | head -1")).startswith("node")
    assert "gripper0.bit3" in good(shell("sioms list --names")).split()


def test_sioms_checks_a_configuration(shell: Shell, daemon: Daemon, tmp_path: Path) -> None:
    text = good(shell(f"sioms check {daemon.config}"))
    assert "ok" in text and re.search(r"its drivers need about 0\.\d\d of \d+ processors?: ", text)
    (tmp_path / "bad.toml").write_text('[device.mod0]\ndriver = "sim-axis"\n[device.b]\ndriver = "sim-io"\n')
    result = shell("sioms check bad.toml")
    assert result.returncode == 2
    assert "did you mean sim-axes" in result.stderr
    assert "[device.b]" in result.stderr
    much = "".join(
        f'[device.d{i}]\ndriver = "sim-tactile"\ntick_hz = 20000\n' for i in range(2 * (os.cpu_count() or 1))
    )
    (tmp_path / "much.toml").write_text(f'[workcell]\nname = "much"\n{much}')
    result = shell("sioms check much.toml")
    assert result.returncode == 0 and "warning: device d0 needs about 1." in result.stderr
    assert re.search(r"warning: these devices need about \d+\.\d\d of \d+ processors?: d0 1\.", result.stderr)


def test_sioms_reloads(shell: Shell) -> None:
    good(shell("sioms reload"))


def test_an_unknown_command(shell: Shell) -> None:
    result = shell("sioms lst")
    assert result.returncode == 2
    assert "no command lst; did you mean list?" in result.stderr


def test_monitor_prints_one_picture_into_a_pipe(shell: Shell) -> None:
    text = good(shell("sioms monitor"))
    assert "workcell tools" in text
    assert "\x1b" not in text
    assert re.search(r"yaxis .* m .* idle", text)


class MonitorTerminal:
    """``sioms monitor`` in a terminal."""

    def __init__(self, socket: str) -> None:
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            os.execve(BIN / "sioms", ["sioms", "monitor"], {**environment(socket), "TERM": "xterm", "LINES": "40"})
        self.seen = bytearray()

    def shows(self, text: bytes) -> None:
        deadline = time.monotonic() + 15
        while text not in self.seen:
            assert time.monotonic() < deadline, f"{text!r} not shown in {bytes(self.seen[-3000:])!r}"
            self.look()

    def look(self) -> None:
        if is_readable(self.terminal, 0.1):
            self.seen.extend(os.read(self.terminal, 65536))

    def press(self, keys: bytes) -> None:
        os.write(self.terminal, keys)

    def end(self) -> int:
        os.write(self.terminal, b"q")
        self.seen.clear()
        self.shows(b"\x1b[?1049l")
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


@pytest.fixture
def monitor(daemon: Daemon) -> Iterator[MonitorTerminal]:
    one = MonitorTerminal(daemon.socket)
    try:
        yield one
    finally:
        os.close(one.terminal)


def test_monitor_in_a_terminal_stops_and_resets_by_key(
    monitor: MonitorTerminal, cell: sioms.Workcell, daemon: Daemon
) -> None:
    monitor.shows(b"mod0")
    monitor.shows(b"taxis")
    with daemon.frozen(daemon.device("mod0")["pid"]):  # what cannot be read any more is told as old, never as live
        monitor.shows(b"LAST SEEN")
    monitor.press(b" ")
    wait_for(lambda: cell.status()["stopped_ns"], "the stop")
    monitor.shows(b"EMERGENCY STOP for")
    monitor.press(b"R")
    monitor.shows(b"Motion may be commanded again")
    monitor.press(b"n")
    monitor.shows(b"reset left alone")
    assert cell.status()["stopped_ns"]
    monitor.press(b"R")
    monitor.seen.clear()
    monitor.shows(b"Motion may be commanded again")
    monitor.press(b"y")
    wait_for(lambda: not cell.status()["stopped_ns"], "the reset")
    assert monitor.end() == 0


def test_monitor_jogs_while_a_key_repeats_and_no_longer(monitor: MonitorTerminal, cell: sioms.Workcell) -> None:
    monitor.shows(b"mod0")
    monitor.press(b"\t")
    monitor.shows(b"chosen: mod0 xaxis")
    with cell.open("mod0.xaxis.readonly") as axis:
        start = axis.read().position[0]
        monitor.press(b"\x1b[C")
        monitor.shows(b"take the axis first")
        assert not axis.read().in_motion[0]
        monitor.press(b"c")
        monitor.shows(b"JOG mod0 xaxis")
        for _ in range(6):
            monitor.press(b"\x1b[C")
            monitor.look()
            time.sleep(0.05)
        wait_for(lambda: axis.read().position[0] > start + 0.01, "a jog")
        wait_for(lambda: not axis.read().in_motion[0], "the end of a jog whose key is up", 3.0)
        place = axis.read().position[0]
        monitor.press(b"<")
        wait_for(lambda: axis.read().position[0] < place - 0.001, "a step back")
        wait_for(lambda: not axis.read().in_motion[0], "its end")
        monitor.press(b"\x1b[C")
        wait_for(lambda: axis.read().in_motion[0], "a jog")
        os.kill(monitor.pid, signal.SIGSTOP)  # Ctrl-Z, or a hung terminal
        wait_for(lambda: not axis.read().in_motion[0], "the lease of a monitor that is stopped", 1.0)
        os.kill(monitor.pid, signal.SIGCONT)
        monitor.shows(b"taken away")
    assert monitor.end() == 0


# --- manners -------------------------------------------------------------------------------------


def test_waits_of_sdev_and_smarkers_end(shell: Shell, cell: sioms.Workcell) -> None:
    token = good(shell("smarkers -r")).strip()
    began = time.monotonic()
    refused(shell(f"smarkers -w -t0.2 {token}"), "wait for marker", "not within 0.2 s")
    with cell.open("mod0.xaxis", "rw") as axis:
        axis.command(velocity=0.01)
        refused(shell("sdev -w -t0.2 mod0.xaxis"), "not within")
    assert time.monotonic() - began < 20.0
    refused(shell(f"smarkers -s -t1 {token}"), "-t needs -w", status=2)
    good(shell(f"smarkers -f {token}"))
    halted(cell)


def test_usage_of_the_command_that_was_meant_and_closed_output(shell: Shell) -> None:
    assert "usage: sioms list" in shell("sioms list --nonsense").stderr
    assert "usage: sioms reconcile axis" in shell("sioms reconcile axis --nonsense x").stderr
    refused(shell("sioms info mod0 >&-"), "sioms info: write standard output: bad file descriptor")
    refused(shell("sioms monitor nosuch"), "no such node: nosuch")


def test_who_stopped_a_node_and_what_resets_it(shell: Shell, daemon: Daemon) -> None:
    good(shell("sioms stop mod0.xaxis"))
    for command in ("sioms list", "sioms info mod0", "sioms status"):
        text = good(shell(command))
        assert "mod0.xaxis: emergency stop by pid" in text and "`sioms reset mod0.xaxis` clears it" in text
    assert "emergency stop" not in good(shell("sioms info mod1"))
    good(shell("sioms reset mod0.xaxis"))
    assert "emergency stop" not in good(shell("sioms list"))
    daemon.said("event=reset node=mod0.xaxis by=")


def test_a_recording_has_names_units_and_the_stamps_of_the_readings(shell: Shell) -> None:
    lines = good(shell("devin --record -L50 mod0.xaxis")).splitlines()
    assert lines[0].split("\t") == ["time [s]", "position [m]", "velocity [m/s]", "force [N]", "command [m]"]
    stamps = [round(float(line.split("\t")[0]) * 1e9) for line in lines[1:]]
    assert len(set(stamps)) == 50 and stamps == sorted(stamps)
    off = [(stamp - stamps[0] + 500_000) % 1_000_000 - 500_000 for stamp in stamps]
    assert max(map(abs, off)) < 1000, "the driver's schedule, not the time when somebody looked"
    assert good(shell("devin --record -L1 lord1")).startswith("time [s]\tfx [N]\t")
    refused(shell("devin --record mod0 mod1"), "takes one device", status=2)


def test_a_time_out_that_is_no_number_costs_the_caller_and_not_the_node(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        for wrong in ("1", float("nan"), [1]):
            with pytest.raises((TypeError, ValueError), match="want seconds as a number"):
                axis.wait_until_idle(timeout=wrong)  # type: ignore[arg-type]
        axis.wait_until_idle(timeout=1)


@pytest.mark.parametrize("no_color", ["", "1"])
def test_a_stopped_monitor_gives_the_terminal_back(shell: Shell, no_color: str) -> None:
    socket = shell("echo $SIOMS_SOCKET").stdout.strip()
    pid, terminal = pty.fork()
    if pid == 0:
        os.execvpe("sioms", ["sioms", "monitor"], {**environment(socket), "TERM": "xterm", "NO_COLOR": no_color})
    seen = b""

    def read(until: bytes) -> None:
        nonlocal seen
        deadline = time.monotonic() + 30.0
        while until not in seen:
            assert time.monotonic() < deadline, seen[-300:]
            if is_readable(terminal, 0.1):
                seen += os.read(terminal, 65536)

    try:
        read(b"\x1b[?1049h")
        read(b"mod0")
        assert (b"\x1b[32m" in seen or b"\x1b[33m" in seen) <= (not no_color)
        seen = b""
        os.write(terminal, b"\x1a")
        read(b"\x1b[?1049l")
        # The kernel stops no process without a shell above it, as here: the monitor goes on at once.
        read(b"\x1b[?1049h")
        seen = b""
        read(b"mod0")
        os.write(terminal, b"q")
        read(b"\x1b[?1049l")
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(terminal)
