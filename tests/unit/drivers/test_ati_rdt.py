"""The driver of ATI's Net F/T against the simulated sensor, on an invented clock and without a line."""

from __future__ import annotations

import errno
import re
from typing import Any

import msgspec
import pytest
from force_rig import INVALID, LOAD, OVERRUN, SATURATED, Rig, check_refused, steps_of
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.ati_rdt import driver as ati_driver
from sioms.drivers.ati_rdt import simulator as ati_rdt
from sioms.drivers.ati_rdt.driver import AtiRdt
from sioms.protocol.flags import Request
from sioms.sdk.driver import Refusal
from sioms.sdk.exchange import DeviceError, LinkError

HOST = ("127.0.0.1", 4711)
UDP = {"udp": "192.168.1.1:49152"}


@pytest.fixture(autouse=True)
def invented_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver's openings take place in the rig's time."""
    monkeypatch.setattr(ati_driver.time, "monotonic_ns", lambda: int(AtiRig.latest.now_s * 1e9))


class AtiRig(Rig):
    latest: AtiRig

    def __init__(self, *options: str, **table: Any) -> None:
        AtiRig.latest = self
        super().__init__(AtiRdt, {"line": UDP, "full_scale": (400, 400, 400, 20, 20, 20), **table})
        self.device = ati_rdt.Sensor(ati_rdt.options_parser().parse_args(options), self.now)
        self.device.load.noise_n = self.device.load.noise_nm = 0.0
        self.pages = 0
        self.side_line, self.on_line = self._page, self._request

    def _page(self, data: bytes) -> bytes:
        if not self.device.supply.is_on:
            return b""
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


def test_streams_in_si_units() -> None:
    pound, inch = 4.4482216152605, 0.0254
    rig = AtiRig(
        "--force-unit", "lbf", "--torque-unit", "lbf-in", "--newton", str(pound), "--newton-metre", str(pound * inch),
        "--counts-per-force", "10000", "--counts-per-torque", "20000",
    )  # fmt: skip
    rig.do(rig.driver.open())
    assert rig.said == ["info: identified f0 on 192.168.1.1:49152: Net F/T, serial number FT12345, 1000 records/s"]
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


def test_loss_late_and_doubled_records() -> None:
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


def test_status_and_overload() -> None:
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
    assert axia.flags == SATURATED | INVALID and axia.driver.counters()["status"] == "force or torque out of range"


def test_buffered_and_bias() -> None:
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


def test_a_stall_restarts_the_stream_and_a_longer_loss_identifies_anew() -> None:
    rig = AtiRig()
    rig.do(rig.driver.open())
    rig.go(0.1)
    rig.now_s += 0.3
    rig.do(rig.driver.open())
    assert rig.pages == 1 and "another client took it, for RDT serves one" in rig.said[-1]
    rig.go(0.1)
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


@pytest.mark.parametrize("internal_hz", ["976", "7000", "7812"])
def test_the_internal_rate_is_read_from_the_page(internal_hz: str) -> None:
    """At 976 Hz taken for 7000, stamps were 2.5 s wrong for 5 s."""
    model = "net" if internal_hz == "7000" else "axia"
    rig = AtiRig("--internal-hz", internal_hz, "--model", model, "--rate", "900", rate_hz=900)
    rig.do(rig.driver.open())
    rig.go(3.0)
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 3e-3
    assert steps_of(rig.published)[200:].max() < 4e6 and not [text for text in rig.said if "sample_hz" in text]


@pytest.mark.parametrize("internal_hz", [488, 976, 4000, 7812])
def test_a_clock_of_another_rate_is_told_and_measured(internal_hz: int) -> None:
    """A page that tells no internal rate: no stamp is more than 50 ms off, and after a second all are right."""
    rig = AtiRig("--internal-hz", str(internal_hz), "--no-rate", "--rate", "400", rate_hz=400)
    rig.do(rig.driver.open())
    before = len(rig.published)
    ages = []
    for _ in range(6000):
        rig.go(0.001)
        if len(rig.published) > before:
            before = len(rig.published)
            ages.append((rig.now_s, rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9))
    assert max(age for _, age in ages) < 0.052 and min(age for _, age in ages) > -1e-6
    assert max(age for at_s, age in ages if at_s > ages[0][0] + 1.5) < 6e-3
    said = [text for text in rig.said if "sample_hz" in text]
    found = re.search(r"the device counts (\d+) a second, not 7000; .*; set sample_hz = (\d+)", said[0])
    assert found is not None and int(found[1]) == pytest.approx(internal_hz, rel=0.03) and len(said) <= 2
    assert rig.driver.counters()["stamp_uncertainty_us"] < 5000
    assert (steps_of(rig.published) >= 0).all()


@pytest.mark.parametrize("buffered", [False, True])
def test_a_frozen_stream_is_none(buffered: bool) -> None:
    """The last datagram again and again; a sample that stands still under numbers that go on; in both cases also after
    an opening.
    """
    for cause in ("freeze", "hold"):
        rig = AtiRig(buffered=buffered)
        rig.do(rig.driver.open())
        rig.go(0.5)
        rig.device.handlers()[cause](*(["on"] if cause == "hold" else []))
        rig.go(0.02)
        before = len(rig.published)
        for _ in range(3):
            rig.go(2.0)
            assert len(rig.published) == before, cause
            assert "stands still at" in rig.driver.trouble
            rig.do(rig.driver.open())
        rig.device.handlers()[cause]("off" if cause == "hold" else "0")
        rig.do(rig.driver.open())
        rig.go(0.1)
        assert len(rig.published) > before + 50 and rig.driver.trouble == ""


def test_records_faster_than_samples_are_not_published_twice() -> None:
    """An Axia of 488 samples a second asked for 1000 records: a sample is published once, and the stream is alive."""
    rig = AtiRig("--model", "axia", "--internal-hz", "488")
    rig.do(rig.driver.open())
    rig.go(2.0)
    assert len(rig.published) == pytest.approx(976, abs=20) and rig.driver.counters()["repeated"] > 900
    assert rig.driver.trouble == ""


def zeroed(*options: str, **table: Any) -> AtiRig:
    rig = AtiRig(*options, **table)
    rig.do(rig.driver.open())
    rig.go(0.5)
    rig.device.load.put(rig.now_s, LOAD)
    (block,) = rig.driver.blocks
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    assert rig.data == pytest.approx([0] * 6, abs=1e-5) and rig.flags == 0 and block.is_zeroed
    return rig


@pytest.mark.parametrize("off_s", [0.05, 0.3, 5.0])
@pytest.mark.parametrize("page", [True, False])
def test_a_bias_that_went_with_the_power_is_told(off_s: float, page: bool) -> None:
    none: dict[str, Any] = {"page": "none", "model": "net", "counts_per_force": 1e6, "counts_per_torque": 1e6}
    rig = zeroed(**({} if page else none))
    rig.device.supply.cycle(str(off_s))
    rig.go(off_s + 0.15)
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert rig.data == pytest.approx(LOAD) and rig.flags == INVALID
    assert "zero lost" in rig.driver.counters()["status"]
    assert rig.pages == 3 * page, "at the opening, behind the bias, and as the sensor has restarted"
    (block,) = rig.driver.blocks
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    assert rig.data == pytest.approx([0] * 6, abs=1e-5) and rig.flags == 0


def test_a_bias_is_kept_over_a_stall_and_repeated_until_the_page_shows_it() -> None:
    rig = zeroed()
    for _ in range(300):
        rig.now_s += 0.001
        rig.device.due(lambda record, to: None)
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert rig.flags == 0 and rig.driver.counters()["status"] == "ok"
    rig.device.load.put(rig.now_s, (0,) * 6)
    heard, deaf = rig.on_line, [2]

    def half_deaf(data: bytes) -> bytes:
        deaf[0] -= 1
        return b"" if deaf[0] >= 0 else heard(data)

    rig.on_line = half_deaf
    (block,) = rig.driver.blocks
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.go(0.1)
    assert rig.data == pytest.approx([0] * 6, abs=1e-5), "the third request was heard"


def test_another_master_is_noticed_by_the_page() -> None:
    """Its zero: readings INVALID. Its units: not one reading of them once it is known, the new ones
    after an opening.
    """
    rig = zeroed()
    rig.do(rig.driver.heartbeat())
    assert rig.flags == 0
    rig.device.load.put(rig.now_s, (0,) * 6)
    rig.device.handlers()["foreign"]("zero")
    rig.do(rig.driver.heartbeat())
    rig.go(0.01)
    assert rig.flags == INVALID and "another client, or its page" in rig.driver.counters()["status"]
    (block,) = rig.driver.blocks
    rig.do(rig.driver.ioctl(block.spec, Request.CALIBRATE_DEVICE, range(6), None))
    rig.device.load.put(rig.now_s, LOAD)
    rig.device.handlers()["foreign"]("units", "lbf")
    rig.do(rig.driver.heartbeat())
    with pytest.raises(LinkError, match="its page tells other settings than at its opening"):
        rig.go(0.01)
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert rig.data == pytest.approx(LOAD, rel=1e-4) and rig.flags == 0
    rig.side_line = lambda data: b""
    for _ in range(30):  # a web server that is gone is asked less and less often, and nothing comes of it
        rig.do(rig.driver.heartbeat())
    rig.go(0.1)
    assert rig.flags == 0


def test_a_client_that_takes_the_stream_is_told_of() -> None:
    rig = AtiRig()
    rig.do(rig.driver.open())
    rig.go(0.1)
    before = len(rig.published)
    rig.device.handlers()["foreign"]("client")
    sent: list[Any] = []
    for _ in range(200):
        rig.now_s += 0.001
        rig.device.due(lambda record, to: sent.append(to))
    assert set(sent) == {("127.0.0.1", 9)}
    rig.do(rig.driver.open())
    rig.go(0.1)
    assert len(rig.published) > before + 90
    assert "another client took it, for RDT serves one; look for other programs" in rig.said[-1]


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
def test_another_sensor_is_refused(options: list[str], table: dict[str, Any], words: str) -> None:
    rig = AtiRig(*options, **table)
    with pytest.raises(DeviceError, match=words) as caught:
        rig.do(rig.driver.open())
    assert caught.value.errno == errno.ENODEV and rig.device.host is None and not rig.published


def test_without_a_page_and_without_an_answer() -> None:
    rig = AtiRig(page="none", model="net", counts_per_force=1e6, counts_per_torque=1e6)
    assert rig.driver.side_line is None
    rig.do(rig.driver.open())
    rig.device.load.put(rig.now_s, LOAD)
    rig.go(0.05)
    assert rig.pages == 0 and rig.data == pytest.approx(LOAD)
    rig.on_line = lambda data: b""
    with pytest.raises(LinkError, match=r"f0 on 192.168.1.1:49152: .*; check host and port, and that RDT is enabled"):
        rig.do(rig.driver.open())
    other = AtiRig()
    other.side_line = lambda data: b"HTTP/1.0 404 Not Found\r\n\r\n"
    with pytest.raises(LinkError, match=r"identify f0: get http://192.168.1.1/netftapi2.xml: .*404; is it another"):
        other.do(other.driver.open())


@given(st.lists(st.binary(max_size=80) | st.integers(0, 30).map(lambda n: bytes(36)), max_size=40))
def test_any_datagrams_are_taken(pieces: list[bytes]) -> None:
    rig = AtiRig()
    for piece in pieces:
        rig.now_s += 0.001
        rig.arrive(piece)
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(stamps)


def test_the_simulated_sensor_does_not_lag_behind_its_clock() -> None:
    """A process that was held up for a minute sends what is measured now; what was missed counts as lost."""
    rig = AtiRig()
    rig.do(rig.driver.open())
    rig.go(0.05)
    rig.now_s += 60.0
    rig.go(0.05)
    assert -1e-6 <= rig.now_s + rig.delay_s - rig.published[-1][0] * 1e-9 < 5e-3
    assert rig.driver.counters()["lost"] == pytest.approx(60000, abs=300)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"line": {"tcp": "h:1"}}, "RDT is UDP; want line"),
        ({"line": {"udp": "h:0", "local": "h:1"}}, "requests need a port; want 49152"),
        ({"rate_hz": 0.0}, "rate_hz = 0; want 1 to 20000"),
        ({"counts_per_force": -1.0}, "counts_per_force = -1; want a positive"),
        ({"page": "none"}, "counts_per_force: none given; page = \"none\" needs it"),
        ({"page": "none", "counts_per_force": 1.0, "counts_per_torque": 1.0}, "want model = \"net\""),
        ({"page": "http"}, "tcp = \"http\"; want \"host:port\""),
    ],
)  # fmt: skip
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    check_refused(AtiRdt, {"line": UDP, **table}, words)
