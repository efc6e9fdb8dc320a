"""The black box: something goes wrong, and what ``sioms blackbox`` names as the cause is compared with what was done.

Each trial has a keeper and a folder of its own, because a keeper writes at most one box in ten seconds.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from sioms.check.daemon import Daemon, wait_for
from sioms.children import ends_with_us
from sioms.client.command import command
from sioms.protocol.flags import AxisStatus
from sioms.recording.reader import Recording
from sioms.recording.story import Story, tell

from .figures import Bar, Report
from .options import Options
from .workcells import axes, workcell

WALL = "encoder_step = 1e-6, wall = { position = 0.01, stiffness = 1e6, damping = 100.0 }"
WRITTEN_S = 30.0
"""How long a box may take to be written on a busy machine [s]; two of them it waits for what follows."""


class _Scene:
    """Two devices, of which axis a0 of mod1 has a wall before it."""

    def __init__(self, daemon: Daemon, dice: random.Random) -> None:
        self.daemon, self.dice = daemon, dice
        self.cell = daemon.cell("bench")

    def ready(self) -> None:
        """Wait until everything is up, at rest, and stopped no more."""
        if self.daemon.process.poll() is not None:
            self.daemon.start()
            self.cell = self.daemon.cell("bench")
        cell = self.cell

        def is_up() -> bool:
            with contextlib.suppress(OSError):
                cell.reset()
            return all(device["state"] == "up" for device in cell.status()["devices"])

        wait_for(is_up, 60.0, "all devices to be up")
        if self.dice.random() < 0.5:
            self._go("mod0")

    def _go(self, device: str) -> None:
        """Leave an axis in motion, held by this session."""
        with contextlib.suppress(OSError):
            node = self.cell.open(f"{device}.a1", "rw", 1.0)
            node.write(command(0, velocity=0.01, time=0.2))


Act = Callable[[_Scene], tuple[str, ...]]


def _driver_killed(scene: _Scene) -> tuple[str, ...]:
    device = scene.dice.choice(("mod0", "mod1"))
    os.kill(scene.daemon.device_pids()[device], signal.SIGKILL)
    return "death", f"the driver of {device} has died"


def _driver_hung(scene: _Scene) -> tuple[str, ...]:
    device = scene.dice.choice(("mod0", "mod1"))
    pid = scene.daemon.device_pids()[device]
    os.kill(pid, signal.SIGSTOP)
    time.sleep(1.6)
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)
    return "death", f"the driver of {device} "


def _daemon_killed(scene: _Scene) -> tuple[str, ...]:
    os.kill(scene.daemon.pid, signal.SIGKILL)
    scene.daemon.process.wait()
    return "death", "daemon"


def _stopped(scene: _Scene) -> tuple[str, ...]:
    why = f"trial {scene.dice.getrandbits(32)}"
    scene.cell.emergency_stop_workcell(why)
    return "stop", why


def _node_stopped(scene: _Scene) -> tuple[str, ...]:
    device = scene.dice.choice(("mod0", "mod1"))
    with scene.cell.open(f"{device}.readonly") as node:
        node.emergency_stop()
    return "stop", device


def _in_fault(scene: _Scene) -> tuple[str, ...]:
    with scene.cell.open("mod1.a0", "rw", 1.0) as axis:
        axis.write(command(0, velocity=0.1), replace=True)
        wait_for(lambda: bool(axis.read().status[0] & AxisStatus.FAULT), 10.0, "a following error")
    return "fault", "mod1", "a0", "following error"


def _in_fault_then_stopped(scene: _Scene) -> tuple[str, ...]:
    told = _in_fault(scene)
    scene.cell.emergency_stop_workcell("because of it")
    return told


def _killed_then_stopped(scene: _Scene) -> tuple[str, ...]:
    told = _driver_killed(scene)
    scene.cell.emergency_stop_workcell("because of it")
    return told


ACTS: dict[str, Act] = {
    "driver killed": _driver_killed, "driver hung": _driver_hung, "daemon killed": _daemon_killed,
    "workcell stopped": _stopped, "node stopped": _node_stopped, "fault": _in_fault,
    "fault, then a stop": _in_fault_then_stopped, "driver killed, then a stop": _killed_then_stopped,
}  # fmt: skip


def bench_blackbox(options: Options, report: Report) -> None:
    """Have things go wrong in turn, and count the causes that are named rightly."""
    wall = axes("mod1", 2, limits=False, axis_keys="following_error_max = 0.004").replace("encoder_step = 1e-6", WALL)
    right = dict.fromkeys(ACTS, 0)
    tried = dict.fromkeys(ACTS, 0)
    with Daemon(workcell([axes("mod0", 2, limits=False), wall])) as daemon:
        scene, trials = _Scene(daemon, random.Random(options.seed)), options.kills(8, 100)
        try:
            for trial in range(trials):
                what = list(ACTS)[trial % len(ACTS)]
                right[what] += _is_right(scene, what, report)
                tried[what] += 1
                report.progress(f"black box: {trial} of {trials}")
        finally:
            for what in filter(tried.__getitem__, ACTS):
                wrong, notes = tried[what] - right[what], f"of {tried[what]}"
                report.value(f"causes not named rightly: {what}", wrong, bars=[Bar("value", 0)], notes=notes)


def _is_right(scene: _Scene, what: str, report: Report) -> bool:
    (cause, *words), story = _trial(scene, ACTS[what])
    if story is not None and story.cause == cause and all(word in story.text for word in words):
        return True
    told = f"{story.cause}: {story.text}" if story else "no box was written"
    report.note(f"{what}: {told}; want {cause} with {', '.join(words)}"[:400])
    return False


def _trial(scene: _Scene, act: Act) -> tuple[tuple[str, ...], Story | None]:
    """Let something go wrong while a keeper is at work; return what is to be named, and the story of its box."""
    scene.ready()
    with tempfile.TemporaryDirectory(prefix="sioms-boxes-") as folder:
        words = [sys.executable, "-P", "-m", "sioms.tools.front", "blackbox", "--keep", "-d", folder]
        environment = {**os.environ, "SIOMS_SOCKET": scene.daemon.socket}
        with subprocess.Popen(words, env=environment, preexec_fn=ends_with_us()) as keeper:
            try:
                wait_for(lambda: (Path(folder) / "keeper.pid").exists(), WRITTEN_S, "a keeper")
                time.sleep(0.3 + 0.3 * scene.dice.random())
                expected = act(scene)
                with contextlib.suppress(TimeoutError):
                    wait_for(lambda: bool(list(Path(folder).glob("*.mcap"))), WRITTEN_S, "a box")
            finally:
                keeper.terminate()
        boxes = sorted(Path(folder).glob("*.mcap"))
        return expected, _told(boxes[0]) if boxes else None


def _told(box: Path) -> Story:
    with Recording(str(box)) as recording:
        return tell(recording.events())
