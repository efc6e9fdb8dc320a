"""Latch, stop requests, marker table, records, node information, socket path."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from sioms.protocol import latch
from sioms.protocol.flags import NodeClass
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.markers import MARKERS, TABLE_SIZE, MarkerTable, split_token, token_of
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.records import READ_SIZE, WRITE_STRUCT, numpy_dtype
from sioms.protocol.socketpath import socket_path
from sioms.protocol.stopfile import SOMEBODY, StopRequest


def test_the_latch_holds_its_first_stop_until_reset() -> None:
    memory = bytearray(LATCH_SIZE)
    latch, other = Latch(memoryview(memory)), Latch(memoryview(memory))
    assert latch.stopped_ns == 0 and latch.source == ""
    assert latch.stop(5, "eva") and not other.stop(6, "tom")
    assert (other.stopped_ns, other.source, other.resets) == (5, "eva", 0)
    latch.reset(1)
    assert (other.stopped_ns, other.resets) == (0, 1)
    assert other.stop(7, "ö" * 300) and 100 < len(latch.source) <= 128
    latch.daemon_alive(9)
    assert other.daemon_alive_ns == 9 and other.stopped_ns == 7


def test_no_processor_shows_the_count_of_a_reset_before_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Latch(memoryview(bytearray(LATCH_SIZE)))
    at_fences: list[tuple[object, ...]] = []

    def fence() -> None:
        at_fences.append((made.stopped_ns, made.ended_stop_ns, made.answered_request, made.reset_ns, made._words[1]))

    monkeypatch.setattr(latch, "fence", fence)
    made.stop(3, "fire")
    made.reset(5, (7, 8))
    ended, counted = at_fences
    assert ended[:2] == (3, 3), "that there was a stop is there before it is gone"
    assert counted == (0, 3, (7, 8), 5, 0), "all but the count"
    assert made.resets == 1 and len(at_fences) == 3, "and who has read that looks at the rest behind it"


def test_a_stop_and_reset_between_two_looks_shows() -> None:
    latch = Latch(memoryview(bytearray(LATCH_SIZE)))
    before = (latch.stopped_ns, latch.resets)
    latch.stop(5, "x")
    latch.reset(1)
    assert (latch.stopped_ns, latch.resets) != before


@pytest.fixture
def request_file(tmp_path: Path) -> Iterator[StopRequest]:
    """Return the two stop files, open as a driver has them."""
    fds = [os.open(tmp_path / name, os.O_RDWR | os.O_CREAT) for name in ("stop", "stopped")]
    request = StopRequest(*fds)
    yield request
    request.close()


def test_every_request_changes_the_mark(request_file: StopRequest) -> None:
    marks = [request_file.mark]
    for now in (5, 6, 0, 7):
        request_file.request(now, 42, "a reason\x1b[31m")
        assert request_file.mark not in marks
        marks.append(request_file.mark)
    assert request_file.source == "pid 42: a reason\\x1b[31m, through the stop-request page"


def test_writing_the_old_word_takes_no_request_back(request_file: StopRequest, tmp_path: Path) -> None:
    request_file.request(5, 42)
    before = request_file.mark
    time.sleep(0.02)  # the clock of the file system ticks
    content = (tmp_path / "stop").read_bytes()
    request_file.request(6, 43)
    (tmp_path / "stop").write_bytes(content)
    assert request_file.mark[0] == before[0] and request_file.mark != before
    os.truncate(tmp_path / "stop", 0)
    assert request_file.mark != before and "pid 0" in request_file.source


@pytest.mark.parametrize("requested", [False, True])
def test_a_request_that_is_just_being_written_is_not_told_for_that_of_the_one_before(
    request_file: StopRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, requested: bool
) -> None:
    """The time of a file's last change is there before what is written."""
    if requested:
        request_file.request(5, 42, "an old reason")
    before = request_file.mark
    os.utime(tmp_path / "stop", ns=(1, 1))
    assert request_file.mark != before and request_file.source == SOMEBODY

    def goes_on() -> None:
        request_file.request(6, 43, "a new one")

    monkeypatch.setattr(os, "sched_yield", goes_on)
    assert request_file.source == "pid 43: a new one, through the stop-request page"
    assert request_file.mark[0] == 6 and request_file.source == "pid 43: a new one, through the stop-request page"


def test_a_request_is_taken(request_file: StopRequest) -> None:
    word, changed_ns = mark = request_file.request(1000, 42)
    assert mark == request_file.mark and not request_file.taken(mark)
    request_file.take(request_file.mark)
    assert request_file.taken(mark) and request_file.taken((word - 1, changed_ns))
    assert not request_file.taken((word + 1, changed_ns))


def test_a_word_of_the_future_takes_no_later_request(request_file: StopRequest) -> None:
    """Anybody can write any word; who asks behind it waits for somebody to obey."""
    request_file.request((1 << 64) - 1, 42)
    request_file.take(request_file.mark)
    time.sleep(0.02)  # the clock of the file system ticks
    mark = request_file.request(1000, 43)
    assert not request_file.taken(mark)
    request_file.take(request_file.mark)
    assert request_file.taken(mark)


@pytest.fixture
def table() -> MarkerTable:
    return MarkerTable(memoryview(bytearray(TABLE_SIZE)))


def test_a_marker_is_signalled_once(table: MarkerTable) -> None:
    generation = table.reserve(5, 77)
    assert table.is_reserved(5) and table.is_key(5, 77) and not table.is_key(5, 78) and not table.is_key(5, 0)
    assert not table.is_signalled(5, generation)
    assert table.signal(5, generation, 100) and not table.signal(5, generation, 200)
    assert table.is_signalled(5, generation) and table.stamp_ns(5) == 100


def test_generations_never_come_back(table: MarkerTable) -> None:
    seen = set()
    for key in range(1, 20):
        generation = table.reserve(5, key)
        assert generation == table.generation(5) and generation not in seen
        seen |= {generation}
        table.signal(5, generation, key)
        table.free(5)
        assert not table.is_reserved(5) and table.generation(5) not in seen
        seen |= {table.generation(5)}
        assert not table.is_key(5, key)
    late = min(seen)
    newest = table.reserve(5, 99)
    table.signal(5, late, 1)
    assert not table.is_signalled(5, newest)
    assert table.signal(5, newest, 2), "a late signal of an old generation must not swallow the new one's"


@pytest.mark.parametrize("number", [0, -1, MARKERS, 1 << 40])
def test_numbers_beyond_the_table_are_not_reserved(table: MarkerTable, number: int) -> None:
    assert not table.is_reserved(number) and not table.is_key(number, 1)


@pytest.mark.parametrize(("number", "key"), [(1, 1), (1023, 1), (1, (1 << 40) - 1), (512, 123456789)])
def test_a_token_survives_a_double(number: int, key: int) -> None:
    token = token_of(number, key)
    assert split_token(token) == (number, key) and int(float(token)) == token and 0 < token < 1 << 50
    assert split_token(number) == (number, 0)


def test_records_are_as_numpy_sees_them() -> None:
    for node_class in NodeClass:
        assert np.dtype(numpy_dtype(node_class)).itemsize == WRITE_STRUCT[node_class].size
    assert (WRITE_STRUCT[NodeClass.AXIS].size, READ_SIZE[NodeClass.AXIS]) == (144, 104)
    record = np.zeros(1, np.dtype(numpy_dtype(NodeClass.AXIS)))
    record["axis"], record["max_force"], record["signal_marker_number"] = 3, 2.5, 1 << 49
    fields = WRITE_STRUCT[NodeClass.AXIS].unpack(record.tobytes())
    assert (fields[0], fields[2], fields[-1]) == (3, 1 << 49, 2.5)


def test_channel_information_packs_and_unpacks() -> None:
    info = ChannelInfo("x", "m", -1.0, None, 0, 15, {"velocity": 2.0}, "text")
    again = ChannelInfo(*info.pack())
    assert again.pack() == info.pack() and again.maximum is None and again.limits == {"velocity": 2.0}


def test_socket_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SIOMS_SOCKET", "/x/y")
    assert socket_path() == "/x/y"
    monkeypatch.delenv("SIOMS_SOCKET")
    monkeypatch.setattr("sioms.protocol.socketpath.SYSTEM_PATH", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/5")
    assert socket_path() == "/run/user/5/sioms/siomsd.sock"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert socket_path() == f"/tmp/sioms-{os.getuid()}/sioms/siomsd.sock"
    (tmp_path / "s").touch()
    monkeypatch.setattr("sioms.protocol.socketpath.SYSTEM_PATH", str(tmp_path / "s"))
    assert socket_path() == str(tmp_path / "s")


def test_a_reset_tells_which_request_it_has_answered(request_file: StopRequest) -> None:
    latch = Latch(memoryview(bytearray(LATCH_SIZE)))
    request_file.request(1000, 4711)
    latch.stop(1000, "a client")
    latch.reset(1, request_file.mark)
    assert latch.stopped_ns == 0 and latch.answered_request == request_file.mark
    request_file.request(2000, 4711)
    assert latch.answered_request != request_file.mark
