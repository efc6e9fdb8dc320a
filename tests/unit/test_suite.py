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
    timed = ("timed", ["python", "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "--timeout=600", "tests"])
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
    mark = tmp_path / "mark"
    front = f"import os, time\nwhile not os.path.exists({str(mark)!r}): time.sleep(0.01)"  # ends only if both run
    beside = (
        "import os, time\nprint(os.getsid(0) == os.getpid(), own := os.nice(0), flush=True)\n"
        f"open({str(mark)!r}, 'w')\nwhile os.geteuid() == 0 and os.nice(0) == own: time.sleep(0.01)\n"
        "raise SystemExit(3)"  # gets on with its share, if it may, once the other has ended
    )
    steps = [("front", script(front))]
    other = f"import os, time\nwhile not os.path.exists({str(mark)!r}): time.sleep(0.01)"  # a lane of its own
    assert suite.run_steps(steps, beside=[[("other", script(other))], [("beside", script(beside))]]) == 1
    said = capfd.readouterr()
    assert "beside:\nTrue 19\n" in said.out
    assert "ok " in said.err and "FAILED" in said.err


def test_the_table_tells_what_a_step_has_used_with_what_it_has_started(capfd: Any) -> None:
    busy = "import time\nwhile time.process_time() < 0.3: pass"
    started = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {busy!r}])"
    steps = [("busy", script(started)), ("idle", script("import time; time.sleep(0.3)")), ("fails", script("exit(7)"))]
    assert suite.run_steps(steps) == 1
    assert suite.USED_S["busy"] > 0.3 > suite.USED_S["idle"] > 0.0
    said = capfd.readouterr().err
    assert f"{suite.USED_S['busy']:6.1f} s of processors  busy" in said and "FAILED" in said


def test_a_command_that_is_not_there_fails_the_run_with_a_sentence(capfd: Any) -> None:
    there = ("there", script("print('done')"))
    assert suite.run_steps([there], beside=[[("style", ["/nowhere/ruff"]), there]]) == 1
    said = capfd.readouterr()
    assert "style: run /nowhere/ruff: No such file or directory" in said.err and said.out.count("done") == 2


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_who_ends_the_run_ends_what_runs_beside(tmp_path: Path, how: signal.Signals, wait_until: Any) -> None:
    mark = tmp_path / "pid"
    text = (
        "import suite, sys\n"
        "wait = 'import os, sys, time; open(sys.argv[1], \"w\").write(str(os.getpid())); time.sleep(60)'\n"
        "steps = [('front', [sys.executable, '-c', 'import time; time.sleep(60)'])]\n"
        "suite.run_steps(steps, beside=[[('beside', [sys.executable, '-c', wait, sys.argv[1]])] * 2] * 2)\n"
    )
    run = subprocess.Popen([*script(text), str(mark)], cwd=TREE / "tests", start_new_session=True)
    try:
        wait_until(lambda: mark.exists() and mark.read_text(), PATIENCE_S, "the step beside")
        os.killpg(run.pid, how)
        assert run.wait(PATIENCE_S) != 0
        wait_until(lambda: has_ended(int(mark.read_text())), PATIENCE_S, "the end of the step beside")
    finally:
        run.kill()
