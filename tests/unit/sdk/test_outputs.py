"""Outputs: what a bit write begins from, and safe values as state."""

from __future__ import annotations

import pytest

from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BinaryBlock, BlockSpec
from sioms.sdk.outputs import WHOLE, Change, Outputs, safe_of


class Rig:
    """A port of 8 bits with the safe value 0x03, on a device whose bits are ``device``."""

    def __init__(self) -> None:
        port = ChannelInfo("do", minimum=0, maximum=255, width=8)
        self.block = BinaryBlock(BlockSpec("", NodeClass.BINARY, (port,), writable=True, safe=(3.0,)))
        self.outputs, self.device, self.stopped = Outputs(), 0, False

    def poll(self) -> None:
        mark = self.outputs.mark()
        self.block.set(0, self.device, 1)
        self.outputs.read(self.block, mark, lambda channel: self.stopped)

    def write(self, mask: int, value: int, taken: bool = True) -> None:
        changes = {0: Change(mask, value)}
        self.outputs.release(self.block, changes)
        self._send(changes, taken)

    def send_safe(self, taken: bool = True) -> bool:
        changes = self.outputs.unsent(self.block)
        if changes:
            self._send(changes, taken)
        return bool(changes)

    def _send(self, changes: dict[int, Change], taken: bool) -> None:
        channels, values = self.outputs.merged(self.block, changes)
        if taken:
            self.device = int(values[0])
            self.outputs.acknowledge(self.block, channels, values)

    def want(self, bit: int = -1) -> None:
        safe = safe_of(self.block.spec, 0, bit)
        assert safe is not None
        self.outputs.want(self.block, 0, safe)


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_bits_that_are_acknowledged_between_two_readings_add_up(rig: Rig) -> None:
    rig.poll()
    for bit in (1, 4, 7):
        rig.write(1 << bit, 1 << bit)
    assert rig.device == 0x92


def test_a_bit_that_was_refused_or_dropped_does_not_come_back(rig: Rig) -> None:
    rig.write(0x80, 0x80)
    rig.write(0x20, 0x20, taken=False)
    rig.poll()
    rig.write(0x01, 0x01)
    assert rig.device == 0x81
    rig.device = 0
    rig.poll()
    rig.write(0x02, 0x02)
    assert rig.device == 0x02


def test_what_was_acknowledged_does_not_outlive_the_link(rig: Rig) -> None:
    rig.poll()
    rig.write(0x80, 0x80)
    rig.outputs.forget([rig.block])
    rig.write(0x01, 0x01)
    assert rig.device == 0x01


def test_a_reading_from_before_a_write_changes_nothing(rig: Rig) -> None:
    rig.poll()
    mark = rig.outputs.mark()
    rig.write(0x80, 0x80)
    rig.block.set(0, 0, 2)  # the poll had asked before the write
    rig.outputs.read(rig.block, mark, lambda channel: False)
    rig.write(0x01, 0x01)
    assert rig.device == 0x81


def test_a_safe_value_is_wanted_until_acknowledged_and_read(rig: Rig) -> None:
    rig.write(0xFF, 0xF0)
    rig.want()
    for _ in range(5):
        assert rig.send_safe(taken=False)
        rig.poll()
    assert rig.outputs.unconfirmed(rig.block)
    assert rig.send_safe()
    assert rig.outputs.unconfirmed(rig.block), "not before it is read"
    rig.device = 0xF0  # it said yes and did not
    rig.poll()
    assert rig.send_safe()
    rig.poll()
    assert rig.device == 3 and not rig.outputs.unconfirmed(rig.block) and not rig.send_safe()
    rig.device = 0xF0  # no stop: others may set what nobody holds
    rig.poll()
    assert not rig.send_safe()


def test_a_value_that_happens_to_read_safe_is_sent_all_the_same(rig: Rig) -> None:
    rig.device = 3  # not so: the reply to a write of something else was lost
    rig.poll()
    rig.want()
    rig.poll()
    assert rig.send_safe()


def test_under_a_stop_the_safe_value_holds_against_everything(rig: Rig) -> None:
    rig.stopped = True
    rig.want()
    rig.send_safe()
    rig.poll()
    assert not rig.send_safe()
    rig.device = 0xFF
    rig.poll()
    assert rig.send_safe() and rig.device == 3
    rig.outputs.forget([rig.block])
    assert rig.send_safe(), "after the link was lost"


def test_safe_bits_of_one_writer_leave_the_bits_of_others(rig: Rig) -> None:
    rig.write(0x80, 0x80)
    rig.write(0x40, 0x40)
    rig.poll()
    rig.want(bit=6)
    rig.send_safe()
    assert rig.device == 0x80
    rig.want(bit=0)
    rig.write(0x10, 0x10)  # a write of others carries the safe bits that are wanted
    assert rig.device == 0x91
    rig.write(0x01, 0x00)  # who holds the bit now says what it is
    rig.poll()
    assert rig.device == 0x90 and not rig.send_safe()


def test_an_analog_value_is_confirmed_within_the_steps_of_its_converter() -> None:
    volts = ChannelInfo("v", "V", 0.0, 10.0)
    block = AnalogBlock(BlockSpec("", NodeClass.ANALOG, (volts,), writable=True, safe=(1.0,)))
    outputs = Outputs()
    safe = safe_of(block.spec, 0)
    assert safe == Change(WHOLE, 1.0)
    outputs.want(block, 0, safe)
    outputs.acknowledge(block, [0], [1.0])
    for reading, confirmed in ((3.0, False), (1.02, True)):
        block.data[0] = reading
        outputs.read(block, outputs.mark(), lambda channel: True)
        assert outputs.unconfirmed(block) is not confirmed
        if not confirmed:
            assert outputs.merged(block, outputs.unsent(block)) == ([0], [1.0])
            outputs.acknowledge(block, [0], [1.0])


@pytest.mark.parametrize(
    ("mask", "value", "expected"), [(0xFF, 3, False), (0xF0, 0, False), (0xFF, 7, True), (0x02, 0, True)]
)
def test_a_write_of_what_is_safe_contradicts_nothing(mask: int, value: int, expected: bool) -> None:
    assert Change(mask, value).contradicts(Change(0xFF, 3)) is expected


def test_only_outputs_with_a_safe_value_have_one() -> None:
    port = ChannelInfo("do", minimum=0, maximum=3, width=2)
    assert safe_of(BlockSpec("", NodeClass.BINARY, (port,), writable=True, safe=(None,)), 0) is None
    assert safe_of(BlockSpec("", NodeClass.BINARY, (port,), writable=True), 0) is None
    assert safe_of(BlockSpec("", NodeClass.BINARY, (port,)), 0) is None


def test_a_reading_from_before_the_safe_value_confirms_nothing(rig: Rig) -> None:
    rig.want()
    mark = rig.outputs.mark()
    rig.send_safe()
    rig.block.set(0, 3, 1)  # what it read before: the write of something else may have been under way
    rig.outputs.read(rig.block, mark, lambda channel: False)
    assert rig.outputs.unconfirmed(rig.block)
