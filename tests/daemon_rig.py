"""Rig for tests of the whole: the real daemon with a configuration, and clients that are processes of their own."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from conftest import PATIENCE_S, Running, pause_s

import sioms
from sioms.protocol.flags import AxisStatus

AXIS = """
[[device.{device}.axis]]
name = "{axis}"
position_min = -1.0
position_max = 1.0
velocity_max = 1.0
acceleration_max = 10.0
jerk_max = 2000.0
force_max = 100.0
following_error_max = 0.05
motor = {{ mass = 1.0, viscous = 2.0, coulomb = 0.5, stiction = 0.6, encoder_step = 1e-6 }}
"""


def axes(device: str, *names: str, extra: str = "") -> str:
    """Return the table of a simulated device with axes between -1 m and 1 m, 1 m/s, 10 m/s^2."""
    head = f'\n[device.{device}]\ndriver = "sim-axes"\nlate_max_s = 0.5\nhistory = 4096\ncapacity = 16384\n{extra}\n'
    return head + "".join(AXIS.format(device=device, axis=name) for name in names)


IO = """
[device.io0]
driver = "sim-io"
outputs = 8
inputs = 8
safe = 0
history = 8192
loop = [{ bit = 0, output_bit = 0 }, { bit = 1, output_bit = 1 }]
wave = [{ bit = 7, period_s = 0.002, high_s = 0.0005, count = 200, trigger_bit = 7 }]
"""
FORCE = """
[device.force0]
driver = "sim-force"
noise = [0, 0, 0, 0, 0, 0]
resolution = [0, 0, 0, 0, 0, 0]
bias = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
"""
WORKCELL = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis", "yaxis") + axes("mod1", "xaxis") + IO + FORCE
"""Two modules in two processes, an I/O block whose outputs are wired to its inputs, a force sensor without noise."""


def wait_for(predicate: Callable[[], Any], what: str, timeout_s: float = 15.0) -> Any:
    """Poll what gives no event; return the first true value."""
    began = time.monotonic()
    while not (value := predicate()):
        if (passed_s := time.monotonic() - began) > timeout_s:
            raise AssertionError(f"{what}: not within {timeout_s:g} s")
        time.sleep(pause_s(passed_s))
    return value


def has_ended(pid: int) -> bool:
    """Tell whether a process has ended, be it that nobody has reaped it yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        return True


class Daemon:
    """The real daemon, ready.

    Args:
        folder: for its socket and configuration.
        text: the configuration.
        env: further variables of its environment.
        ready: whether to wait until it says that it is ready.
        files: to be put beside the configuration, by name.
        real_time: whether simulated drivers ask for real time, as those of hardware do; tests time what they do.
    """

    def __init__(
        self,
        folder: Path,
        text: str,
        env: Mapping[str, str] | None = None,
        *,
        ready: bool = True,
        files: Mapping[str, str] | None = None,
        real_time: bool = True,
    ) -> None:
        self.folder = folder
        self._real_time = real_time
        for name, content in (files or {}).items():
            (folder / name).write_text(content)
        self.config = folder / "cell.toml"
        self.configure(text)
        self.socket = str(folder / "d.sock")
        command = [
            sys.executable,
            "-m",
            "sioms.daemon.main",
            "--config",
            self.config,
            "--socket",
            self.socket,
        ]
        self.running = Running(command, dict(env or {}), None)
        self._frozen: set[int] = set()
        if ready:
            self.running.wait_line("event=ready", 60.0)

    def configure(self, text: str) -> None:
        """Write the configuration, for the start or for a reload."""
        if self._real_time:
            text = re.sub(r'(driver = "sim-\w+"\n)(?!realtime_priority)', r"\1realtime_priority = 50\n", text)
        self.config.write_text(text)

    @property
    def pid(self) -> int:
        """Of the daemon's process."""
        return self.running.process.pid

    def cell(self, name: str = "test") -> sioms.Workcell:
        """Open a session."""
        return sioms.Workcell(self.socket, name)

    def device(self, name: str) -> dict[str, Any]:
        """Return the status of a device."""
        with self.cell() as cell:
            absent = {
                "name": name,
                "state": "leaving",
                "generation": 0,
                "pid": 0,
                "link": "",
            }  # between two processes of a reload
            return next((d for d in cell.status()["devices"] if d["name"] == name), absent)

    def wait_up(self, name: str, generation: int = 1, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait until a device is up in at least this generation with a good link."""

        def up() -> dict[str, Any] | None:
            found = self.device(name)
            good = (found["state"], found["link"]) == ("up", "good") and found["generation"] >= generation
            return found if good else None

        return wait_for(up, f"device {name} up", timeout_s)

    def fork_server(self) -> int:
        """Return the pid of the fork server: the daemon's child."""
        children = Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text().split()
        return next(int(c) for c in children if "fork_server" in Path(f"/proc/{c}/cmdline").read_text())

    def said(self, pattern: str, timeout_s: float = PATIENCE_S) -> str:
        """Wait for a line of its log; return it."""
        return self.running.wait_line(pattern, timeout_s).string

    @contextlib.contextmanager
    def frozen(self, pid: int) -> Iterator[None]:
        """Stop a process (SIGSTOP) for the length of a block."""
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    def terminate(self) -> int:
        """Ask it to end; return its status."""
        self.running.signal(signal.SIGTERM)
        return self.running.wait_exit(PATIENCE_S)

    def end(self) -> None:
        """End it and all that it started, whatever state it is in."""
        if self.running.process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGCONT)
            self.running.signal(signal.SIGTERM)
            with contextlib.suppress(AssertionError):
                self.running.wait_exit(8.0)
        self.running.end()


@contextlib.contextmanager
def daemons() -> Iterator[Callable[..., Daemon]]:
    """Give a function that starts daemons with a configuration; all are ended afterwards."""
    started: list[Daemon] = []
    folder = Path(tempfile.mkdtemp(prefix="sioms-", dir="/tmp"))

    def start(
        text: str = WORKCELL, env: Mapping[str, str] | None = None, *, at: Path | None = None, **options: Any
    ) -> Daemon:
        mine = at or folder / str(len(started))
        mine.mkdir(exist_ok=True)
        started.append(Daemon(mine, text, env, **options))
        return started[-1]

    try:
        yield start
    finally:
        for one in reversed(started):
            one.end()
        shutil.rmtree(folder, ignore_errors=True)


class Client:
    """A client that is a process of its own; it runs a few lines with ``cell`` open and says when it is ready.

    Args:
        daemon: whose client.
        script: its lines; they print what the test waits for. ``hold()`` sleeps for ever.
    """

    PROLOGUE = (
        "import errno, os, sys, time, sioms\n"
        "cell = sioms.Workcell(sys.argv[1], 'victim')\n"
        "def say(*a): print(*a, flush=True)\n"
        "def hold(): time.sleep(1000)\n"
    )

    def __init__(self, daemon: Daemon, script: str, ready: str | None = "^ready") -> None:
        self.running = Running([sys.executable, "-c", self.PROLOGUE + script, daemon.socket], {}, None)
        if ready is not None:
            self.running.wait_line(ready)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self.running.process.pid

    def wait_line(self, pattern: str, timeout_s: float = PATIENCE_S) -> Any:
        """Return the match of a line."""
        return self.running.wait_line(pattern, timeout_s)

    def kill(self) -> None:
        """SIGKILL, of this process alone: a child that it forked lives on."""
        os.kill(self.pid, signal.SIGKILL)
        self.running.process.wait()

    def end(self) -> None:
        """End it."""
        self.running.end()


JOG = """
node = cell.open({node!r}, 'rw'{lease})
node.command(velocity={velocity})
while abs(node.read().velocity[0]) < 0.5 * abs({velocity}): time.sleep(0.001)
say('ready')
"""


def jog(node: str = "mod0.xaxis", velocity: float = 0.2, lease: float = 0.0) -> str:
    """Return the script of a client that lets an axis run until told otherwise."""
    return JOG.format(node=node, velocity=velocity, lease=f", lease={lease}" if lease else "")


def raises(errno_: int, *words: str) -> Any:
    """Expect an OSError with an errno, and these words in its sentence."""
    return _Raises(errno_, words)


class _Raises:
    def __init__(self, errno_: int, words: tuple[str, ...]) -> None:
        self.errno, self.words = errno_, words
        self.text = ""

    def __enter__(self) -> _Raises:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, _: object) -> bool:
        assert error is not None, f"nothing was refused; want errno {self.errno}"
        if not isinstance(error, OSError):
            return False
        self.text = error.strerror or str(error)
        assert error.errno == self.errno, f"errno {error.errno}: {self.text}; want {self.errno}"
        missing = [word for word in self.words if word not in self.text]
        assert not missing, f"{self.text!r} does not say {missing}"
        return True


def reads(node: Any) -> bool:
    """Tell whether a node can be read."""
    try:
        node.read()
    except OSError:
        return False
    return True


def at_rest(node: Any, timeout_s: float = 5.0) -> float:
    """Wait until all axes of a node are at rest; return how long it took [s]."""
    began = time.monotonic()
    wait_for(lambda: not any(node.read().in_motion), f"{node.name} at rest", timeout_s)
    return time.monotonic() - began


WORKFLOW_S = 500.0
"""Longest that a whole workflow of `sioms reconcile` on a cell may take [s]: alone on two cores one takes 30 to 65 s,
beside four busy loops at a load of 16 that of a finger took 184.
"""


def put_in_fault(axis: sioms.AxisNode) -> None:
    """Have an axis that is held lag behind its set-points until that is a fault; return when a reading shows it."""
    axis.command(velocity=1.0, max_force=1e-3, replace=True)
    wait_for(lambda: axis.read().status[0] & AxisStatus.FAULT, "in fault")


class Waiting:
    """A call in a thread, and how it ended.

    Args:
        call: it waits.
        of: the node or session that it waits on; the request has then been taken when this returns.
    """

    def __init__(self, call: Callable[[], object], of: Any = None) -> None:
        self.error: OSError | None = None
        self.value: object = None
        self.thread = threading.Thread(target=self._run, args=(call,), daemon=True)
        before = of._channel._number if of is not None else 0
        self.thread.start()
        if of is not None:
            wait_for(lambda: of._channel._number > before, "the request is sent")
            of.status() if isinstance(of, sioms.Workcell) else of.statistics(1)  # is answered after it

    def _run(self, call: Callable[[], object]) -> None:
        try:
            self.value = call()
        except OSError as error:
            self.error = error

    def errno(self) -> int | None:
        self.thread.join(10.0)
        assert not self.thread.is_alive()
        return self.error.errno if self.error else None
