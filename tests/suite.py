"""Runs the checks and the tests of the tree; `./dev test`, `./dev check` and `./dev docs` come here, in the
environment of the tree.

    python tests/suite.py test [--quick [ARG...] | --durations]
    python tests/suite.py check | documents

Tests of real processes and all that computes run side by side: docs/decisions/0731-the-suite.md.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, cast

from sioms.children import ends_with_us

TREE = Path(__file__).resolve().parents[1]
DURATIONS = TREE / "tests" / "durations.json"
QUIET_S = 600
"""Longest that a step may print nothing on a machine with nothing else to do [s]; a hang ends with a name."""
SLOW_S = 600
"""Longest that a test may take which gives way to others; alone it is that of pyproject.toml [s]."""
# Tests of real processes mostly wait: two files of them run at a time, and what they promise holds on a busy machine.
# All others compute, one for each processor, on the time that those leave.
# Those that measure share the processors with nothing.
BESIDE = [folder for folder in ("tests/devices", "tests/process") if (TREE / folder).is_dir()]
ALONE = [folder for folder in ("tests/bench",) if (TREE / folder).is_dir()]
PARALLEL = ("tests", *(f"--ignore={folder}" for folder in (*BESIDE, *ALONE)))
TWO_FILES = ("-n", "2", "--dist", "loadfile")
"""Two workers; what a file computes for all of its tests is computed once."""
TYPES = "import gc; gc.enable = gc.disable; from mypy.__main__ import console_entry; console_entry()"
"""mypy, without a garbage collector that passes over trees which all stay: an eighth of its time."""
Step = tuple[str, list[str]]
"""Its name, and its command."""
Result = tuple[Step, int, float]
"""A step, its exit status, and how long it took [s]."""


def static_checks() -> list[Step]:
    steps = [
        # Whether an import is of this tree is no part of what ruff remembers of a file.
        ("style", ["ruff", "check", "--no-cache", "."]),
        ("format", ["ruff", "format", "--check", "."]),
        ("types", [sys.executable, "-c", TYPES]),
        ("layers", ["lint-imports", "--no-logo"]),
    ]
    if (TREE / "tools" / "generate.py").exists():
        steps.append(("generated files", [sys.executable, "-m", "sioms.tools.generate", "--check"]))
    return steps


def pytest(cache: str, *arguments: str) -> list[str]:
    """Return a command; what runs at the same time notes in a cache of its own what has failed."""
    return [sys.executable, "-m", "pytest", "-q", "-o", f"cache_dir=.pytest_cache/{cache}", *arguments]


def computing(*paths: str) -> Step:
    return "tests that compute, in parallel", pytest("computing", *TWO_FILES, f"--timeout={SLOW_S}", *paths)


def of_processes(*paths: str) -> Step:
    return "tests of processes, two files at a time", pytest("processes", *TWO_FILES, *paths)


def run_tests() -> int:
    """Run all checks and tests."""
    return run_steps(
        [of_processes(*BESIDE)] if BESIDE else [],
        beside=[[*static_checks(), documents()], [computing(*PARALLEL)]],
        then=[(f"{folder}, one by one", pytest("alone", folder)) for folder in ALONE],
    )


def documents(builder: str = "dummy") -> Step:
    """Return the step that reads all documents; a link that leads nowhere fails it.

    Args:
        builder: of sphinx; "html" also writes the site, which takes six times as long.
    """
    words = f"-q -W --keep-going -j 2 -b {builder} -d out/doctrees -c docs/site . out/site"
    return "documents", [sys.executable, "-m", "sphinx", *words.split()]


def run_quick(arguments: list[str]) -> int:
    """Run the checks, and the tests that are chosen: see tests/quick.py."""
    command = [sys.executable, "tests/quick.py", *arguments]
    done = subprocess.run(command, cwd=TREE, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        sys.exit("suite.py: the tests nearest to what has changed could not be chosen")
    print(done.stdout, end="")
    chosen = [word for line in done.stdout.splitlines() for word in line.split()[-1:] if word.endswith(".py")]
    apart = [path for path in chosen if path.startswith((*BESIDE, *ALONE))]
    rest = [path for path in chosen if path not in apart]
    return run_steps(
        [of_processes(*apart)] if apart else [],
        beside=[static_checks(), [computing(*rest)] if rest else []],
    )


def run_steps(steps: list[Step], *, beside: Sequence[Sequence[Step]] = (), then: Sequence[Step] = ()) -> int:
    """Run every step, also after a failure, and close with a table of them.

    Args:
        steps: run one after the other.
        beside: lanes that run at the same time, the steps of each also one after the other, on the time of the
            processors that the first leave.
        then: after all these, with nothing beside them.
    """
    if steps:
        ALONE_AT_LAST.clear()
    with ThreadPoolExecutor(len(beside) or 1) as pool, ended_with_us():
        lanes = [pool.submit(run_lane, lane) for lane in beside]
        results = [run_timed(step) for step in steps]
        go_ahead()
        results = [*(result for lane in lanes for result in lane.result()), *results]
    results += [run_timed(step) for step in then]
    results = [run_again(result) for result in results]
    for step, code, seconds in results:
        nothing_there = is_pytest(step) and code == 5  # a folder may have no tests
        verdict = "ok    " if code == 0 or nothing_there else "FAILED"
        say(f"{verdict} {seconds:6.1f} s, {USED_S.get(step[0], 0.0):6.1f} s of processors  {step[0]}")
    return 0 if all(code == 0 or (is_pytest(step) and code == 5) for step, code, _ in results) else 1


def run_lane(steps: Sequence[Step]) -> list[Result]:
    """Run steps that give way to others, one after the other."""
    return [run_timed(step, beside=True) for step in steps if not ENDING.is_set()]


def run_timed(step: Step, *, beside: bool = False) -> Result:
    """Run a step."""
    name, command = step
    say(f"{name}: {' '.join(command)}")
    began = time.monotonic()
    try:
        code = run_step(name, command, beside=beside)
    except OSError as error:
        say(f"{name}: run {command[0]}: {error.strerror}; ./dev setup installs it")
        code = 127
    return step, code, time.monotonic() - began


def run_again(result: Result) -> Result:
    """Run what failed of tests once more, one by one.

    They time real processes: what the machine held up passes alone, what is wrong fails again.
    """
    (name, command), code, seconds = result
    if not is_pytest((name, command)) or code != 1:
        return result
    name += ", what failed once more"
    _, code, more = run_timed((name, [*without_workers(command), "--lf", "--lfnf=none"]))
    return (name, command), code, seconds + more


def is_pytest(step: Step) -> bool:
    return step[1][2:3] == ["pytest"]


def without_workers(command: list[str]) -> list[str]:
    """Return a command of pytest that runs in one process, and beside nothing."""
    command = [word for word in command if not word.startswith("--timeout=")]
    for option in ("-n", "--dist"):
        at = command.index(option) if option in command else len(command)
        command = command[:at] + command[at + 2 :]
    return command


USED_S: dict[str, float] = {}
"""Processor time of each step, with all processes that it has started and seen end [s]: what both lanes share."""
RUNNING: set[int] = set()
"""Process groups of the steps that run beside others."""
ENDING, ALONE_AT_LAST = threading.Event(), threading.Event()
"""The run is to end; nothing runs any more that others must give way to."""


@contextlib.contextmanager
def ended_with_us() -> Iterator[None]:
    """Kill the steps beside others when we are told to end: a terminal reaches its own session only."""
    try:
        yield
    except BaseException:
        ENDING.set()
        for group in list(RUNNING):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)
        raise


def tied(*, beside: bool) -> Callable[[], None]:
    """Return what a new process of a step does first: it ends when we do, and beside others it gives way to them."""
    tie = ends_with_us()

    def begin() -> None:
        tie()
        if beside:
            os.setsid()
            if not ALONE_AT_LAST.is_set():
                put_behind(0, 19)

    return begin


def put_behind(group: int, nice: int) -> None:
    """Let the session of a process group, 0: our own, get only the time that others leave, by 19, or its share, by 0.

    Where the scheduler groups processes by session (autogroup), nice values count within one; the group has its own.
    """
    with contextlib.suppress(OSError):  # to be nice no more takes rights where there are no such groups
        os.setpriority(os.PRIO_PGRP, group, nice)
    with contextlib.suppress(OSError), open(f"/proc/{group or 'self'}/autogroup", "w") as file:
        file.write(str(nice))


def go_ahead() -> None:
    """Let what runs beside the steps have its share: these have ended."""
    ALONE_AT_LAST.set()
    for group in list(RUNNING):
        put_behind(group, 0)


def run_step(name: str, command: list[str], *, beside: bool = False) -> int:
    """Run one step and show what it prints, of one beside others when it has ended; end it when it has been silent for
    too long.

    Silence counts by the share of the processor that a process gets: slow is not hanging.
    """
    colour = {"FORCE_COLOR": "1"} if sys.stdout.isatty() and not os.environ.get("NO_COLOR") else {}
    kept = bytearray()
    quiet_s, last = 0.0, time.monotonic()
    with subprocess.Popen(
        command, cwd=TREE, env={**os.environ, **colour}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT if beside else None, preexec_fn=tied(beside=beside),
    ) as process:  # fmt: skip
        if beside:
            RUNNING.add(process.pid)
            if ALONE_AT_LAST.is_set():  # since the process began
                put_behind(process.pid, 0)
        try:
            output = cast("IO[bytes]", process.stdout).fileno()
            while True:
                if select.select([output], [], [], 1.0)[0]:  # noqa: TID251 - imports nothing of SIOMS
                    data = os.read(output, 65536)
                    if not data:
                        return status_of(name, process)
                    kept += data
                    if not beside:
                        show(kept)
                    quiet_s, last = 0.0, time.monotonic()
                elif os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                    return status_of(name, process)  # something that it has left behind keeps our end open
                now = time.monotonic()
                quiet_s += (now - last) / max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
                last = now
                if quiet_s > QUIET_S:
                    say(f"{name}: killed; it has printed nothing for as long as {QUIET_S} s of a free machine")
                    process.kill()
                    return -1
        finally:
            RUNNING.discard(process.pid)
            if kept:
                print(f"{name}:", flush=True)
                show(kept)


def status_of(name: str, process: subprocess.Popen[bytes]) -> int:
    """Wait for the end of a step; note what it has used of the processors, and return its exit status."""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    USED_S[name] = used.ru_utime + used.ru_stime
    return process.returncode


def show(text: bytearray) -> None:
    """Print, and forget what has been printed."""
    sys.stdout.buffer.write(text)
    sys.stdout.buffer.flush()
    text.clear()


def say(text: str) -> None:
    print(f"dev: {text}", file=sys.stderr, flush=True)


def main(verb: str, *rest: str) -> int:
    if verb == "check":
        return run_steps(static_checks())
    if verb == "documents":
        return run_steps([documents("html")])
    if rest[:1] == ("--quick",):
        return run_quick(list(rest[1:]))
    if rest[:1] == ("--durations",):
        DURATIONS.unlink(missing_ok=True)  # the longest of all runs is kept in it
        os.environ["SIOMS_TEST_DURATIONS"] = str(DURATIONS)
    return run_tests()


if __name__ == "__main__":
    try:
        sys.exit(main(*sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit(130)
