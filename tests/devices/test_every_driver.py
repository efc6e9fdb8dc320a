"""What every driver must do, whatever it drives."""

from __future__ import annotations

import errno
import math
import os
import signal
import time
from importlib.metadata import entry_points

import pytest
from daemon_rig import Daemon, raises, wait_for
from device_rigs import GROUPS, RIGS, Rig, group_of

import sioms

every_rig = pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.title)
# The driver check kills the drivers with a line in motion, and that of converters.
UNCHECKED = [rig for rig in RIGS if not rig.line and rig.driver != "iio"]
every_unchecked_rig = pytest.mark.parametrize("rig", UNCHECKED, ids=lambda rig: rig.title)


OVER_OTHERS = {"arm", "gantry", "hand", "mill", "slits"}
"""Drivers whose axes are those of other devices: tests/process/test_compound.py, tests/unit/drivers/test_hand.py,
tests/unit/drivers/test_arm_and_mill.py."""


def test_every_registered_driver_has_a_rig() -> None:
    registered = {point.name for point in entry_points(group="sioms.drivers")} - OVER_OTHERS
    assert registered == {rig.title for rig in RIGS}, "add a rig to tests/device_rigs.py"
    assert all(rig.nodes for rig in RIGS)


@every_rig
def test_readings_are_finite_fresh_and_of_this_clock(cell: sioms.Workcell, rig: Rig) -> None:
    for name in rig.nodes:
        node = _reader(cell, name)
        with node:
            first = node.read()
            second = node.wait_new(first.number, 5.0)
            assert second.number > first.number and second.stamp_ns > first.stamp_ns
            assert -1e9 < time.monotonic_ns() - second.stamp_ns < 2e9
            for reading in second:
                assert all(math.isfinite(value) for value in reading)


@every_rig
def test_information_tells_what_the_node_is(cell: sioms.Workcell, rig: Rig) -> None:
    for name in rig.nodes:
        info = cell.info(name)
        assert info.driver == rig.driver and info.device == rig.device and 0.1 <= info.tick_hz <= 20_000
        names = [channel.name for channel in info.channels]
        assert len(set(names)) == len(names) == info.number_structs >= 1
        for channel in info.channels:
            if info.node_class is sioms.NodeClass.AXIS:
                assert channel.unit in ("m", "rad") and channel.modes and channel.limits["velocity"] > 0
            if info.node_class is sioms.NodeClass.BINARY:
                assert 1 <= channel.width <= 62


@every_rig
def test_outputs_are_exclusive_and_their_companions_are_not(cell: sioms.Workcell, rig: Rig) -> None:
    for name in [*(axis.node for axis in rig.axes), *(output.node for output in rig.outputs)]:
        with cell.open(name, "rw", timeout=2.0):
            with raises(errno.EBUSY, name):
                cell.open(name, "r")
            with cell.open(f"{name}.readonly") as first, cell.open(f"{name}.readonly") as second:
                first.read()
                second.read()


@every_rig
def test_statistics_are_told(cell: sioms.Workcell, rig: Rig) -> None:
    with _reader(cell, rig.nodes[0]) as node:
        report = node.statistics()
        assert report["ticks"] > 0 and report["handles"] >= 1
        if rig.simulator:
            assert report["link"]["received_bytes"] > 0


@every_unchecked_rig
def test_a_killed_driver_is_refused_and_comes_back(workcell: Daemon, cell: sioms.Workcell, rig: Rig) -> None:
    before = workcell.device(rig.device)
    others = {r.device: workcell.device(r.device)["pid"] for r in GROUPS[group_of(rig) or 0] if r is not rig}
    with _reader(cell, rig.nodes[0]) as node:
        node.read()
        os.kill(before["pid"], signal.SIGKILL)
        with raises(errno.EIO, node.name):
            wait_for(lambda: node.read() and False, "reads are refused")
    after = workcell.wait_up(rig.device, before["generation"] + 1)
    assert after["pid"] != before["pid"]
    with _reader(cell, rig.nodes[0]) as node:
        node.read()
    assert {name: workcell.device(name)["pid"] for name in others} == others


def _reader(cell: sioms.Workcell, name: str) -> sioms.Node:
    """Open a node for reading without owning it."""
    read_only = cell.info(name).read_only
    return cell.open(name if read_only else f"{name}.readonly")
