"""What is taken out of rings, and what a file does when its disk is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
from recording_rig import NODES, slots

from sioms.protocol.flags import NodeClass, Request
from sioms.protocol.journal import HEADER, JournalReader, JournalWriter, Note
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.verbs import Ioctl
from sioms.recording.live.files import LiveFile
from sioms.recording.live.taps import PageTap
from sioms.recording.messages import Event
from sioms.recording.notes import noted, told
from sioms.recording.reader import Recording


def test_every_snapshot_is_taken_once_and_what_was_overwritten_is_counted() -> None:
    memory = bytearray(page_size(NodeClass.AXIS, 3, 16))
    writer = PageWriter(memoryview(memory), NodeClass.AXIS, 3, 16, 10**9, 1, 5)
    reader = PageReader(memory)
    tap, some = PageTap(reader, [0, 1, 2], 13, None), PageTap(reader, [2, 0], 13, None)
    raw, taken = slots(NODES[0], 1, 100), []
    for i, row in enumerate(raw):
        writer.publish(row[4:].tobytes(), int(row[1]), int(row[2]), 0)  # type: ignore[arg-type]
        if i % 10 == 0 and i < 50:
            taken += [found.tolist() for found in [tap.take()] if found is not None]
    taken += [found.tolist() for found in [tap.take()] if found is not None]
    numbers = [row[0] for rows in taken for row in rows]
    assert numbers == [*range(1, 42), *range(86, 101)] and tap.lost == 44
    assert taken[-1][-1][4:] == raw[-1, 4:].tolist()
    picked: Any = some.take()
    assert picked[-1, 4:6].tolist() == [raw[-1, 6], raw[-1, 4]] and picked.shape[1] == 4 + 2 * 13
    assert tap.take() is None


def test_commands_tell_who_gave_them_and_why_they_were_refused() -> None:
    memory = bytearray(HEADER + 4096)
    writer = JournalWriter(memoryview(memory))
    writer.note(Note.COMMAND, 5, "mod0", "eva", Ioctl(int(Request.STOP), None, 0.0).packed(3), errno.EPERM, "no right")
    writer.note(Note.STOP, 6, "EMERGENCY", "emergency stop by eva", [])
    writer.note(99, 7, "of a later version")
    command, stop, unknown = [told("mod0", noted) for noted in JournalReader(memory).read()]
    assert (command.kind, command.node, command.who, command.error) == ("command", "mod0", "eva", errno.EPERM)
    assert command.data is not None and command.data["request"] == "STOP"
    assert (stop.kind, stop.text, stop.stamp_ns) == ("stop", "emergency stop by eva", 6)
    assert unknown.kind == "unknown 99"


def test_an_event_becomes_the_note_that_it_was() -> None:
    memory = bytearray(HEADER + 8192)
    writer, reader = JournalWriter(memoryview(memory)), JournalReader(memory)
    packet = Ioctl(int(Request.STOP), None, 0.0).packed(3)
    notes: list[tuple[int, list[Any]]] = [
        (Note.COMMAND, ["mod0", "eva", packet, errno.EPERM, "no right"]), (Note.REFUSAL, ["mod0", "eva", 7, 5, "lost"]),
        (Note.STOP, ["EMERGENCY", "smoke", [["axes", [0, 1], -1]]]), (Note.FAULT, [["xaxis"], "following error"]),
        (Note.LINK, ["LINK_LOST", "silent"]), (Note.RESET, ["axes", [0]]), (Note.MARKER, ["mod0", 5]),
        (Note.LOG, ["info", "device up", {"device": "mod0", "pid": "7"}]), (Note.CLOSED, ["mod0", "eva"]),
        (Note.REQUEST, ["eva", "Open", ["mod0", 3, 0.0, 0.0], 0, ""]),
    ]  # fmt: skip
    assert {kind for kind, _ in notes} == set(Note)
    for kind, values in notes:
        writer.note(kind, 5, *values)
    assert [noted(told("mod0", event)) for event in reader.read()] == notes
    assert noted(Event(5, 0, "mod0", "unknown 99")) is None and noted(Event(5, 0, "mod0", "stop")) is None
    assert noted(Event(5, 0, "recorder", "lost", text="3 snapshots")) == (
        Note.LOG, ["info", "recorder: lost", {"text": "3 snapshots", "node": ""}]
    )  # fmt: skip


def test_a_full_disk_leaves_whole_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = LiveFile(str(tmp_path / "a.mcap"), pack=False)
    file.append(b"\x0c" + (9).to_bytes(8, "little") + bytes(9))
    size, real, room = os.path.getsize(file.path), os.write, [5]

    def write(fd: int, data: Any) -> int:
        if not room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(fd, data[: room.pop()])

    monkeypatch.setattr(os, "write", write)
    with pytest.raises(OSError, match="no space left"):
        file.append(bytes(100))
    assert os.path.getsize(file.path) == size
    monkeypatch.setattr(os, "write", real)
    file.append(b"there is room again")
    file.close()
    data = Path(file.path).read_bytes()
    assert len(data) == size + 19 and data.endswith(b"there is room again")


@pytest.mark.parametrize("why", ["there already", "no space left", "too many open"])
def test_a_next_file_that_cannot_be_made_leaves_the_present_one_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    """And no descriptor is closed twice: its number may be another's by then."""
    file = LiveFile(str(tmp_path / "a.mcap"), most_bytes=100, pack=False)
    file.append(b"\x0c" + (200).to_bytes(8, "little") + bytes(200))
    with monkeypatch.context() as patch, pytest.raises(OSError, match=f"record to .*a-0002.mcap: .*{why}"):
        if why == "there already":
            (tmp_path / "a-0002.mcap").write_text("mine")
        else:
            error = errno.ENOSPC if why == "no space left" else errno.EMFILE

            def fail(*_: Any) -> int:
                raise OSError(error, os.strerror(error))

            patch.setattr(os, "write" if error == errno.ENOSPC else "open", fail)
        file.look()
    assert file.path == str(tmp_path / "a-0001.mcap")
    file.append(b"still the first")
    other = os.open(tmp_path, os.O_RDONLY)
    file.close()
    os.close(other)
    assert (tmp_path / "a-0001.mcap").read_bytes().endswith(b"still the first")
    left = [path.name for path in tmp_path.iterdir() if path.name != "a-0001.mcap"]
    assert left == (["a-0002.mcap"] if why == "there already" else [])


def test_files_rotate_and_each_stands_for_itself(tmp_path: Path) -> None:
    file = LiveFile(str(tmp_path / "a.mcap"), most_bytes=1000, pack=False)
    from sioms.recording import mcap

    file.define(mcap.metadata("sioms", {"offset_ns": "5"}))
    for _ in range(3):
        file.append(mcap.metadata("x", {"y": "z" * 1000}))
        file.look()
    file.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"a-000{i}.mcap" for i in (1, 2, 3, 4)]
    with Recording(tmp_path / "a-0003.mcap") as recording:
        assert recording.offset_ns == 5
    with pytest.raises(OSError, match="there already"):
        LiveFile(str(tmp_path / "a.mcap"), most_bytes=1000)
