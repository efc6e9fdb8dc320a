"""The recorder and the black box on a real daemon."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from daemon_rig import Daemon

import sioms
from sioms.recording.reader import Recording
from sioms.recording.story import tell


def test_a_killed_recorder_leaves_what_it_recorded_and_who_did_what(
    daemon: Daemon, cell: sioms.Workcell, tmp_path: Path
) -> None:
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-P", "-m", "sioms.tools.front", "record", "-v", "-o", str(path)]
    env = {**os.environ, "SIOMS_SOCKET": daemon.socket}
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as recorder:
        try:
            assert recorder.stdout is not None
            assert "none lost" in recorder.stdout.readline()
            cell.emergency_stop_workcell("a test")
            cell.reset()
            recorder.stdout.readline()
        finally:
            recorder.send_signal(signal.SIGKILL)
    with Recording(path) as recording:
        assert not recording.is_packed and recording.nodes
        numbers = {name: np.concatenate(list(recording.slots(name)))[:, 0] for name in recording.nodes}
        assert all((np.diff(each.astype(int)) == 1).all() for each in numbers.values())
        story = tell(recording.events())
        assert story.cause == "stop" and "tester" in " ".join(
            str(event.data) + event.who for event in story.events if event.kind in ("log", "request")
        )


def test_the_death_of_a_driver_is_told_from_the_black_box(daemon: Daemon, cell: sioms.Workcell, tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "sioms.tools.front", "blackbox", "--keep", "-d", str(tmp_path)]
    env = {**os.environ, "SIOMS_SOCKET": daemon.socket}
    with subprocess.Popen(command, env=env) as keeper:
        try:
            deadline = time.monotonic() + 20
            while not (tmp_path / "keeper.pid").exists() and time.monotonic() < deadline:
                time.sleep(0.02)
            device = cell.status()["devices"][0]
            os.kill(device["pid"], signal.SIGKILL)
            while not list(tmp_path.glob("*.mcap")) and time.monotonic() < deadline:
                time.sleep(0.02)
        finally:
            keeper.terminate()
    (box,) = tmp_path.glob("*.mcap")
    with Recording(box) as recording:
        story = tell(recording.events())
    assert story.cause == "death" and f"driver of {device['name']} has died" in story.text
