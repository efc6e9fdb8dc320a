"""The suite's own workcells: one that did not come up is no daemon for the tests after it."""

import sys
from contextlib import contextmanager

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
