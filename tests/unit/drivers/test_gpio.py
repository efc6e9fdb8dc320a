"""The driver of GPIO lines: its pure core, and all that stands above the binding on a fake chip.

No GPIO chip and no gpio-sim is needed here; that the kernel does what the fake does is what ``tests/kernel``
looks at on a simulated chip.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fake_gpio as chip
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.gpio.driver import Gpio
from sioms.drivers.gpio.edges import Edge, EdgePort
from sioms.sdk.driver import Refusal
from sioms.sdk.exchange import LinkError

OUTPUTS = [{"line": "OUT0", "safe": 1}, {"line": 1, "active_low": True}, {"line": 2}]
INPUTS = [
    {"line": "IN0", "bias": "pull_up"},
    {"line": 9, "debounce_s": 0.005},
    {"line": 10, "active_low": True},
]


class Rig:
    """A driver on the fake; keeps what is published and said."""

    def __init__(self, **table: Any) -> None:
        table = {"chip": "/dev/gpiochip0", "input": INPUTS, "output": OUTPUTS, **table}
        self.published: list[tuple[int, int, int]] = []
        self.said: list[str] = []
        self.driver = chip.GpioOnFakeChip("io0", msgspec.convert(table, Gpio.Settings), self)

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((int(block.data[0]), int(block.rows["changed_ns"][0]), int(block.edges[0])))

    def log(self, level: str, text: str) -> None:
        self.said.append(text)

    def tick(self) -> None:
        """Tick as the engine does, which publishes once more afterwards."""
        self.driver.tick(10**12)
        self.publish(self.driver.blocks[-1], 0)


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    chip.requests.clear()
    chip.levels[:] = [0] * 16
    yield
    chip.requests.clear()


def test_outputs_open_and_close_at_their_safe_levels() -> None:
    rig = Rig()
    rig.driver.open()
    out = rig.driver.blocks[0]
    assert chip.levels[:3] == [1, 1, 0] and int(out.data[0]) == 0b001, "the second is active low"
    rig.driver.write_outputs(out.spec, [0], [0b110])
    assert chip.levels[:3] == [0, 0, 1] and int(out.data[0]) == 0b110
    assert {r.consumer for r in chip.requests} == {"sioms io0"}
    rig.driver.close()
    assert chip.levels[:3] == [1, 1, 0] and not chip.requests
    with pytest.raises(Refusal, match="not open"):
        rig.driver.write_outputs(out.spec, [0], [0])


def test_every_edge_of_a_tick_is_published_with_its_own_stamp() -> None:
    rig = Rig()
    rig.driver.open()
    assert int(rig.driver.blocks[1].data[0]) == 0b111 ^ 0b010 ^ (1 << 1)
    rig.tick()
    first = rig.published[-1]
    chip.set_level(8, 0, 100)
    chip.set_level(8, 1, 200)
    chip.set_level(10, 1, 300)
    rig.tick()
    news = [p for p in rig.published if p != first]
    assert news == [(0b110, 100, first[2] + 1), (0b111, 200, first[2] + 2), (0b011, 300, first[2] + 3)]
    assert rig.driver.counters() == {"edges": 3, "lost_edges": 0}


def test_a_full_event_buffer_is_counted_said_and_made_good() -> None:
    rig = Rig(event_buffer=4, output=[], input=[{"line": 8}, {"line": 9}])
    rig.driver.open()
    chip.set_level(9, 1, 50)
    for i in range(9):
        chip.set_level(8, 1 - i % 2, 100 + i)
    rig.tick()
    assert rig.driver.counters() == {"edges": 4, "lost_edges": 6}
    assert rig.said == ["io0: 6 edges lost; want a higher tick_hz, a longer debounce_s, or a calmer line"]
    assert rig.published[-1][0] == 0b11, "the level of the line whose only edge was lost is read"
    counts = [count for _, _, count in rig.published]
    assert counts[0] == 7 and counts[-1] == 10, "the first reading behind the loss counts the six that nobody saw"
    rig.tick()
    assert len(rig.said) == 1


@given(st.lists(st.tuples(st.integers(0, 5), st.booleans()), max_size=60), st.data())
def test_any_cut_and_any_loss_of_the_oldest_gives_the_same_end(events: list[tuple[int, bool]], data: Any) -> None:
    """The port agrees with a plain record of the levels, whatever the kernel dropped; and nothing is counted twice."""
    edges = [Edge(bit, rising, 10 * i, i + 1) for i, (bit, rising) in enumerate(events)]
    whole, pieces = EdgePort(0), EdgePort(0)
    values = whole.take(edges)
    at = data.draw(st.integers(0, len(edges)))
    assert pieces.take(edges[:at]) + pieces.take(edges[at:]) == values
    levels = [False] * 6
    for bit, rising in events:
        levels[bit] = rising
    assert whole.value == sum(level << bit for bit, level in enumerate(levels)) and whole.lost == 0
    cut = EdgePort(0)
    cut.take(edges[at:])
    assert cut.lost == (at if at < len(edges) else 0) and cut.seen == len(edges) - at
    assert [stamp for _, stamp in values] == sorted(stamp for _, stamp in values)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"chip": "/dev/gpiochip7"}, "open /dev/gpiochip7: no such chip; gpiodetect lists"),
        ({"input": [{"line": "LID"}]}, "no line is named 'LID'; gpioinfo lists"),
        ({"input": [{"line": 16}]}, "line 16; it has 16, want 0 to 15"),
        ({"output": [{"line": "IN1"}]}, "line 9 is configured by name and by offset"),
    ],
)
def test_lines_that_are_not_there(table: dict[str, Any], words: str) -> None:
    rig = Rig(**table)
    with pytest.raises(LinkError, match=words):
        rig.driver.open()
    assert not chip.requests, "nothing is held after a failure"


def test_a_line_of_somebody_else_is_named_with_its_holder() -> None:
    holder = Rig(input=[])
    holder.driver.open()
    other = Rig()
    with pytest.raises(LinkError, match=r"line 0 \(OUT0\) is held by sioms io0"):
        other.driver.open()


class TestRealBinding:
    """Failures that the real binding shows on a machine without GPIO."""

    def driver(self, path: str) -> Gpio:
        settings = msgspec.convert({"chip": path, "input": [{"line": 0}]}, Gpio.Settings)
        return Gpio("io0", settings, Rig())  # type: ignore[arg-type]

    def test_no_chip(self) -> None:
        with pytest.raises(LinkError, match="open /dev/gpiochip-none: no such chip"):
            self.driver("/dev/gpiochip-none").open()

    def test_no_gpio_chip(self) -> None:
        with pytest.raises(LinkError, match="open /dev/null: this is not a GPIO chip"):
            self.driver("/dev/null").open()

    @pytest.mark.root
    def test_no_permission(self, tmp_path: Path) -> None:
        folder = tmp_path / "closed"
        folder.mkdir(0o700)
        driver = self.driver(str(folder / "gpiochip0"))
        os.seteuid(65534)
        try:
            with pytest.raises(LinkError, match="gpiochip0: no permission; put the daemon's user into the group"):
                driver.open()
        finally:
            os.seteuid(0)

    def test_settings_are_those_of_the_binding(self) -> None:
        """Every word of the configuration is one that the installed binding knows."""
        import gpiod

        for bias in ("as_is", "disabled", "pull_up", "pull_down"):
            for drive in ("push_pull", "open_drain", "open_source"):
                table = {
                    "chip": "/dev/gpiochip0",
                    "input": [{"line": 0, "bias": bias, "debounce_s": 0.005, "active_low": True}],
                    "output": [{"line": 1, "bias": bias, "drive": drive, "safe": 1}],
                }
                driver = Gpio("io0", msgspec.convert(table, Gpio.Settings), Rig())  # type: ignore[arg-type]
                key, pin = driver._input(driver.settings.input[0]), driver._output(driver.settings.output[0])
                assert isinstance(key, gpiod.LineSettings) and isinstance(pin, gpiod.LineSettings)
                assert (key.bias.name, key.active_low, key.debounce_period.total_seconds()) == (
                    bias.upper(),
                    True,
                    0.005,
                )
                assert (pin.drive.name, pin.output_value) == (drive.upper(), gpiod.line.Value.ACTIVE)
                assert key.event_clock is gpiod.line.Clock.MONOTONIC


@pytest.mark.parametrize(("there", "words"), [(None, "is missing; install"), ("v1", "is version 1; install")])
def test_without_the_binding_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, there: str | None, words: str) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None if there is None else type(sys)("gpiod"))
    settings = msgspec.convert({"chip": "/dev/gpiochip0", "input": [{"line": 0}]}, Gpio.Settings)
    with pytest.raises(ValueError, match=rf"{words} sioms\[gpio\]"):
        Gpio.describe("io0", settings)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"input": [], "output": []}, "none given"),
        ({"input": [{"line": i} for i in range(63)]}, "63 lines; want at most 62"),
        ({"input": [{"line": "OUT0"}]}, "line = 'OUT0' is given 2 times"),
        ({"input": [{"line": -1}]}, "line = -1; want an offset from 0"),
        ({"input": [{"line": 9, "debounce_s": -1.0}]}, "debounce_s = -1"),
        ({"tick_hz": 0.5}, "tick_hz = 0.5"),
        ({"event_buffer": 5000}, "event_buffer = 5000; want 1 to 1024"),
    ],
)
def test_bad_configurations(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Rig(**table)


def test_a_level_that_cannot_be_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.driver.open()

    def gone(self: Any, values: Any) -> None:
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr(chip.Request, "set_values", gone)
    with pytest.raises(Refusal, match="set lines of /dev/gpiochip0: No such device"):
        rig.driver.write_outputs(rig.driver.blocks[0].spec, [0], [1])
    rig.driver.close()
    assert "safe outputs could not be set" in rig.said[0] and not chip.requests


def test_a_chip_that_goes_away_is_a_loss_and_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.driver.open()

    def gone(self: Any, max_events: int) -> None:
        raise OSError(errno.ENODEV, "No such device")

    chip.set_level(8, 0)
    with monkeypatch.context() as patch:
        patch.setattr(chip.Request, "read_edge_events", gone)
        with pytest.raises(LinkError, match="read lines of /dev/gpiochip0: no such device"):
            rig.driver.tick(0)
    rig.driver.open()
    assert len(chip.requests) == 2, "what was held is let go first"
    rig.tick()
    assert rig.published[-1][0] & 1
