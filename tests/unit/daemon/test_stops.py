"""The stop of a session and the request that its process has written ahead of it are one stop; another's is another."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
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
        record = SimpleNamespace(
            look=lambda: None, state=state, note=self._note, path="stops", asked=PartTimes(), unshown=list, elsewhere=[]
        )
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
    mark = rig.request.request(1000, PID, "enough")
    if heard_by_a_driver:
        rig.latch.stop(1001, rig.request.source)
    rig.stops.stop_for(PID, 1000, "eva: enough")
    assert rig.latch.stopped_ns and rig.latch.source == "eva: enough" and rig.noted == ["eva: enough"]
    assert rig.request.taken(mark) and not rig.stops.hear_request(), "it has been heard"
    assert rig.noted == ["eva: enough"]


def test_a_stop_that_a_driver_could_not_name_yet_is_named_by_who_asked(rig: Rig) -> None:
    rig.request.request(1000, PID, "enough")
    rig.latch.stop(1001, SOMEBODY)
    rig.stops.stop_for(PID, 1000, "eva: enough")
    assert rig.latch.source == "eva: enough" and rig.noted == ["eva: enough"]
    rig.stops.stop_for(PID + 1, 1000, "tom: me too")
    assert rig.latch.source == "eva: enough", "and keeps that name"


def test_a_request_of_another_process_is_another_stop(rig: Rig) -> None:
    """Be it that it says the word of the other, which anybody can read who sees what has been obeyed."""
    mark = rig.request.request(1000, PID + 1, "fire")
    rig.stops.stop_for(PID, 1000, "eva: enough")
    assert [each.split(",")[0] for each in rig.noted] == [f"pid {PID + 1}: fire", "eva: enough"]
    assert rig.request.taken(mark)


def test_a_request_of_another_session_of_a_process_is_another_stop(rig: Rig) -> None:
    """As of a gateway, whose sessions share it: a reset that one has sent before does not end the other's."""
    rig.request.request(1000, PID, "enough")
    rig.request.request(1001, PID, "fire")
    sent_ns = time.monotonic_ns()
    rig.stops.stop_for(PID, 1000, "eva: enough", 1)
    assert [each.split(",")[0] for each in rig.noted] == [f"pid {PID}: fire", "eva: enough"]
    assert rig.stops.stopped_since(sent_ns - 10**9, 1), "by somebody else than eva"


def test_a_stop_whose_request_has_been_answered_stops_nobody_again(rig: Rig) -> None:
    """Who stops writes a request ahead; it may be reset before what he tells the daemon is served."""
    mark = rig.request.request(1000, PID, "enough")
    rig.stops.hear_request()
    rig.latch.reset(time.monotonic_ns(), mark)
    rig.noted.clear()
    rig.stops.stop_for(PID, 1000, "eva: enough")
    assert not rig.latch.stopped_ns and not rig.noted
    rig.stops.stop_for(PID, 0, "eva: enough, by a session that has written none")
    assert rig.latch.stopped_ns


def test_a_session_without_a_request_stops_and_a_later_request_is_heard(rig: Rig) -> None:
    rig.stops.stop_for(PID, 0, "eva: enough")
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


@pytest.mark.parametrize("by", ["its driver", "a status", "a refusal", "time"])
def test_a_stop_by_an_alarm_is_younger_than_any_reset_until_it_can_be_known(
    start: Callable[[], Daemon], monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    """And no longer: who has seen it and resets at once is not refused."""
    daemon, now_ns = start(), time.monotonic_ns()
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    daemon.cell.names = SimpleNamespace(  # type: ignore[assignment]
        devices={"mod0": SimpleNamespace(blocks=[SimpleNamespace(name="", channels=[SimpleNamespace(width=0)] * 2)])}
    )
    x, y = (SimpleNamespace(name="n", device="mod0", block=0, channels=[c], bit=-1) for c in (0, 1))
    entry = node_entry("mod0.x", "mod0", "", [(0, 0)], "an alarm", stop=True, pid=PID, at_ns=now_ns + 1_000_000)
    daemon.drivers_journal.append(entry, time.time())
    for node, is_later in ((x, True), (y, False), (None, True)):
        assert daemon.stops.stopped_since(now_ns, 1, node) is is_later  # type: ignore[arg-type]
    now_ns += 100
    match by:
        case "its driver":
            daemon.record.shown(now_ns, "mod1")
            assert daemon.stops.stopped_since(now_ns, 1), "another driver shows others"
            daemon.record.shown(now_ns, "mod0")
        case "a status":
            daemon.record.shown(now_ns)
        case "a refusal":
            assert daemon.stops.stopped_by() == "n: an alarm" or "alarm" in daemon.stops.stopped_by(x)  # type: ignore[arg-type]
        case "time":
            now_ns += 1_000_000
            assert daemon.stops.stopped_since(now_ns - 101, 1), "at the latest a millisecond after it"
            now_ns -= 100
    for instant_ns, is_later in ((now_ns - 1, True), (now_ns, False)):
        for node in (x, None):
            assert daemon.stops.stopped_since(instant_ns, 1, node) is is_later  # type: ignore[arg-type]


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
    rig.stops.stop_for(PID, 1000, "eva: enough")
    assert any("fire" in each for each in rig.noted) and rig.noted[-1] == "eva: enough"


class Daemon:
    """The shared things of a daemon, and its stops.

    Args:
        folder: where its files are, but for its journal.
    """

    def __init__(self, folder: Path, journal: Path) -> None:
        self.record = StopRecord(str(journal))
        self.shared = Shared(str(folder / "sioms"), self.record)
        self.cell = Cell(SimpleNamespace(), Log(level="error"), self.shared)  # type: ignore[arg-type]
        self.stops = Stops(self.cell)
        self.request = self.shared.request
        self.drivers_journal = StopJournal(os.dup(self.record.drivers_fd))

    def obey(self, mark: tuple[int, int], resets: int) -> None:
        """Do as a driver that has found a request."""
        entry = workcell_entry("pid 7: fire", stop=True, resets=resets, requests=[mark], inode=self.request.inode)
        self.drivers_journal.append(entry, time.time())
        self.request.take(mark)

    def reset(self) -> None:
        self.stops.hear_request()
        self.stops.reset_workcell("ann", time.monotonic_ns(), 1)

    def die(self) -> None:
        self.record._flusher.end()
        os.close(self.record._fd)
        os.close(self.record.drivers_fd)

    def let_go(self) -> None:
        """Close what the daemon has open."""
        shared = self.shared
        if not self.record._flusher._ends:
            self.die()
        for fd in (shared.fds[0], shared.fds[3], *shared.files.client_fds, shared.journal.fd):
            os.close(fd)
        self.cell.timestamps.close()
        shared.request.close()
        self.drivers_journal.close()
        shared.latch.release()

    @property
    def stopped_by(self) -> str:
        self.stops.look()
        return self.record.state.workcell


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[[], Daemon]]:
    made: list[Daemon] = []

    def start() -> Daemon:
        made.append(Daemon(tmp_path, tmp_path / "stops"))
        return made[-1]

    yield start
    for daemon in made:
        daemon.let_go()


@pytest.mark.parametrize("obeyed", [None, (5000, 0)])
def test_a_daemon_that_dies_at_its_start_loses_no_stop_that_nobody_has_heard(
    start: Callable[[], Daemon], obeyed: tuple[int, int] | None
) -> None:
    """Neither one of which a later word is said to have been obeyed, as from before the machine was started again."""
    first = start()
    if obeyed:
        first.request.take(obeyed)
    first.request.request(1000, PID, "fire")
    first.die()
    start().die()
    again = start()
    assert "fire" in again.stopped_by
    again.reset()
    again.record.close()
    assert not os.path.exists(again.record.path)


@pytest.mark.parametrize(("asked", "writer"), [(True, "fire"), (False, "nobody")])
def test_a_file_that_the_journal_does_not_know_is_a_stop_that_says_why(
    start: Callable[[], Daemon], *, asked: bool, writer: str
) -> None:
    """As the first daemon behind one of an earlier version that was killed, whose journal keeps words alone."""
    first = start()
    word = first.request.request(1000, PID, "fire")[0] if asked else 0
    first.die()
    os.truncate(first.record.path, 0)
    first.drivers_journal.append({"workcell": "", "stop": False, "by": "eva", "resets": 1, "request": word}, 0.0)
    again = start()
    why, _, last = again.stopped_by.partition("; its last writer: ")
    assert "an earlier version" in why and writer in last
    again.reset()
    again.die()
    assert not start().stopped_by


@pytest.mark.parametrize("place", range(8))
def test_a_daemon_that_dies_anywhere_in_its_start_is_stopped_by_nothing_that_was_reset(
    start: Callable[[], Daemon], monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    first = start()
    first.request.request(1000, PID, "fire")
    first.reset()
    first.die()
    left, open_, rename, write = [place], os.open, os.rename, os.write

    def mortal(call: Callable[..., Any]) -> Callable[..., Any]:
        def called(*arguments: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                os._exit(0)
            return call(*arguments)

        return called

    pid = os.fork()
    if not pid:
        record = StopRecord(first.record.path)
        for name, call in (("open", open_), ("rename", rename), ("write", write)):
            monkeypatch.setattr(os, name, mortal(call))
        Shared(first.shared.files._path, record)
        os._exit(1)
    assert os.waitpid(pid, 0)[1] == 0, "it has died"
    assert not start().stopped_by


def test_a_word_that_is_late_is_not_lost_with_the_daemon(start: Callable[[], Daemon]) -> None:
    """Somebody is held up between the clock and the file; his is written in the middle of a reset, a driver obeys it
    and knows of no reset, and the daemon dies.
    """
    first = start()
    first.request.request(2000, PID, "smoke")
    count = first.shared.latch.resets

    class Late(Latch):
        def reset(self, *arguments: Any) -> None:
            late.append(first.request.request(1000, PID + 1, "fire"))
            first.obey(first.request.mark, count)
            super().reset(*arguments)
            raise KeyboardInterrupt

    late: list[tuple[int, int]] = []
    first.shared.latch.__class__ = Late
    with pytest.raises(KeyboardInterrupt):
        first.reset()
    assert late and first.request.taken(late[0]), "who has asked for it has been told"
    first.die()
    again = start()
    assert "fire" in again.stopped_by
    again.reset()
    assert not again.stopped_by


@pytest.mark.parametrize("answered", [False, True])
def test_of_a_file_that_is_lost_the_journal_says_what_was_asked_for(
    start: Callable[[], Daemon], answered: bool
) -> None:
    """As by a boot, while the daemon hung; and the words need not have come in their order."""
    first = start()
    first.reset()
    for word in (3000, 2000):
        time.sleep(0.01)
        first.obey(first.request.request(word, PID, "fire"), 1)
    if answered:
        first.reset()
        first.obey((1500, first.request.mark[1] - 10**6), 1)  # one that was late, and died before it looked again
    first.die()
    first.shared.files.remove()
    again = start()
    assert again.stopped_by == ("" if answered else "pid 7: fire")
    again.reset()
    again.die()
    again.shared.files.remove()
    assert not start().stopped_by


def test_who_asks_by_the_file_of_the_daemon_before_while_the_next_one_starts_is_heard(
    start: Callable[[], Daemon], monkeypatch: pytest.MonkeyPatch
) -> None:
    first = start()
    first.die()
    show = StopFiles.show

    def shown(self: StopFiles) -> None:
        first.request.request(1000, PID, "fire")
        show(self)

    monkeypatch.setattr(StopFiles, "show", shown)
    again = start()
    assert "fire" in again.stopped_by
    again.reset()
    assert not again.stopped_by


def test_a_stop_that_a_driver_notes_at_the_end_of_the_daemon_is_kept(start: Callable[[], Daemon]) -> None:
    first = start()
    first.obey((1000, time.time_ns()), 0)
    first.shared.files.remove()
    first.record.close()
    assert "fire" in start().stopped_by


def test_what_a_driver_of_the_daemon_before_obeys_stops_the_next_one(start: Callable[[], Daemon]) -> None:
    """Whoever had a session with the daemon that has died asks by its file, and is told that this has been taken."""
    first = start()
    first.die()
    again = start()
    again.reset()
    mark = first.request.request(1000, PID, "fire")
    first.obey(mark, 0)
    assert first.request.taken(mark)
    assert "fire" in again.stopped_by and again.shared.latch.stopped_ns
    again.reset()
    assert not again.stopped_by and not again.shared.latch.stopped_ns
    again.shared.files.remove()
    again.record.close()
    assert not start().stopped_by


@pytest.mark.parametrize("is_heard", [True, False])
def test_no_reset_ends_what_a_driver_of_the_daemon_before_has_obeyed_just_now(
    start: Callable[[], Daemon], is_heard: bool
) -> None:
    first = start()
    first.die()
    again = start()
    again.stops.stop_workcell("eva")
    first.obey(first.request.request(1000, PID, "fire"), 0)
    if is_heard:
        assert "fire" in again.stops.hear_request(), "which refuses the reset"
        assert not again.stops.hear_request()
    again.stops.reset_workcell("ann", time.monotonic_ns(), 1)
    again.stops.look()
    assert bool(again.shared.latch.stopped_ns) is not is_heard
    again.reset()
    assert not again.stopped_by and not again.shared.latch.stopped_ns


def test_what_drivers_note_late_of_the_daemons_own_file_stops_nobody_again(start: Callable[[], Daemon]) -> None:
    """Two ask at the same time, their words not in their order; a driver that has read the first notes it last."""
    daemon = start()
    first = daemon.request.request(2000, PID, "fire")
    daemon.request.request(1000, PID + 1, "smoke")
    daemon.reset()
    daemon.obey(first, 0)
    assert not daemon.stopped_by and not daemon.shared.latch.stopped_ns
