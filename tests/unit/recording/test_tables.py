"""Recordings as tables: exported, and as reconcile and tactile take them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_rig import NODES, OFFSET_NS, info, slots, write

from sioms.protocol.flags import NodeClass
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.table import load_table
from sioms.recording.export import export
from sioms.recording.reader import Recording
from sioms.recording.tables import columns_of, of_events
from sioms.tactile.files import read_recording
from sioms.tools.front import main

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


def test_a_table_in_parquet_has_units_utc_and_every_bit(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    path = tmp_path / "a.parquet"
    assert main(["log", "export", str(write(tmp_path / "a.mcap", 30)), "mod0", "-o", str(path)]) == 0
    table = parquet.read_table(path)
    raw = slots(NODES[0], 1, 30)
    assert str(table.schema.field("utc").type) == "timestamp[ns, tz=UTC]"
    assert table["utc"].cast("int64").to_pylist() == (raw[:, 1].astype(np.int64) + OFFSET_NS).tolist()
    assert table["number"].to_pylist() == list(range(1, 31))
    assert np.array_equal(table["a position [m]"].to_numpy(), raw[:, 4].copy().view("<f8"))
    assert (
        table["c in_motion"].type == "int64" and table.schema.field("c velocity [rad/s]").metadata[b"unit"] == b"rad/s"
    )
    about = json.loads(table.schema.metadata[b"sioms"])
    assert (about["node"], about["class"], about["workcell"]) == ("mod0", "axis", "test")


@pytest.mark.parametrize("ending", [".csv", ".npz", ".parquet"])
def test_what_happened_is_a_table(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"e{ending}"
    assert main(["log", "export", "--events", str(write(tmp_path / "a.mcap", 30)), "-o", str(path)]) == 0
    rows: Any
    if ending == ".csv":
        with open(path, encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    elif ending == ".npz":
        loaded = np.load(path)
        rows = [{name: loaded[name][i] for name in loaded.files} for i in range(5)]
    else:
        rows = pytest.importorskip("pyarrow.parquet").read_table(path).to_pylist()
    assert [float(row["time [s]"]) for row in rows] == pytest.approx([5.0, 5.01, 5.02, 5.03, 5.04])
    assert {(row["who"], row["kind"], row["text"]) for row in rows} == {("eva", "command", "Größe")}
    assert json.loads(rows[2]["data"]) == {"i": 2} and bytes.fromhex(str(rows[2]["raw"])) == b"rawraw"
    assert of_events([])["time [s]"].shape == (0,)


def test_an_export_of_several_nodes_asks_which(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path / "a.mcap", 5)
    assert main(["log", "export", str(path), "-o", str(tmp_path / "a.csv")]) == 1
    assert "name one of its nodes, or --events; there are: mod0, force0, io0.in" in capsys.readouterr().err
    assert main(["log", "export", str(path), "mod0", "-o", str(tmp_path / "a.xls")]) == 1
    assert "want a name that ends in .csv" in capsys.readouterr().err
    one = write(tmp_path / "b.mcap", 5, nodes=[AXIS])
    assert main(["log", "export", str(one), "-o", str(tmp_path / "b.csv")]) == 0


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
