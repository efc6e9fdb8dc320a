"""The compiled devin says what the tool in Python says, on both outputs and by its status."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from daemon_rig import FORCE, Daemon, axes, daemons, wait_for

from sioms.native.language import LIBRARY
from sioms.protocol.flags import PageState
from sioms.protocol.page import HEADER_FIELDS, MAGIC, REASON_OFFSET

TOOL = Path(sys.prefix) / "bin" / "devin"
PROGRAM = LIBRARY.with_name("_devin")
CELL = (
    '[workcell]\nname = "tools"\n'
    + axes("mod0", "xaxis", "yaxis", "zaxis")
    + FORCE.replace("force0", "lord1")
    + '\n[device.gripper0]\ndriver = "sim-io"\noutputs = 8\nsafe = 0xa5\n'
    + '\n[node.atod0]\nof = "lord1"\nchannels = ["fz", "fx"]\n'
)
BLIND = (
    '[workcell]\nname = "blind"\n[device.gone0]\ndriver = "ascii-stream"\nline = { serial = "/dev/nothing" }\n'
    'columns = ["load"]\nrate_hz = 50.0\nunit = "N"\n'
    + FORCE.replace("force0", "blind0")
    + '\n[[device.blind0.contact]]\nnode = "gone0.load"\ndirection = [0, 0, 1]\n'
)
"""A sensor whose readings are INVALID: what it feels is not there."""
LINES = """
mod0|-p mod0|-v mod0.readonly|-N mod0|-pvfm mod0 atod0|-l1h2p mod0|-l1h2N mod0 -N gripper0 -n1 atod0|-n2pN mod0.xaxis
gripper0|gripper0.bit0 gripper0.bit2|-p gripper0|-v gripper0|-f lord1|-n1e mod0|-n0 mod0.xaxis
-t0.001 -L3 mod0|-r -t0.001 -L2 -p lord1|-L1|-L0 mod0|-t1e-3 -L2 -N mod0 lord1|-N -t0.002 -L2 -v atod0
-L2 -t.001 mod0 -N
-rp -L1 -n0v mod0|-t0.001 -L2 -V mod0|-l0 -l2 mod0|-L2.0 -t0.001 mod0|-L+2 -t0.001 mod0
-V mod0|--digits=7 mod0|--count=2 --period=0.001 mod0|--help|--version|nothing|mod0 nothing|./mod0|-- mod0
-n3 mod0|-l2h1 mod0|-n1h2 mod0|-q mod0|-t0 mod0|-L1.5 mod0|-t1e9 mod0|-t mod0
-t1.2.3 mod0|-L-2 mod0|-L-0 mod0|-n1.5 mod0
3 mod0|mod0 3|mod0 -p|mod0 -N|-|é mod0|x123456789012345678901234567890123456789012345678901234567890
"""


@pytest.fixture(scope="module")
def shared_daemon() -> Iterator[Daemon]:
    if not PROGRAM.exists():
        pytest.skip("nothing is compiled here: ./dev setup says why")
    with daemons() as start:
        yield start(CELL)


def environment(daemon: Daemon, compiled: bool) -> dict[str, str]:
    return {**os.environ, "SIOMS_SOCKET": daemon.socket, "SIOMS_UNCOMPILED": "" if compiled else "1"}


Both = Callable[..., list["subprocess.CompletedProcess[bytes]"]]


@pytest.fixture
def both(daemon: Daemon) -> Both:
    """Run a line compiled and in Python; the times of samples are left out."""

    def run(words: list[str], **how: object) -> list[subprocess.CompletedProcess[bytes]]:
        found = []
        for compiled in (True, False):
            done = subprocess.run([TOOL, *words], stderr=-1, env=environment(daemon, compiled), timeout=30, **how)  # type: ignore[call-overload]
            done.stdout = re.sub(rb"(?m)^0\.\d{6} \d+", b"TIME NUMBER", done.stdout or b"")
            found.append(done)
        return found

    return run


@pytest.mark.parametrize("line", LINES.strip().replace("\n", "|").split("|"))
def test_a_line_gives_the_same_either_way(both: Both, line: str) -> None:
    compiled, python = both(line.split(), stdout=subprocess.PIPE)
    assert (compiled.returncode, compiled.stderr, compiled.stdout) == (python.returncode, python.stderr, python.stdout)


@pytest.mark.parametrize("line", ["mod0", "-t0.001 -L-1 mod0"])
def test_nowhere_to_write(both: Both, line: str) -> None:
    with open("/dev/full", "wb") as full:
        compiled, python = both(line.split(), stdout=full)
    assert compiled.returncode == 1 and compiled.stderr == b"devin: write standard output: no space left on device\n"
    assert (compiled.returncode, compiled.stderr) == (python.returncode, python.stderr)


def start(daemon: Daemon, compiled: bool) -> subprocess.Popen[bytes]:
    """Start an endless devin, and return it when its first row has come."""
    words = [TOOL, "-t0.01", "-L-1", "lord1"]
    process = subprocess.Popen(words, env=environment(daemon, compiled), stdout=-1, stderr=-1)
    assert process.stdout is not None and process.stdout.read(5) == b"1.00e"
    assert (os.path.realpath(f"/proc/{process.pid}/exe") == str(PROGRAM)) == compiled
    assert Path(f"/proc/{process.pid}/comm").read_text() == ("devin\n" if compiled else "python3\n")
    return process


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_without_a_word(daemon: Daemon, how: signal.Signals) -> None:
    process = start(daemon, True)
    process.send_signal(how)
    assert process.communicate(timeout=5)[1] == b"" and process.returncode == -how


def test_a_device_that_is_lost_meanwhile_ends_both_with_one_sentence(daemon: Daemon) -> None:
    running = [start(daemon, True), start(daemon, False)]
    pid = daemon.device("lord1")["pid"]
    os.kill(pid, signal.SIGKILL)
    said = [process.communicate(timeout=5)[1].decode() for process in running]
    assert [process.returncode for process in running] == [1, 1]
    assert said[0].startswith("devin: read lord1: ") and said[0] == said[1]
    wait_for(lambda: daemon.device("lord1")["pid"] not in (0, pid), "lord1 again")


def test_a_device_that_hangs_is_told_by_its_age(daemon: Daemon) -> None:
    daemon.wait_up("lord1")
    running = [start(daemon, True), start(daemon, False)]
    with daemon.frozen(daemon.device("lord1")["pid"]):
        said = [re.sub(r"\d+\.\d+ s \(", "AGE (", p.communicate(timeout=5)[1].decode()) for p in running]
    assert "has not ticked for AGE (lease" in said[0] and said[0] == said[1]


def is_page(fd: int) -> bool:
    try:
        return os.pread(fd, len(MAGIC), 0) == MAGIC
    except OSError:
        return False


def pass_on(listener: socket.socket, daemon: Daemon, reason: bytes) -> None:
    """Stand between two clients and the daemon, and hand out pages of a device in fault."""
    for _ in range(2):
        client, server = listener.accept()[0], socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        server.connect(daemon.socket)
        while request := client.recv(65536):
            server.send(request)
            answer, fds, _, _ = socket.recv_fds(server, 65536, 8)
            for fd in filter(is_page, fds):
                page = bytearray(os.pread(fd, 1 << 24, 0))
                page[64:68] = int(PageState.FAULT).to_bytes(4, "little")
                page[REASON_OFFSET : REASON_OFFSET + len(reason) + 1] = reason + b"\0"
                os.dup2(os.memfd_create("page"), fd)
                os.pwrite(fd, page, 0)
            socket.send_fds(client, [answer], fds)


def test_a_reason_that_no_terminal_should_see_is_shown_as_its_escapes(
    both: Both, daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reason = "\x1b[2J\t  \x7f\xa0é🦾\u202e\U000e0001".encode() + b"\xff\xe2\x82x\xed\xa0\x80\xf0\x9f"
    path = str(tmp_path / "between.sock")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(path)
        listener.listen()
        threading.Thread(target=pass_on, args=(listener, daemon, reason), daemon=True).start()
        monkeypatch.setenv("SIOMS_CELL", path)
        compiled, python = both(["lord1"], stdout=subprocess.PIPE)
    assert compiled.stderr == python.stderr
    assert r": \x1b[2J\t \x7f\xa0é🦾\u202e\U000e0001��x����" in python.stderr.decode()


def test_a_daemon_that_hangs_is_told_as_soon_as_by_the_tool_in_python(both: Both, daemon: Daemon) -> None:
    with daemon.frozen(daemon.pid):
        compiled, python = both(["lord1"], stdout=subprocess.PIPE)
    assert (compiled.returncode, compiled.stderr) == (python.returncode, python.stderr)
    assert b"hung" in python.stderr


def test_with_other_sources_than_it_was_made_of_the_tool_in_python_runs(tmp_path: Path) -> None:
    if not PROGRAM.exists():
        pytest.skip("nothing is compiled here: ./dev setup says why")
    (tmp_path / "sioms" / "native").mkdir(parents=True)
    copy = tmp_path / "sioms" / "native" / "_devin"
    copy.write_bytes(PROGRAM.read_bytes())
    copy.chmod(0o755)
    words = ["/bin/echo", "-", "-", "-", "program", "devin", "self", "mod0"]
    done = subprocess.run([copy, *words], capture_output=True, text=True, timeout=5)
    assert done.stdout == "- - - program devin self mod0\n"


def test_a_page_has_no_gaps_which_c_would_fill_in() -> None:
    at = 0
    for code in HEADER_FIELDS.values():
        size = {"I": 4, "Q": 8}.get(code) or int(code[:-1])
        assert at % (1 if code.endswith("s") else size) == 0
        at += size
    assert at == 256


def test_what_is_no_measurement_is_nan_either_way(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(BLIND)
    daemon.wait_up("blind0")
    for words in (["-h1pN", "blind0"], ["-ph1", "blind0"], ["-t0.001", "-L1", "-h1", "blind0"]):
        for compiled in (True, False):
            done = subprocess.run([TOOL, *words], stdout=-1, env=environment(daemon, compiled), timeout=30, check=True)
            assert re.findall(rb"nan", done.stdout) == [b"nan"] * 2 and b"e" not in done.stdout, done
