"""The daemon's list of alarms: latched until they are over and acknowledged, kept over its end."""

import errno
import json
import math
import os
import resource
import threading
from types import SimpleNamespace

import pytest

from sioms.daemon.alarm_keeper import AlarmKeeper
from sioms.daemon.alarms import MOST, AlarmFile, AlarmList


@pytest.fixture
def told():
    return []


@pytest.fixture
def alarms(told):
    return AlarmList(lambda event, alarm: told.append((event, alarm.node, alarm.severity)))


def states(alarms):
    return [(alarm.node, alarm.state, alarm.severity) for alarm in alarms]


def test_an_alarm_that_is_over_stands_until_somebody_acknowledges_it(alarms, told):
    alarms.take("m.x", "m", "force", 0, "", 1.0)
    assert states(alarms) == [] and told == []
    alarms.take("m.x", "m", "force", 1, "force 3 N", 2.0)
    alarms.take("m.x", "m", "force", 1, "force 4 N", 3.0)
    assert states(alarms) == [("m.x", "unacknowledged", 1)] and len(told) == 1
    alarms.take("m.x", "m", "force", 0, "", 4.0)
    assert states(alarms) == [("m.x", "returned", 0)]
    assert [alarm.text for alarm in alarms] == ["force 4 N"]
    (done,) = alarms.acknowledge(list(alarms), "eva", "seen", 5.0)
    assert (done.by, done.at, done.note) == ("eva", 5.0, "seen") and states(alarms) == []
    assert [event for event, *_ in told] == ["raised", "returned", "acknowledged"]


def test_an_acknowledged_alarm_goes_by_itself_and_comes_back_when_it_gets_worse(alarms):
    alarms.take("m.x", "m", "force", 1, "force 3 N", 1.0)
    alarms.acknowledge(list(alarms), "eva", "", 2.0)
    assert alarms.acknowledge(list(alarms), "tom", "", 3.0) == []
    assert states(alarms) == [("m.x", "acknowledged", 1)]
    alarms.take("m.x", "m", "force", 2, "force 9 N", 4.0)
    assert states(alarms) == [("m.x", "unacknowledged", 2)]
    alarms.acknowledge(list(alarms), "eva", "", 5.0)
    alarms.take("m.x", "m", "force", 1, "force 3 N", 6.0)
    assert states(alarms) == [("m.x", "acknowledged", 1)], "what eases has been acknowledged"
    alarms.take("m.x", "m", "force", 0, "", 7.0)
    assert states(alarms) == []


def test_what_a_dead_driver_watched_is_not_known(alarms):
    alarms.take("m.x", "m", "force", 1, "force 3 N", 1.0)
    alarms.take("m.y", "m", "fault", 2, "stalled", 1.0)
    alarms.take("n.x", "n", "force", 1, "force 3 N", 1.0)
    alarms.lose("m", "it died", 2.0)
    assert states(alarms) == [("m.x", "unacknowledged", 3), ("m.y", "returned", 0), ("n.x", "unacknowledged", 1)]


def test_they_are_bounded_and_those_that_are_over_go_first(alarms):
    for i in range(MOST):
        alarms.take(f"m.{i}", "m", "force", 1, "", i)
    alarms.take("m.7", "m", "force", 0, "", 2000.0)
    alarms.take("m.more", "m", "force", 1, "", 2001.0)
    assert len(list(alarms)) == MOST and "m.7" not in [alarm.node for alarm in alarms]


def test_they_outlive_the_daemon(alarms, tmp_path):
    file = AlarmFile(str(tmp_path / "stops.alarms"))
    assert file.load() == []
    for node in ("m.x", "m.y"):
        alarms.take(node, "m", "force", 1, "force 3 N", 1.0)
    alarms.acknowledge([next(iter(alarms))], "eva", "seen", 2.0)
    file.keep(alarms.entries())
    again = AlarmList()
    again.restore(file.load())
    assert states(again) == [("m.x", "acknowledged", 1), ("m.y", "unacknowledged", 1)]
    again.take("m.x", "m", "force", 1, "force 3 N", 3.0)
    assert states(again)[0] == ("m.x", "acknowledged", 1), "it was so before"
    file.keep([])
    assert not (tmp_path / "stops.alarms").exists()


GOOD = {"node": "m.x", "device": "m", "what": "force", "severity": 1, "text": "force 3 N", "since": 1.0}


def restored(path):
    """Return the alarms that a daemon finds in a file, and why it left some out."""
    alarms = AlarmList()
    try:
        return alarms, alarms.restore(AlarmFile(str(path)).load())
    except (OSError, ValueError) as error:  # what AlarmKeeper takes for a list that is lost
        return alarms, str(error)


@pytest.mark.parametrize(
    "text",
    ["{}", "[1]", '[{"node": "x"}]', '[{"nod', "\x00", "[" * 200_000, "[" + "9" * 5000 + "]", '"' * (1 << 21), "\udcff"]
    + [json.dumps([{**GOOD, name: value}]) for name, value in (
        ("severity", 17), ("severity", 10**30), ("severity", True), ("worst", -1), ("times", 1e3), ("since", math.nan),
        ("since", math.inf), ("at", -1.0), ("node", ""), ("node", "\ud800"), ("text", "\x1b[2J"), ("by", "x" * 300),
        ("what", ["force"]), ("more", 1),
    )],
)  # fmt: skip
def test_a_damaged_file_is_told_and_gives_no_alarm_that_could_not_be_shown(tmp_path, text):
    path = tmp_path / "stops.alarms"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    alarms, why = restored(path)
    assert why and not list(alarms)


def test_of_a_file_that_is_damaged_in_part_the_rest_is_kept(tmp_path):
    path = tmp_path / "stops.alarms"
    path.write_text(
        json.dumps([{**GOOD, "severity": 9}, GOOD, 7, *[{**GOOD, "node": f"n{i}"} for i in range(2 * MOST)]])
    )
    alarms, why = restored(path)
    assert "entry 0: severity is 9" in why
    assert len(list(alarms)) == MOST


@pytest.mark.parametrize("what", ["folder", "pipe", "link", "unreadable"])
def test_what_is_no_file_is_told_and_holds_up_nobody(tmp_path, what):
    path = tmp_path / "stops.alarms"
    match what:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "link":
            path.symlink_to("/dev/zero")
        case "unreadable":
            path.symlink_to(path)
    assert restored(path)[1]
    with pytest.raises(OSError):
        AlarmFile(str(path)).keep([GOOD])


def test_what_a_client_watches_outlives_the_driver(alarms):
    alarms.take("m.x", "m", "drift", 1, "backlash", 1.0)
    alarms.take("m.x", "m", "force", 1, "force 3 N", 1.0)
    alarms.lose("m", "it died", 2.0)
    assert [(alarm.what, alarm.severity) for alarm in alarms] == [("drift", 1), ("force", 3)]


def test_an_empty_file_is_a_list_that_is_lost(tmp_path):
    path = tmp_path / "stops.alarms"
    path.touch()
    assert "Expecting value" in restored(path)[1]


@pytest.mark.parametrize("fault", ["limit", "EIO", "ENOSPC", "EDQUOT", "EROFS"])
def test_what_cannot_be_kept_leaves_what_was_kept_before(tmp_path, monkeypatch, fault):
    path = tmp_path / "stops.alarms"
    file = AlarmFile(str(path))
    file.keep([GOOD])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with monkeypatch.context() as patch, pytest.raises(OSError):
        if fault == "limit":
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
        else:
            error = OSError(getattr(errno, fault), "no")
            patch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(error))
        try:
            file.keep([{**GOOD, "times": n} for n in range(50)])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [each.name for each in tmp_path.iterdir()] == ["stops.alarms"]
    assert file.load() == [GOOD]


def test_all_that_is_kept_is_on_the_disk(tmp_path, monkeypatch):
    synced = []
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (synced.append(os.readlink(f"/proc/self/fd/{fd}")), fsync(fd))[1])
    file = AlarmFile(str(tmp_path / "stops.alarms"))
    file.keep([GOOD])
    file.keep([])
    assert synced == [str(tmp_path / "stops.alarms.new"), str(tmp_path), str(tmp_path)]


class Timers:
    """The loop of a daemon, whose timers run when a test says so."""

    def __init__(self):
        self.due = []

    def after(self, _delay_s, callback):
        self.due.append(callback)

    def run(self):
        due, self.due = self.due, []
        for callback in due:
            callback()


def keeper_of(path):
    """Return what keeps the alarms of a daemon, its loop, and what it logs."""
    said, loop = [], Timers()
    cell = SimpleNamespace(loop=loop, log=lambda *text, **fields: said.append((*text, fields.get("why"))))
    return AlarmKeeper(cell, None, str(path)), loop, said


def test_a_disk_that_hangs_holds_up_no_daemon_and_the_newest_is_kept(tmp_path, monkeypatch):
    keeper, loop, _ = keeper_of(tmp_path / "stops.alarms")
    hangs, goes_on = threading.Event(), threading.Event()
    fsync = os.fsync

    def slow(fd):
        hangs.set()
        assert goes_on.wait(60.0)
        fsync(fd)

    monkeypatch.setattr(os, "fsync", slow)
    keeper.take("m.x", "m", "force", 1, "first")
    loop.run()
    assert hangs.wait(60.0)
    for n in range(3):  # the loop goes on
        keeper.take("m.x", "m", "force", 2, f"later {n}")
        loop.run()
    assert len(loop.due) == 1 and not (tmp_path / "stops.alarms").exists()
    goes_on.set()
    keeper._writer.join()
    loop.run()
    keeper.close()
    assert [entry["text"] for entry in AlarmFile(str(tmp_path / "stops.alarms")).load()] == ["later 2"]
    loop.run()
    assert not loop.due, "it rests when all is kept"


def test_what_changes_last_is_kept_at_the_end_and_a_failure_is_told(tmp_path):
    keeper, loop, said = keeper_of(tmp_path / "stops.alarms")
    keeper.take("m.x", "m", "force", 1, "first")
    keeper.close()
    assert len(AlarmFile(str(tmp_path / "stops.alarms")).load()) == 1
    os.unlink(tmp_path / "stops.alarms")
    (tmp_path / "stops.alarms").mkdir()
    keeper.take("m.y", "m", "force", 1, "second")
    loop.run()
    keeper._writer.join()
    loop.run()
    assert ("error", "not kept", "it is not a regular file") in said


@pytest.mark.parametrize("at_all", [False, True])
def test_without_a_thread_alarms_are_kept_all_the_same(tmp_path, monkeypatch, at_all):
    keeper, loop, _ = keeper_of(tmp_path / "stops.alarms")

    def none(_):
        raise RuntimeError("can't start new thread")

    if at_all:
        monkeypatch.setattr(threading.Thread, "start", none)
    keeper.take("m.x", "m", "force", 1, "first")
    loop.run()
    keeper.close()
    assert len(AlarmFile(str(tmp_path / "stops.alarms")).load()) == 1
