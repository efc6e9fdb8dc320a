"""The suite's own workcells: one that did not come up is no daemon for the tests after it."""

import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest


def test_a_workcell_that_did_not_come_up_is_tried_again_by_the_next_test(workcells, monkeypatch):
    asked, ended = [], []

    @contextmanager
    def at_work(group):
        asked.append(group)
        if len(asked) == 2:
            raise AssertionError("device iio up: not within 60 s")
        try:
            yield f"daemon {len(asked)}"
        finally:
            ended.append(len(asked))

    monkeypatch.setattr(sys.modules[type(workcells).__module__], "at_work", at_work)
    held = type(workcells)()
    assert held.at(0) == held.at(0) == "daemon 1"
    with pytest.raises(AssertionError, match="not within"):
        held.at(1)
    assert ended == [1], "the first one has ended"
    assert held.at(1) == "daemon 3"
    assert held.at(None) is None


def test_the_workcell_ends_behind_the_last_test_of_the_folder(workcells, monkeypatch):
    ended = []

    @contextmanager
    def at_work(group):
        yield "daemon"
        ended.append(group)

    rig = sys.modules[type(workcells).__module__]
    monkeypatch.setattr(rig, "at_work", at_work)
    monkeypatch.setattr(rig, "WORKCELLS", held := type(workcells)())
    here = Path(__file__).parent
    for following, count in ((here / "test_axis.py", 0), (here.parent / "process" / "test_stops.py", 1), (None, 2)):
        assert held.at(0) == "daemon"
        rig.pytest_runtest_teardown(nextitem=following and SimpleNamespace(path=following))
        assert len(ended) == count
