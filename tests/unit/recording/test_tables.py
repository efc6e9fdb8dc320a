"""Recordings as tables: exported, and as reconcile and tactile take them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recording_rig import info, slots, write

from sioms.protocol.flags import NodeClass
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.table import load_table
from sioms.recording.reader import Recording
from sioms.recording.tables import columns_of, export
from sioms.tactile.files import read_recording

AXIS = info("mod0.xaxis", NodeClass.AXIS, ["m"])
FINGER = info("finger", NodeClass.ANALOG, [""] * 4)


def test_a_table_is_exported(tmp_path: Path) -> None:
    with Recording(write(tmp_path / "a.mcap", 30)) as recording:
        columns = columns_of(recording, "mod0", ["position", "force"])
    assert list(columns)[:4] == ["time [s]", "number", "a position [m]", "a force [N]"]
    assert list(columns)[-1] == "c force [N m]"
    export(columns, tmp_path / "a.csv")
    export(columns, tmp_path / "a.npz")
    csv = np.genfromtxt(tmp_path / "a.csv", delimiter=",", skip_header=1)
    npz = np.load(tmp_path / "a.npz")
    assert csv.shape == (30, 8) and np.array_equal(npz["a position [m]"], csv[:, 2])
    with pytest.raises(OSError, match=r"\.csv, \.npz, \.parquet"):
        export(columns, tmp_path / "a.xls")


def test_reconcile_takes_a_recording_of_an_axis(tmp_path: Path) -> None:
    table = load_table(write(tmp_path / "a.mcap", 50, nodes=[AXIS, FINGER]))
    assert {"time [s]", "position [m]", "velocity [m/s]", "force [N]", "command [m]"} <= table.columns.keys()
    assert table.units["position [m]"] == "m"
    assert np.array_equal(table.columns["position [m]"], slots(AXIS, 1, 50)[:, 4].copy().view("<f8"))
    with pytest.raises(BadInputError, match="sioms log cut"):
        load_table(write(tmp_path / "b.mcap", 50, nodes=[AXIS, info("mod1", NodeClass.AXIS, ["m"])]))
    whole = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[:5000] + bytes(500) + whole[5500:])
    with pytest.raises(BadInputError, match="lost"):
        load_table(tmp_path / "a.mcap")


def test_tactile_takes_a_recording_with_its_touches(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 100, nodes=[FINGER])
    assert (read_recording(path).touch == -1).all()
    (tmp_path / "a.touches.csv").write_text(
        "base_s,start_s,end_s,cmd_theta,cmd_P,cmd_rc\n0.0,0.01,0.03,10,100,0\n0.05,0.06,0.08,20,50,3\n"
    )
    recording = read_recording(path)
    assert recording.raw.shape == (100, 4) and recording.raw[3, 1] == 4 + 1 / 64
    assert recording.touch[[5, 20, 40, 55, 70]].tolist() == [0, 0, -1, 1, 1]
    assert recording.phase[[5, 20, 40, 55, 70]].tolist() == [0, 1, 2, 0, 1]
