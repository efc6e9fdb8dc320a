"""Generic helpers of all tests: processes with a ready line, free names, markers, hypothesis settings."""

from __future__ import annotations

import collections
import contextlib
import fcntl
import gc
import itertools
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import pytest
from hypothesis import HealthCheck, settings

from sioms.children import ends_with_us

# A loaded machine is no fault of the code under test: examples are counted, not timed. They are the same each
# time; --hypothesis-profile=search looks for new ones.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("sioms", settings.get_profile("search"), derandomize=True)
settings.load_profile("sioms")

# As the drivers and `sioms reconcile` set it for themselves, before numpy is loaded: two workers on two cores, each
# with two threads that wait for each other by spinning, take many times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A suite in the background of a non-interactive shell is started with SIGINT ignored, and its children would inherit
# that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

PATIENCE_S = 60.0
"""Longest wait for a process that starts or ends [s]: on two cores at a load of 20 a workcell takes 27 s."""


def pause_s(passed_s: float) -> float:
    """Return how long to pause between two looks at what has been waited for so long [s].

    What takes long is looked for less often, to a twentieth of its time: each look at a daemon takes 2 ms of a
    processor.
    """
    return min(max(0.002, 0.05 * passed_s), 0.02)


MARKERS = {
    "slow": "takes more than five seconds",
    "root": "needs the rights of root; skipped without",
}


DURATIONS = Path(__file__).with_name("durations.json")


def pytest_configure(config: pytest.Config) -> None:
    for name, meaning in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {meaning}")
    config.option.loadscopereorder = False  # files are handed to workers in the order of their first tests below
    gc.disable()  # until all is collected: what is imported stays, and is not looked through again and again


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no worker is left with one when the others have ended."""
    taken: dict[str, float] = json.loads(DURATIONS.read_text()) if DURATIONS.exists() else {}
    items.sort(key=lambda item: -taken.get(item.nodeid.partition("::")[0], 0.0))


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Let the workers of a run collect one after the other: in a fresh clone the first compiles all modules and tests,
    which the others then read.
    """
    if not hasattr(session.config, "workerinput") or not hasattr(session.config, "cache"):
        return (yield)
    turn = os.open(session.config.cache.mkdir("collecting"), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(turn, fcntl.LOCK_EX)
        return (yield)
    finally:
        os.close(turn)


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over what lives until the end: modules and tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


MOST_LEFT_OPEN = 64
"""Descriptors that the tests of a file may leave behind; a process that holds 1024 is at the end of many a limit."""
OF_PROCESSES = ("tests/devices/", "tests/process/")
"""Their files are few, and what they leave open is mostly in processes that have ended."""
_open_before: dict[str, set[str]] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Fail the last test of a file that leaves descriptors open, which the garbage collector closes not either."""
    yield
    path = item.nodeid.partition("::")[0]
    if (nextitem is not None and nextitem.nodeid.partition("::")[0] == path) or path.startswith(OF_PROCESSES):
        return
    before = _open_before.pop(path, set())
    if len(_descriptors() - before) > MOST_LEFT_OPEN:
        gc.collect()
    left = [_leads_to(number) for number in _descriptors() - before]
    if len(left) > MOST_LEFT_OPEN:
        most = ", ".join(f"{count} of {name}" for name, count in collections.Counter(left).most_common(5))
        pytest.fail(f"{path} leaves {len(left)} descriptors open, at most {MOST_LEFT_OPEN} may be: {most}")


def _descriptors() -> set[str]:
    return set(os.listdir("/proc/self/fd"))


def _leads_to(number: str) -> str:
    """Return what a descriptor leads to, without what differs from one to the next."""
    try:
        return re.sub(r"\d+|\[.*", "", os.readlink(f"/proc/self/fd/{number}"))
    except OSError:
        return "nothing"


def pytest_runtest_setup(item: pytest.Item) -> None:
    _open_before.setdefault(item.nodeid.partition("::")[0], _descriptors())
    if item.get_closest_marker("root") and os.geteuid() != 0:
        pytest.skip("needs the rights of root")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Add how long each file took to the file in SIOMS_TEST_DURATIONS (see quick.py)."""
    target = os.environ.get("SIOMS_TEST_DURATIONS")
    if not target:
        return
    taken: dict[str, float] = {}
    for report in (each for reports in terminalreporter.stats.values() for each in reports):
        if isinstance(report, pytest.TestReport):
            path = report.nodeid.partition("::")[0]
            taken[path] = taken.get(path, 0.0) + report.duration
    known = json.loads(Path(target).read_text()) if Path(target).exists() else {}
    for path, seconds in taken.items():
        known[path] = max(round(seconds, 1), known.get(path, 0.0))  # what failed runs once more, but in part
    Path(target).write_text(json.dumps(known, indent=0, sort_keys=True) + "\n")


_popen = subprocess.Popen.__init__


def _popen_tied(self: subprocess.Popen[Any], *arguments: Any, **options: Any) -> None:
    """Start a process that ends with the test run, however that ends; from another thread it would end with that."""
    if options.get("preexec_fn") is None and threading.current_thread() is threading.main_thread():
        options["preexec_fn"] = ends_with_us()
    _popen(self, *arguments, **options)


subprocess.Popen.__init__ = _popen_tied  # type: ignore[method-assign]


class Running:
    """A process of our own session whose output is collected line by line while it runs.

    Any thread may call; the output is read by a thread of its own, so that the process never blocks on a full pipe.

    Attributes:
        process: the process; its stdin is a pipe.
        lines: all lines of stdout and stderr so far, without their ends.
    """

    def __init__(self, command: Sequence[str | os.PathLike[str]], env: Mapping[str, str], cwd: Path | None) -> None:
        self.command = [os.fspath(part) for part in command]
        self.process = subprocess.Popen(
            self.command,
            env={**os.environ, "PYTHONUNBUFFERED": "1", **env},
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=ends_with_us(),
        )
        self.lines: list[str] = []
        self._news = threading.Condition()
        self._ended = False
        assert self.process.stdout is not None
        self._reader = threading.Thread(target=self._collect, args=(self.process.stdout,), daemon=True)
        self._reader.start()

    def _collect(self, stream: IO[str]) -> None:
        for line in stream:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def wait_line(self, pattern: str, timeout_s: float = PATIENCE_S) -> re.Match[str]:
        """Return the first match of a regular expression in any line, old or new.

        Raises:
            AssertionError: the output ended or the time ran out; the message holds all that was said.
        """
        deadline = time.monotonic() + timeout_s
        seen = 0
        with self._news:
            while True:
                for line in self.lines[seen:]:
                    if match := re.search(pattern, line):
                        return match
                seen = len(self.lines)
                left = deadline - time.monotonic()
                if self._ended or left <= 0:
                    why = "its output ended" if self._ended else f"{timeout_s:g} s went by"
                    raise AssertionError(self._told(f"no line matched {pattern!r} before {why}"))
                self._news.wait(left)

    def wait_exit(self, timeout_s: float = PATIENCE_S) -> int:
        """Return the exit status (minus the signal's number after a kill), with all output collected."""
        try:
            status = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(self._told(f"still running after {timeout_s:g} s")) from None
        self._reader.join(1.0)  # a grandchild may hold the pipe open; what came until now is enough
        return status

    def wait_for(self, condition: Callable[[], object], what: str, timeout_s: float = 3 * PATIENCE_S) -> None:
        """Wait for something that the process brings about.

        Raises:
            AssertionError: the process ended before it, or the time ran out; the message holds all that was said.
        """
        began = time.monotonic()
        while not condition():
            if self.process.poll() is not None or (passed_s := time.monotonic() - began) > timeout_s:
                raise AssertionError(self._told(f"{what}: not before its end, and not within {timeout_s:g} s"))
            time.sleep(pause_s(passed_s))

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self) -> None:
        """Kill the process and everything that it started in its session."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self._reader.join(1.0)
        if self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        if self.process.stdout is not None and not self._reader.is_alive():
            self.process.stdout.close()

    def _told(self, what: str) -> str:
        said = "\n".join(self.lines[-60:]) or "(nothing)"
        return f"{' '.join(self.command)}: {what}; status {self.process.poll()}; it said:\n{said}"


@pytest.fixture
def start() -> Iterator[Callable[..., Running]]:
    """Start processes, ``start(command, env={}, cwd=None) -> Running``; those left over are killed after the test."""
    running: list[Running] = []

    def start_one(
        command: Sequence[str | os.PathLike[str]],
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
    ) -> Running:
        running.append(Running(command, env or {}, cwd))
        return running[-1]

    yield start_one
    for one in reversed(running):
        one.end()


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let reports be written as where the extra ``report`` is not installed: drawing takes as long as the analysis."""
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"] + ["matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A fresh folder with a path short enough for the 107 bytes of a Unix socket's address."""
    folder = Path(tempfile.mkdtemp(prefix="sioms-", dir="/tmp"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def free_name(short_folder: Path) -> Callable[[str], Path]:
    """Make names that nobody uses: ``free_name("daemon.sock")``; each call gives another one."""
    numbers = itertools.count()
    return lambda name: short_folder / f"{next(numbers)}-{name}"


@pytest.fixture
def free_port() -> Callable[[], int]:
    """Give TCP ports of 127.0.0.1 that were free a moment ago; let a server of our own bind port 0 instead."""

    def pick() -> int:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return int(probe.getsockname()[1])

    return pick


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """Poll what gives no line and no event: ``wait_until(predicate, timeout_s=10.0, what="...")``."""

    def wait(predicate: Callable[[], object], timeout_s: float = 10.0, what: str = "the condition") -> None:
        began = time.monotonic()
        while not predicate():
            if (passed_s := time.monotonic() - began) > timeout_s:
                raise AssertionError(f"{what} did not come true within {timeout_s:g} s")
            time.sleep(pause_s(passed_s))

    return wait
