"""Recordings are what independent readers take them for, and what is whole in a damaged one is read."""

from __future__ import annotations

import errno
import os
import random
from pathlib import Path
from typing import Any

import mcap.reader
import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from recording_rig import NODES, OFFSET_NS, START_NS, events, slots, write
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sioms.recording import reader
from sioms.recording.reader import Recording
from sioms.recording.rewrite import rewrite


def decoded(path: Path) -> dict[str, list[Any]]:
    """Return the messages of a file by topic, as the reference reader and rosbags see them."""
    packed = path.read_bytes()[-8:] == b"\x89MCAP0\r\n"
    types, found = get_typestore(Stores.ROS2_HUMBLE), dict[str, list[Any]]()
    with open(path, "rb") as file:
        reader: Any = (mcap.reader.make_reader if packed else mcap.reader.NonSeekingReader)(file, validate_crcs=True)
        try:
            for schema, channel, message in reader.iter_messages(log_time_order=packed):
                if schema.name not in types.fielddefs:
                    types.register(get_types_from_msg(schema.data.decode(), schema.name))
                found.setdefault(channel.topic, []).append(types.deserialize_cdr(message.data, schema.name))
        except EndOfFile:
            assert not packed
        if packed:
            assert reader.get_summary().statistics.message_count == sum(map(len, found.values()))
    return found


@pytest.mark.parametrize("is_packed", [False, True])
def test_other_readers_see_what_was_published(tmp_path: Path, is_packed: bool) -> None:
    path = write(tmp_path / "a.mcap")
    if is_packed:
        assert rewrite([str(path)], str(path)) == []
    found = decoded(path)
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/mod0/snapshot": 200, "/mod0/joint_states": 200, "/force0/snapshot": 200, "/force0/wrench": 200,
        "/io0/in/snapshot": 200, "/sioms/events": 5,
    }  # fmt: skip
    raw = slots(NODES[0], 1, 200)
    last, joint = found["/mod0/snapshot"][-1], found["/mod0/joint_states"][-1]
    assert (last.number, last.stamp_ns, last.tick) == (200, START_NS + 200_000_000, 207)
    assert last.position.tobytes() == joint.position.tobytes() == raw[-1, 4:7].tobytes()
    assert joint.effort.tobytes() == raw[-1, 10:13].tobytes() and joint.name == ["a", "b", "c"]
    assert joint.header.stamp.sec * 10**9 + joint.header.stamp.nanosec == OFFSET_NS + last.stamp_ns
    wrench = found["/force0/wrench"][0]
    assert wrench.header.frame_id == "force0" and wrench.wrench.torque.z == 1 + 5 / 64
    assert found["/sioms/events"][3].text == "Größe" and bytes(found["/sioms/events"][3].raw) == b"raw" * 3


def test_a_second_reader_opens_a_packed_file_by_its_index(tmp_path: Path) -> None:
    """Rosbags has a reader of MCAP of its own, which knows nothing of the reference one."""
    path = write(tmp_path / "a.mcap")
    assert rewrite([str(path)], str(path)) == []
    with AnyReader([path]) as bag:
        assert bag.message_count == 1005 and bag.topics["/mod0/snapshot"].msgcount == 200
        wanted = [connection for connection in bag.connections if connection.topic == "/mod0/snapshot"]
        found: list[Any] = [bag.deserialize(raw, one.msgtype) for one, _, raw in bag.messages(wanted)]
    raw = slots(NODES[0], 1, 200)
    assert b"".join(message.position.tobytes() for message in found) == raw[:, 4:7].tobytes()
    assert [message.number for message in found] == list(range(1, 201))


@pytest.mark.parametrize("is_packed", [False, True])
def test_every_value_is_read(tmp_path: Path, is_packed: bool) -> None:
    path = write(tmp_path / "a.mcap")
    if is_packed:
        rewrite([str(path)], str(path))
    with Recording(path) as recording:
        assert recording.is_packed is is_packed and recording.offset_ns == OFFSET_NS
        for node in NODES:
            assert np.array_equal(np.concatenate(list(recording.slots(node.name))), slots(node, 1, 200))
        table = recording.table("mod0", ["velocity"], START_NS + 50_000_000, START_NS + 60_000_000)
        assert table.numbers.tolist() == [*range(50, 60)] and table.values["velocity"][0, 1] == 50 + 4 / 64
        assert recording.events() == events(5) and recording.damage == []
        with pytest.raises(OSError, match="no node mod1"):
            recording.table("mod1")
        with pytest.raises(OSError, match=r"no node mod0\.x is recorded; want mod0, which holds all of its channels"):
            recording.table("mod0.x")


def test_of_a_file_cut_off_anywhere_all_whole_records_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 40)
    whole, chance = path.read_bytes(), random.Random(3)
    with Recording(path) as recording:
        ends = [at for piece in recording.pieces() for each in piece.by_channel.values() for at in each]
    first = min(ends) + 8  # offsets in the piece, which begins behind the magic
    for end in [len(whole) - 1, *(chance.randrange(first, len(whole)) for _ in range(60))]:
        path.write_bytes(whole[:end])
        with Recording(path) as recording:
            there = sum(len(each) for piece in recording.pieces() for each in piece.by_channel.values())
            expected = sum(1 for begin in sorted(ends) if _end(whole, begin + 8) <= end)
            assert there == expected and (len(recording.damage) == 1 or end in {_end(whole, b + 8) for b in ends})


def _end(data: bytes, at: int) -> int:
    return at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")


def test_behind_bytes_that_are_damaged_reading_goes_on(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 3000] = bytes(3000)
    path.write_bytes(data)
    with Recording(path) as recording:
        numbers = [int(n) for batch in recording.slots("mod0") for n in batch[:, 0]]
        assert numbers[0] == 1 and numbers[-1] == 200 and 180 <= len(numbers) < 200
        assert len(recording.damage) == 1 and "are lost" in recording.damage[0]
    told = rewrite([str(path)], str(tmp_path / "b.mcap"))
    assert len(told) == 1
    assert len(decoded(tmp_path / "b.mcap")["/mod0/snapshot"]) == len(numbers)


def test_a_damaged_chunk_is_lost_and_said(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 20)
    rewrite([str(path)], str(path))
    data = bytearray(path.read_bytes())
    data[data.index(b"zstd") + 60] ^= 0xFF
    path.write_bytes(data)
    with Recording(path) as recording:
        assert list(recording.slots("mod0")) == []
        assert "chunk" in recording.damage[0]


def test_a_cut_and_a_merge_hold_what_they_shall(tmp_path: Path) -> None:
    one = write(tmp_path / "a.mcap", 100)
    two = write(tmp_path / "b.mcap", 100, first=101)
    cut, both = tmp_path / "cut.mcap", tmp_path / "both.mcap"
    start = OFFSET_NS + START_NS + 30_000_000
    assert rewrite([str(one)], str(cut), start, start + 10_000_000, ["mod0"]) == []
    found = decoded(cut)
    assert [message.number for message in found["/mod0/snapshot"]] == [*range(30, 40)]
    assert set(found) == {"/mod0/snapshot", "/mod0/joint_states", "/sioms/events"}
    assert rewrite([str(one), str(two)], str(both)) == []
    with Recording(both) as recording:
        assert np.array_equal(np.concatenate(list(recording.slots("force0"))), slots(NODES[1], 1, 200))
        assert len(recording.channels) == 6


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"position,velocity\n1,2\n")
    with pytest.raises(OSError, match="not a recording"):
        Recording(path)


@pytest.mark.parametrize("is_packed", [False, True])
@pytest.mark.parametrize("piece", [16, 100, 4096])
def test_pieces_of_any_size_hold_every_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_packed: bool, piece: int
) -> None:
    monkeypatch.setattr(reader, "PIECE", piece)
    path = write(tmp_path / "a.mcap", 40)
    if is_packed:
        rewrite([str(path)], str(path))
    with Recording(path) as recording:
        for node in NODES:
            assert np.array_equal(np.concatenate(list(recording.slots(node.name))), slots(node, 1, 40))
        assert recording.events() == events(5) and recording.damage == []
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes(200) + whole[middle + 200 :])
    with Recording(path) as recording:
        read = sum(len(each) for node in NODES for each in recording.slots(node.name))
        assert (0 < read < 120 or is_packed) and len(recording.damage) == 1


@pytest.mark.parametrize("is_packed", [False, True])
def test_a_file_that_is_cut_off_while_it_is_read_is_read_up_to_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_packed: bool
) -> None:
    """Somebody copies over it, or rotates it away: no signal, no exception, and what is lost is said."""
    monkeypatch.setattr(reader, "PIECE", 8192)
    path = write(tmp_path / "a.mcap", 400)
    if is_packed:
        rewrite([str(path)], str(path))
    whole = path.read_bytes()
    for left in (len(whole) // 2, 100, 0):
        path.write_bytes(whole)
        with Recording(path) as recording:
            pieces = recording.slots("mod0")
            read = [] if is_packed else [next(pieces)]
            os.truncate(path, left)
            read += list(pieces)
            assert sum(map(len, read)) < 400 and recording.damage[-1].endswith("to the end of the file")
            assert len(recording.table("mod0").numbers) <= 400 and len(recording.events()) <= 5


def test_what_cannot_be_packed_leaves_the_file_as_it_was_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mcap", 4)
    whole = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        rewrite([str(path)], str(path))
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"] and path.read_bytes() == whole


def test_a_pipe_holds_up_nobody(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    for name, kind in (("pipe.mcap", "no ordinary file"), ("", "a folder")):
        with pytest.raises(OSError, match=f"^.*read {tmp_path / name}: it is {kind}; want a recording"):
            Recording(tmp_path / name)
