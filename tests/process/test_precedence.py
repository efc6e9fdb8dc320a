"""The daemon's loop is never starved by its own drivers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_rig import Daemon, axes, wait_for

HOGS = 3
HOG = '''
import os
import pathlib
import time
from sioms.drivers.sim.axes import SimAxes

FOLDER = pathlib.Path("{folder}")
LONGEST_S = 4.0


class Hog(SimAxes):
    """Computes for the whole of its period, but for moments that others like it use: nobody takes its class away."""

    began_s = 0.0

    def tick(self, now_ns):
        super().tick(now_ns)
        mark = FOLDER / f"burns-{{os.getpid()}}"
        burns = (FOLDER / "burn").exists() and time.monotonic() - (self.began_s or time.monotonic()) < LONGEST_S
        if burns and not self.began_s:
            self.began_s = time.monotonic()
            mark.touch()
        elif not burns and self.began_s:
            mark.unlink(missing_ok=True)
        if burns:
            until = time.thread_time() + 0.1
            while time.thread_time() < until:
                pass
            time.sleep(1e-4)

    def quiet_steps(self, pages, instants):
        return None


DRIVER = Hog
'''


@pytest.mark.root
def test_the_loop_goes_on_beside_drivers_that_leave_no_pause(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    (tmp_path / "hog.py").write_text(HOG.format(folder=tmp_path))
    text = '[workcell]\nname = "test"\n'
    for i in range(HOGS):
        one = axes(f"hog{i}", "a", extra="realtime_priority = 60\nhang_s = 10.0\nlease_s = 10.0")
        text += one.replace("late_max_s = 0.5", "late_max_s = 10.0").replace('"sim-axes"', f'"{tmp_path}/hog.py"')
    daemon = start_daemon(text, ready=False, real_time=False)
    core = min(os.sched_getaffinity(0))
    os.sched_setaffinity(daemon.pid, {core})
    for child in Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split():
        os.sched_setaffinity(int(child), {core})  # the fork server: drivers inherit it
    daemon.running.wait_line("event=ready", 60.0)
    with daemon.cell() as cell:
        assert {os.sched_getscheduler(device["pid"]) for device in cell.status()["devices"]} == {os.SCHED_FIFO}
        (tmp_path / "burn").touch()
        wait_for(lambda: len(list(tmp_path.glob("burns-*"))) == HOGS, "all compute")
        began_s = time.monotonic()
        for _ in range(3):
            cell.status()
        still = len(list(tmp_path.glob("burns-*")))
        (tmp_path / "burn").unlink()
        assert still == HOGS, f"answered when drivers had ended, after {time.monotonic() - began_s:.1f} s"
