"""What every binary node must do, whichever driver it belongs to."""

from __future__ import annotations

import errno

import pytest
from daemon_rig import Daemon, raises, wait_for
from device_rigs import RIGS, Output

import sioms
from sioms.protocol.records import BINARY_WRITE

OUTPUTS = [output for rig in RIGS for output in rig.outputs]
INPUTS = [name for rig in RIGS for name in rig.inputs]
every_output = pytest.mark.parametrize("output", OUTPUTS, ids=lambda output: output.node)


def shows(node: sioms.BinaryNode, value: int) -> None:
    wait_for(lambda: node.read().data[0] == value, f"{node.name} shows {value:#x}, not {node.read().data[0]:#x}")


@every_output
def test_what_is_written_is_read_back(cell: sioms.Workcell, output: Output) -> None:
    top = (1 << output.width) - 1
    with cell.open(output.node, "rw", timeout=2.0) as node:
        for value in (0, top, 0b1010 & top, 1):
            before = node.read()
            node.set(value)
            shows(node, value)
            after = node.read()
            if before.data[0] != value:
                assert after.edges[0] > before.edges[0] and after.changed_ns[0] > before.changed_ns[0]


@every_output
def test_values_beyond_its_width_are_refused(cell: sioms.Workcell, output: Output) -> None:
    with cell.open(output.node, "rw", timeout=2.0) as node:
        node.set(1)
        shows(node, 1)
        for value in (1 << output.width, -1):
            with raises(errno.EINVAL, f"data {value}"):
                node.set(value)
        with raises(errno.EINVAL, "channel 1"):
            node.write([*(BINARY_WRITE.pack(i, 0, 0, 0) for i in (0, 1))])
        assert node.read().data[0] == 1, "nothing of a refused write was taken"


@every_output
def test_bits_have_owners_of_their_own(cell: sioms.Workcell, output: Output) -> None:
    last = output.width - 1
    with (
        cell.open(f"{output.node}.bit0", "rw", timeout=2.0) as low,
        cell.open(f"{output.node}.bit{last}", "rw", timeout=2.0) as high,
        cell.open(f"{output.node}.readonly") as seen,
    ):
        low.set(0)
        high.set(0)
        wait_for(lambda: not seen.read().data[0] & (1 | 1 << last), "both low")
        high.set(1)
        wait_for(lambda: seen.read().data[0] >> last & 1, "the high bit")
        assert not seen.read().data[0] & 1 and high.read().data == (1,) and low.read().data == (0,)
        with raises(errno.EBUSY, f"{output.node}.bit0"):
            cell.open(output.node, "rw")


@every_output
def test_outputs_become_safe_with_their_writer(cell: sioms.Workcell, output: Output) -> None:
    other = 0b10 if output.safe != 0b10 else 0b01
    with cell.open(f"{output.node}.readonly") as seen:
        with cell.open(output.node, "rw", timeout=2.0) as node:
            node.set(other)
            shows(seen, other)
        shows(seen, other if output.safe is None else output.safe)


@every_output
def test_outputs_become_safe_with_an_emergency_stop(workcell: Daemon, cell: sioms.Workcell, output: Output) -> None:
    other = 0b10 if output.safe != 0b10 else 0b01
    with cell.open(output.node, "rw", timeout=2.0) as node:
        node.set(other)
        shows(node, other)
        cell.emergency_stop(why="suite")
        shows(node, other if output.safe is None else output.safe)
        with raises(errno.EPERM, output.node, "suite"):
            node.set(other)
        cell.reset()
        wait_for(lambda: _takes(node, other), "outputs again")
        shows(node, other)


def _takes(node: sioms.BinaryNode, value: int) -> bool:
    try:
        node.set(value)
    except OSError as error:
        assert error.errno == errno.EPERM
        return False
    return True


@pytest.mark.parametrize("name", INPUTS)
def test_inputs_are_read_only_and_wait_for_edges(cell: sioms.Workcell, name: str) -> None:
    with raises(errno.EACCES, "read-only"):
        cell.open(name, "rw")
    with cell.open(name) as node, pytest.raises(TimeoutError):
        node.wait_event(timeout=0.02)
    with cell.open(f"{name}.bit0") as bit:
        assert bit.read().data in ((0,), (1,))
