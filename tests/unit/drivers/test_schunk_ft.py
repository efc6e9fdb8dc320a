"""The driver of SCHUNK's Ethernet sensors against the simulated one, on an invented clock and without a line."""

from __future__ import annotations

import errno
from typing import Any

import pytest
from force_rig import INVALID, LOAD, SATURATED, Rig, check_refused, steps_of

from sioms.drivers.schunk_ft import SchunkFt
from sioms.protocol.flags import Request
from sioms.sdk.driver import Refusal
from sioms.sdk.exchange import DeviceError, LinkError
from sioms.tools.counterparts import schunk_ifb


class SchunkRig(Rig):
    def __init__(self, **table: Any) -> None:
        super().__init__(SchunkFt, {"line": {"tcp": "192.168.0.100:82"}, **table})
        self.device = schunk_ifb.Sensor(schunk_ifb.options_parser().parse_args([]), self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.aside = lambda data: b"".join(self.device.take(data))

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
    other_kind = bytearray(sent[7])
    other_kind[6] = 0x41
    for wrong in (b"", sent[7][:-1], bytes(other_kind)):
        assert rig.arrive(wrong) == 0
    counters = rig.driver.counters()
    assert [counters[name] for name in ("lost", "late", "doubled", "malformed")] == [1, 1, 1, 3]


def test_another_sensor_is_refused() -> None:
    for table, parameter, value, words in (
        ({"product": "FTN"}, (1, 0), b"KMS", "calls itself 'KMS'; the configuration says 'FTN'"),
        ({}, (0x50, 0), b"\x01", "has unit selection 1; N and N\\*m, 0, are right"),
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
    rig.aside = lambda data: b"HTTP/1.0 400 Bad Request"
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
