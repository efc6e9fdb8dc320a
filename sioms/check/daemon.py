"""What a bench stands on: a daemon of its own, its processes' times and memory, forked clients.

The bench process has one thread, so that it may fork clients; the daemon's log goes to a file and
its readiness comes over a notification socket, as under a service manager.

Concurrency: one thread.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from sioms.children import ends_with_us
from sioms.client.workcell import Workcell

from .held_up import tree_waited_ns

READY_S = 30.0
MOST_HELD_UP = 4.0
"""How many times as long a daemon may take to start that the machine keeps waiting."""


class Daemon:
    """A daemon of our own. Use it in a ``with`` block.

    Args:
        config: the configuration, TOML.
        pin: core that the daemon and its drivers may use, None for all.
        ready_s: how long it may take until it is ready.

    Attributes:
        pid, socket: of the daemon.
        start_ns, ready_ns: when it was started, and when it told that it was ready [CLOCK_MONOTONIC].
    """

    def __init__(self, config: str, pin: int | None = None, ready_s: float = READY_S) -> None:
        self._ready_s = ready_s
        self.folder = Path(tempfile.mkdtemp(prefix="sioms-bench-"))
        self.socket = str(self.folder / "siomsd.sock")
        self.log_path = self.folder / "log"
        (self.folder / "bench.toml").write_text(config, encoding="utf-8")
        self._children: list[int] = []
        self.start(pin)

    def start(self, pin: int | None = None) -> None:
        """Start the daemon, which has not been started or has ended, and wait until it is ready."""
        (self.folder / "notify").unlink(missing_ok=True)
        notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        notify.bind(str(self.folder / "notify"))
        notify.settimeout(0.2)
        environment = dict(os.environ, NOTIFY_SOCKET=str(self.folder / "notify"))
        environment.pop("WATCHDOG_USEC", None)
        command = [
            sys.executable,
            "-P",
            "-m",
            "sioms.daemon.main",
            "--config",
            str(self.folder / "bench.toml"),
        ]
        if pin is not None:
            command = ["taskset", "-c", str(pin), *command]
        with open(self.log_path, "ab") as log:
            self.start_ns = time.monotonic_ns()
            self.process = subprocess.Popen(
                [*command, "--socket", self.socket],
                env=environment,
                stderr=log,
                stdin=subprocess.DEVNULL,
                preexec_fn=ends_with_us(),
                start_new_session=True,  # the kernel lets stopped processes of a group go on that is orphaned in ours
            )
        self.pid = self.process.pid
        try:
            self._wait_ready(notify)
        except BaseException:  # also when we are interrupted: nothing is left behind
            self.close()
            raise
        finally:
            notify.close()
        self.ready_ns = time.monotonic_ns()

    def _wait_ready(self, notify: socket.socket) -> None:
        """Wait until it is ready; what it or a process of it waited for a processor is not counted, up to a bound."""
        most_ns = self._ready_s * 1e9
        while self.process.poll() is None:
            took_ns = time.monotonic_ns() - self.start_ns
            held_up_ns = tree_waited_ns(self.process.pid) if took_ns > most_ns else 0
            if took_ns - min(held_up_ns, MOST_HELD_UP * most_ns) > most_ns:
                break
            try:
                if b"READY=1" in notify.recv(4096):
                    return
            except TimeoutError:
                continue
        raise RuntimeError(f"start daemon: not ready; want READY=1 within {self._ready_s:g} s; it said:\n{self.log()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def cell(self, name: str = "bench") -> Workcell:
        """Return a new session."""
        return Workcell(self.socket, name)

    def ended(self) -> bool:
        """Tell whether the daemon has ended by itself."""
        try:
            self.process.wait(0.05)
        except subprocess.TimeoutExpired:
            return False
        return True

    def log(self) -> str:
        """Return what the daemon has logged."""
        return self.log_path.read_text(encoding="utf-8", errors="replace")

    def device_pids(self) -> dict[str, int]:
        """Return the driver process of each device."""
        with self.cell() as cell:
            return {device["name"]: device["pid"] for device in cell.status()["devices"]}

    def fork(self, work: Callable[[], object]) -> int:
        """Run a function in a forked client process; return its pid. It is killed with the daemon."""
        sys.stdout.flush()
        tie = ends_with_us()
        pid = os.fork()
        if pid == 0:
            status = 1
            try:
                tie()
                os.setsid()  # as the daemon
                signal.signal(signal.SIGINT, signal.SIG_DFL)
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                work()
                status = 0
            except KeyboardInterrupt:
                status = 130
            finally:
                os._exit(status)
        self._children.append(pid)
        return pid

    def kill(self, pid: int, how: int = signal.SIGKILL) -> int:
        """Kill a forked client; return the time just before [ns]."""
        begin = time.monotonic_ns()
        os.kill(pid, how)
        return begin

    def reap(self, pid: int) -> None:
        """Wait for a forked client to be gone."""
        os.waitpid(pid, 0)
        self._children.remove(pid)

    def close(self) -> None:
        """End the clients, the daemon and its drivers, and remove the files."""
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        self._children.clear()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)


class CpuTimes:
    """Processor shares of processes between construction and ``shares``.

    Args:
        processes: name to pid.
    """

    def __init__(self, processes: Mapping[str, int]) -> None:
        self._processes = dict(processes)
        self._begin_ns = time.monotonic_ns()
        self._before = {name: run_ns(pid) for name, pid in self._processes.items()}

    def shares(self) -> dict[str, float]:
        """Return the share of one core that each has used."""
        passed = max(1, time.monotonic_ns() - self._begin_ns)
        return {name: (run_ns(pid) - self._before[name]) / passed for name, pid in self._processes.items()}


def on_one_processor(*pids: int) -> contextlib.AbstractContextManager[None]:
    """Keep all threads of some processes on the last processor that they may use."""
    return on_processors({pid: max(os.sched_getaffinity(pid)) for pid in pids})


@contextlib.contextmanager
def on_processors(places: Mapping[int, int]) -> Iterator[None]:
    """Keep all threads of processes each on a processor.

    Args:
        places: processor by pid.
    """
    tasks = {int(task): place for pid, place in places.items() for task in os.listdir(f"/proc/{pid}/task")}
    before = {task: os.sched_getaffinity(task) for task in tasks}
    try:
        for task, place in tasks.items():
            os.sched_setaffinity(task, {place})
        yield
    finally:
        for task, processors in before.items():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(task, processors)


def run_ns(pid: int) -> int:
    """Return the time that a process has run on a processor [ns]; 0 when it is gone."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0])
    except (OSError, IndexError):
        return 0


def memory_kb(pid: int) -> dict[str, int]:
    """Return resident, proportional and private memory of a process [KiB]."""
    sizes = {"Rss": 0, "Pss": 0, "Private_Clean": 0, "Private_Dirty": 0}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
        key, _, rest = line.partition(":")
        if key in sizes:
            sizes[key] = int(rest.split()[0])
    return {
        "rss": sizes["Rss"],
        "pss": sizes["Pss"],
        "private": sizes["Private_Clean"] + sizes["Private_Dirty"],
    }


def descriptors(pid: int) -> int:
    """Return how many descriptors a process has open."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def wait_for(condition: Callable[[], Any], timeout_s: float, what: str) -> Any:
    """Look until something is true and return it.

    Raises:
        TimeoutError: it never was.
    """
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"wait for {what}: nothing within {timeout_s:g} s")
        time.sleep(0.0005)
    return found
