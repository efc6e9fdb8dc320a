"""The watch beside a running cell: it sees the moves, tells the cell's alarms, and keeps its state."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from conftest import Running
from daemon_rig import Daemon, axes

from sioms.documents import json_text
from sioms.reconcile.live.watch import about
from sioms.reconcile.watch.axis import AxisWatch, Drift
from sioms.reconcile.watch.causes import Finding
from sioms.reconcile.watch.keep import packed
from sioms.reconcile.watch.normal import TOTAL, Normal
from sioms.reconcile.watch.rows import SIZE

BEAM = '[[device.mod0.beam]]\nname = "beam0"\nboxes = [{ xaxis = [0.05, 0.10] }]\n'
CELL = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis") + BEAM
NODE, BITS = "mod0.xaxis", "mod0.beams"


def watch(daemon: Daemon, folder: Path, seconds: float) -> Running:
    command = [sys.executable, "-m", "sioms.reconcile", "watch", NODE, "--reference", f"{NODE}={BITS}", "--time",
               str(seconds), "--socket", daemon.socket, "--state", str(folder / "state.json"),
               "--out", str(folder / "report")]  # fmt: skip
    return Running(command, {"OPENBLAS_NUM_THREADS": "1"}, None)


def drifted(daemon: Daemon) -> AxisWatch:
    """Return a watch that has found more friction than there was."""
    with daemon.cell("rig") as cell:
        made = AxisWatch(about(cell.info(NODE)))
    theta = np.zeros(TOTAL)
    theta[:4] = 1.0, 2.0, 0.5, 0.0
    made.normal = Normal(theta, np.eye(TOTAL) * 1e-4, 0.01, 5.0, np.ones(SIZE), False, 1.0, 1.0, (), 0.0, 1e-9, 50, 0.0)
    change = np.zeros(TOTAL)
    change[2] = 1.5
    found = Finding(99.0, ("dry friction",), 1.5, 1.4, 1.6, change, "direction of motion", 0.3)
    made.drift = Drift(("dry friction",), found, 10.0, 20.0, False)
    return made


def test_a_drift_is_told_as_an_alarm_and_motion_is_seen(start_daemon: Callable[..., Daemon], tmp_path: Path) -> None:
    daemon = start_daemon(CELL)
    state = tmp_path / "state.json"
    state.write_text(json_text({"axes": {NODE: packed(drifted(daemon), 0.0)}}))
    run = watch(daemon, tmp_path, 6.0)
    with daemon.cell("mover") as cell, cell.open(NODE, "rw") as axis:
        run.wait_line("watching", 60.0)
        end = time.monotonic() + 4.0
        while time.monotonic() < end:
            for place in (0.2, 0.0):
                axis.move(place)
                axis.wait_until_idle(timeout=20.0)
        assert run.wait_exit(60.0) == 3, "\n".join(run.lines)
        (alarm,) = cell.alarms()
        assert (alarm["node"], alarm["what"], alarm["severity"]) == (NODE, "drift", 1)
        assert "dry friction has grown" in alarm["text"] and "+1.5 N, +1.4 to +1.6" in alarm["text"]
    told = json.loads((tmp_path / "report" / "watch.json").read_text())[NODE]
    assert told["cause"] == "dry friction" and told["motion_s"] > 0.5, "it saw the moves"
    assert "dry friction" in (tmp_path / "report" / "report.html").read_text()
    kept = json.loads(state.read_text())["axes"][NODE]
    assert kept["motion_s"] == told["motion_s"] and kept["gains"][0] > 0.0
    state.write_bytes(b'{"axes": {"mod0.xaxis": [')
    again = watch(daemon, tmp_path, 0.2)
    assert again.wait_exit(60.0) == 0 and any("learnt anew" in line for line in again.lines), again.lines
