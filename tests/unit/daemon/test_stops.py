"""The stop of a session and the request that its process has written ahead of it are one stop; another's is another."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.daemon import requests as requests_module
from sioms.daemon.cell import Cell
from sioms.daemon.log import Log
from sioms.daemon.requests import Requests
from sioms.daemon.shared import Shared
from sioms.daemon.stop_files import StopFiles
from sioms.daemon.stop_record import StopRecord
from sioms.daemon.stops import Stops
from sioms.part_times import PartTimes
from sioms.protocol import verbs
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.stopfile import SOMEBODY, StopRequest
from sioms.protocol.stopjournal import StopJournal, node_entry, workcell_entry

PID = 4711


class Rig:
    """The stops of a cell without devices, whose record and log are written down."""

    def __init__(self) -> None:
        self.fds = [os.memfd_create(name) for name in ("stop", "stopped")]
        self.request = StopRequest(*self.fds)
        self.latch = Latch(memoryview(bytearray(LATCH_SIZE)))
        self.latch.begin(0, self.request.mark)
        self.noted: list[str] = []
        state = SimpleNamespace(workcell="")
        record = SimpleNamespace(look=lambda: None, state=state, note=self._note, path="stops", asked=PartTimes())
        shared: Any = SimpleNamespace(latch=self.latch, request=self.request, record=record)
        cell = Cell(SimpleNamespace(), Log(level="error"), shared)  # type: ignore[arg-type]
        self.cell, self.stops, self._state = cell, Stops(cell), state

    def _note(self, entry: dict[str, Any]) -> None:
        self.noted.append(entry["by"])
        self._state.workcell = entry["by"]


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.request.close()


@pytest.mark.parametrize("heard_by_a_driver", [False, True])
def test_a_request_of_the_sessions_process_is_its_stop(rig: Rig, heard_by_a_driver: bool) -> None:
    word = rig.request.request(1000, PID, "enough")
    if heard_by_a_driver:
        rig.latch.stop(1001, rig.request.source)
    rig.stops.stop_for(PID, "eva: enough")
    assert rig.latch.stopped_ns and rig.latch.source == "eva: enough" and rig.noted == ["eva: enough"]
    assert rig.request.taken(word) and not rig.stops.hear_request(), "it has been heard"
    assert rig.noted == ["eva: enough"]


def test_a_stop_that_a_driver_could_not_name_yet_is_named_by_who_asked(rig: Rig) -> None:
    rig.request.request(1000, PID, "enough")
    rig.latch.stop(1001, SOMEBODY)
    rig.stops.stop_for(PID, "eva: enough")
    assert rig.latch.source == "eva: enough" and rig.noted == ["eva: enough"]
    rig.stops.stop_for(PID + 1, "tom: me too")
    assert rig.latch.source == "eva: enough", "and keeps that name"


def test_a_request_of_another_process_is_another_stop(rig: Rig) -> None:
    word = rig.request.request(1000, PID + 1, "fire")
    rig.stops.stop_for(PID, "eva: enough")
    assert [each.split(",")[0] for each in rig.noted] == [f"pid {PID + 1}: fire", "eva: enough"]
    assert rig.request.taken(word)


def test_a_session_without_a_request_stops_and_a_later_request_is_heard(rig: Rig) -> None:
    rig.stops.stop_for(PID, "eva: enough")
    assert rig.noted == ["eva: enough"]
    rig.request.request(2000, PID, "again")
    assert f"pid {PID}: again" in rig.stops.hear_request()


@pytest.mark.parametrize("is_honest", [True, False])
def test_a_stop_past_the_daemon_was_asked_for_when_it_was_written(rig: Rig, is_honest: bool) -> None:
    """As its word says; a word that the time of the file's last change contradicts counts for nothing."""
    written_ns = time.monotonic_ns()
    rig.request.request(written_ns if is_honest else written_ns - 10**9, PID, "enough")
    rig.latch.stop(written_ns + 1, rig.request.source)  # by a driver
    sent_ns = written_ns + 2
    rig.stops.hear_request()
    assert rig.stops.stopped_since(written_ns - 1, 1)
    assert rig.stops.stopped_since(sent_ns, 1) is not is_honest
    time.sleep(0.011)
    assert not rig.stops.stopped_since(time.monotonic_ns(), 1)


class Device:
    """A device as far as stops know it: the process that it is in, and what it is told."""

    def __init__(self, process: str, name: str, *, ticks: bool = True, is_there: bool = True) -> None:
        self.name, self.lives_in = name, (process, "" if process else name)
        self.contact, self.is_there, self.told = (object() if ticks else None), is_there, 0

    def tell(self, message: Any) -> None:
        self.told += 1


def test_one_device_of_each_process_is_told_of_a_stop_and_one_that_listens(rig: Rig) -> None:
    devices = [
        Device("many", "starts", ticks=False), Device("many", "ticks"), Device("many", "too"),
        Device("", "alone"), Device("", "many"), Device("few", "begins", ticks=False),
        Device("", "off", is_there=False),
    ]  # fmt: skip
    rig.cell.devices.update({device.name: device for device in devices})  # type: ignore[misc]
    rig.stops.stop_workcell("eva")
    assert [device.name for device in devices if device.told] == ["ticks", "alone", "many", "begins"]
    assert max(device.told for device in devices) == 1


def test_what_a_driver_has_written_to_the_file_is_taken_up_once(rig: Rig) -> None:
    rig.request.request(2000, 0, "an input")
    for _ in range(2):
        rig.stops.hear_request()
        assert rig.latch.source == "an input" and rig.noted == ["an input"]
    rig.latch.reset(3000, rig.request.mark)
    rig.stops.hear_request()
    assert not rig.latch.stopped_ns


class Told:
    """A driver that is there, and what it is told."""

    name, is_there, lives_in, trouble = "mod0", True, "mod0", ""

    def __init__(self) -> None:
        self.orders: list[Any] = []

    def send(self, message: Any) -> None:
        self.orders.append(message)


def _node(rig: Rig, *channels: int) -> Any:
    """Return a node of these channels of a device that is there."""
    blocks = [SimpleNamespace(name="", channels=[SimpleNamespace(width=0)] * 2)]
    rig.cell.names = SimpleNamespace(devices={"mod0": SimpleNamespace(blocks=blocks)})  # type: ignore[assignment]
    rig.cell.devices = {"mod0": Told()}  # type: ignore[dict-item]
    rig.cell.shared.record.state.entries = list
    rig.cell.shared.record.note = lambda entry: None  # type: ignore[method-assign]
    return SimpleNamespace(name="mod0.x", device="mod0", block=0, channels=list(channels), bit=-1)


def test_a_stop_of_a_node_is_younger_than_a_reset_that_was_sent_before(rig: Rig) -> None:
    x, y = _node(rig, 0), _node(rig, 1)
    sent_ns = time.monotonic_ns()
    rig.stops.stop_node(x, "eva", 1)
    assert rig.stops.stopped_since(sent_ns, 2, x), "of this node"
    assert rig.stops.stopped_since(sent_ns, 2), "of the workcell, and with it of this node"
    assert not rig.stops.stopped_since(sent_ns, 2, y), "of another one"
    assert not rig.stops.stopped_since(sent_ns, 1, x), "by who has stopped it"
    assert not rig.stops.stopped_since(time.monotonic_ns(), 2, x), "afterwards"


def test_who_resets_what_he_has_stopped_has_sent_it_after_that(rig: Rig) -> None:
    node, sent_ns = _node(rig, 0), time.monotonic_ns()
    rig.stops.stop_node(node, "eva", 1)
    for by, is_later in ((1, True), (2, False)):
        rig.stops.reset_node(node, "eva", sent_ns, by)
        order = rig.cell.devices["mod0"].orders[-1]  # type: ignore[attr-defined]
        assert (order.sent_ns > sent_ns) is is_later


def test_stops_that_drivers_have_noted_have_been_asked_for(tmp_path: Path) -> None:
    record = StopRecord(str(tmp_path / "stops"))
    driver = StopJournal(os.dup(record.drivers_fd))
    at_ns = time.monotonic_ns()
    driver.append(node_entry("mod0", "mod0", "", [(0, 0)], "eva", stop=True, pid=PID, at_ns=at_ns), time.time())
    record.look()
    assert record.asked.latest_ns(("mod0", ""), {0: 1}, 0) == at_ns
    record.close()
    driver.close()


def test_what_lay_in_a_socket_before_it_was_stamped_is_as_old_as_can_be() -> None:
    served: list[int] = []
    session = SimpleNamespace(sock=SimpleNamespace(), early_bytes=5, timestamp_ns=-1, waits={})
    requests: Any = SimpleNamespace(
        _clients=SimpleNamespace(sessions=[session]), _dispatch=lambda session, *_: served.append(session.timestamp_ns)
    )
    packet = verbs.List().packed(1)
    session.early_bytes = len(packet) + 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(requests_module, "receive", lambda sock, most: (packet, 77))
        for _ in range(3):
            Requests.receive(requests, session)  # type: ignore[arg-type]
    assert served == [0, 0, 77]


def test_a_stop_asked_for_by_two_at_the_same_time_is_each_ones(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else writes while the daemon looks whose the request is."""
    rig.request.request(1000, PID, "enough")
    look, looks = os.pread, []

    def pread(*arguments: int) -> bytes:
        found = look(*arguments)
        looks.append(arguments)
        if len(looks) == 2:
            rig.request.request(1001, PID + 1, "fire")
        return found

    monkeypatch.setattr(os, "pread", pread)
    rig.stops.stop_for(PID, "eva: enough")
    assert any("fire" in each for each in rig.noted) and rig.noted[-1] == "eva: enough"


def files(path: Path) -> StopRequest:
    """Leave the stop files of a daemon that has been killed."""
    made = StopFiles(str(path))
    return StopRequest(made.fd, made.taken_fd)


@pytest.mark.parametrize("obeyed", [0, 5000])
def test_a_daemon_that_dies_at_its_start_loses_no_stop_that_nobody_has_heard(tmp_path: Path, obeyed: int) -> None:
    """Neither one of which a later word is said to have been obeyed, as from before the machine was started again."""
    left = files(tmp_path / "sioms")
    left.take((obeyed, 0))
    left.request(1000, PID, "fire")
    record = StopRecord(str(tmp_path / "stops"))
    Shared(str(tmp_path / "sioms"), record)
    record._flusher.end()
    os.close(record._fd)  # it dies
    again = StopRecord(str(tmp_path / "stops"))
    assert "fire" in again.state.workcell
    Shared(str(tmp_path / "sioms"), again)
    again.note(workcell_entry("ann", stop=False, resets=1))
    again.close()
    assert not (tmp_path / "stops").exists()


def test_who_asks_while_the_files_are_made_is_heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin = StopFiles.__init__

    def made(self: StopFiles, path: str) -> None:
        begin(self, path)
        StopRequest(os.dup(self.fd), os.dup(self.taken_fd)).request(1000, PID, "fire")

    monkeypatch.setattr(StopFiles, "__init__", made)
    record = StopRecord(str(tmp_path / "stops"))
    shared = Shared(str(tmp_path / "sioms"), record)
    assert shared.request.mark != shared.latch.answered_request, "what drivers look at"
    cell = Cell(SimpleNamespace(), Log(level="error"), shared)  # type: ignore[arg-type]
    assert "fire" in Stops(cell).hear_request() and "fire" in record.state.workcell
    record.close()


def test_a_stop_that_a_driver_notes_at_the_end_of_the_daemon_is_kept(tmp_path: Path) -> None:
    record = StopRecord(str(tmp_path / "stops"))
    StopJournal(os.dup(record.drivers_fd)).append(workcell_entry("pid 7: fire", stop=True, request=1000), 1.0)
    record.close()
    again = StopRecord(str(tmp_path / "stops"))
    assert "fire" in again.state.workcell
    again.close()
