"""A watch over a recording: it touches nothing of the axes of a running cell, which may have the same names."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from recording_rig import write

from sioms.documents import json_of
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.reconcile.command import watch

NAME = "mod0.xaxis"
LIMITS = {"velocity": 0.5, "acceleration": 5.0, "jerk": 100.0, "force": 50.0}


def recorded(folder: Path) -> Path:
    channel = ChannelInfo("xaxis", "m", -0.2, 0.2, limits=LIMITS).pack()
    axis = NodeInfo([NAME, int(NodeClass.AXIS), False, [channel], -1, 1000.0, 16, "dev", "sim-axes", 2])
    return write(folder / "day.mcap", nodes=[axis])


def arguments(folder: Path, *further: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    watch.add_parser(parser.add_subparsers())
    return parser.parse_args(["watch", "--recording", str(recorded(folder)), "--out", str(folder / "report"), *further])


def test_a_recording_leaves_the_state_of_the_running_cell_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("watch.json").write_text(kept := '{"axes": {"mod0.xaxis": {"version": 1}}}')
    assert watch.run(arguments(tmp_path), print) == watch.NORMAL
    assert Path("watch.json").read_text() == kept
    assert json_of((tmp_path / "report" / "watch.json").read_text())[NAME]["state"] == "learning"


def test_the_state_of_a_recording_is_kept_where_a_file_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert watch.run(arguments(tmp_path, "--state", "day.json"), print) == watch.NORMAL
    assert list(json_of(Path("day.json").read_text())["axes"]) == [NAME]
    assert not Path("watch.json").exists()
