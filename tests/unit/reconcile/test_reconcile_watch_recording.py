"""The watch over a recording: what is whole is judged, what is lost is told and changes the exit status."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_rig import write

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.reconcile.command import main

CHANNEL = ChannelInfo("x", "m", 0.0, 1.0, limits={"force": 20.0, "velocity": 0.5})
NODE = NodeInfo(["x", int(NodeClass.AXIS), False, [CHANNEL.pack()], -1, 1000.0, 16, "dev", "sim-axes", 2])


@pytest.mark.parametrize("cut", [0, 1, 700])
def test_a_cut_recording_is_no_normal_one(tmp_path: Path, capsys: pytest.CaptureFixture[str], cut: int) -> None:
    path = write(tmp_path / "day.mcap", 300, nodes=[NODE])
    path.write_bytes(path.read_bytes()[: path.stat().st_size - cut])
    status = main(["watch", "--recording", str(path), "--out", str(tmp_path / "report")])
    told = capsys.readouterr().err
    assert (tmp_path / "report" / "report.html").exists(), told
    assert status == (1 if cut else 0)
    assert told.count("are lost, to the end of the file") == (1 if cut else 0), told
