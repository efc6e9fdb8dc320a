"""Reconcile a finger behind its serial stream, probed through the real daemon, by a process that knows nothing of what
it hides.

What the simulated finger hides is in a file that only it has read; the file is gone before the workflow begins.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Running
from daemon_rig import WORKFLOW_S, at_rest, wait_for

import sioms
from sioms.drivers.framed_adc.simulated.finger import shape_of
from sioms.plant.finger import scattered
from sioms.protocol.flags import Request
from sioms.reconcile import command as reconcile
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.finger import from_toml, nominal_finger, to_toml
from sioms.tactile.live.simulated import simulated

CONFIG = Path(__file__).parents[2] / "etc" / "prober.toml"
ELEMENTS = 4
"""Of a short finger: half a minute of touches."""
ANGLES = np.radians(90.0 - 9.22 * np.arange(ELEMENTS))
PUBLIC = f"gain = 3.0; length_m = 0.012; angles_rad = {ANGLES.tolist()}"
HIDDEN = "gain_scatter = 0.12\nseed = 5\n"
SHAPE = """
[device.tactile0.shape]
finger_file = "finger.toml"
load_node = "force0.fz"
load_scale = 83.333
compiled = true
"""
MODEL = f"""[finger]
name = "left"
core_m = 0.0096
outer_m = 0.0127
shear_modulus_pa = 83000.0
poisson = 0.46
angle_rad = {ANGLES.tolist()}
radius_m = 0.0103
gain = 3.0
"""
SURFACE_M, MOST = 0.010, 100.0  # [m, N/m]
NAMED, STOPPED = 0, 1


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A prober with a finger that hides something; gives its folder."""
    folder = tmp_path_factory.mktemp("t")
    (folder / "finger.toml").write_text(to_toml(nominal_finger(FINGER_B, ANGLES, 10.3e-3, 3.0, 5.3e-4)))
    hidden = folder / "hidden.toml"
    hidden.write_text(HIDDEN)
    with simulated(
        folder,
        PUBLIC,
        (0.0,),
        CONFIG.read_text().replace("channels = 16", f"channels = {ELEMENTS}") + SHAPE,
        hidden,
    ):
        hidden.unlink()
        yield folder


def arguments(cell: Path, folder: Path, *options: str) -> list[str]:
    """Write the nominal model; return the words of the workflow's command."""
    model = folder / "nominal.toml"
    model.write_text(MODEL)
    return ["tactile", "tactile0", "--model", str(model), "--socket", str(cell / "prober.sock"),
            "--out", str(folder / "report"), "--no-pictures", *options]  # fmt: skip


def workflow(cell: Path, folder: Path, *options: str) -> Running:
    """Start the workflow as a user does."""
    command = [sys.executable, "-m", "sioms.reconcile", *arguments(cell, folder, *options)]
    return Running(command, {"OPENBLAS_NUM_THREADS": "1"}, None)


def said(run: Running) -> str:
    """Return all that a process has printed."""
    return "\n".join(run.lines)


@pytest.mark.timeout(600)
def test_hidden_gains_are_named_and_the_driver_loads_the_finger(cell: Path, tmp_path: Path) -> None:
    """Light touches: the finger's own error, 0.3 % of its peak, stays below the noise, which moves a gain by 0.005."""
    file = cell / "finger.toml"
    run = workflow(cell, tmp_path, "--yes", "--load", "80", "--most-load", str(MOST), "--install", str(file))
    assert run.wait_exit(WORKFLOW_S) == NAMED, said(run)
    found = json.loads((tmp_path / "report" / "verdict.json").read_text())
    assert found["effects"] == ["gain_scatter"]
    true = scattered(shape_of(PUBLIC, HIDDEN)).gains / 3.0 - 1.0
    given = [found["parameters"]["gain_scatter"][f"g[{i}]"] for i in range(ELEMENTS)]
    assert np.allclose(given, true, atol=0.03)
    records = {p.name: np.load(p) for p in (tmp_path / "report" / "records").glob("*.npz")}
    assert set(records) == {"noise.npz", "places_0mm.npz", "loads_0mm.npz"}
    for name in set(records) - {"noise.npz"}:
        assert 0.5 * MOST < records[name]["force"].max() < 1.25 * MOST

    installed = from_toml(file.read_text())
    assert np.allclose(np.array(installed.elements.gain) / 3.0 - 1.0, given, atol=1e-6)
    with (
        sioms.Workcell(str(cell / "prober.sock"), "test") as session,
        session.open("tactile0.strain") as strain,
    ):
        gains = np.reshape(strain.ioctl(Request.GET_GAINS), (ELEMENTS, ELEMENTS))
    assert np.allclose(np.diag(gains), installed.elements.gain)


@pytest.mark.timeout(400)
def test_the_emergency_stop_ends_the_probing_and_nothing_resumes(cell: Path, tmp_path: Path) -> None:
    run = workflow(cell, tmp_path, "--yes")
    with sioms.Workcell(str(cell / "prober.sock"), "test") as session:
        with session.open("prober.radial.readonly") as axis:
            run.wait_for(lambda: axis.read().position[0] > SURFACE_M, "the indenter on the finger")
            session.emergency_stop(why="test")
            at_rest(axis)
            assert run.wait_exit(60.0) == STOPPED
            assert "emergency stop" in said(run)
            where = axis.read().position[0]
            session.reset()
            wait_for(lambda: axis.read().number > 0, "a reading")
            assert axis.read().position[0] == pytest.approx(where, abs=1e-4)
        with session.open("prober.radial", "rw") as axis:
            axis.move(0.0)
            axis.wait_until_idle(timeout=10.0)
    assert not (tmp_path / "report" / "verdict.json").exists()


@pytest.mark.timeout(700)
def test_an_interrupted_probing_leaves_the_indenter_clear_at_rest_and_free(cell: Path, tmp_path: Path) -> None:
    run = workflow(cell, tmp_path, "--yes")
    with sioms.Workcell(str(cell / "prober.sock"), "test") as session:
        with session.open("prober.radial.readonly") as axis:
            run.wait_for(lambda: axis.read().position[0] > SURFACE_M + 2e-4, "the indenter in the finger")
            run.wait_for(lambda: axis.read().position[0] < SURFACE_M, "the first touch felt")
            run.wait_for(lambda: axis.read().position[0] > SURFACE_M + 2e-4, "the indenter in the finger")
            os.kill(run.process.pid, signal.SIGINT)
            assert run.wait_exit(60.0) == STOPPED
            at_rest(axis)
            assert axis.read().position[0] < SURFACE_M - 1e-3
        with session.open("prober.radial", "rw"):
            pass


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("--yes", ()),
        ("400 N/m", ("--yes", "--load", "400")),
        ("no single axis in rad", ("--yes", "--place", "prober.radial")),
    ],
)
def test_without_consent_or_with_wrong_nodes_nothing_is_pressed(
    cell: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, options: tuple[str, ...]
) -> None:
    assert reconcile.main(arguments(cell, tmp_path, *options)) == 2
    assert words in capsys.readouterr().err
    with sioms.Workcell(str(cell / "prober.sock"), "test") as session:
        assert session.open("prober.radial.readonly").read().position[0] < SURFACE_M
