"""The helpers that other tests lean on."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from daemon_rig import has_ended


def test_wait_line_finds_old_and_new_lines_and_collects_stderr(start):
    code = "import sys; print('ready on 5'); print('more', file=sys.stderr); sys.stdin.readline(); print('late')"
    child = start([sys.executable, "-c", code])
    assert child.wait_line(r"ready on (\d+)")[1] == "5"
    child.wait_line("more")
    child.process.stdin.write("\n")
    child.process.stdin.flush()
    child.wait_line("late")
    assert child.wait_exit() == 0
    child.wait_line("ready")


def test_wait_line_tells_what_was_said_when_the_output_ends(start):
    child = start([sys.executable, "-c", "print('broken: no such port'); raise SystemExit(3)"])
    with pytest.raises(AssertionError, match=r"its output ended(.|\n)*broken: no such port"):
        child.wait_line("ready", timeout_s=20)


def test_wait_line_keeps_its_deadline(start):
    child = start([sys.executable, "-c", "import time; time.sleep(60)"])
    begin = time.monotonic()
    with pytest.raises(AssertionError, match=r"0\.05 s went by"):
        child.wait_line("ready", timeout_s=0.05)
    assert time.monotonic() - begin < 20


def test_a_signal_ends_it_and_the_status_tells(start):
    child = start([sys.executable, "-c", "print('ready'); import time; time.sleep(60)"])
    child.wait_line("ready")
    child.signal(signal.SIGKILL)
    assert child.wait_exit() == -signal.SIGKILL


def test_end_kills_what_the_process_started(start, wait_until):
    code = "import subprocess, sys; p = subprocess.Popen(['sleep', '60']); print('child', p.pid); p.wait()"
    child = start([sys.executable, "-c", code])
    pid = int(child.wait_line(r"child (\d+)")[1])
    child.end()

    wait_until(lambda: has_ended(pid), what="the end of the grandchild")


def test_names_are_free_and_fit_a_socket_address(free_name):
    names = {free_name("daemon.sock") for _ in range(3)}
    assert len(names) == 3
    assert all(len(str(name)) < 100 and not name.exists() and name.parent.is_dir() for name in names)


def test_a_suite_that_is_started_with_interrupts_ignored_has_children_that_obey_them(tmp_path):
    """As in the background of a shell that is not interactive."""
    tests = Path(__file__).parents[1]
    inner = (
        f"import sys; sys.path.insert(0, {str(tests)!r}); import conftest, signal; "
        "print(signal.getsignal(signal.SIGINT))"
    )
    outer = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); os.execv(sys.executable, sys.argv[1:])"
    )
    done = subprocess.run(
        [sys.executable, "-c", outer, sys.executable, "-c", inner], capture_output=True, text=True, check=True
    )
    assert "default_int_handler" in done.stdout
