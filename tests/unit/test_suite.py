"""The run of the whole suite: steps that are slow, that fail, and that run beside others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import suite
from conftest import PATIENCE_S
from daemon_rig import has_ended

TREE = Path(__file__).resolve().parents[2]


def script(text: str) -> list[str]:
    return [sys.executable, "-c", text]


def test_a_step_ends_when_it_is_silent_and_not_when_it_is_slow(monkeypatch: Any, capfd: Any) -> None:
    monkeypatch.setattr(suite, "QUIET_S", 1.5)  # silence is looked at once a second: it ends after 2 s
    monkeypatch.setattr(suite.os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    slow = "import time\nfor _ in range(2): print('.', flush=True); time.sleep(1.2)"
    assert suite.run_step("slow", script(slow)) == 0
    assert suite.run_step("hangs", script("import time; time.sleep(60)")) == -1
    assert "hangs: killed; it has printed nothing" in capfd.readouterr().err
    monkeypatch.setattr(suite.os, "getloadavg", lambda: (100.0 * suite.os.cpu_count(), 0.0, 0.0))
    assert suite.run_step("starved", script("import time; time.sleep(2.3)")) == 0


def test_what_failed_is_run_once_more_and_a_second_failure_counts(monkeypatch: Any, capsys: Any) -> None:
    ran = []

    def step(name: str, command: list[str], *, beside: bool = False) -> int:
        ran.append(command)
        return next(codes)

    monkeypatch.setattr(suite, "run_step", step)
    timed = ("timed", ["python", "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "tests"])
    codes = iter([1, 0])
    assert suite.run_steps([timed]) == 0
    assert ran[1] == ["python", "-m", "pytest", "-q", "tests", "--lf", "--lfnf=none"]
    assert "what failed once more" in capsys.readouterr().err
    codes = iter([1, 1])
    assert suite.run_steps([timed]) == 1
    codes = iter([2, 0])  # an interrupted or broken run is not run again
    assert suite.run_steps([timed]) == 1
    codes = iter([1, 0])
    assert suite.run_steps([("style", ["ruff", "check"])]) == 1
    codes = iter([5])
    assert suite.run_steps([("nothing there", ["python", "-m", "pytest", "tests"])]) == 0


def test_steps_beside_others_give_way_fail_the_run_and_are_shown_whole(tmp_path: Path, capfd: Any) -> None:
    mine, seen = tmp_path / "mine", "while not os.path.exists(sys.argv[1]): time.sleep(0.01)"
    front = [*script(f"import os, sys, time\n{seen}"), str(mine)]
    text = "import os, sys; print(os.nice(0), os.getsid(0) == os.getpid()); open(sys.argv[1], 'w'); sys.exit(3)"
    steps = [("front", front)]  # ends only if the other runs at the same time
    assert suite.run_steps(steps, beside=[("beside", [*script(text), str(mine)])]) == 1
    said = capfd.readouterr()
    assert "beside:\n19 True\n" in said.out
    assert "ok " in said.err and "FAILED" in said.err


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_who_ends_the_run_ends_what_runs_beside(tmp_path: Path, how: signal.Signals, wait_until: Any) -> None:
    mark = tmp_path / "pid"
    text = (
        "import suite, sys\n"
        "wait = 'import os, sys, time; open(sys.argv[1], \"w\").write(str(os.getpid())); time.sleep(60)'\n"
        "steps = [('front', [sys.executable, '-c', 'import time; time.sleep(60)'])]\n"
        "suite.run_steps(steps, beside=[('beside', [sys.executable, '-c', wait, sys.argv[1]])] * 2)\n"
    )
    run = subprocess.Popen([*script(text), str(mark)], cwd=TREE / "tests", start_new_session=True)
    try:
        wait_until(lambda: mark.exists() and mark.read_text(), PATIENCE_S, "the step beside")
        os.killpg(run.pid, how)
        assert run.wait(PATIENCE_S) != 0
        wait_until(lambda: has_ended(int(mark.read_text())), PATIENCE_S, "the end of the step beside")
    finally:
        run.kill()
