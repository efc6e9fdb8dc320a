"""The force/torque drivers against the simulated sensors, on an invented clock and without a line."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers import ati_rdt as ati_driver
from sioms.drivers import ft300 as ft_driver
from sioms.drivers import schunk_ft as schunk_driver
from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.driver import Driver, LineDriver, Refusal, StreamDriver
from sioms.sdk.exchange import Aside, DeviceError, Exchange, LinkError, Pause, Send, Steps
from sioms.tools.counterparts import ati_rdt, ft300, schunk_ifb

SATURATED, INVALID, OVERRUN = (int(AnalogStatus[name]) for name in ("SATURATED", "INVALID", "OVERRUN"))
LOAD = (10.0, -20.0, 30.0, 1.0, -2.0, 3.0)
HOST = ("127.0.0.1", 4711)
RECORD_S = 16 * 10 / 19200


class Rig:
    """A driver and a sensor joined without a line, on one clock; keeps what was published and said."""

    def __init__(self, driver: type[Driver], table: dict[str, Any]) -> None:
        self.now_s = 50.0
        self.published: list[tuple[int, np.ndarray, int]] = []
        self.said: list[str] = []
        settings = msgspec.convert(table, driver.Settings)
        driver.describe("f0", settings)
        self.driver: Any = driver.variant(settings)("f0", settings, self)
        self.on_line: Callable[[bytes], bytes] = lambda data: b""
        self.aside: Callable[[bytes], bytes] = lambda data: b""
        self.delay_s = 0.0002
        self.rest = b""

    def now(self) -> float:
        return self.now_s

    def log(self, level: str, text: str) -> None:
        self.said.append(f"{level}: {text}")

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.copy(), int(block.flags[0])))

    def arrive(self, data: bytes) -> int:
        return int(self.driver.feed(data, round((self.now_s + self.delay_s) * 1e9)))

    def do(self, steps: Steps) -> Any:
        """Carry out a hook, as the kit does it."""
        value: Any = None
        failure: Exception | None = None
        while True:
            try:
                step = steps.throw(failure) if failure else steps.send(value)
            except StopIteration as end:
                rest, self.rest = self.rest, b""
                if rest:
                    self.arrive(rest)  # what came behind a reply is fed, as the kit does it
                return end.value
            value, failure = None, None
            match step:
                case Pause(duration_s):
                    self.now_s += duration_s
                case Send(data):
                    self.now_s += len(data) * 10 / 19200
                    self.on_line(data)
                case _:
                    exchange = step.exchange if isinstance(step, Aside) else step
                    send = self.aside if isinstance(step, Aside) else self.on_line
                    try:
                        value = self._ask(exchange, send)
                    except (LinkError, DeviceError) as error:
                        failure = error

    def _ask(self, exchange: Exchange, send: Callable[[bytes], bytes]) -> Any:
        reply = send(exchange.data)
        size = exchange.want(reply)
        if size is None and not reply:
            raise LinkError("no reply")
        self.rest = b"" if size is None else reply[size:]
        return exchange.decode(reply if size is None else reply[:size])

    @property
    def data(self) -> list[float]:
        return [float(value) for value in self.published[-1][1]]

    @property
    def flags(self) -> int:
        return self.published[-1][2]


def steps_of(published: list[tuple[int, np.ndarray, int]]) -> np.ndarray:
    return np.diff([stamp for stamp, _, _ in published])


# --- Robotiq --------------------------------------------------------------------------------------


class FtRig(Rig):
    def __init__(self, **table: Any) -> None:
        super().__init__(ft_driver.Ft300, {"line": {"serial": "/x", "baud": 19200}, **table})
        self.device = ft300.Sensor(9, "FT3-21", 123456, self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.on_line = lambda data: b"".join(self.device.take(data))

    def go(self, seconds: float, bend: Callable[[bytes], bytes] = lambda data: data) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.now_s += 0.001
            for record in self.device.due():
                sent_s, self.now_s = self.now_s, self.now_s + RECORD_S
                self.arrive(bend(record))
                self.now_s = sent_s


def test_ft300_streams() -> None:
    rig = FtRig()
    assert isinstance(rig.driver, StreamDriver)
    rig.device.streaming = True  # the last host has left it so
    rig.do(rig.driver.open())
    assert rig.device.streaming and rig.said == [
        "info: identify f0 at address 9 on /x: firmware FT3-21, serial number 123456 of 2019"
    ]
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(1.0)
    assert rig.data == pytest.approx(LOAD) and rig.flags == 0
    assert len(rig.published) in (99, 100, 101)
    age_s = rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9
    assert -1e-6 <= age_s < 0.02
    rig.device.load.put(rig.now_s, (310, 0, 0, 0, 0, 0))
    rig.go(0.1)
    assert rig.flags == SATURATED and rig.driver.counters()["saturated"] > 0
    rig.do(rig.driver.close())
    assert not rig.device.streaming


def test_ft300_records_in_pairs_are_a_period_apart() -> None:
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


def test_ft300_damaged_records_are_lost_and_flagged() -> None:
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


def test_ft300_polls() -> None:
    rig = FtRig(mode="modbus", acceleration=True, poll_hz=30.0)
    assert isinstance(rig.driver, LineDriver)
    (unit,) = rig.driver.units
    rig.device.streaming = True
    rig.do(unit.open())
    assert not rig.device.streaming
    rig.device.load.put(rig.now_s, LOAD)
    rig.do(unit.poll())
    force, acceleration = unit.blocks
    assert force.data == pytest.approx(LOAD)
    assert acceleration.data == pytest.approx([0.0, 0.0, 9.80665])
    plain = FtRig(mode="modbus")
    (unit,) = plain.driver.units
    plain.do(unit.open())
    plain.device.load.put(plain.now_s, (-300.5, 0, 0, 0, 0, -30.0))
    plain.do(unit.poll())
    assert list(unit.blocks[0].flags) == [SATURATED, 0, 0, 0, 0, SATURATED] and len(unit.blocks) == 1


@pytest.mark.parametrize("mode", ["stream", "modbus"])
def test_ft300_another_device_is_refused(mode: str) -> None:
    def opened(rig: FtRig) -> Steps:
        return rig.driver.open() if mode == "stream" else rig.driver.units[0].open()

    other = FtRig(mode=mode, serial_number=7)
    with pytest.raises(DeviceError, match=r"serial number 123456; the configuration says 7") as caught:
        other.do(opened(other))
    assert caught.value.errno == errno.ENODEV and not other.device.streaming
    binary = FtRig(mode=mode)
    binary.device.words[500] = 0x0100
    with pytest.raises(DeviceError, match="500 to 502 read 0100 332d 3231, which is no firmware version"):
        binary.do(opened(binary))
    drive = FtRig(mode=mode)
    del drive.device.words[502]
    with pytest.raises(DeviceError, match=r"no FT 300 answers there: .*illegal address"):
        drive.do(opened(drive))
    silent = FtRig(mode=mode, address=8)
    with pytest.raises(LinkError, match=r"at address 8 on /x: .*; look at port, power and address"):
        silent.do(opened(silent))


@pytest.mark.parametrize("line", [{"serial": "/x", "baud": 19200}, {"tcp": "10.0.0.1:4001"}])
def test_ft300_the_stream_is_ended_by_half_a_second_of_ff(line: dict[str, Any]) -> None:
    """On a serial line the bytes take that time; behind a serial server, where they leave at once, pauses do."""
    rig = FtRig(line=line)
    steps = list(rig.driver.close())
    sent = b"".join(step.data for step in steps if isinstance(step, Send))
    assert set(sent) == {0xFF} and len(sent) * 10 / 19200 >= 0.5
    paused = sum(step.duration_s for step in steps if isinstance(step, Pause))
    assert paused >= 0.5 if "tcp" in line else paused == 0


@given(st.lists(st.binary(max_size=40), max_size=40))
def test_ft300_any_bytes_are_taken(pieces: list[bytes]) -> None:
    rig = FtRig()
    for piece in pieces:
        rig.now_s += 0.001
        rig.arrive(piece)
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(stamps)


# --- ATI ------------------------------------------------------------------------------------------

UDP = {"udp": "192.168.1.1:49152"}


class AtiRig(Rig):
    def __init__(self, *options: str, **table: Any) -> None:
        super().__init__(ati_driver.AtiRdt, {"line": UDP, "full_scale": (400, 400, 400, 20, 20, 20), **table})
        self.device = ati_rdt.Sensor(ati_rdt.options_parser().parse_args(options), self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.pages = 0
        self.aside, self.on_line = self._page, self._request

    def _page(self, data: bytes) -> bytes:
        assert data.startswith(b"GET /netftapi2.xml ")
        self.pages += 1
        return b"HTTP/1.0 200 OK\r\n\r\n" + self.device.xml().encode()

    def _request(self, data: bytes) -> bytes:
        self.device.take(data, HOST)
        sent: list[bytes] = []
        self.now_s += 0.02
        self.device.due(lambda record, to: sent.append(record))
        return b"".join(sent)

    def collect(self, seconds: float) -> list[bytes]:
        """Let time pass; return what the sensor sent in it, each record fed at once unless the caller takes it."""
        sent: list[bytes] = []
        for _ in range(round(seconds * 1000)):
            self.now_s += 0.001
            self.device.due(lambda record, to: sent.append(record))
        return sent

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            for record in self.collect(0.001):
                self.arrive(record)


def test_ati_streams_in_si_units() -> None:
    pound, inch = 4.4482216152605, 0.0254
    rig = AtiRig(
        "--force-unit", "lbf", "--torque-unit", "lbf-in", "--newton", str(pound), "--newton-metre", str(pound * inch),
        "--counts-per-force", "10000", "--counts-per-torque", "20000",
    )  # fmt: skip
    rig.do(rig.driver.open())
    assert rig.said == [
        "info: identified f0 on 192.168.1.1:49152: Net F/T, serial number FT12345, 1000 records/s"
    ]
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(4.0)
    assert rig.data == pytest.approx(LOAD, rel=1e-4) and rig.flags == 0
    steps = steps_of(rig.published[2500:])
    assert steps.min() > 0.99e6 and steps.max() < 1.01e6, "stamped by the sensor's clock"
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 2e-3
    counters = rig.driver.counters()
    assert counters["lost"] == counters["late"] == counters["malformed"] == 0 and counters["status"] == "ok"
    rig.do(rig.driver.close())
    assert rig.device.host is None


def test_ati_loss_late_and_doubled_records() -> None:
    rig = AtiRig()
    rig.do(rig.driver.open())
    rig.go(0.1)
    before = len(rig.published)
    sent = rig.collect(0.02)
    assert len(sent) == 20
    order = [0, 1, 4, 3, 5, 5, 6, 8, 7, *range(9, 20)]
    for i in order:
        rig.arrive(sent[i])
    counters = rig.driver.counters()
    # 2 never came; 3 and 7 came late; 5 came twice
    assert (counters["lost"], counters["late"], counters["doubled"]) == (1, 2, 1)
    fresh = rig.published[before:]
    assert [flags for _, _, flags in fresh].count(OVERRUN) == 2 and len(fresh) == 20 - 3
    assert (steps_of(fresh) > 0).all(), "nothing old is published after something new"
    for wrong in (b"", b"x", sent[0] + b"y"):
        assert rig.arrive(wrong) == 0
    assert rig.driver.counters()["malformed"] == 3


def test_ati_status_and_overload() -> None:
    rig = AtiRig()
    rig.do(rig.driver.open())
    rig.go(0.01)
    rig.device.load.put(rig.now_s, (500, 0, 0, 0, 0, 0))
    rig.go(0.01)
    assert rig.flags == SATURATED | INVALID
    assert rig.said[-1] == "warning: f0: status: saturation or A/D converter"
    rig.device.load.put(rig.now_s, (0,) * 6)
    rig.go(1.5)
    assert rig.flags == 0 and rig.driver.counters()["status"] == "ok"
    rig.device.extra_status = 0x80010000
    rig.go(0.01)
    assert rig.flags == 0 and rig.driver.counters()["status"] == "a monitored condition is latched"
    for word in range(400):  # a status that changes with each record does not fill the log
        rig.device.extra_status = 0x80000000 | 1 << word % 7
        rig.go(0.01)
    assert rig.flags == INVALID and len(rig.said) < 10
    axia = AtiRig("--model", "axia", "--range-n", "100")
    axia.do(axia.driver.open())
    axia.device.load.put(axia.now_s, (150, 0, 0, 0, 0, 0))
    axia.go(0.01)
    assert (
        axia.flags == SATURATED | INVALID
        and axia.driver.counters()["status"] == "force or torque out of range"
    )


def test_ati_buffered_and_bias() -> None:
    rig = AtiRig("--buffer", "10", buffered=True)
    rig.do(rig.driver.open())
    rig.device.load.put(rig.now_s, LOAD)
    sent = rig.collect(0.05)
    assert [len(datagram) for datagram in sent] == [360] * 5
    for datagram in sent:
        assert rig.arrive(datagram) == 10
    assert rig.data == pytest.approx(LOAD) and rig.driver.counters()["lost"] == 0
    (block,) = rig.driver.blocks
    block.offset[:] = 5.0
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    for datagram in rig.collect(0.05):
        rig.arrive(datagram)
    assert rig.data == pytest.approx([0] * 6, abs=1e-5) and not block.offset.any()
    with pytest.raises(Refusal, match="fx, fy alone; the sensor's zero belongs to all its channels"):
        rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, (0, 1), None)
    with pytest.raises(Refusal, match="HOME"):
        rig.driver.ioctl(block.spec, Request.HOME, range(6), None)


def test_ati_a_stall_restarts_the_stream_and_a_longer_loss_identifies_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig = AtiRig()
    monkeypatch.setattr(ati_driver.time, "monotonic_ns", lambda: int(rig.now_s * 1e9))
    rig.do(rig.driver.open())
    rig.go(0.1)
    rig.now_s += 0.3
    rig.do(rig.driver.open())
    assert rig.pages == 1
    rig.go(0.1)
    rig.device.reboot()
    rig.now_s += 3.0
    rig.do(rig.driver.open())
    assert rig.pages == 2
    rig.go(1.0)
    counters = rig.driver.counters()
    assert counters["lost"] == 0 and counters["sequence_restarts"] == 0 and counters["clock_restarts"] == 0
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 5e-3
    rig.now_s += 3.0
    rig.device.page["setserial"] = "FT999"
    rig.driver.settings = msgspec.structs.replace(rig.driver.settings, serial_number="FT12345")
    with pytest.raises(DeviceError, match=r"serial number 'FT999'; the configuration says 'FT12345'"):
        rig.do(rig.driver.open())


def test_ati_a_clock_of_another_rate_is_told_and_not_believed() -> None:
    rig = AtiRig("--internal-hz", "4000")
    rig.do(rig.driver.open())
    rig.go(7.0)
    (said,) = [text for text in rig.said if "sample_hz" in text]
    found = re.search(
        r"the sensor counts (\d+) samples/s, not sample_hz = 7000; .*; set sample_hz = (\d+)", said
    )
    assert found is not None and found[1] == found[2] and int(found[1]) == pytest.approx(4000, rel=5e-3)
    assert abs(rig.now_s - rig.published[-1][0] * 1e-9) < 2e-3
    assert (steps_of(rig.published) >= 0).all()


@pytest.mark.parametrize(
    ("options", "table", "words"),
    [
        (["--rate", "7000"], {}, "sends 7000 records/s; the configuration says rate_hz = 1000; change one"),
        (["--model", "axia"], {"model": "net"}, "is a 'ETHERNET AXIA'; the configuration says model = net"),
        ([], {"serial_number": "FT1"}, "has serial number 'FT12345'; the configuration says 'FT1'"),
        (
            [],
            {"counts_per_force": 5e5},
            "has 1e\\+06 counts in an SI unit; the configuration says counts_per_force",
        ),
        (["--force-unit", "st"], {}, "gives its units as 'st' and 'Nm'; set N and Nm on its page"),
    ],
)
def test_ati_another_sensor_is_refused(options: list[str], table: dict[str, Any], words: str) -> None:
    rig = AtiRig(*options, **table)
    with pytest.raises(DeviceError, match=words) as caught:
        rig.do(rig.driver.open())
    assert caught.value.errno == errno.ENODEV and rig.device.host is None and not rig.published


def test_ati_without_a_page_and_without_an_answer() -> None:
    rig = AtiRig(page="none", model="net", counts_per_force=1e6, counts_per_torque=1e6)
    assert rig.driver.aside is None
    rig.do(rig.driver.open())
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(0.05)
    assert rig.pages == 0 and rig.data == pytest.approx(LOAD)
    rig.on_line = lambda data: b""
    with pytest.raises(
        LinkError, match=r"f0 on 192.168.1.1:49152: .*; look at host and port, and that RDT is enabled"
    ):
        rig.do(rig.driver.open())
    other = AtiRig()
    other.aside = lambda data: b"HTTP/1.0 404 Not Found\r\n\r\n"
    with pytest.raises(
        LinkError, match=r"identify f0: get http://192.168.1.1/netftapi2.xml: .*404; is it another"
    ):
        other.do(other.driver.open())


@given(st.lists(st.binary(max_size=80) | st.integers(0, 30).map(lambda n: bytes(36)), max_size=40))
def test_ati_any_datagrams_are_taken(pieces: list[bytes]) -> None:
    rig = AtiRig()
    for piece in pieces:
        rig.now_s += 0.001
        rig.arrive(piece)
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(stamps)


# --- SCHUNK ---------------------------------------------------------------------------------------


class SchunkRig(Rig):
    def __init__(self, **table: Any) -> None:
        super().__init__(schunk_driver.SchunkFt, {"line": {"tcp": "192.168.0.100:82"}, **table})
        self.device = schunk_ifb.Sensor(schunk_ifb.options_parser().parse_args([]), self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.aside = lambda data: b"".join(self.device.take(data))

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds * 1000)):
            self.now_s += 0.001
            self.device.due(self.arrive)


def test_schunk_streams() -> None:
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


def test_schunk_tare_and_its_way_back() -> None:
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


def test_schunk_loss_and_other_datagrams() -> None:
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


def test_schunk_another_sensor_is_refused() -> None:
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


def test_simulated_sensors_do_not_lag_behind_their_clock() -> None:
    """A process that was held up for a minute sends what is measured now; what was missed counts as lost."""
    rig = SchunkRig()
    rig.do(rig.driver.open())
    rig.go(0.05)
    rig.now_s += 20.0
    rig.go(0.05)
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 5e-3
    assert rig.driver.counters()["lost"] == pytest.approx(20000, abs=300)
    ati = AtiRig()
    ati.do(ati.driver.open())
    ati.go(0.05)
    ati.now_s += 60.0
    ati.go(0.05)
    assert -1e-6 <= ati.now_s + ati.delay_s - ati.published[-1][0] * 1e-9 < 5e-3
    assert ati.driver.counters()["lost"] == pytest.approx(60000, abs=300)


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("driver", "table", "words"),
    [
        (ft_driver.Ft300, {"line": {"serial": "/x"}}, "115200 baud, 8N1; the sensor speaks 19200 baud, 8N1: want baud"),
        (ft_driver.Ft300, {"line": {"serial": "/x", "baud": 19200, "parity": "E"}}, "19200 baud, 8E1"),
        (ft_driver.Ft300, {"line": UDP}, "the sensor is on a serial line"),
        (ft_driver.Ft300, {"address": 0}, "address = 0; want 1 to 247 \\(9 from the factory"),
        (ft_driver.Ft300, {"acceleration": True}, "acceleration: the stream has none"),
        (ft_driver.Ft300, {"mode": "modbus", "poll_hz": 90.0}, "6 registers a poll at 19200 baud carry at most 60 Hz"),
        (ft_driver.Ft300, {"full_scale": (1, 1, 1, 1, 1, 0)}, "want six positive numbers"),
        (ati_driver.AtiRdt, {"line": {"tcp": "h:1"}}, "RDT is UDP; want line"),
        (ati_driver.AtiRdt, {"line": {"udp": "h:0", "local": "h:1"}}, "requests need a port; want 49152"),
        (ati_driver.AtiRdt, {"rate_hz": 0.0}, "rate_hz = 0; want 1 to 20000"),
        (ati_driver.AtiRdt, {"counts_per_force": -1.0}, "counts_per_force = -1; want a positive"),
        (ati_driver.AtiRdt, {"page": "none"}, "counts_per_force: none given; page = \"none\" needs it"),
        (ati_driver.AtiRdt, {"page": "none", "counts_per_force": 1.0, "counts_per_torque": 1.0}, "want model = \"net\""),
        (ati_driver.AtiRdt, {"page": "http"}, "tcp = \"http\"; want \"host:port\""),
        (schunk_driver.SchunkFt, {"line": UDP}, "the box takes commands on TCP"),
        (schunk_driver.SchunkFt, {"data": "54843"}, "data = \"54843\"; want \"0.0.0.0:54843\""),
        (schunk_driver.SchunkFt, {"data": "0.0.0.0:0"}, "want \"0.0.0.0:54843\""),
        (schunk_driver.SchunkFt, {"tool": 4}, "tool = 4; want 0 to 3"),
        (schunk_driver.SchunkFt, {"noise_filter": -1}, "noise_filter = -1; want 0 to 4"),
    ],
)  # fmt: skip
def test_bad_configurations(driver: type[Driver], table: dict[str, Any], words: str) -> None:
    lines = {
        ft_driver.Ft300: {"serial": "/x", "baud": 19200}, ati_driver.AtiRdt: UDP, schunk_driver.SchunkFt: {"tcp": "h:82"},
    }  # fmt: skip
    settings = msgspec.convert({"line": lines[driver], **table}, driver.Settings)
    with pytest.raises(ValueError, match=words):
        driver.describe("f0", settings)


def test_channels_have_units_and_ranges() -> None:
    for driver, table in (
        (ft_driver.Ft300, {"line": {"serial": "/x", "baud": 19200}}),
        (ati_driver.AtiRdt, {"line": UDP, "full_scale": (300, 300, 300, 30, 30, 30)}),
        (schunk_driver.SchunkFt, {"line": {"tcp": "h:82"}, "full_scale": (300, 300, 300, 30, 30, 30)}),
    ):
        (block,) = driver.describe("f0", msgspec.convert(table, driver.Settings)).blocks
        assert [(c.name, c.unit, c.minimum, c.maximum) for c in block.channels] == [
            *((name, "N", -300, 300) for name in ("fx", "fy", "fz")),
            *((name, "N*m", -30, 30) for name in ("tx", "ty", "tz")),
        ]
    open_ended = msgspec.convert({"line": UDP}, ati_driver.AtiRdt.Settings)
    assert ati_driver.AtiRdt.describe("f0", open_ended).blocks[0].channels[0].maximum is None
