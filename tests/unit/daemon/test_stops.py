"""The stop of a session and the request that its process has written ahead of it are one stop; another's is another."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.daemon.cell import Cell
from sioms.daemon.log import Log
from sioms.daemon.stops import Stops
from sioms.part_times import PartTimes
from sioms.protocol.latch import LATCH_SIZE, Latch
from sioms.protocol.stopfile import SOMEBODY, StopRequest

PID = 4711


class Rig:
    """The stops of a cell without devices, whose record and log are written down."""

    def __init__(self) -> None:
        self.fds = [os.memfd_create(name) for name in ("stop", "stopped")]
        self.request = StopRequest(*self.fds)
        self.latch = Latch(memoryview(bytearray(LATCH_SIZE)))
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
    sent_ns = time.monotonic_ns()
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
    rig.stops.stopped(devices[2], "an input")  # type: ignore[arg-type]
    assert [device.told for device in devices] == [0, 1, 0, 2, 2, 2, 0], "its own process has seen it"
