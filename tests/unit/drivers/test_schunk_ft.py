"""The driver of SCHUNK's Ethernet sensors against the simulated one, on an invented clock and without a line."""

from __future__ import annotations

import errno
from typing import Any

import numpy as np
import pytest
from force_rig import INVALID, LOAD, SATURATED, Rig, check_refused, steps_of

from sioms.drivers.schunk_ft import simulator as schunk_ifb
from sioms.drivers.schunk_ft.driver import SchunkFt
from sioms.protocol.flags import Request
from sioms.sdk.driver import Refusal
from sioms.sdk.exchange import DeviceError, LinkError


class SchunkRig(Rig):
    def __init__(self, *options: str, **table: Any) -> None:
        super().__init__(SchunkFt, {"line": {"tcp": "192.168.0.100:82"}, **table})
        self.device = schunk_ifb.Sensor(schunk_ifb.options_parser().parse_args(options), self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.replies = 0
        self.side_line = self._reply

    def _reply(self, data: bytes) -> bytes:
        self.replies += 1
        return self.device.take(data, self.replies) or b"" if self.device.supply.is_on else b""

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.now_s += 0.001
            self.device.due(self.arrive)


def test_streams() -> None:
    rig = SchunkRig(tool=2, noise_filter=3, full_scale=(400, 400, 1000, 15, 15, 15))
    assert str(rig.driver.line) == "192.168.0.100:0" and rig.driver.line.local == "0.0.0.0:54843"
    rig.device.streaming = True
    rig.do(rig.driver.open())
    assert rig.device.streaming and rig.device.selected == {0x30: 2, 0x31: 3}
    assert rig.said == ["info: identified f0 at 192.168.0.100:82: KMS, firmware 1.0.4"]
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(4.0)
    assert rig.data == pytest.approx(LOAD, rel=1e-6) and rig.flags == 0
    steps = steps_of(rig.published[2500:])
    assert steps.min() > 0.99e6 and steps.max() < 1.01e6
    rig.device.load.put(rig.now_s, (500, 0, 0, 0, 0, 0))
    rig.go(0.01)
    assert rig.flags == SATURATED and rig.driver.counters()["status"] == "loaded beyond its mechanical range"
    for bits, flags in ((0x20, SATURATED), (0x02, INVALID), (0x08, INVALID), (0x04, 0)):
        rig.device.load.put(rig.now_s, LOAD)
        rig.device.extra_status = bits
        rig.go(0.01)
        assert rig.flags == flags, hex(bits)
    rig.do(rig.driver.close())
    assert not rig.device.streaming


def test_tare_and_its_way_back() -> None:
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(0.01)
    (block,) = rig.driver.blocks
    for argument, expected in ((None, [0.0] * 6), (0, LOAD), ([], None), ([0], LOAD), (1, None)):
        if expected is None:
            with pytest.raises(Refusal, match="want nothing for a tare, or 0"):
                rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), argument)
            continue
        rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), argument))
        rig.go(0.01)
        assert rig.data == pytest.approx(expected, abs=1e-5)


def test_loss_and_other_datagrams() -> None:
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(0.05)
    sent: list[bytes] = []
    for _ in range(10):
        rig.now_s += 0.001
        rig.device.due(sent.append)
    for i in (0, 1, 4, 3, 3, 5, 6):
        rig.arrive(sent[i])
    for wrong in (b"", sent[7][:-1], b"\xff\xfe" + sent[7][2:]):
        assert rig.arrive(wrong) == 0
    counters = rig.driver.counters()
    assert [counters[name] for name in ("lost", "late", "doubled", "malformed")] == [1, 1, 1, 3]


def test_no_record_is_dropped_for_its_second_counter() -> None:
    """The byte behind the length counts with every record; taken for a kind, 255 of 256 were dropped."""
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(1.0)
    assert len(rig.published) in (999, 1000, 1001) and rig.driver.counters()["malformed"] == 0
    assert rig.driver.counters()["lost"] == 0


def test_replies_are_numbered_by_the_box() -> None:
    """After a loss of the connection the box counts its replies from 1 again, whatever number the command has."""
    rig = SchunkRig()
    for _ in range(3):
        rig.replies = 0
        rig.do(rig.driver.open())
        rig.go(0.01)
    assert len(rig.published) > 20
    rig.side_line = lambda data: b"\xff\xff\x07\x00\x02\x00\x12\x00"
    with pytest.raises(LinkError, match="stop: the reply 12 00 does not answer command 41"):
        rig.do(rig.driver.open())


def test_the_vendors_simulator_is_taken() -> None:
    """It answers every parameter with its name, the units too."""
    rig = SchunkRig("--vendor", product="KMS")
    rig.do(rig.driver.open())
    rig.go(0.5)
    assert len(rig.published) > 490 and rig.flags == 0
    assert "it answers every parameter with its name" in rig.said[0]


@pytest.mark.parametrize("window", [1, 3, 8, 20])
def test_a_frozen_stream_is_none(window: int) -> None:
    """One record again and again, or some in a ring: not one of them is good, for as long as it lasts; then it is read
    again.
    """
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(0.5)
    sent: list[bytes] = []
    while len(sent) < window:
        rig.now_s += 0.001
        rig.device.due(sent.append)
    for record in sent:
        rig.arrive(record)
    before = len(rig.published)
    for _ in range(3):
        for i in range(2000):
            rig.now_s += 0.001
            assert rig.arrive(sent[i % window]) == 0
        assert "the sensor is frozen" in rig.driver.trouble
        rig.do(rig.driver.open())
    rig.go(0.1)
    assert len(rig.published) > before + 90


def test_a_quiet_coarse_sensor_is_alive() -> None:
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(3.0)
    assert {tuple(values) for _, values, _ in rig.published} == {(0.0,) * 6} and len(rig.published) > 2990


def test_a_restart_within_the_time_of_a_lost_link_is_told() -> None:
    """A box that streams by itself after 50 ms without power: set up anew before it is read, its tare told as lost."""
    rig = SchunkRig(noise_filter=2)
    rig.do(rig.driver.open())
    rig.go(0.5)
    (block,) = rig.driver.blocks
    rig.device.load.put(rig.now_s, LOAD)
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    assert rig.data == pytest.approx([0.0] * 6, abs=1e-5) and rig.flags == 0
    rig.device.supply.cycle("0.05")
    rig.device.streaming, rig.device.next_s = True, rig.now_s + 0.05
    before = len(rig.published)
    with pytest.raises(LinkError, match=r"began anew at 1 after \d+: it has restarted"):
        rig.go(0.2)
    assert len(rig.published) == before, "nothing of the restarted sensor is read"
    rig.do(rig.driver.open())
    assert rig.device.selected[0x31] == 2
    rig.go(0.1)
    assert rig.data == pytest.approx(LOAD) and rig.flags == INVALID
    assert "zero lost: its tare may be gone: the sensor restarted; zero it again" in rig.driver.counters()["status"]
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    assert rig.data == pytest.approx([0.0] * 6, abs=1e-5) and rig.flags == 0


@pytest.mark.parametrize(("off_s", "lost"), [(0.3, True), (4.0, True), (0.0, False)])
def test_a_tare_is_told_as_lost_when_the_sensor_was_without_power(off_s: float, lost: bool) -> None:
    """After a silence of the network alone the counter stands where time has brought it, and the tare is kept."""
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(5.0)
    (block,) = rig.driver.blocks
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    if off_s:
        rig.device.supply.cycle(str(off_s))
    for _ in range(4500):
        rig.now_s += 0.001
        rig.device.due(lambda record: None)
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert (rig.flags == INVALID) is lost
    if lost:
        block.set_offset(np.arange(6), np.full(6, 0.5))  # as ZERO_DEVICE does
        rig.go(0.1)
        assert rig.flags == 0 and rig.driver.counters()["status"] == "ok"


def test_refusals_and_other_masters() -> None:
    rig = SchunkRig(noise_filter=1)
    rig.do(rig.driver.open())
    (block,) = rig.driver.blocks
    rig.device.refusals.set("1")
    with pytest.raises(DeviceError, match="tare: the sensor answers error 04, busy"):
        rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    assert not block.is_zeroed
    rig.device.refusals.set("2")
    with pytest.raises(DeviceError, match=r"open f0 at .*: noise filter 1: .*busy"):
        rig.do(rig.driver.open())
    handlers = rig.device.handlers()
    handlers["foreign"]("stop")
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert rig.device.streaming and len(rig.published) > 90


def test_another_sensor_is_refused() -> None:
    for table, parameter, value, words in (
        ({"product": "FTN"}, (1, 0), b"KMS", "calls itself 'KMS'; the configuration says 'FTN'"),
        ({}, (0x50, 0), b"\x01", "has unit selection 1; want 0 \\(N and N\\*m\\)"),
    ):
        rig = SchunkRig(**table)
        rig.device.parameters[parameter] = value
        with pytest.raises(DeviceError, match=words) as caught:
            rig.do(rig.driver.open())
        assert caught.value.errno == errno.ENODEV and not rig.device.streaming
    rig = SchunkRig()
    del rig.device.parameters[1, 0]
    with pytest.raises(
        DeviceError,
        match=r"open f0 at 192.168.0.100:82: read parameter 0x0001/0: .*error 14, unknown subindex",
    ):
        rig.do(rig.driver.open())
    rig.side_line = lambda data: b"HTTP/1.0 400 Bad Request"
    with pytest.raises(LinkError, match=r"open f0: stop: 48 54 54 50 2f 31 begins no reply of this sensor"):
        rig.do(rig.driver.open())


def test_the_simulated_sensor_does_not_lag_behind_its_clock() -> None:
    """A process that was held up for long sends what is measured now; what was missed counts as lost."""
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(0.05)
    rig.now_s += 20.0
    rig.go(0.05)
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 5e-3
    assert rig.driver.counters()["lost"] == pytest.approx(20000, abs=300)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"line": {"udp": "h:1"}}, "the box takes commands on TCP"),
        ({"data": "54843"}, "data = \"54843\"; want \"0.0.0.0:54843\""),
        ({"data": "0.0.0.0:0"}, "want \"0.0.0.0:54843\""),
        ({"tool": 4}, "tool = 4; want 0 to 3"),
        ({"noise_filter": -1}, "noise_filter = -1; want 0 to 4"),
    ],
)  # fmt: skip
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    check_refused(SchunkFt, {"line": {"tcp": "h:82"}, **table}, words)
