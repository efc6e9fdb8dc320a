"""Several light devices in one process: what is shared, and what is not."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from daemon_rig import Daemon, wait_for

from sioms.client.command import command

AXES = """
[device.{name}]
driver = "{driver}"
realtime_priority = 50
process = "light"
tick_hz = {hz}
late_max_s = 5.0
lease_s = 5.0
[[device.{name}.axis]]
name = "a"
velocity_max = 1.0
acceleration_max = 10.0
bandwidth_hz = 5.0
force_max = 60.0
motor = {{ mass = 1.0, viscous = 2.0 }}
"""
RAISING = '''
import os
from sioms.drivers.sim.axes import SimAxes


class Raising(SimAxes):
    """Raises in a tick once a file is there."""

    def tick(self, now_ns):
        if os.path.exists("{folder}/fail"):
            os.unlink("{folder}/fail")
            raise ZeroDivisionError("as planned")
        super().tick(now_ns)

    def quiet_steps(self, pages, instants):
        return None


DRIVER = Raising
'''


def table(name: str, driver: str = "sim-axes", hz: int = 100) -> str:
    return AXES.format(name=name, driver=driver, hz=hz)


def pids(daemon: Daemon) -> dict[str, int]:
    with daemon.cell("pids") as cell:
        return {device["name"]: device["pid"] for device in cell.status()["devices"]}


def test_an_exception_ends_one_device_and_the_end_of_the_process_all(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    (tmp_path / "raising.py").write_text(RAISING.replace("{folder}", str(tmp_path)))
    apart = table("apart").replace('process = "light"\n', "")
    daemon = start_daemon(
        '[workcell]\nname = "t"\n'
        + table("one", f"{tmp_path}/raising.py")
        + table("two")
        + table("fast", hz=1000)
        + apart
    )
    for name in ("one", "two", "fast", "apart"):
        daemon.wait_up(name)
    before = pids(daemon)
    assert before["one"] == before["two"] == before["fast"] != before["apart"]
    with daemon.cell("mover") as cell, cell.open("two", "rw") as two, cell.open("one", "rw") as one:
        for node in (one, two):
            node.write([command(0, velocity=0.05)])
        wait_for(lambda: one.read().velocity[0] > 0.04 and two.read().velocity[0] > 0.04, "both moving")
        (tmp_path / "fail").touch()
        daemon.said("driver failed")
        daemon.said("its driver ended, in process light")
        daemon.wait_up("one", 2)
        assert two.read().in_motion[0] and two.read().velocity[0] > 0.04, "the other device moves on"
    assert pids(daemon) == before, "it starts again in the process of the others"

    os.kill(before["two"], signal.SIGKILL)
    daemon.said("process light ended, and with it every device in it")
    for name in ("one", "two", "fast"):
        wait_for(lambda name=name: pids(daemon)[name] not in (0, before[name]), f"{name} again")  # type: ignore[misc]
        daemon.wait_up(name)
    after = pids(daemon)
    assert len({after[name] for name in ("one", "two", "fast")}) == 1 and after["apart"] == before["apart"]


def test_stops_clients_and_reloads_are_as_in_processes_apart(start_daemon: Callable[..., Daemon]) -> None:
    text = '[workcell]\nname = "t"\n' + table("one") + table("two")
    daemon = start_daemon(text)
    for name in ("one", "two"):
        daemon.wait_up(name)
    with daemon.cell("mover") as cell, cell.open("one", "rw") as one, cell.open("two", "rw") as two:
        for node in (one, two):
            node.write([command(0, velocity=0.05)])
        wait_for(lambda: one.read().velocity[0] > 0.04 and two.read().velocity[0] > 0.04, "both moving")
        one.close()
        with cell.open("one.readonly") as reader:
            wait_for(lambda: not reader.read().in_motion[0], "whose client has gone at rest")
        assert two.read().in_motion[0], "and the other not"
        number = two.read().number
        time.sleep(0.3)
        assert two.read().number > number + 5, "it ticks on"
        cell.emergency_stop(why="test")
        wait_for(lambda: not two.read().in_motion[0], "stopped")
        with pytest.raises(PermissionError):
            two.write([command(0, velocity=0.05)])
        cell.reset()
        two.write([command(0, velocity=0.02)])
    before = pids(daemon)
    daemon.configure('[workcell]\nname = "t"\n' + table("two"))
    with daemon.cell("reloader") as cell:
        cell.reload()
    wait_for(lambda: set(pids(daemon)) == {"two"}, "one taken out")
    assert pids(daemon)["two"] == before["two"]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (table("one") + table("two").replace("= 50", "= 5"), "want the same"),
        (
            table("one") + '[device.s]\ndriver = "modbus-axis"\nmap = "leadshine"\nprocess = "light"\n'
            'line = { serial = "/dev/null", baud = 115200 }\n[[device.s.axis]]\nname = "x"\naddress = 1\n'
            "travel_per_turn = 0.01\nvelocity_max = 0.1\nacceleration_max = 1.0\n",
            "its driver has a line",
        ),
        (table("one").replace('"light"', '"li ght"'), "process"),
    ],
)
def test_what_cannot_share_a_process_is_told_at_the_check(text: str, error: str, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('[workcell]\nname = "t"\n' + text)
    command_line = [sys.executable, "-P", "-m", "sioms.daemon.main", "--config", str(tmp_path / "c.toml"), "--check"]
    done = subprocess.run(command_line, capture_output=True, text=True, timeout=60)
    assert done.returncode and error in done.stdout + done.stderr
