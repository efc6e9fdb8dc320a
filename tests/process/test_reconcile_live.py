"""Reconcile an axis behind the real daemon, whose driver has been given effects in a file that only it reads.

The workflow is a process of its own that knows the socket, the node and the nominal model.
"""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Running
from daemon_rig import WORKFLOW_S, Daemon, at_rest, wait_for

from sioms.reconcile import command as reconcile

AXIS = """
[[device.{device}.axis]]
name = "xaxis"
position_min = -0.2
position_max = 0.2
velocity_max = 0.5
acceleration_max = 6.0
jerk_max = 300.0
force_max = 60.0
following_error_max = 0.02
motor = {{ mass = 2.0, viscous = 4.0, encoder_step = 1e-6 }}
{more}
"""
MODEL = """[axis]
name = "xaxis"
kind = "linear"
sample_time_s = 0.002
inertia = 2.0
viscous = 4.0
resolution = 1e-6
pitch = 0.02
rated_force = 30.0
max_speed = 0.5
"""
ARM = """
[[device.mod0.axis]]
name = "arm"
unit = "rad"
position_min = -2.0
position_max = 2.0
velocity_max = 2.5
acceleration_max = 60.0
jerk_max = 6000.0
force_max = 2.0
following_error_max = 0.2
motor = { mass = 2e-3, viscous = 2e-3, encoder_step = 1e-4 }
"""
ARM_MODEL = """[axis]
name = "arm"
kind = "rotary"
sample_time_s = 0.002
inertia = 2e-3
viscous = 2e-3
resolution = 1e-4
pitch = 6.283185307179586
rated_force = 1.0
max_speed = 2.5
"""
WEIGHT = 0.2
HEAD = '\n[device.{device}]\ndriver = "sim-axes"\ntick_hz = 500\nlate_max_s = 0.5\nhistory = 4096\n{more}\n'
LEVEL = 3.0
STOPPED, NAMED = 1, 0


def cell(hidden: Path) -> str:
    real = HEAD.format(device="mod0", more=f'effects_file = "{hidden}"') + AXIS.format(device="mod0", more="")
    twin = HEAD.format(device="twin", more="") + AXIS.format(device="twin", more='model_file = "twin.toml"')
    return '[workcell]\nname = "test"\n' + real + twin


@pytest.fixture
def daemon(start_daemon: Callable[..., Daemon], tmp_path: Path) -> Iterator[Daemon]:
    """A daemon with an axis that hides something, and a twin that knows the nominal model only."""
    vault = tmp_path / "vault"
    vault.mkdir(mode=0o700)
    hidden = vault / "effects.toml"
    hidden.write_text(f"[xaxis]\ncoulomb = {{ level = {LEVEL} }}\n")
    hidden.chmod(0o600)
    yield start_daemon(cell(hidden), files={"twin.toml": MODEL})


def arguments(daemon: Daemon, folder: Path, *options: str, node: str = "mod0.xaxis", model: str = MODEL) -> list[str]:
    """Write the nominal model; return the words of the workflow's command."""
    file = folder / "nominal.toml"
    file.write_text(model)
    return ["axis", node, "--model", str(file), "--socket", daemon.socket,
            "--out", str(folder / "report"), "--no-pictures", *options]  # fmt: skip


def workflow(daemon: Daemon, folder: Path, *options: str, **what: str) -> Running:
    """Start the workflow as a user does."""
    command = [sys.executable, "-m", "sioms.reconcile", *arguments(daemon, folder, *options, **what)]
    return Running(command, {"OPENBLAS_NUM_THREADS": "1"}, None)


def said(run: Running) -> str:
    """Return all that a process has printed."""
    return "\n".join(run.lines)


@pytest.mark.timeout(600)
def test_a_hidden_friction_is_named_and_the_twin_takes_the_model(daemon: Daemon, tmp_path: Path) -> None:
    """The workflow moves the axis by itself; if one speed does not tell frictions apart, by a second experiment."""
    twin_file = daemon.folder / "twin.toml"
    options = ("--yes", "--first", "one_speed", "--lap", "2", "--install", str(twin_file))
    run = workflow(daemon, tmp_path, *options)
    assert run.wait_exit(WORKFLOW_S) == NAMED, said(run)
    found = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert found["effects"] == ["coulomb"]
    friction = found["parameters"]["coulomb"]["Fc"]
    assert friction == pytest.approx(LEVEL, rel=0.05)
    records = sorted(p.name for p in (tmp_path / "report" / "records").glob("*.csv"))
    assert any(name.startswith("one_speed") for name in records)
    for name in records:  # the axis stayed well within its limits
        positions = [
            float(line.split(",")[1]) for line in (tmp_path / "report" / "records" / name).read_text().splitlines()[1:]
        ]
        assert max(map(abs, positions)) < 0.19

    assert "[effects.coulomb]" in twin_file.read_text()
    wait_for(lambda: daemon.device("twin")["state"] == "up", "the twin with its model")
    with daemon.cell() as session:
        plant = session.info("twin.plant").channels[0].description
        assert re.search(r"model [0-9a-f]{8}", plant)
        forces = [cruising(session, node) for node in ("mod0.xaxis", "twin.xaxis")]
    assert forces[0] == pytest.approx(LEVEL + 4.0 * 0.05, rel=0.1)
    assert forces[1] == pytest.approx(forces[0], rel=0.06)


def cruising(session: object, node: str) -> float:
    """Return the mean force of an axis at 0.05 m/s."""
    with session.open(node, "rw") as axis:  # type: ignore[attr-defined]
        axis.move(-0.1)
        axis.wait_until_idle(timeout=10.0)
        axis.move(0.1, max_velocity=0.05, max_acceleration=2.0)
        last, forces = axis.read().number, []
        while len(forces) < 500:
            snapshot = axis.wait_new(last, timeout=2.0)
            last = snapshot.number
            if abs(snapshot.commanded_velocity[0] - 0.05) < 1e-9 and snapshot.position[0] > -0.09:
                forces.append(snapshot.force[0])
        return sum(forces) / len(forces)


@pytest.mark.timeout(600)
def test_two_effects_that_confounder_are_told_apart_by_the_experiment_it_designs(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    """An arm that moves little about the horizontal feels its weight as a constant force; a long way decides."""
    hidden = tmp_path / "arm.toml"
    hidden.write_text(f"[arm]\ngravity = {{ amplitude = {WEIGHT}, phase = {math.pi / 2} }}\n")
    hidden.chmod(0o600)
    head = HEAD.format(device="mod0", more=f'effects_file = "{hidden}"')
    daemon = start_daemon('[workcell]\nname = "test"\n' + head + ARM)
    run = workflow(daemon, tmp_path, "--yes", "--first", "one_speed", "--lap", "2", node="mod0.arm", model=ARM_MODEL)
    assert run.wait_exit(WORKFLOW_S) == NAMED, said(run)
    asked = next(line for line in run.lines if "not told apart" in line)
    assert "gravity" in asked
    assert "offset" in asked
    found = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert found["effects"] == ["gravity"]
    assert found["parameters"]["gravity"]["amp"] == pytest.approx(WEIGHT, rel=0.03)
    assert found["parameters"]["gravity"]["phase"] == pytest.approx(-math.pi / 2, abs=0.03)
    assert "offset" in {**found["details"][0]["ruled_out"]}
    records = {p.stem for p in (tmp_path / "report" / "records").glob("*.csv")}
    assert any(name.startswith("one_speed") for name in records)
    assert any(name.startswith("separate_") for name in records)


@pytest.mark.timeout(400)
def test_the_emergency_stop_ends_an_experiment_and_nothing_resumes(daemon: Daemon, tmp_path: Path) -> None:
    run = workflow(daemon, tmp_path, "--yes")
    with daemon.cell() as session, session.open("mod0.xaxis.readonly") as axis:
        run.wait_for(lambda: abs(axis.read().velocity[0]) > 1e-3, "the experiment moves the axis")
        session.emergency_stop(why="test")
        at_rest(axis)
        assert run.wait_exit(60.0) == STOPPED
        assert "stop" in said(run)
        where = axis.read().position[0]
        session.reset()
        wait_for(lambda: axis.read().number > 0, "a reading")
        assert axis.read().position[0] == pytest.approx(where, abs=1e-4)
        assert axis.read().buffered[0] == 0
    assert not (tmp_path / "report").exists()


@pytest.mark.timeout(400)
def test_an_interrupted_experiment_leaves_the_axis_halted_and_free(daemon: Daemon, tmp_path: Path) -> None:
    run = workflow(daemon, tmp_path, "--yes")
    with daemon.cell() as session, session.open("mod0.xaxis.readonly") as axis:
        run.wait_for(lambda: abs(axis.read().velocity[0]) > 1e-3, "the experiment moves the axis")
        os.kill(run.process.pid, signal.SIGINT)
        assert run.wait_exit(60.0) == STOPPED
        at_rest(axis)
        assert axis.read().buffered[0] == 0
        with session.open("mod0.xaxis", "rw"):
            pass


@pytest.mark.parametrize(
    ("words", "options", "model"),
    [
        ("--yes", (), MODEL),
        ("it is in m, the model in rad", ("--yes",), MODEL.replace("linear", "rotary")),
    ],
)
def test_nothing_moves_without_consent_and_a_node_of_another_kind_is_refused(
    daemon: Daemon,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: str,
    options: tuple[str, ...],
    model: str,
) -> None:
    assert reconcile.main(arguments(daemon, tmp_path, *options, model=model)) == 2
    assert words in capsys.readouterr().err
    with daemon.cell() as session:
        assert session.open("mod0.xaxis.readonly").read().position[0] == 0.0
