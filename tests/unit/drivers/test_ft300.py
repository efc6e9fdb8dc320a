"""The driver of Robotiq's FT 300 against the simulated sensor, on an invented clock and without a line."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import pytest
from force_rig import LOAD, OVERRUN, SATURATED, Rig, check_refused, steps_of
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.ft300 import simulator as ft300
from sioms.drivers.ft300.driver import Ft300
from sioms.sdk.driver import LineDriver, StreamDriver
from sioms.sdk.exchange import DeviceError, LinkError, Pause, Send, Steps

RECORD_S = 16 * 10 / 19200


class FtRig(Rig):
    def __init__(self, **table: Any) -> None:
        super().__init__(Ft300, {"line": {"serial": "/x", "baud": 19200}, **table})
        self.device = ft300.Sensor(9, "FT3-21", 123456, self.now)
        self.device.load.noise_n, self.device.load.noise_nm = 0.02, 0.001  # a fifth of the data sheet's
        self.on_line = lambda data: b"".join(self.device.take(data))

    def go(self, seconds: float, bend: Callable[[bytes], bytes] = lambda data: data) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.001
            for record in self.device.due():
                sent_s, self.now_s = self.now_s, self.now_s + RECORD_S
                self.arrive(bend(record))
                self.now_s = sent_s


def test_streams() -> None:
    rig = FtRig()
    assert isinstance(rig.driver, StreamDriver)
    rig.device.streaming = True  # the last host has left it so
    rig.do(rig.driver.open())
    assert rig.device.streaming and rig.said == [
        "info: identify f0 at address 9 on /x: firmware FT3-21, serial number 123456 of 2019"
    ]
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(1.0)
    assert rig.data == pytest.approx(LOAD, abs=0.1) and rig.flags == 0
    assert len(rig.published) in (99, 100, 101)
    age_s = rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9
    assert -1e-6 <= age_s < 0.02
    rig.device.load.put(rig.now_s, (310, 0, 0, 0, 0, 0))
    rig.go(0.1)
    assert rig.flags == SATURATED and rig.driver.counters()["saturated"] > 0
    rig.do(rig.driver.close())
    assert not rig.device.streaming


def test_records_in_pairs_are_a_period_apart() -> None:
    """At its default latency a USB adapter hands the records over two at a time."""
    rig = FtRig()
    rig.do(rig.driver.open())
    held: list[bytes] = []
    for _ in range(100):
        rig.now_s += 0.01
        held += rig.device.due()
        if len(held) >= 2:
            assert rig.arrive(b"".join(held)) == len(held)
            held.clear()
    assert set(steps_of(rig.published[2:])) <= {10_000_000, 9_999_999, 10_000_001}


def test_damaged_records_are_lost_and_flagged() -> None:
    rig = FtRig()
    rig.do(rig.driver.open())
    rig.go(0.2)
    flip = [True]

    def bend(record: bytes) -> bytes:
        return record[:5] + bytes((record[5] ^ 1,)) + record[6:] if flip and flip.pop() else record

    before = len(rig.published)
    rig.go(0.2, bend)
    assert [flags for _, _, flags in rig.published[before:]].count(OVERRUN) == 1
    counters = rig.driver.counters()
    assert counters["lost"] == 1 and counters["bad_crc"] == 1 and counters["skipped_bytes"] == 16


def test_a_sensor_that_repeats_itself_is_none() -> None:
    """Twelve equal records of six noisy channels: the stream is dead, also behind an opening, until one differs."""
    rig = FtRig()
    rig.do(rig.driver.open())
    rig.go(0.5)
    handlers = rig.device.handlers()
    handlers["freeze"]()
    before = len(rig.published)
    rig.go(2.0)
    assert len(rig.published) - before <= 12
    before = len(rig.published)
    for _ in range(2):
        rig.do(rig.driver.open())
        rig.go(1.0)
        assert len(rig.published) == before
        assert "records were all the same, which no measurement is: the sensor is frozen" in rig.driver.trouble
    handlers["freeze"]("0")
    rig.go(0.2)
    assert len(rig.published) > before + 15 and rig.driver.trouble == ""


def test_polls_of_registers_that_stand_still_are_a_lost_link() -> None:
    rig = FtRig(mode="modbus")
    (unit,) = rig.driver.units
    rig.do(unit.open())
    for _ in range(20):
        rig.now_s += 0.025
        rig.do(unit.poll())
    rig.device.handlers()["freeze"]()
    with pytest.raises(LinkError, match="the last 13 records were all the same"):
        for _ in range(13):
            rig.now_s += 0.025
            rig.do(unit.poll())
    rig.device.handlers()["freeze"]("0")
    rig.do(unit.open())
    rig.do(unit.poll())


def test_another_master_that_starts_or_ends_the_stream() -> None:
    """A sensor that streams answers no poll, one that was told to stop is silent: both are opened again."""
    rig = FtRig(mode="modbus")
    (unit,) = rig.driver.units
    rig.do(unit.open())
    rig.do(unit.poll())
    foreign = rig.device.handlers()["foreign"]
    foreign("stream")
    with pytest.raises(LinkError):
        rig.do(unit.poll())
    rig.do(unit.open())
    rig.do(unit.poll())
    rig = FtRig()
    rig.do(rig.driver.open())
    rig.go(0.2)
    rig.device.handlers()["foreign"]("stop")
    before = len(rig.published)
    rig.go(0.5)
    assert len(rig.published) == before
    rig.do(rig.driver.open())
    rig.go(0.2)
    assert len(rig.published) > before + 10
    rig.device.handlers()["refuse"]("1")
    with pytest.raises(DeviceError):
        rig.do(rig.driver.open())


@pytest.mark.parametrize("streams", [True, False])
@pytest.mark.parametrize("mode", ["stream", "modbus"])
def test_a_power_cycle(mode: str, streams: bool) -> None:
    """Whether it streams from power on, as the vendor's driver expects, or waits: it is opened again and read again."""
    rig = FtRig(mode=mode)
    rig.device.streams = streams
    target = rig.driver if mode == "stream" else rig.driver.units[0]
    rig.do(target.open())
    rig.device.supply.cycle("3")
    rig.now_s += 0.1
    with pytest.raises(LinkError):
        rig.do(target.open())
    rig.now_s += 3.0
    rig.do(target.open())
    rig.device.load.put(rig.now_s, LOAD)
    if mode == "stream":
        rig.go(0.1)
        assert rig.data == pytest.approx(LOAD, abs=0.1)
    else:
        rig.do(target.poll())
        assert list(target.force.data) == pytest.approx(LOAD, abs=0.1)


def test_polls() -> None:
    rig = FtRig(mode="modbus", acceleration=True, poll_hz=30.0)
    assert isinstance(rig.driver, LineDriver)
    (unit,) = rig.driver.units
    rig.device.streaming = True
    rig.do(unit.open())
    assert not rig.device.streaming
    rig.device.load.put(rig.now_s, LOAD)
    rig.do(unit.poll())
    force, acceleration = unit.blocks
    assert force.data == pytest.approx(LOAD, abs=0.1)
    assert acceleration.data == pytest.approx([0.0, 0.0, 9.80665])
    plain = FtRig(mode="modbus")
    (unit,) = plain.driver.units
    plain.do(unit.open())
    plain.device.load.put(plain.now_s, (-300.5, 0, 0, 0, 0, -30.0))
    plain.do(unit.poll())
    assert list(unit.blocks[0].flags) == [SATURATED, 0, 0, 0, 0, SATURATED] and len(unit.blocks) == 1


@pytest.mark.parametrize("mode", ["stream", "modbus"])
def test_another_device_is_refused(mode: str) -> None:
    def opened(rig: FtRig) -> Steps:
        return rig.driver.open() if mode == "stream" else rig.driver.units[0].open()

    other = FtRig(mode=mode, serial_number=7)
    with pytest.raises(DeviceError, match=r"serial number 123456; the configuration says 7") as caught:
        other.do(opened(other))
    assert caught.value.errno == errno.ENODEV and not other.device.streaming
    binary = FtRig(mode=mode)
    binary.device.words[500] = 0x0100
    with pytest.raises(DeviceError, match="500 to 502 read 0100 332d 3231, which is not a firmware version"):
        binary.do(opened(binary))
    drive = FtRig(mode=mode)
    del drive.device.words[502]
    with pytest.raises(DeviceError, match=r"no FT 300 answers there: .*illegal address"):
        drive.do(opened(drive))
    silent = FtRig(mode=mode, address=8)
    with pytest.raises(LinkError, match=r"at address 8 on /x: .*; check port, power and address"):
        silent.do(opened(silent))


@pytest.mark.parametrize("line", [{"serial": "/x", "baud": 19200}, {"tcp": "10.0.0.1:4001"}])
def test_the_stream_is_ended_by_half_a_second_of_ff(line: dict[str, Any]) -> None:
    """On a serial line the bytes take that time; behind a serial server, where they leave at once, pauses do."""
    rig = FtRig(line=line)
    steps = list(rig.driver.close())
    sent = b"".join(step.data for step in steps if isinstance(step, Send))
    assert set(sent) == {0xFF} and len(sent) * 10 / 19200 >= 0.5
    paused = sum(step.duration_s for step in steps if isinstance(step, Pause))
    assert paused >= 0.5 if "tcp" in line else paused == 0


@given(st.lists(st.binary(max_size=40), max_size=40))
def test_any_bytes_are_taken(pieces: list[bytes]) -> None:
    rig = FtRig()
    for piece in pieces:
        rig.now_s += 0.001
        rig.arrive(piece)
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"line": {"serial": "/x"}}, "115200 baud, 8N1; the sensor speaks 19200 baud, 8N1: want baud"),
        ({"line": {"serial": "/x", "baud": 19200, "parity": "E"}}, "19200 baud, 8E1"),
        ({"line": {"udp": "h:1"}}, "the sensor is on a serial line"),
        ({"address": 0}, "address = 0; want 1 to 247 \\(9 from the factory"),
        ({"acceleration": True}, "acceleration: the stream has none"),
        ({"mode": "modbus", "poll_hz": 90.0}, "6 registers a poll at 19200 baud carry at most 60 Hz"),
        ({"full_scale": (1, 1, 1, 1, 1, 0)}, "want six positive numbers"),
    ],
)  # fmt: skip
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    check_refused(Ft300, {"line": {"serial": "/x", "baud": 19200}, **table}, words)
