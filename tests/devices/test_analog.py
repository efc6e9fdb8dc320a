"""What every analog node must do, whichever driver it belongs to.

Good values in their range are what a driver gives; offsets, gains and rights are the kit's alone, and are tried on a
node that ticks by itself and on one whose device pushes.
"""

from __future__ import annotations

import errno
import math

import numpy as np
import pytest
from daemon_rig import raises, wait_for
from device_rigs import RIGS

import sioms
from sioms.protocol.flags import AnalogStatus

NODES = [name for rig in RIGS for name in rig.analogs]
every_node = pytest.mark.parametrize("name", NODES)
KINDS = [name for name in NODES if name in ("sim_force", "ascii_stream")]
every_kind = pytest.mark.parametrize("name", KINDS)


def test_both_kinds_of_node_are_tried() -> None:
    assert len(KINDS) == 2, "a node of the rigs is called otherwise"


@every_node
def test_values_are_good_and_in_range(cell: sioms.Workcell, name: str) -> None:
    with cell.open(name) as node:
        number = node.read().number
        node.wait_new(number + 20, 5.0)
        history = node.history(number)
        assert len(history) >= 10
        for snapshot in history:
            assert not any(flag & AnalogStatus.INVALID for flag in snapshot.flags)
            for value, channel in zip(snapshot.data, node.info.channels, strict=True):
                low = -math.inf if channel.minimum is None else channel.minimum
                high = math.inf if channel.maximum is None else channel.maximum
                assert low <= value <= high


@every_kind
def test_zero_takes_the_mean_as_offset(cell: sioms.Workcell, name: str) -> None:
    with cell.open(name) as node:
        node.zero(20, 10.0)
        number = node.read().number
        node.wait_new(number + 30, 10.0)
        values = np.array([snapshot.data for snapshot in node.history(number)])
        spread = values.std(axis=0) + 1e-12
        assert (np.abs(values.mean(axis=0)) <= 5 * spread).all()
        with raises(errno.EINVAL, "samples"):
            node.zero(0)


@every_kind
def test_gains_are_applied_and_told(cell: sioms.Workcell, name: str) -> None:
    with cell.open(name) as node:
        n = len(node.info.channels)
        assert node.gains() == np.eye(n).ravel().tolist()
        node.set_gains([0.0] * n)
        wait_for(lambda: all(value == 0.0 for value in node.read().data), "no gain, no value")
        rows = np.eye(n)
        rows[0] = 0.0
        node.set_gains(rows.ravel().tolist())
        wait_for(lambda: node.read().data[0] == 0.0, "the first alone")
        with raises(errno.EINVAL, "gain"):
            node.set_gains([1.0] * (n + 1))
        node.set_gains([1.0] * n)


@every_kind
def test_it_cannot_be_written(cell: sioms.Workcell, name: str) -> None:
    with raises(errno.EACCES, "read-only"):
        cell.open(name, "rw")


@every_kind
def test_a_channel_is_the_column_of_its_array(cell: sioms.Workcell, name: str) -> None:
    info = cell.info(name)
    last = info.channels[-1].name
    with cell.open(name) as whole, cell.open(f"{name}.{last}") as part:
        for _ in range(100):
            one, all_ = part.read(), whole.read()
            if one.number == all_.number:
                assert one.data == (all_.data[-1],)
                return
        pytest.fail("never the same snapshot")
