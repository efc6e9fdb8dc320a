"""Workcells of some registered drivers at a time, for all suites; the tests run in the order of these workcells."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from daemon_rig import Daemon
from device_rigs import GROUPS, at_work, group_of

import sioms


def _group(item: pytest.Item) -> int | None:
    """Return the group that a test is about; None when it needs no workcell of these."""
    callspec = getattr(item, "callspec", None)
    if callspec is None or "cell" not in getattr(item, "fixturenames", ()):
        return None
    found = [group_of(value) for value in callspec.params.values()]
    return next((number for number in found if number is not None), 0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the drivers' check, which takes longer than all else and mostly waits; put the tests of one workcell
    together.
    """

    def place(item: pytest.Item) -> int:
        if "shipped" in getattr(item, "fixturenames", ()):
            return -1
        group = _group(item)
        return len(GROUPS) if group is None else group

    items.sort(key=place)


class Workcells:
    """Has one workcell at work at a time."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._daemon: Daemon | None = None
        self._stack = ExitStack()

    def at(self, number: int | None) -> Daemon | None:
        """Return the daemon of a group, started if another was at work; None ends what is at work."""
        if number != self._number:
            self._stack.close()
            self._stack, self._number, self._daemon = ExitStack(), None, None
            if number is not None:
                self._daemon = self._stack.enter_context(at_work(GROUPS[number]))
            self._number = number  # of one that did not come up the next test tries again
        return self._daemon


WORKCELLS = Workcells()
FOLDER = Path(__file__).parent


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(nextitem: pytest.Item | None) -> None:
    """End the workcell behind the last test of this folder: it takes a quarter of a processor from all others."""
    if nextitem is None or FOLDER not in nextitem.path.parents:
        WORKCELLS.at(None)


@pytest.fixture
def workcells() -> Workcells:
    return WORKCELLS


@pytest.fixture(autouse=True)
def workcell(request: pytest.FixtureRequest) -> Daemon | None:
    """The workcell that the test is about."""
    return WORKCELLS.at(_group(request.node))


@pytest.fixture
def cell(request: pytest.FixtureRequest, workcell: Daemon) -> Iterator[sioms.Workcell]:
    """A session; nothing is stopped, and every device is up."""
    with workcell.cell("suite") as opened:
        opened.reset()
        for rig in GROUPS[_group(request.node) or 0]:
            workcell.wait_up(rig.device)
        yield opened
