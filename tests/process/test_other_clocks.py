"""Clients on a machine that was started at another time than the cell's: what they record and tell has its UTC."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_rig import Daemon
from elsewhere import AHEAD_S, elsewhere, why_not

import sioms
from sioms.check.remote import Gateway
from sioms.client.keys import VARIABLE
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder
from sioms.recording.reader import Recording

pytestmark = pytest.mark.skipif(bool(why_not()), reason=f"other clocks: {why_not()}")
AGREES_S = 0.05
"""How far apart two clocks may be told to be on a busy machine [s]; the fault was a hundred thousand seconds."""


def sioms_there(gate: Gateway, *words: str) -> subprocess.CompletedProcess[str]:
    command = elsewhere([sys.executable, "-P", "-m", "sioms.tools.front", *words])
    env = {**os.environ, "SIOMS_CELL": gate.socket, VARIABLE: gate.own.path}
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60)
    assert not done.returncode, done.stderr
    return done


def times(recording: Recording, node: str) -> dict[int, float]:
    """Return the UTC of snapshots by their numbers [s]."""
    table = recording.table(node, ["position"])
    return dict(zip(table.numbers.tolist(), ((table.stamps_ns + recording.offset_ns) / 1e9).tolist(), strict=True))


def test_a_recording_of_a_cell_on_another_machine_has_its_utc(
    daemon: Daemon, cell: sioms.Workcell, tmp_path: Path
) -> None:
    there, here, part, table = (tmp_path / name for name in ("there.mcap", "here.mcap", "part.mcap", "part.csv"))
    with Gateway(daemon.socket) as gate:
        ours = Recorder(LiveFile(str(here)), lambda: daemon.cell("recorder"), ["mod0"])
        began_s = time.time()
        command = [sys.executable, "-P", "-m", "sioms.tools.front", "record", "mod0", "-t", "0.5", "-o", str(there)]
        env = {**os.environ, "SIOMS_CELL": gate.socket, VARIABLE: gate.own.path}
        with subprocess.Popen(elsewhere(command), env=env) as theirs:
            ours.run(lambda: theirs.poll() is not None)
        ours.close()
        ended_s = time.time()
        cell.emergency_stop_workcell("a test")
        status = json.loads(sioms_there(gate, "status", "--json").stdout)
        assert 0 <= (status["now_ns"] - status["stopped_ns"]) / 1e9 < ended_s - began_s + 10
        cell.reset()
    with Recording(there) as far, Recording(here) as near:
        assert abs(far.offset_ns - near.offset_ns) < AGREES_S * 1e9
        a, b = times(far, "mod0"), times(near, "mod0")
        assert len(a.keys() & b.keys()) > 50
        assert max(abs(a[number] - b[number]) for number in a.keys() & b.keys()) < AGREES_S
        assert abs(near.offset_ns - (time.time_ns() - time.monotonic_ns())) < AGREES_S * 1e9
        assert began_s < max(a.values()) < ended_s + AGREES_S, "the first are what the page still had"
        told = [event for event in far.events() if event.source == "recorder"]
        assert told, "what the recorder says of itself, too"
        for event in told:
            assert began_s - AGREES_S < (event.stamp_ns + far.offset_ns) / 1e9 < ended_s + AGREES_S, event
        whole = far.table("mod0", ["position"])
    assert abs(whole.stamps_ns[0] / 1e9 - time.monotonic()) < AHEAD_S / 2, "stamps are the cell's"
    _cut(there, part, table, whole.stamps_ns)


def _cut(path: Path, part: Path, table: Path, stamps_ns: Any) -> None:
    """A cut by time takes what was recorded then, and a table of it tells when."""
    from sioms.tools.front import main

    assert main(["log", "cut", str(path), "--from", "0.1", "--to", "0.3", "-o", str(part)]) == 0
    assert main(["log", "export", str(part), "mod0", "-c", "position", "-o", str(table)]) == 0
    rows = np.loadtxt(table, delimiter=",", skiprows=1)
    first_s = stamps_ns[0] / 1e9
    assert len(rows) > 50 and first_s <= rows[0, 0] and rows[-1, 0] < first_s + 0.35
