"""A recording is served as it was published, and nobody can write to it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_rig import NODES, slots, write

import sioms
from sioms.client.cell_verbs import is_part
from sioms.protocol import verbs
from sioms.protocol.messages import decode_reply
from sioms.recording.live.files import LiveFile
from sioms.recording.live.recorder import Recorder
from sioms.recording.live.replay import Peer, Replay
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
        entries = cell.nodes()
        assert [entry.name for entry in entries if not is_part(entry, entries)] == [node.name for node in NODES]
        assert {"mod0.b", "force0.c", "io0.in.bit7"} <= {entry.name for entry in entries}
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


def test_bits_are_nodes_of_their_own(replayed: str) -> None:
    with sioms.Workcell(replayed) as cell:
        port, bit = cell.open("io0.in"), cell.open("io0.in.bit3.readonly")
        assert bit.info.bit == 3
        deadline = time.monotonic() + 20
        while len(port.history(0, gone=True)) < 100 and time.monotonic() < deadline:
            time.sleep(0.01)
        both = port.history(0), bit.history(0)
        bits = {snapshot.number: snapshot.data[0] for snapshot in both[1]}
        assert len(bits) > 20 and set(bits.values()) == {0, 1}
        assert all(bits[s.number] == s.data[0] >> 3 & 1 for s in both[0] if s.number in bits)
        with pytest.raises(OSError, match="not in the recording"):
            cell.open("io0.in.bit8")


def test_what_happened_happens_again_and_can_be_recorded(replayed: str, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    recorder = Recorder(LiveFile(str(path)), lambda: sioms.Workcell(replayed))
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and (recorder.look() or len(read_events(path)) < 5):
        time.sleep(0.01)
    recorder.close()
    with Recording(tmp_path / "a.mcap") as first, Recording(path) as second:
        before, after = first.events(), [e for e in second.events() if e.source == "dev"]
        assert set(second.nodes) == {node.name for node in NODES}
        assert [(e.kind, e.node, e.who, e.text, e.raw) for e in after] == [
            (e.kind, e.node, e.who, e.text, e.raw) for e in before
        ]
        for number in range(1, 5):
            gap = after[number].stamp_ns - after[0].stamp_ns
            assert gap == before[number].stamp_ns - before[0].stamp_ns, "at the same distances"


def read_events(path: Path) -> list[object]:
    with Recording(path) as recording:
        return [event for event in recording.events() if event.source == "dev"]


def test_packets_that_are_passed_on_in_each_other_end_their_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    served: Any = Replay.__new__(Replay)
    node: Any = object()
    peer = Peer(ours, served._handle, verbs.ON_HANDLE, node)
    dropped: list[Peer] = []
    monkeypatch.setattr(served, "_drop", dropped.append, raising=False)
    once = verbs.Passed(5, verbs.CancelOnHandle(3).packed(7)).packed()
    theirs.send(once)
    served._receive(peer)
    assert (decode_reply(theirs.recv(1000))[1], dropped) == (7, [])
    theirs.send(verbs.Passed(5, once).packed())
    served._receive(peer)
    assert dropped == [peer]
    ours.close()
    theirs.close()
