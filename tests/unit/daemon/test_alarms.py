"""The daemon's list of alarms: latched until they are over and acknowledged, kept over its end."""

import pytest

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


@pytest.mark.parametrize("text", ["{}", "[1]", '[{"node": "x"}]', '[{"nod', "\x00"])
def test_a_damaged_file_is_told(tmp_path, text):
    path = tmp_path / "stops.alarms"
    path.write_text(text)
    with pytest.raises((ValueError, TypeError)):
        AlarmList().restore(AlarmFile(str(path)).load())
