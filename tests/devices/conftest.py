"""One workcell with every registered driver, for all suites."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from daemon_rig import Daemon
from device_rigs import RIGS, everything

import sioms


@pytest.fixture(scope="session")
def workcell() -> Iterator[Daemon]:
    with everything() as daemon:
        yield daemon


@pytest.fixture
def cell(workcell: Daemon) -> Iterator[sioms.Workcell]:
    """A session; nothing is stopped, and every device is up."""
    with workcell.cell("suite") as opened:
        opened.reset()
        for rig in RIGS:
            workcell.wait_up(rig.device)
        yield opened
