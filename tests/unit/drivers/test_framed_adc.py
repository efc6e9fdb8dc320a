"""The driver of the framed sample stream against the simulated front end, on an invented clock."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.framed_adc import simulator as adc
from sioms.drivers.framed_adc.driver import FramedAdc
from sioms.protocol.flags import AnalogStatus
from sioms.sdk.exchange import DeviceError, LinkError, Steps


class Rig:
    """Driver and device joined without a line; keeps what was published."""

    def __init__(self, *options: str, **table: Any) -> None:
        self.now_s = 50.0
        self.device = adc.FrontEnd(adc.options_parser().parse_args(options), lambda: self.now_s)
        settings = {"line": {"serial": "/x", "baud": 921600}, "channels": 16, "rate_hz": 100, **table}
        self.driver = FramedAdc("t0", msgspec.convert(settings, FramedAdc.Settings), self)
        self.published: list[tuple[int, np.ndarray, int]] = []
        self.said: list[str] = []

    def log(self, level: str, text: str) -> None:
        self.said.append(f"{level}: {text}")

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.copy(), int(block.flags[0])))

    def do(self, steps: Steps) -> None:
        value = None
        with pytest.raises(StopIteration):
            while True:
                step = steps.send(value)
                replies = b"".join(self.device.take(step.data))
                value = step.decode(replies) if hasattr(step, "decode") else None

    def go(self, seconds: float, delay_s: float = 0.001) -> int:
        """Let time pass; return how many good blocks came."""
        good = 0
        for _ in range(round(seconds * 200)):
            self.now_s += 0.005
            for data in self.device.due():
                good += self.driver.feed(data, round((self.now_s + delay_s) * 1e9))
        return good


def test_samples_flags_and_stamps() -> None:
    rig = Rig("--noise", "0", scale=0.0005, unit="N")
    rig.do(rig.driver.open())
    rig.device.press(adc.Touch(1.0, 1.0, 0.5, low_n=4.0, high_n=4.0))
    rig.go(4.0)
    assert len(rig.published) in (399, 400)
    stamp_ns, data, flags = rig.published[-1]
    assert data.sum() == pytest.approx(4.0, abs=0.01) and flags == 0
    steps = np.diff([stamp for stamp, _, _ in rig.published[100:]])
    assert steps.min() > 8e6 and steps.max() < 12e6
    # sampled at most a poll and the delay before it was fed
    assert 0 <= (rig.now_s + 0.001) * 1e9 - stamp_ns < 12e6
    rig.device.lose = 5
    rig.go(0.2)
    assert [flags for _, _, flags in rig.published].count(int(AnalogStatus.OVERRUN)) == 1
    assert rig.driver.counters()["lost_blocks"] == 5
    rig.device.press(adc.Touch(1.0, 1.0, 0.2, low_n=40.0, high_n=40.0))
    rig.go(0.05)
    assert rig.published[-1][2] == AnalogStatus.SATURATED


def test_heartbeat_keeps_the_stream_alive_and_close_ends_it() -> None:
    rig = Rig()
    rig.do(rig.driver.open())
    for _ in range(8):
        rig.go(1.0)
        rig.do(rig.driver.heartbeat())
    assert rig.device.rate_hz == 100
    rig.do(rig.driver.close())
    assert rig.device.rate_hz == 0
    rig.do(rig.driver.open())
    rig.go(6.0)
    assert rig.device.rate_hz == 0


def test_a_restarted_device_is_no_loss() -> None:
    rig = Rig()
    rig.do(rig.driver.open())
    rig.go(3.0)
    rig.device.restart()
    rig.now_s += 1.0
    rig.do(rig.driver.open())
    rig.go(1.0)
    counters = rig.driver.counters()
    assert counters["lost_blocks"] == 0 and counters["clock_restarts"] == 1
    assert (rig.now_s + 0.001) * 1e9 - rig.published[-1][0] < 12e6


@pytest.mark.parametrize("cause", ["freeze", "hold"])
def test_a_frozen_stream_is_none(cause: str) -> None:
    """The last block again and again, or numbers that go on while clock and samples stand still: a dead converter."""
    rig = Rig()
    rig.do(rig.driver.open())
    rig.go(2.0)
    rig.device.handlers()[cause](*(["on"] if cause == "hold" else []))
    rig.go(0.02)
    for _ in range(3):
        assert rig.go(3.0) == 0, "not for a moment, behind an opening neither"
        assert re.search("stands still at", rig.driver.trouble)
        rig.do(rig.driver.open())
    rig.device.handlers()[cause](*(["off"] if cause == "hold" else ["0"]))
    rig.do(rig.driver.open())
    assert rig.go(1.0) > 90 and rig.driver.trouble == ""


@pytest.mark.parametrize("rate_hz", [50, 110, 200])
def test_another_host_that_sets_the_rate_is_told(rate_hz: int) -> None:
    rig = Rig()
    rig.do(rig.driver.open())
    rig.go(2.0)
    rig.device.handlers()["foreign"]("rate", str(rate_hz))
    with pytest.raises(
        LinkError, match=r"blocks a second after 100: another host has started the stream anew|restarted"
    ):
        rig.go(1.0)
    rig.do(rig.driver.open())
    assert rig.device.rate_hz == 100 and rig.go(2.0) == pytest.approx(200, abs=2)


def test_a_restart_that_streams_at_once_is_told() -> None:
    """Firmware that begins to stream by itself: numbers or clock say that it began anew, however brief it was away."""
    for seconds in (1.0, 7.0, 400.0):
        rig = Rig()
        rig.do(rig.driver.open())
        rig.go(min(seconds, 5.0))
        rig.device.sequence = int(seconds * 100)
        rig.now_s += seconds - min(seconds, 5.0)
        rig.device.heard_s = rig.device.next_s = rig.now_s
        rig.do(rig.driver.open())
        rig.go(1.0)
        rig.device.restart()
        rig.device.rate_hz, rig.device.next_s = 100, rig.now_s
        with pytest.raises(LinkError, match="it has restarted"):
            rig.go(1.5)


def test_a_device_that_grants_another_rate_is_told_once() -> None:
    rig = Rig()
    rig.do(rig.driver.open())
    rig.device.rate_hz = 80
    assert rig.go(3.0) == pytest.approx(240, abs=3)
    assert rig.said == ["warning: t0: the device sends 80.0 blocks a second, not rate_hz = 100"]


def test_a_refused_start_and_a_power_cycle() -> None:
    rig = Rig()
    rig.device.refusals.set("1")
    with pytest.raises(DeviceError, match="start stream 1 at 100 Hz: the device answers error 3, busy"):
        rig.do(rig.driver.open())
    rig.do(rig.driver.open())
    rig.go(1.0)
    rig.device.supply.cycle("0.3")
    assert rig.go(0.6) == 0 and rig.device.rate_hz == 0
    rig.do(rig.driver.open())
    assert rig.go(1.0) == pytest.approx(100, abs=2) and rig.driver.counters()["lost_blocks"] == 0


@given(st.lists(st.binary(max_size=40), max_size=30), st.lists(st.binary(min_size=1, max_size=60), max_size=10))
def test_any_bytes_and_any_payloads_are_taken(noise: list[bytes], payloads: list[bytes]) -> None:
    """Noise is counted; so are well-framed messages of other streams, lengths and kinds."""
    rig = Rig(channels=2)
    for piece in [*noise, b"\0", *map(adc.frame, payloads)]:
        rig.now_s += 0.01
        with contextlib.suppress(LinkError):
            rig.driver.feed(piece, round(rig.now_s * 1e9))
    stamps = [stamp for stamp, _, _ in rig.published]
    assert stamps == sorted(stamps)
    assert rig.driver.counters()["frames"] >= len(payloads)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"channels": 8}, "has 16 channels; the configuration says 8"),
        ({"format": "i32", "rate_hz": 50}, "sends i16; the configuration says i32"),
        ({"device_name": "FT6"}, "calls itself 'TAC16'; the configuration says 'FT6'"),
        ({"rate_hz": 1500}, "sends at most 1000 Hz"),
    ],
)
def test_another_device_is_refused(table: dict[str, Any], words: str) -> None:
    rig = Rig(**table)
    with pytest.raises(DeviceError, match=words):
        rig.do(rig.driver.open())
    assert rig.device.rate_hz == 0


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"channels": 122}, "channels = 122; want 1 to 121 of format i16"),
        ({"rate_hz": 240, "line": {"serial": "/x"}}, "46 bytes a block at 115200 baud carry 238 Hz"),
        ({"names": ["a"]}, "names: 1 for 16 channels"),
        ({"scale": [1.0]}, "scale: 1 for 16 channels"),
        ({"scale": 0.0}, "scale = 0.0; want finite numbers, not 0"),
        ({"format": "i8"}, "format = i8; want one of i16, i32, f32"),
        ({"rate_hz": 0}, "rate_hz = 0"),
    ],
)
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    settings = {"line": {"serial": "/x", "baud": 921600}, "channels": 16, "rate_hz": 100, **table}
    with pytest.raises(ValueError, match=words):
        FramedAdc.describe("t0", msgspec.convert(settings, FramedAdc.Settings))
