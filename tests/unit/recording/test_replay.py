"""A recording is served as it was published, and nobody can write to it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from recording_rig import NODES, slots, write

import sioms
from sioms.recording.live.replay import Replay
from sioms.recording.live.taps import PageTap
from sioms.recording.reader import Recording


@pytest.fixture
def replayed(tmp_path: Path) -> Iterator[str]:
    recording, ended = Recording(write(tmp_path / "a.mcap")), threading.Event()
    replay = Replay(recording, str(tmp_path / "sock"))

    def serve() -> None:
        replay.run(ended.is_set)
        while not ended.is_set():
            replay.look(0.01)
        replay.close()

    thread = threading.Thread(target=serve)
    thread.start()
    yield replay.path
    ended.set()
    thread.join()
    recording.close()


def test_every_value_is_published_again(replayed: str) -> None:
    with sioms.Workcell(replayed) as cell:
        assert [entry.name for entry in cell.nodes()] == [node.name for node in NODES]
        assert cell.info("mod0").channels[2].unit == "rad"
        nodes = {node.name: cell.open(node.name) for node in NODES}
        taps = {
            n: PageTap(node.readings, node.layout.channels, len(node.layout.columns), 0) for n, node in nodes.items()
        }
        last = nodes["mod0"].read()
        while last.position[0] < 200:
            last = nodes["mod0"].wait_new(last.number, timeout=5.0)
        axis = cell.open("mod0.b.readonly")
        assert axis.read().position == (200 + 1 / 64,)
        for info in NODES:
            found = taps[info.name].take()
            assert found is not None and taps[info.name].lost == 0
            assert np.array_equal(found[:, 4:], slots(info, 1, 200)[: len(found), 4:]) and len(found) >= 199
        for tap in taps.values():
            tap.release()


def test_it_can_only_be_read(replayed: str) -> None:
    with sioms.Workcell(replayed) as cell:
        with pytest.raises(OSError, match="only be read"):
            cell.open("mod0", "rw")
        with pytest.raises(OSError, match="only be read"):
            cell.emergency_stop_workcell()
        with pytest.raises(OSError, match="not in the recording"):
            cell.open("mod7")
        with pytest.raises(OSError, match="only be read"):
            cell.open("force0").zero()
