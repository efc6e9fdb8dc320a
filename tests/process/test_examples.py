"""Every example runs against the simulated workcell and says what it shows."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import sioms

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
EXPECTED = {
    "first_move.py": r"after:  0\.(10|099)\d*\nrefused: .*position 9 m is outside",
    "damper.py": r"at -?\d+\.\d\d mm after 1 s",
    "pick_and_place.py": r"gripper closed, switches 0b\d1\nplaced at \[0\.05",
    "force_guarded_move.py": r"touched at (19|20|21)\.\d+ mm\nforce now [+-][2-6]\.\d+ N",
    "beam_localisation.py": r"beam 0 from (99\.9|100\.0)\d* to (139\.9|140\.0)\d* mm",
    "trajectory.py": r"400 commands, 2\.0\d\d s, back at \[0\.(14|139)\d*, 0\.(1|099)\d*",
    "watch.py": r"\d+\.\d{3} mod0.readonly +\(0\.",
    "asyncio_modules.py": r"(?s)beam 0 broken.*mod0.xaxis at (0|-0)\.000",
    "stop_and_reset.py": r"at rest: -?0\.000 m/s.*EMERGENCY_STOP.*\nrefused: .*emergency stop.*\nback at",
}
ARGUMENTS = {"damper.py": ["1"], "watch.py": ["1"]}


@pytest.fixture(scope="module")
def socket_path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A daemon with the demo's workcell."""
    path = f"/tmp/sioms-examples-{os.getpid()}.sock"
    process = subprocess.Popen(
        [sys.executable, "-m", "sioms.daemon.main", "--config", str(ROOT / "etc/demo.toml"), "--socket", path],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    for line in process.stderr:
        if "event=ready" in line:
            break
    else:
        pytest.fail(f"the daemon ended with {process.wait()}")
    yield path
    process.terminate()
    assert process.wait(10) == 0


def _environment(socket_path: str) -> dict[str, str]:
    folders = [str(ROOT / "tools/bin"), os.path.dirname(sys.executable), os.environ["PATH"]]
    return dict(os.environ, SIOMS_SOCKET=socket_path, PATH=":".join(folders))


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_example(name: str, socket_path: str) -> None:
    runner = [sys.executable] if name.endswith(".py") else ["sh"]
    done = subprocess.run(
        [*runner, str(EXAMPLES / name), *ARGUMENTS.get(name, [])],
        env=_environment(socket_path), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(EXPECTED[name], done.stdout), done.stdout


def test_the_damper_in_the_shell_acts_on_each_sample_as_it_comes(socket_path: str) -> None:
    with sioms.Workcell(socket_path) as cell, cell.open("mod0.xaxis.readonly") as axis:
        damper = subprocess.Popen(["sh", str(EXAMPLES / "damper.sh"), "100"], env=_environment(socket_path))
        moved, before = [], axis.read().velocity[0]
        while damper.poll() is None:
            reading = axis.wait_new(axis.read().number, 5.0)
            if reading.commanded_velocity[0] != before:
                before = reading.commanded_velocity[0]
                moved.append(time.monotonic())
        assert damper.returncode == 0
    assert len(moved) > 20 and moved[-1] - moved[0] > 1.0, f"{len(moved)} changes of velocity; want some 100 in 2 s"


def test_slider_moves_with_the_arrow_keys(socket_path: str) -> None:
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLES / "slider.py"), "mod0.yaxis"],
        stdin=theirs, stdout=theirs, env=_environment(socket_path),
    )  # fmt: skip
    shown = b""
    deadline = time.monotonic() + 30
    os.set_blocking(ours, False)

    def wait_for(pattern: bytes) -> re.Match[bytes]:
        """Return the next match in what the terminal shows."""
        nonlocal shown
        while (found := re.search(pattern, shown)) is None:
            assert time.monotonic() < deadline, shown[-300:]
            try:
                shown += os.read(ours, 4096)
            except BlockingIOError:
                time.sleep(0.01)
        shown = shown[found.end() :]
        return found

    try:
        first = float(wait_for(rb" (-?\d+\.\d{4}) m")[1])
        os.write(ours, b"\x1b[C\x1b[C")
        while abs(float(wait_for(rb" (-?\d+\.\d{4}) m")[1]) - first - 0.02) > 0.0005:
            pass
        os.write(ours, b"q")
        assert process.wait(10) == 0
    finally:
        process.kill()
        os.close(ours)
        os.close(theirs)


def test_every_example_is_tested() -> None:
    files = {path.name for path in EXAMPLES.iterdir() if path.suffix in (".py", ".sh")}
    assert files == {*EXPECTED, "slider.py", "damper.sh"}
    for path in EXAMPLES.iterdir():
        if path.suffix in (".py", ".sh"):
            assert 5 <= len(path.read_text().splitlines()) <= 60, path.name
