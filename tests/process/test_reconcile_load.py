"""Reconcile a force/torque sensor behind the real daemon, loaded by axes, by a process that knows nothing of what it
hides.

What the simulated sensor hides is in a file that only its driver has read; the file is gone before the workflow begins.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Running
from daemon_rig import WORKFLOW_S, Daemon, at_rest, wait_for

from sioms.reconcile import command as reconcile

AXIS = """
[[device.press.axis]]
name = "{name}"
position_min = -0.005
position_max = 0.006
velocity_max = 0.2
acceleration_max = 10.0
jerk_max = 1000.0
force_max = 60.0
following_error_max = 0.02
bandwidth_hz = 60.0
motor = {{ mass = 0.5, viscous = 5.0, coulomb = 0.02, stiction = 0.025, encoder_step = 1e-7, stop_minus = -0.02, stop_plus = 0.02, wall = {{ position = 0.002, stiffness = 40000.0, damping = 40.0 }} }}
"""  # noqa: E501
SENSOR = """
[device.{name}]
driver = "sim-force"
history = 512
noise = [0.02, 0.02, 0.02, 0.0005, 0.0005, 0.0005]
limit = [100.0, 100.0, 200.0, 8.0, 8.0, 8.0]
{more}
[[device.{name}.contact]]
node = "press.plant.near_contact"
direction = [0, 0, 1]
point_m = [0.05, 0.0, 0.0]
[[device.{name}.contact]]
node = "press.plant.far_contact"
direction = [0, 0, 1]
point_m = [-0.05, 0.0, 0.0]
"""
MODEL = """[sensor]
name = "wrist"
components = ["fx", "fy", "fz", "tx", "ty", "tz"]
full_range = [100.0, 100.0, 200.0, 8.0, 8.0, 8.0]
"""
STAND = """
[[push]]
name = "near"
axis = "press.near"
reference = "press.plant.near_contact"
wrench = [0, 0, 1, 0, -0.05, 0]
most = 40.0
clear_m = 5e-4
[[push]]
name = "far"
axis = "press.far"
reference = "press.plant.far_contact"
wrench = [0, 0, 1, 0, 0.05, 0]
most = 40.0
clear_m = 5e-4
"""
TY, GAIN = 4, 0.06
NAMED, STOPPED = 0, 1


@pytest.fixture
def daemon(start_daemon: Callable[..., Daemon], tmp_path: Path) -> Daemon:
    """Two axes that press on a sensor which hides something, and a twin that knows the nominal model only."""
    hidden = tmp_path / "flaws.toml"
    hidden.write_text(f"gain = [0.0, 0.0, 0.0, 0.0, {GAIN}, 0.0]\n")
    head = '[workcell]\nname = "test"\n[device.press]\ndriver = "sim-axes"\nlate_max_s = 0.5\nhistory = 512\n'
    text = head + "".join(AXIS.format(name=n) for n in ("near", "far"))
    text += SENSOR.format(name="force0", more=f'flaws_file = "{hidden}"')
    text += SENSOR.format(name="twin", more='model_file = "twin.toml"')
    running = start_daemon(text, files={"twin.toml": MODEL})
    running.wait_up("force0")
    return running


def arguments(daemon: Daemon, folder: Path, *options: str, stand: str = STAND) -> list[str]:
    """Write the nominal model and the stand; return the words of the workflow's command."""
    for name, text in (("nominal.toml", MODEL), ("stand.toml", stand)):
        (folder / name).write_text(text)
    return ["force", "force0", "--model", str(folder / "nominal.toml"), "--stand", str(folder / "stand.toml"),
            "--socket", daemon.socket, "--out", str(folder / "report"), "--no-pictures", *options]  # fmt: skip


def workflow(daemon: Daemon, folder: Path, *options: str) -> Running:
    """Start the workflow as a user does."""
    command = [sys.executable, "-m", "sioms.reconcile", *arguments(daemon, folder, *options)]
    return Running(command, {"OPENBLAS_NUM_THREADS": "1"}, None)


def said(run: Running) -> str:
    """Return all that a process has printed."""
    return "\n".join(run.lines)


@pytest.mark.timeout(600)
def test_two_effects_that_confounder_are_told_apart_by_the_other_load_and_the_twin_takes_the_model(
    daemon: Daemon, tmp_path: Path
) -> None:
    """With one lever arm the torque is always in one proportion to the force: its gain passes for cross-talk from the
    force.
    """
    twin = daemon.folder / "twin.toml"
    run = workflow(daemon, tmp_path, "--yes", "--first", "one", "--install", str(twin))
    assert run.wait_exit(WORKFLOW_S) == NAMED, said(run)
    asked = next(line for line in run.lines if "not told apart" in line)
    assert "gain" in asked
    assert "cross_talk" in asked
    found = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert found["effects"] == ["gain"]
    gains = [found["parameters"]["gain"][f"g[{i}]"] for i in range(6)]
    assert gains[TY] == pytest.approx(GAIN, abs=3e-3)
    rows = np.genfromtxt(tmp_path / "report" / "records" / "loads.csv", delimiter=",", names=True)
    assert rows["load_fz"].max() < 1.1 * 40.0
    assert {np.sign(v) for v in rows["load_ty"][np.abs(rows["load_ty"]) > 0.5]} == {-1.0, 1.0}

    wait_for(lambda: daemon.device("twin")["state"] == "up", "the twin with its model")
    with daemon.cell() as session, session.open("press.near", "rw") as axis:
        assert session.info("twin").channels[0].description.startswith("model ")
        axis.move(0.0025)
        axis.wait_until_idle(timeout=10.0)
        torques = [pressed(session, node) for node in ("force0", "twin")]
        axis.move(0.0)
        axis.wait_until_idle(timeout=10.0)
    assert torques[1] == pytest.approx(torques[0], rel=5e-3)
    assert abs(torques[0]) > 0.5


def pressed(session: object, node: str) -> float:
    """Return the mean torque about y."""
    with session.open(node) as sensor:  # type: ignore[attr-defined]
        seen = sensor.read().number
        sensor.wait_new(seen + 200, 5.0)
        return float(np.mean([s.data[TY] for s in sensor.history(seen)]))


@pytest.mark.timeout(400)
def test_the_emergency_stop_ends_the_loading_and_nothing_resumes(daemon: Daemon, tmp_path: Path) -> None:
    run = workflow(daemon, tmp_path, "--yes")
    with daemon.cell() as session, session.open("press.near.readonly") as axis:
        run.wait_for(lambda: axis.read().position[0] > 0.0021, "the axis presses")
        session.emergency_stop(why="test")
        at_rest(axis)
        assert run.wait_exit(60.0) == STOPPED
        assert "stop" in said(run)
        where = axis.read().position[0]
        session.reset()
        wait_for(lambda: axis.read().number > 0, "a reading")
        assert axis.read().position[0] == pytest.approx(where, abs=1e-4)
    assert not (tmp_path / "report" / "verdict.json").exists()


def test_nothing_is_pressed_beyond_the_sensor(
    daemon: Daemon, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stand = STAND.replace("most = 40.0", "most = 400.0")
    assert reconcile.main(arguments(daemon, tmp_path, "--yes", stand=stand)) == 2
    assert "of full range" in capsys.readouterr().err
    with daemon.cell() as session:
        assert session.open("press.near.readonly").read().position[0] < 0.002
