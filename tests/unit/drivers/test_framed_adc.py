"""The driver of the framed sample stream against the simulated front end, on an invented clock."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.framed_adc import FramedAdc
from sioms.protocol.flags import AnalogStatus
from sioms.sdk.exchange import DeviceError, Steps
from sioms.tools.counterparts import adc


class Rig:
    """Driver and device joined without a line; keeps what was published."""

    def __init__(self, *options: str, **table: Any) -> None:
        self.now_s = 50.0
        self.device = adc.FrontEnd(adc.options_parser().parse_args(options), lambda: self.now_s)
        settings = {"line": {"serial": "/x", "baud": 921600}, "channels": 16, "rate_hz": 100, **table}
        self.driver = FramedAdc("t0", msgspec.convert(settings, FramedAdc.Settings), self)
        self.published: list[tuple[int, np.ndarray, int]] = []

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.copy(), int(block.flags[0])))

    def do(self, steps: Steps) -> None:
        value = None
        with pytest.raises(StopIteration):
            while True:
                step = steps.send(value)
                replies = b"".join(self.device.take(step.data))
                value = step.decode(replies) if hasattr(step, "decode") else None

    def go(self, seconds: float, delay_s: float = 0.001) -> None:
        for _ in range(round(seconds * 200)):
            self.now_s += 0.005
            for data in self.device.due():
                assert self.driver.feed(data, round((self.now_s + delay_s) * 1e9)) == 1


def test_samples_flags_and_stamps() -> None:
    rig = Rig("--noise", "0", scale=0.0005, unit="N")
    rig.do(rig.driver.open())
    rig.device.press(adc.Touch(1.0, 1.0, 0.5, low_n=4.0, high_n=4.0))
    rig.go(4.0)
    assert len(rig.published) in (400, 401)
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


@given(
    st.lists(st.binary(max_size=40), max_size=30), st.lists(st.binary(min_size=1, max_size=60), max_size=10)
)
def test_any_bytes_and_any_payloads_are_taken(noise: list[bytes], payloads: list[bytes]) -> None:
    """Noise is counted; so are well-framed messages of other streams, lengths and kinds."""
    rig = Rig(channels=2)
    for piece in [*noise, b"\0", *map(adc.frame, payloads)]:
        rig.now_s += 0.01
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
        ({"format": "i8"}, "format = i8; one of i16, i32, f32 is right"),
        ({"rate_hz": 0}, "rate_hz = 0"),
    ],
)
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    settings = {"line": {"serial": "/x", "baud": 921600}, "channels": 16, "rate_hz": 100, **table}
    with pytest.raises(ValueError, match=words):
        FramedAdc.describe("t0", msgspec.convert(settings, FramedAdc.Settings))
