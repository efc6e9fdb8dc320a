"""The simulated devices behave as their vendors say; time is a number here, nothing sleeps."""

from __future__ import annotations

import math
import struct

import pytest

from sioms.drivers.ati_rdt import simulator as ati_rdt
from sioms.drivers.framed_adc import simulator as adc
from sioms.drivers.modbus.simulated import leadshine, oriental_az, wago
from sioms.drivers.modbus.simulated.moxa import Block
from sioms.drivers.schunk_ft import simulator as schunk_ifb
from sioms.simulation.control import obey
from sioms.simulation.drive import Mover
from sioms.simulation.faults import Faults


class Clock:
    """A clock that stands until it is told."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_a_trapezoid_takes_its_closed_form_time() -> None:
    # 10000 pulses at 5000/s with ramps of 10000/s^2: 10000/5000 + 5000/10000 = 2.5 s
    mover = Mover()
    mover.go_to(10000, 5000, 10000, 10000)
    time_s, top = 0.0, 0.0
    while mover.busy:
        mover.step(0.001)
        time_s, top = time_s + 0.001, max(top, mover.velocity)
    assert time_s == pytest.approx(2.5, abs=0.02)
    assert top == pytest.approx(5000) and mover.position == 10000
    # a short move is a triangle: 2 sqrt(d/a) = 2 sqrt(100/10000) = 0.2 s
    mover.go_to(9900, 5000, 10000, 10000)
    time_s = 0.0
    while mover.busy:
        mover.step(0.001)
        time_s += 0.001
    assert time_s == pytest.approx(0.2, abs=0.01)
    assert mover.position == 9900


def test_a_hard_end_stops_dead() -> None:
    mover = Mover(high=500)
    mover.run(1000, 1e6, 1e6)
    hits = sum(mover.step(0.001) for _ in range(1000))
    assert (hits, mover.position, mover.velocity) == (1, 500, 0)


class TestLeadshine:
    def drive(self) -> tuple[Clock, leadshine.Drive]:
        clock = Clock()
        return clock, leadshine.Drive(clock)

    def word(self, drive: leadshine.Drive, address: int) -> int:
        words = drive.read(3, address, 1)
        assert isinstance(words, list)
        return words[0]

    def test_move_and_status(self) -> None:
        clock, drive = self.drive()
        assert self.word(drive, 0x1003) == 0x0002
        # 10000 pulses = 1 turn at 60 rpm = 1 s
        assert drive.write(16, 0x6200, [1, 0, 10000, 60, 1, 1, 0, 0x10]) is None
        clock.now_s += 0.5
        assert self.word(drive, 0x1003) == 0x0006
        assert drive.state()["position"] == pytest.approx(5000, rel=0.02)
        clock.now_s += 0.6
        assert self.word(drive, 0x1003) == 0x0032
        assert drive.read(3, 0x602C, 2) == [0, 10000] == drive.read(3, 0x1014, 2)
        drive.write(16, 0x6200, [0x41, 0xFFFF, 0xFFFF - 9999, 60, 1, 1, 0, 0x10])
        drive.write(16, 0x6200, [0x41, 0xFFFF, 0xFFFF - 9999, 60, 1, 1, 0, 0x10])
        clock.now_s += 3
        assert drive.state()["position"] == pytest.approx(0, abs=2)

    def test_jog_ends_50_ms_after_the_last_word(self) -> None:
        clock, drive = self.drive()
        drive.write(6, 0x01E1, [600])
        for _ in range(20):
            drive.write(6, 0x1801, [0x4002])
            clock.now_s += 0.04
            drive.time.catch_up()
        assert drive.state()["velocity"] == pytest.approx(-600 / 60 * 10000)
        clock.now_s += 0.011
        drive.time.catch_up()
        assert abs(drive.state()["velocity"]) < 100000
        clock.now_s += 0.2
        assert drive.state()["velocity"] == 0
        # 20 periods of 40 ms at 100000/s, less the ramp of 60 ms, plus 10 ms and the ramp down
        assert drive.state()["position"] == pytest.approx(-(0.8 - 0.03 + 0.01 + 0.03) * 1e5, rel=0.01)

    def test_stop_home_alarm_and_disable(self) -> None:
        clock, drive = self.drive()
        drive.write(16, 0x6200, [2, 0, 0, 600, 50, 50, 0, 0x10])
        clock.now_s += 1
        drive.write(6, 0x6002, [0x40])
        clock.now_s += 1
        assert drive.state()["velocity"] == 0 and drive.state()["position"] > 50000
        drive.write(6, 0x6002, [0x20])
        clock.now_s += 60
        assert self.word(drive, 0x1003) & 0x40 and drive.state()["position"] == 0
        drive.raise_alarm(0x40)
        drive.write(16, 0x6200, [1, 0, 10000, 60, 1, 1, 0, 0x10])
        clock.now_s += 2
        assert (self.word(drive, 0x1003) & 1, self.word(drive, 0x2203), drive.state()["position"]) == (
            1,
            0x40,
            0,
        )
        drive.write(6, 0x1801, [0x1111])
        assert self.word(drive, 0x1003) & 3 == 2
        drive.write(6, 0x000F, [0])
        drive.write(16, 0x6200, [1, 0, 10000, 60, 1, 1, 0, 0x10])
        clock.now_s += 2
        assert drive.state()["position"] == 0

    def test_refusals(self) -> None:
        _, drive = self.drive()
        assert drive.read(4, 0x1003, 1) == leadshine.ILLEGAL_FUNCTION
        assert drive.read(3, 0x6200, 98) == leadshine.ILLEGAL_VALUE
        assert drive.write(6, 0x6002, [0x77]) == leadshine.ILLEGAL_VALUE
        assert drive.write(16, 0x6200, [9, 0, 0, 60, 1, 1, 0, 0x10]) == leadshine.ILLEGAL_VALUE


class TestOrientalAz:
    def drive(self, timeout_s: float = 0.0) -> tuple[Clock, oriental_az.Drive]:
        clock = Clock()
        return clock, oriental_az.Drive(clock, timeout_s)

    def operate(self, drive: oriental_az.Drive, kind: int, position: int, speed: int, trigger: int = 1) -> None:
        values = [0, kind, position, speed, 100000, 100000, 1000, trigger]
        drive.write(16, 0x58, [word for v in values for word in (v >> 16 & 0xFFFF, v & 0xFFFF)])

    def test_kinds_of_operation(self) -> None:
        clock, drive = self.drive()
        assert drive.outputs() == 1 << 5 | 1 << 14
        self.operate(drive, 1, 5000, 10000)
        clock.now_s += 0.3
        assert drive.read(3, 0x7E, 2) == [0, 1 << 13]
        clock.now_s += 0.4
        assert drive.state()["position"] == 5000 and drive.outputs() == 1 << 5 | 1 << 14
        self.operate(drive, 2, -1000, 10000)
        clock.now_s += 1
        assert drive.read(3, 0xCC, 2) == [0, 4000]
        self.operate(drive, 16, 0, -2000)
        clock.now_s += 1
        drive.time.catch_up()
        assert drive.read(3, 0xD0, 2) == [0xFFFF, 0x10000 - 2000]

    def test_writing_the_triggering_item_starts(self) -> None:
        clock, drive = self.drive()
        self.operate(drive, 16, 0, 1000, trigger=-4)
        clock.now_s += 1
        assert drive.state()["velocity"] == 1000
        drive.write(16, 0x5E, [0, 3000])
        clock.now_s += 1
        assert drive.state()["velocity"] == 3000

    def test_stop_is_a_level_and_free_lets_go(self) -> None:
        clock, drive = self.drive()
        self.operate(drive, 16, 0, 5000)
        clock.now_s += 1
        drive.write(16, 0x7C, [0, 1 << 5])
        clock.now_s += 1
        assert drive.state()["velocity"] == 0 and not drive.outputs() & 1 << 5
        self.operate(drive, 16, 0, 5000)
        clock.now_s += 1
        assert drive.state()["velocity"] == 0
        drive.write(6, 0x7D, [0])
        self.operate(drive, 16, 0, 5000)
        clock.now_s += 1
        assert drive.state()["velocity"] == 5000
        drive.write(6, 0x7D, [1 << 6])
        assert drive.state()["velocity"] == 0 and drive.outputs() == 0

    def test_silence_ends_motion_with_alarm_85(self) -> None:
        clock, drive = self.drive(0.2)
        self.operate(drive, 16, 0, 5000)
        for _ in range(10):
            clock.now_s += 0.15
            drive.read(3, 0x7E, 2)
        assert drive.state()["velocity"] == 5000
        clock.now_s += 0.5
        state = drive.state()
        assert (state["alarm"], state["velocity"]) == (0x85, 0)
        drive.write(16, 0x180, [0, 1])
        assert drive.state()["alarm"] == 0

    def test_alarms(self) -> None:
        clock, drive = self.drive()
        drive.mover.high = 1000
        self.operate(drive, 16, 0, 5000)
        clock.now_s += 1
        assert drive.state()["alarm"] == 0x66 and drive.state()["position"] == 1000
        drive.write(16, 0x7C, [0, 1 << 7])
        assert drive.state()["alarm"] == 0
        self.operate(drive, 99, 0, 5000)
        assert drive.state()["alarm"] == 0x70
        drive.raise_alarm(0x41)
        drive.write(16, 0x180, [0, 1])
        assert drive.state()["alarm"] == 0x41  # needs a power cycle


def test_the_watchdog_of_the_coupler_starts_only_when_its_trigger_is_modified() -> None:
    """The manual's words: of two openings of its life that write the same value, the second starts nothing."""
    clock = Clock()
    coupler = wago.Coupler(8, 8, 2, clock)
    for value, runs in ((1, True), (1, False), (2, True), (0, False)):
        coupler.write(wago.SIMPLE_STOP, [0xAA55])
        coupler.write(wago.TIME, [10])
        coupler.write(wago.TRIGGER, [value])
        assert coupler.state()["armed"] is runs, value


def test_the_block_counts_and_drops_its_outputs() -> None:
    clock = Clock()
    block = Block("E1212", 1.0, clock)
    for value in (1, 0, 1, 1):
        block.set_input(2, value)
    assert block.read_input(0x14, 2) == [0, 2] and block.read_input(0x30, 1) == [4]
    block.hear()
    block.write_bits(0, [1, 0, 1])
    clock.now_s += 0.9
    block.hear()
    assert block.read_bits(1, 0, 3) == [1, 0, 1]
    clock.now_s += 1.1
    block.hear()
    assert block.read_bits(1, 0, 3) == [0, 0, 0]
    assert block.write_bits(0, [1]) is not None
    block.write_bits(0x1030, [1])
    assert block.write_bits(0, [1]) is None
    analog = Block("E1240", 0.0, clock)
    analog.ramps[3] = (clock.now_s, 0.0, 10.0, 2.0)
    clock.now_s += 1
    assert analog.read_input(3, 1) == [round(65535 / 2)]


class TestFrontEnd:
    def device(self, *options: str) -> tuple[Clock, adc.FrontEnd]:
        clock = Clock()
        return clock, adc.FrontEnd(adc.options_parser().parse_args(options), clock)

    def test_golden_frames(self) -> None:
        _, device = self.device("--channels", "4", "--columns", "2", "--name", "TAC4")
        hello = bytes.fromhex("04 10 c1 f3 00")
        assert device.take(hello)[0].hex(" ") == "04 11 01 04 03 e8 03 01 07 54 41 43 34 de c8 00"
        start = bytes.fromhex("05 12 01 e8 03 01 03 fc 6d 00")
        replies = [device.take(start[i : i + 1]) for i in range(len(start))]
        assert replies[-1][0].hex(" ") == "03 1f 12 03 df c6 00"
        payload = bytes.fromhex("01 01 07 00 40 e2 01 00 04 00 64 00 38 ff 00 00 ff 7f")
        wire = bytes.fromhex("04 01 01 07 04 40 e2 01 02 04 02 64 03 38 ff 01 05 ff 7f f5 76 00")
        assert adc.frame(payload) == wire and adc.unframe(wire[:-1]) == payload

    def test_dead_man_rate_and_clock(self) -> None:
        clock, device = self.device("--clock-ppm", "1000")
        device.take(adc.frame(bytes.fromhex("12 01 64 00 00 00")))
        frames = []
        for _ in range(550):
            clock.now_s += 0.01
            frames += device.due()
        assert len(frames) in (500, 501) and device.rate_hz == 0
        first, last = (adc.unframe(one[:-1]) for one in (frames[0], frames[-1]))
        assert first is not None and last is not None
        t_us = int.from_bytes(last[4:8], "little") - int.from_bytes(first[4:8], "little")
        assert t_us == pytest.approx((len(frames) - 1) * 1e4 * 1.001, abs=2)
        refused = device.take(adc.frame(bytes.fromhex("12 01 d0 07 00 00")))
        assert adc.unframe(refused[0][:-1]) == bytes.fromhex("1f 12 02")

    def test_touch_keeps_its_force_and_clipping_is_flagged(self) -> None:
        clock, device = self.device("--noise", "0")
        device.press(adc.Touch(1.5, 1.5, 0.8, low_n=2.0, high_n=2.0))
        payload = device._block(clock())
        values = [int.from_bytes(payload[10 + 2 * i : 12 + 2 * i], "little", signed=True) for i in range(16)]
        assert sum(values) == pytest.approx(4000, abs=8) and payload[9] == 0
        assert math.isclose(values[5], values[10], abs_tol=1)
        device.press(adc.Touch(1.5, 1.5, 0.2, low_n=200.0, high_n=200.0))
        assert device._block(clock())[9] == adc.SATURATED


def test_faults_hold_for_their_count() -> None:
    faults = Faults()
    handlers = faults.handlers()
    assert obey("noise 1", handlers) == obey("mute 1", handlers) == obey("cut 1 3", handlers) == "ok"
    assert faults.outgoing(b"abcdef") == (0.0, b"")
    once = faults.outgoing(b"abcdef")[1]
    assert len(once) == 3 and faults.outgoing(b"abcdef") == (0.0, b"abcdef")
    assert obey("late 0.5 1", handlers) == "ok" and faults.outgoing(b"a") == (0.5, b"a")
    assert obey("nois", handlers).startswith("error unknown command nois; want one of")
    assert obey("cut x", handlers).startswith("error cut: ")
    obey("deaf", handlers)
    assert not faults.hears() and not faults.hears()
    obey("clear", handlers)
    assert faults.hears()


# --- sensors that push ----------------------------------------------------------------------------


def test_the_schunk_box_takes_one_segment_for_one_command_and_loses_all_with_its_power() -> None:
    """As the vendor's simulator does it: see the tables of the driver's page."""
    clock = Clock()
    sensor = schunk_ifb.Sensor(schunk_ifb.options_parser().parse_args([]), clock)
    start, tare = b"\xff\xff\x63\x00\x01\x00\x40", b"\xff\xff\x64\x00\x01\x00\x12"
    assert sensor.take(start, 1) == b"\xff\xff\x01\x00\x02\x00\x40\x00", "its own number, not the command's"
    assert sensor.take(start[:6], 2) is None, "the connection ends"
    assert sensor.take(tare + start, 3) == b"\xff\xff\x03\x00\x02\x00\x12\x02", "one command, too long"
    sent: list[bytes] = []
    for _ in range(2):
        clock.now_s += 0.15
        sensor.due(sent.append)
    assert [record[6] for record in sent[:3]] == [1, 2, 3] and sent[260][6] == 261 - 256, (
        "a byte that counts with every record"
    )
    assert sensor.take(tare, 4)[-1] == 0 and sensor.is_tared  # type: ignore[index]
    sensor.supply.cycle("0.3")
    clock.now_s += 0.2
    sent.clear()
    sensor.due(sent.append)
    assert not sensor.supply.is_on and not sent
    clock.now_s += 0.2
    sensor.due(sent.append)
    assert sensor.supply.is_on and not sensor.streaming and not sensor.is_tared and not sent
    sensor.take(start, 1)
    clock.now_s += 0.01
    sensor.due(sent.append)
    assert sent[0][2:4] == b"\x01\x00" and sent[0][6] == 1


def test_the_ati_sensor_serves_the_last_client_and_its_bias_goes_with_its_power() -> None:
    clock = Clock()
    sensor = ati_rdt.Sensor(ati_rdt.options_parser().parse_args(["--model", "axia", "--internal-hz", "488"]), clock)
    sensor.load.put(clock(), (1, 2, 3, 0, 0, 0))
    start = bytes.fromhex("1234000200000000")
    sent: list[tuple[bytes, ati_rdt.Address]] = []
    for client in (("a", 1), ("b", 2)):
        sensor.take(start, client)
        clock.now_s += 0.01
        sensor.due(lambda record, to: sent.append((record, to)))
    numbers = [(struct.unpack(">II", record[:8]), to[0]) for record, to in sent]
    firsts = {to: number for (number, _), to in reversed(numbers)}
    assert firsts == {"a": 1, "b": 1} and [to for _, to in numbers] == sorted(to for _, to in numbers)
    samples = [count for (_, count), _ in numbers]
    assert len(set(samples)) < 12 and samples == sorted(samples), "records are faster than samples"
    assert "<setrate>488</setrate>" in sensor.xml() and "runrate" not in sensor.xml()
    sensor.take(bytes.fromhex("1234004200000000"), ("c", 3))
    assert "<setbias>1000000;2000000;3000000;0;0;0</setbias>" in sensor.xml()
    sensor.supply.cycle("0.1")
    sensor.take(start, ("a", 1))
    clock.now_s += 0.2
    sent.clear()
    sensor.due(lambda record, to: sent.append((record, to)))
    assert not sent and "<setbias>0;0;0;0;0;0</setbias>" in sensor.xml()
