"""The journal of stops: whatever was acknowledged is in it, whatever it holds is obeyed, and damage is a stop."""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sioms.daemon import stop_record
from sioms.daemon.stop_record import StopRecord
from sioms.protocol import stopjournal
from sioms.protocol.stopjournal import (
    StopJournal,
    Stopped,
    channels_and_bits,
    file_entry,
    node_entry,
    parts_of,
    replay,
    workcell_entry,
)

AXES = [(c, 0) for c in range(4)]


def stop_of_axes(source: str = "ann", *, stop: bool = True) -> dict[str, Any]:
    return node_entry("mod0", "mod0", "", AXES, source, stop=stop)


def bit(number: int, *, stop: bool = True) -> dict[str, Any]:
    return node_entry(f"io0.bit{number}", "io0", "do", parts_of(0, number, 8), "bob", stop=stop)


def byte(*, stop: bool = True) -> dict[str, Any]:
    return node_entry("io0", "io0", "do", parts_of(0, -1, 8), "bob", stop=stop)


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "state" / "stops")


def kept(path: str) -> Stopped:
    """Return what a daemon that starts now would find."""
    data = Path(path).read_bytes()
    held = data.lstrip(b"\0")
    return replay(held, len(data) - len(held), 1.8e9)


def test_what_is_noted_is_there_after_a_death_without_an_end(path: str) -> None:
    record = StopRecord(path)
    record.note(stop_of_axes())
    record.note(bit(3))
    record.note(workcell_entry("input estop reads 0", stop=True))
    state = kept(path)  # as after SIGKILL: nothing was closed
    assert state.workcell == "input estop reads 0" and state.since_s > 1.7e9
    assert state.nodes() == [["mod0", "ann"], ["io0.bit3", "bob"]]
    assert state.of_device("mod0") == [["", [[0, 3, 1]], "ann", "mod0"]]
    record.close()
    again = StopRecord(path)
    assert again.state.workcell == "input estop reads 0"
    again.note(workcell_entry("operator", stop=False))
    assert not again.state.workcell and not again.state.parts
    again.close()
    assert not os.path.exists(path)


def test_a_request_that_is_noted_behind_its_own_reset_is_over(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver notes a stop when it has done it; others may have seen it, and its reset, before."""
    monkeypatch.setattr(stop_record, "MOST_BYTES", 1)  # a checkpoint after every entry
    record = StopRecord(path)
    for word in range(5, 9):
        resets = record.state.resets
        record.note(workcell_entry("ann", stop=False, resets=resets + 1, requests=[(word, word)]))
        for request in range(5, word + 1):
            record.note(workcell_entry("pid 7", stop=True, resets=resets, requests=[(request, request)]))
        assert not record.state.requested and not kept(path).requested
    for resets, mark in ((4, (8, 8)), (4, (5, 5)), (3, (9, 9)), (3, (7, 8)), (3, (8, 7)), (3, (7, 9)), (3, (9, 7))):
        record.note(workcell_entry("bob", stop=True, resets=resets, requests=[mark]))
        for state in (record.state, kept(path)):
            assert state.requested == [mark] and state.requested_by == "bob", "no other request is taken for it"
        record.note(workcell_entry("ann", stop=False, resets=4, requests=[(8, 8), mark]))
        assert not record.state.requested and not kept(path).requested
        record.note(workcell_entry("ann", stop=False, resets=4, requests=[(8, 8)]))


def test_a_reset_ends_no_request_that_it_has_not_answered(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver notes a request that the daemon has not heard when it resets, and may not live to tell."""
    record = StopRecord(path)
    record.note(workcell_entry("pid 7", stop=True, requests=[(9, 9)]))
    record.note(workcell_entry("ann", stop=False, resets=1, requests=[(8, 8)]))
    assert record.state.requested == kept(path).requested == [(9, 9)]
    monkeypatch.setattr(stop_record, "MOST_BYTES", 1)  # a checkpoint
    record.note(workcell_entry("ann", stop=False, resets=2, requests=[(8, 8)]))
    assert record.state.requested == kept(path).requested == [(9, 9)]
    record.close()
    record = StopRecord(path)
    assert record.state.requested_by == "pid 7"
    record.note(workcell_entry("ann", stop=False, resets=3, requests=[(9, 9)]))
    assert not record.state.requested and not kept(path).requested
    record.note(workcell_entry("pid 7", stop=True, resets=3, requests=[(20, 20)]))
    record.note(file_entry((0, 30)))
    assert not record.state.requested and not kept(path).requested, "what a lost file has asked for is noted before"
    assert kept(path).answered[:2] == [(0, 30), (9, 9)]


def test_words_of_before_version_6_are_read(path: str) -> None:
    record = StopRecord(path)
    record.note({**workcell_entry("ann", stop=False, resets=1), "request": 8})
    record.note({**workcell_entry("pid 7", stop=True), "request": 8})
    assert not record.state.requested
    record.note({**workcell_entry("pid 7", stop=True, resets=1), "request": 9})
    assert kept(path).requested_by == "pid 7"


def test_many_requests_take_a_bounded_room(path: str) -> None:
    record = StopRecord(path)
    for word in range(3 * stopjournal.MOST_REQUESTED):
        for _ in range(2):
            record.note(workcell_entry("pid 7", stop=True, requests=[(word, word)]))
    assert len(record.state.requested) == stopjournal.MOST_REQUESTED
    record.note(workcell_entry("ann", stop=False, resets=1, requests=record.state.requested))
    assert not record.state.requested and not kept(path).requested


def test_a_bit_is_stopped_and_reset_by_itself(path: str) -> None:
    record = StopRecord(path)
    record.note(byte())
    record.note(bit(0, stop=False))
    assert channels_and_bits(record.state.of_device("io0")[0][1]) == [(0, b) for b in range(1, 8)]
    record.note(bit(0))
    record.note(byte(stop=False))
    assert record.state.parts == {}
    record.close()


def test_a_driver_notes_beside_the_daemon(path: str) -> None:
    record = StopRecord(path)
    driver = StopJournal(os.dup(record.drivers_fd))
    driver.append(stop_of_axes("input limit"), 1.0)
    record.look()
    assert record.state.nodes() == [["mod0", "input limit"]]
    driver.close()
    record.close()


def test_two_daemons_do_not_keep_one_record(path: str) -> None:
    record = StopRecord(path)
    drivers = os.dup(record.drivers_fd)
    with pytest.raises(OSError, match="another daemon"):
        StopRecord(path)
    record.note(stop_of_axes())
    record.close()
    StopRecord(path).close()  # a driver that lives on does not keep the next daemon out
    os.close(drivers)


@pytest.mark.parametrize("at", ["1e300", "NaN", "-5.0"])
def test_a_time_that_no_calendar_has_is_damage(path: str, at: str) -> None:
    os.makedirs(os.path.dirname(path))
    Path(path).write_text(f'{{"at":{at},"workcell":"","stop":true,"by":"eva"}}\n')
    state = kept(path)
    assert "damaged" in state.workcell and time.gmtime(state.since_s).tm_year > 1970


@pytest.mark.parametrize("damage", ["cut", "flipped", "zeros", "garbage", "shortened"])
def test_damage_stops_the_workcell_and_is_told(path: str, damage: str) -> None:
    record = StopRecord(path)
    record.note(stop_of_axes())
    record.note(stop_of_axes(stop=False))
    record.note(bit(1))
    record.look()
    data = Path(path).read_bytes()
    match damage:
        case "cut":
            data = data[:-7]
        case "flipped":
            data = data.replace(b'"stop":true', b'"st\xfep":true', 1)
        case "zeros":
            data += bytes(300) + b"x"
        case "garbage":
            data += b"[]\n[[[[[[[\n" + b"[" * 100_000 + b"\n"
        case "shortened":
            os.truncate(path, 10)
            record.look()
            assert "damaged" in record.state.workcell
            return
    Path(path).write_bytes(data)
    state = kept(path)
    assert "damaged" in state.workcell
    record._flusher.end()
    os.close(record._fd)
    again = StopRecord(path)
    assert "damaged" in again.state.workcell
    again.note(workcell_entry("operator", stop=False))
    assert not kept(path).workcell  # a reset clears it for good
    again.close()


def test_checkpoints_free_the_file_and_lose_nothing(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stop_record, "MOST_BYTES", 6000)
    chance = random.Random(5)
    record, model = StopRecord(path), Stopped()
    drivers = StopJournal(os.dup(record.drivers_fd))
    for step in range(3000):
        entry = chance.choice([stop_of_axes, bit, byte])  # type: ignore[list-item]
        kind: Any = entry
        stop = chance.random() < 0.5
        made = kind(chance.randrange(8), stop=stop) if entry is bit else kind(stop=stop)
        if chance.random() < 0.02:
            made = workcell_entry(f"number {step}", stop=stop)
        model.apply({"at": 1.0, **made})
        if chance.random() < 0.5:
            drivers.append(made, 1.0)
        else:
            record.note(made)
        if step % 100 == 0:
            record.look()
            assert (record.state.workcell, record.state.parts) == (model.workcell, model.parts)
    record.look()
    record._flusher.end()
    about = os.stat(path)
    assert about.st_size > 300_000 and about.st_blocks * 512 < 40_000
    fd = os.open(path, os.O_RDONLY)
    start = os.lseek(fd, 0, os.SEEK_DATA)
    state = replay(os.pread(fd, 1 << 20, start), start, 0.0)
    assert start > 0 and (state.workcell, state.parts) == (model.workcell, model.parts)
    os.close(fd)
    drivers.close()


def test_what_comes_beside_a_checkpoint_is_not_lost() -> None:
    """A driver appends between the look of the daemon and its checkpoint."""
    lines = [{"at": 1.0, **stop_of_axes()}]
    first = json.dumps(lines[0]).encode() + b"\n"
    beside = json.dumps({"at": 2.0, **workcell_entry("beam", stop=True)}).encode() + b"\n"
    state = Stopped()
    state.apply(lines[0])
    checkpoint = json.dumps({"checkpoint": state.entries(), "from": len(first), "at": 3.0}).encode() + b"\n"
    for start in (0, len(first)):
        found = replay((first + beside + checkpoint)[start:], start, 0.0)
        assert found.workcell == "beam" and found.nodes() == [["mod0", "ann"]]
    assert "the entries before byte" in replay(beside, 4096, 0.0).workcell


def test_ten_thousand_channels_are_a_short_line() -> None:
    entry = node_entry("big", "big", "", [(c, 0) for c in range(10_000)], "x", stop=True)
    assert len(json.dumps(entry)) < 200
    state = Stopped()
    state.apply({"at": 0.0, **entry})
    assert len(state.parts) == 10_000 and state.of_device("big")[0][1] == [[0, 9999, 1]]


@contextlib.contextmanager
def no_room_beyond(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("room", [0, 20])
@pytest.mark.parametrize("by_driver", [False, True])
@pytest.mark.parametrize("freed", [False, True])
def test_a_stop_that_a_full_disk_does_not_take_stops_the_next_daemon(
    path: str, room: int, by_driver: bool, freed: bool
) -> None:
    record = StopRecord(path)
    driver = StopJournal(os.dup(record.drivers_fd))
    with no_room_beyond(os.stat(path).st_size + room), pytest.raises(OSError):
        if by_driver:
            driver.append(stop_of_axes(), 1.0)
        else:
            record.note(stop_of_axes())
    if freed:
        driver.append(bit(3), 2.0)  # what comes after it does not make it whole
    record.look()
    if by_driver:
        assert "damaged" in record.state.workcell
    else:
        assert ["mod0", "ann"] in record.state.nodes()
    assert "damaged" in kept(path).workcell
    record._flusher.end()
    os.close(record._fd)
    again = StopRecord(path)
    assert "damaged" in again.state.workcell
    again.note(workcell_entry("operator", stop=False))
    assert not kept(path).workcell
    again.close()
    driver.close()


def test_a_reset_that_a_full_disk_does_not_take_leaves_what_was_stopped(path: str) -> None:
    record = StopRecord(path)
    record.note(stop_of_axes())
    with no_room_beyond(os.stat(path).st_size), pytest.raises(OSError):
        record.note(stop_of_axes(stop=False))
    assert not record.state.parts
    state = kept(path)
    assert state.nodes() == [["mod0", "ann"]] and not state.workcell


def test_where_there_is_no_room_for_stops_no_daemon_starts(path: str) -> None:
    with no_room_beyond(0), pytest.raises(OSError):
        StopRecord(path)
    StopRecord(path).close()
    assert not os.path.exists(path)


def test_room_for_many_stops_is_kept(path: str) -> None:
    record = StopRecord(path)
    record._flusher.end()
    assert os.stat(path).st_size < 200
    assert os.stat(path).st_blocks * 512 >= stop_record.MOST_BYTES
    os.close(record._fd)


def test_a_checkpoint_of_a_place_behind_it_is_damage() -> None:
    stop = b'{"at":1.0,"workcell":"","stop":true,"by":"me"}\n'
    assert replay(b'{"checkpoint":[],"from":0}\n' + stop, 0, 5.0).workcell == "me"
    assert "checkpoint" in replay(b'{"checkpoint":[],"from":999}\n' + stop, 0, 5.0).workcell


FEW = 1 << 12
"""The most parts that there can be in the tests of what is more: of a million each takes seconds."""
EVERYTHING = f"[[0,{FEW - 1},{(1 << 64) - 1}]]"


@pytest.mark.parametrize(
    "lines",
    [
        [f'{{"at":1,"node":"a","device":"d","block":"","parts":{EVERYTHING},"stop":true,"by":"x"}}'],
        [
            f'{{"at":1,"node":"a","device":"d{i}","block":"","parts":[[0,{FEW - 1},1]],"stop":true,"by":"x"}}'
            for i in range(4)
        ],
        ['{"at":1,"checkpoint":[],"from":-5}'],
    ],
)
def test_a_line_that_stops_more_than_there_can_be_is_damage(
    path: str, lines: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stopjournal, "MOST_PARTS", FEW)
    os.makedirs(os.path.dirname(path))
    Path(path).write_text("\n".join(lines) + "\n")
    assert "damaged" in kept(path).workcell


def test_what_a_journal_says_can_be_shown_and_sent(path: str) -> None:
    os.makedirs(os.path.dirname(path))
    Path(path).write_text('{"at":1,"workcell":"","stop":true,"by":"a\\ud800\\u001b[2J"}\n')
    assert kept(path).workcell == "a\\ud800\\x1b[2J"


def test_of_a_journal_that_nobody_of_us_wrote_the_end_is_read_and_it_is_damage(
    path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stop_record, "LARGEST", 10_000)
    os.makedirs(os.path.dirname(path))
    line = '{"at":1,"node":"a","device":"d","block":"","parts":[[0,0,1]],"stop":false,"by":"x"}\n'
    Path(path).write_text(line * 1000)
    record = StopRecord(path)
    assert "damaged" in record.state.workcell
    record.close()


def test_what_is_no_file_keeps_no_stops(path: str) -> None:
    os.makedirs(os.path.dirname(path))
    os.mkfifo(path)
    with pytest.raises(OSError, match="not a regular file"):
        StopRecord(path)
