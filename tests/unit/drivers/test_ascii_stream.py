"""The driver of the ASCII line stream against the simulated board, on an invented clock."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.ascii_stream import simulator
from sioms.drivers.ascii_stream.driver import AsciiStream, Inspection
from sioms.protocol.flags import AnalogStatus, Request
from sioms.sdk.exchange import DeviceError, Exchange, LinkError
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.emap import e_map
from sioms.tactile.quality import Quality
from sioms.tactile.series import line_load


class Rig:
    """Driver and board joined without a line; keeps what was published."""

    def __init__(self, *options: str, **table: Any) -> None:
        self.now_s = 50.0
        self.device = simulator.Board(simulator.options_parser().parse_args(options), lambda: self.now_s)
        settings = {"line": {"serial": "/x"}, "columns": ["a", "b"], "rate_hz": 80.0, **table}
        self.driver = AsciiStream("t0", msgspec.convert(settings, AsciiStream.Settings), self)
        self.published: list[tuple[int, np.ndarray, int]] = []
        self.said: list[str] = []

    def now_ns(self) -> int:
        return 0  # never behind

    def log(self, level: str, text: str) -> None:
        self.said.append(f"{level}: {text}")

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.copy(), int(block.flags[0])))

    def open(self) -> None:
        """Do the exchange as the kit does, with bytes in pieces of seven."""
        steps = self.driver.open()
        step = next(steps)
        assert isinstance(step, Exchange)
        self.device.take(step.data)
        reply, end = b"", self.now_s + step.timeout_s
        while self.now_s < end:
            self.now_s += 0.005
            news = b"".join(self.device.due())
            for at in range(0, len(news), 7):
                reply += news[at : at + 7]
                if (size := step.want(reply)) is not None:
                    with pytest.raises(StopIteration):
                        steps.send(step.decode(reply[:size]))
                    self.driver.feed(reply[size:], round(self.now_s * 1e9))
                    return
        raise LinkError("time-out")

    def go(self, seconds: float, delay_s: float = 0.001) -> int:
        """Let time pass; return how many good lines came."""
        good = 0
        for _ in range(round(seconds * 200)):
            self.now_s += 0.005
            for data in self.device.due():
                good += self.driver.feed(data, round((self.now_s + delay_s) * 1e9))
        return good


@pytest.mark.parametrize("unit", ["us", "ms", "s"])
@pytest.mark.parametrize("start_s", [0.0, 4290.0])
def test_samples_flags_and_stamps(unit: str, start_s: float) -> None:
    """The clock of the board is 0.2 % fast, has millisecond steps or fine ones, and wraps after 71.6 minutes."""
    options = ("--time", unit, "--clock-start-s", str(start_s), "--noise", "0", "--crlf", "--separator", "; ")
    rig = Rig(*options, time=unit, offset=200, scale=0.01, unit="N", low=0, high=4095)
    rig.open()
    rig.device.loads = [3.0, -1.0]
    rig.go(8.0)
    stamps = np.array([stamp for stamp, _, _ in rig.published])
    assert 635 <= len(stamps) <= 641
    assert rig.published[-1][1] == pytest.approx([3.0, -1.0], abs=0.02) and rig.published[-1][2] == 0
    steps = np.diff(stamps[320:])
    assert steps.mean() == pytest.approx(12.5e6, rel=1e-3) and steps.min() > 10e6 and steps.max() < 15e6
    assert rig.driver.counters()["clock_restarts"] == 0
    rig.device.loads = [90.0, -1.0]
    rig.go(0.5)
    assert rig.published[-1][2] == AnalogStatus.SATURATED


def test_without_a_clock_lines_of_one_read_keep_their_distance_on_the_line() -> None:
    rig = Rig()
    rig.driver.feed(b"cut\n", 10**9)
    rig.driver.feed(b"201,199\n202,198\n203,197\n", 2 * 10**9)
    stamps = [stamp for stamp, _, _ in rig.published]
    character_ns = 10 / 115200 * 1e9
    assert stamps[-1] == 2 * 10**9 and np.diff(stamps) == pytest.approx(8 * character_ns, abs=2)


def test_a_dropped_line_marks_the_next_good_one() -> None:
    rig = Rig()
    rig.driver.feed(b"cut\n1,2\n1,2,3\n1,2\n1,2\n1,x\n1,2*00\n1,2\n", 10**9)
    overrun = int(AnalogStatus.OVERRUN)
    assert [flags for _, _, flags in rig.published] == [0, overrun, 0, overrun]
    counters = rig.driver.counters()
    assert (counters["bad_columns"], counters["bad_number"], counters["bad_checksum"]) == (1, 1, 1)


def test_a_restarted_board_is_told_and_opened_anew() -> None:
    """Its time goes back: what it was told at its start is gone, so it is told again before it is read."""
    rig = Rig("--time", "us", time="us")
    rig.open()
    rig.go(4.0)
    before = len(rig.published)
    rig.device.restart()
    with pytest.raises(LinkError, match=r"its time went from \d+ back to \d+ us: it has restarted"):
        rig.go(2.0)
    assert len(rig.published) == before
    rig.open()
    rig.go(2.0)
    assert (rig.now_s + 0.001) * 1e9 - rig.published[-1][0] < 14e6


def test_a_board_without_a_clock_is_known_by_its_greeting() -> None:
    rig = Rig(greeting="load cells", open_s=1.0)
    rig.open()
    rig.go(3.0)
    rig.device.restart()
    with pytest.raises(LinkError, match="it has greeted again: it has restarted"):
        rig.go(0.1)


@pytest.mark.parametrize("unit", ["us", "ms", "s"])
@pytest.mark.parametrize("cause", ["freeze", "hold"])
def test_a_time_that_stands_still_is_a_frozen_device(unit: str, cause: str) -> None:
    rig = Rig("--time", unit, time=unit)
    rig.open()
    assert rig.go(2.0) == pytest.approx(160, abs=2)
    rig.device.handlers()[cause](*(["on"] if cause == "hold" else []))
    rig.go(0.3)
    assert rig.go(3.0) == 0 and "their time stands still at" in rig.driver.trouble
    for _ in range(3):
        rig.open()
        assert rig.go(1.0) == 0, "not for a moment, behind an opening neither"
    rig.device.handlers()[cause](*(["off"] if cause == "hold" else ["0"]))
    assert rig.go(1.0) == pytest.approx(80, abs=2) and rig.driver.trouble == ""


def test_lines_faster_than_the_clock_of_the_board_are_all_samples() -> None:
    rig = Rig("--time", "ms", "--rate", "2000", time="ms", rate_hz=1000.0)
    rig.open()
    assert rig.go(2.0) == pytest.approx(4000, abs=25)


def test_without_a_time_column_equal_lines_are_judged_only_when_told_so() -> None:
    """A scale at rest prints one number for hours; a load cell whose noise shows in its last digit does not."""
    rig = Rig("--noise", "0")
    rig.open()
    assert rig.go(5.0) == pytest.approx(400, abs=2)
    rig = Rig(frozen_after=10)
    rig.open()
    rig.device.loads = [3.0, -1.0]
    assert rig.go(2.0) == pytest.approx(160, abs=2)
    rig.device.handlers()["freeze"]()
    rig.go(0.2)
    assert rig.go(3.0) == 0 and "lines were all the same: the device is frozen" in rig.driver.trouble
    rig.device.handlers()["freeze"]("0")
    assert rig.go(1.0) > 75


def test_a_power_cycle() -> None:
    rig = Rig("--wait-for", "RUN", "--time", "us", start="RUN\n", time="us")
    rig.open()
    rig.go(1.0)
    rig.device.supply.cycle("0.3")
    assert rig.go(1.0) == 0 and not rig.device.runs
    rig.open()
    assert rig.go(1.0) == pytest.approx(80, abs=2)


def test_a_board_that_waits_is_started_and_stopped() -> None:
    rig = Rig("--wait-for", "RUN", "--rate", "200", start="RUN\r\n", stop="x\n", greeting="load cells")
    with pytest.raises(LinkError):
        Rig("--wait-for", "RUN", open_s=0.5).open()
    rig.open()
    assert rig.device.runs
    (stop,) = rig.driver.close()
    rig.device.take(stop.data)
    assert not rig.device.runs


@pytest.mark.parametrize(
    ("options", "table", "words"),
    [
        (("--columns", "3"), {}, r"sends other lines, e.g. '20\d,\d+,\d+'; the configuration says 2 numbers"),
        (("--time", "ms"), {}, "2 numbers a line, the time column included"),
        ((), {"greeting": "scale"}, "did not greet with 'scale'"),
        ((), {"checksum": True}, "without a right checksum"),
        (("--separator", "|"), {}, r"sends lines that are not numbers|sends other lines"),
    ],
)
def test_another_device_is_refused(options: tuple[str, ...], table: dict[str, Any], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        Rig(*options, **table).open()


def test_a_wrong_baud_rate_is_told() -> None:
    noise = bytes((i * 37 + 128) % 256 or 1 for i in range(5000)).replace(b"\n", b"\xff")
    with pytest.raises(LinkError, match="without an end of line; is this the right device and baud rate"):
        Inspection(2, False, "").want(noise)
    with pytest.raises(DeviceError, match=r"not numbers, .*check the baud rate"):
        Inspection(2, False, "").want(b"\n" + b"\xfe\x83\xf8\x91\n" * 6)


@given(st.binary(max_size=6000), st.booleans())
def test_any_first_bytes_are_judged(data: bytes, checked: bool) -> None:
    inspection = Inspection(2, checked, "")
    try:
        size = inspection.want(data)
    except (LinkError, DeviceError):
        return
    assert size is None or data[:size].endswith(b"\n")


@given(st.lists(st.binary(max_size=60), max_size=30))
def test_any_bytes_are_taken_and_stamps_rise(pieces: list[bytes]) -> None:
    rig = Rig(time="us", columns=["a"])
    for piece in [*pieces, b"\n", b"5,7\n", b"6,8\n"]:
        rig.now_s += 0.01
        with contextlib.suppress(LinkError):
            rig.driver.feed(piece, round(rig.now_s * 1e9))
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(set(stamps))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"columns": []}, "columns: none given"),
        ({"unit": ["N"]}, "unit: 1 for 2 columns"),
        ({"scale": 0}, r"scale = \[0.*not 0"),
        ({"offset": [1.0]}, "offset: 1 for 2 columns"),
        ({"rate_hz": 0.0}, "rate_hz = 0; want 0.1"),
        ({"rate_hz": 3000.0}, "lines of 4 bytes, the shortest possible, at 115200 baud carry 2736 Hz"),
        ({"low": 5.0, "high": 5.0}, "want low below high"),
        ({"start": "é"}, "want ASCII"),
        ({"open_s": 0.0}, "open_s = 0"),
        ({"frozen_after": 1}, "frozen_after = 1; want 0 for never"),
        ({"line": {"udp": "127.0.0.1:5000"}}, "come on serial and tcp"),
    ],
)
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    settings = {"line": {"serial": "/x"}, "columns": ["a", "b"], "rate_hz": 80.0, **table}
    with pytest.raises(ValueError, match=words):
        AsciiStream.describe("t0", msgspec.convert(settings, AsciiStream.Settings))


def test_a_finger_that_prints_its_elements_is_felt() -> None:
    """Lines of 16 readings in per cent, as an edge of 150 N/m at 60 degrees would give them, 3 % strain for 1 %."""
    angles = np.radians(143.0 - 9.22 * np.arange(16))
    edge = e_map(FINGER_B, angles, 10.3e-3, 60)[:, :121] @ line_load(FINGER_B, -150.0, np.radians(60.0), 60)
    columns, finger = [f"e{i}" for i in range(16)], str(Path(__file__).parents[3] / "etc" / "finger.toml")
    rig = Rig(columns=columns, unit="%", low=-90.0, high=90.0, shape={"finger_file": finger})
    random = np.random.default_rng(1)

    def line(strain: Any) -> bytes:
        return (",".join(f"{r:.3f}" for r in -100.0 * strain / 3.0 + 0.02 * random.normal(size=16)) + "\n").encode()

    rig.driver.feed(b"cut\n", 10**9)
    for number in range(30):
        rig.driver.feed(line(0.0 * edge), (2 + number) * 10**9)
    raw, strain, shape = rig.driver.blocks
    names = [channel.name for channel in shape.spec.channels]
    assert dict(zip(names, shape.data, strict=True))["quality"] == Quality.NO_CONTACT.value
    rig.driver.feed(line(edge), 33 * 10**9)
    felt = dict(zip(names, shape.data, strict=True))
    assert np.degrees(felt["angle"]) == pytest.approx(60.0, abs=0.3) and felt["load"] == pytest.approx(150.0, rel=0.05)
    np.testing.assert_allclose(strain.data, edge, atol=3e-3)
    assert {block.stamp_ns for block in (raw, strain, shape)} == {33 * 10**9}
    assert len(rig.driver.ioctl(strain.spec, Request.GET_GAINS, [], None)) == 256
    with pytest.raises(ValueError, match="has 16 elements; the device has 2"):
        Rig(shape={"finger_file": finger})
