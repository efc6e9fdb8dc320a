"""What serves until it is told to end leaves its blocks and ends with status 0, whichever signal told it."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

SIOMS = Path(__file__).resolve().parents[2] / "sioms"
SERVES = ["bridges/epics.py", "bridges/metrics.py", "bridges/ros2.py", "gateway/serve.py"] + [
    f"recording/command/{name}.py" for name in ("blackbox", "record", "replay")
]
PROGRAM = """
import contextlib, time
from sioms.ending import end_well
with contextlib.ExitStack() as stack:
    stack.callback(print, "left", flush=True)
    end_well()
    print("serves", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_who_is_told_to_end_has_not_failed(number: signal.Signals) -> None:
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "serves\n"
        process.send_signal(number)
        assert process.communicate(timeout=30)[0] == "left\n" and process.returncode == 0


@pytest.mark.parametrize("name", SERVES)
def test_what_serves_has_the_one_way_to_end(name: str) -> None:
    text = (SIOMS / name).read_text()
    assert "from sioms.ending import" in text and "signal.SIGTERM" not in text


LEAVES = """
import atexit, threading, time
from sioms.ending import leave
atexit.register(print, "taken apart")
threading.Thread(target=time.sleep, args=(60,)).start()
print("said", end="")
leave(3)
"""


FRONT = """
import atexit, sys
from types import SimpleNamespace
from sioms.gateway import command
from sioms.tools import front
def fails(args):
    raise {error}
command.run = fails
atexit.register(print, "taken apart")
sys.argv = ["sioms", "{name}", {more}]
front.main()
"""


@pytest.mark.parametrize("error", ['OSError(98, "in use")', 'RuntimeError("a mistake")'])
def test_a_gateway_that_fails_leaves_too(error: str) -> None:
    """Zenoh's own threads are never ended; they would run on while interpreter and libraries are taken apart."""

    def run(name: str, more: str) -> tuple[int, str, str]:
        program = FRONT.format(error=error, name=name, more=more)
        found = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=30.0, check=False
        )
        return found.returncode, found.stdout, found.stderr

    status, out, said = run("serve", "")
    assert status == 1 and not out and ("in use" in said or "a mistake" in said)
    assert run("key", "'list'")[1] == "taken apart\n" and not out, "other commands end as programs do"


def test_who_leaves_has_written_all_and_runs_nothing_more() -> None:
    found = subprocess.run([sys.executable, "-c", LEAVES], capture_output=True, text=True, timeout=30.0, check=False)
    assert found.stdout == "said" and found.returncode == 3
