"""Dead-men of I/O blocks: set, read back, proved by the polls, and set again by each opening, against the register
models.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest
from io_rig import Joined

from sioms.drivers.modbus.simulated import moxa, wago
from sioms.sdk.exchange import DeviceError, StateLost

WAGO = {
    "map": "wago_750",
    "channels": {"di": 8, "do": 4, "ai": 2, "ao": 2},
    "watchdog_s": 1.5,
    "safe": {"do": 0},
}
MOXA = {"map": "moxa_e1200", "model": "E1212", "safe": {"do": 0}}


def coupler(**more: Any) -> Joined:
    return Joined(lambda clock: wago.Coupler(8, 4, 2, clock), **WAGO | more)


def block(**more: Any) -> Joined:
    return Joined(lambda clock: moxa.Block("E1212", 1.0, clock, **more), **MOXA)


def test_the_watchdog_runs_behind_every_opening() -> None:
    """The trigger acts only when it is modified: the first opening of a coupler's life is no proof for the second."""
    joined = coupler()
    for opening in range(5):
        joined.begin()
        joined.open()
        assert joined.device.state()["armed"], opening
        joined.write("do", 0b1111)
        joined.poll(2.0)
        assert joined.device.state()["outputs"] == 0b1111, "polls keep it alive"
        joined.now_s += 1.6
        assert joined.device.state() | {"outputs": 0, "tripped": True} == joined.device.state(), opening


def test_a_watchdog_that_does_not_run_is_no_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = coupler()
    monkeypatch.setattr(wago, "TRIGGER", 0x1010)  # a coupler whose trigger is elsewhere
    with pytest.raises(DeviceError, match="set the watchdog of io0: watchdog_status is 0; want 1"):
        joined.open()


def test_a_time_that_was_not_taken_is_no_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    joined = coupler()
    write = joined.device._write_watchdog
    monkeypatch.setattr(
        joined.device, "_write_watchdog", lambda at, value: write(at, 100 if at == wago.TIME else value)
    )
    with pytest.raises(DeviceError, match=r"watchdog_time is 10; want 1\.5"):
        joined.open()


def test_a_time_between_two_steps_is_the_lower_one() -> None:
    joined = coupler(watchdog_s=0.79)
    joined.open()
    assert joined.device.registers[wago.TIME] == 7


def test_a_watchdog_that_has_acted_is_ended_by_the_next_opening() -> None:
    joined = coupler()
    joined.open()
    joined.write("do", 0b1010)
    joined.now_s += 3.0
    with pytest.raises(DeviceError, match="exception 4, device failure"):
        joined.poll()
    joined.open()
    joined.poll()
    assert joined.device.state()["outputs"] == 0, "nobody ordered them on again"
    joined.write("do", 0b0001)
    assert joined.device.state()["outputs"] == 1


@pytest.mark.parametrize(
    "behind_our_back",
    [
        lambda device: (device.power_off(), device.power_on()),
        lambda device: device.write(wago.SIMPLE_STOP, [0xAA55]),
        lambda device: (device.write(wago.STOP, [0xAAAA]), device.write(wago.STOP, [0x5555])),
        lambda device: (
            device.write(wago.SIMPLE_STOP, [0xAA55]), device.write(wago.TIME, [600]), device.write(wago.TRIGGER, [7]),
        ),
    ],
)  # fmt: skip
def test_a_watchdog_that_others_stopped_is_noticed(behind_our_back: Callable[[Any], Any]) -> None:
    joined = coupler()
    joined.open()
    joined.poll(1.0)
    behind_our_back(joined.device)
    with pytest.raises(StateLost, match=r"its watchdog is not as it was set: watchdog_(status is 0|time is 60)"):
        joined.poll(0.3)
    joined.open()
    assert joined.device.state()["armed"]
    joined.poll(1.0)


def test_without_a_time_the_watchdog_is_left_alone() -> None:
    joined = coupler(watchdog_s=0.0)
    joined.open()
    joined.poll(1.0)
    assert not joined.device.state()["armed"]
    assert joined.kit.said == ["io0: its own watchdog: none is set (watchdog_s = 0)"]
    assert not any(pdu.startswith("06 10") for pdu in joined.sent)


def test_outputs_read_what_the_coupler_has_on() -> None:
    """Function 1 reads inputs at 0, functions 3 and 4 input words: outputs are read from 0x200 on."""
    joined = coupler()
    joined.open()
    joined.device.di, joined.device.ai = [1] * 8, [0x1111, 0x2222]
    joined.write("do", 0b0101)
    spec = joined.unit.blocks[3].spec
    joined.run(joined.unit.write_outputs(spec, [1], [5.0]))
    joined.poll()
    inputs, outputs, _, analog = joined.unit.blocks
    assert (inputs.data[0], outputs.data[0]) == (0xFF, 0b0101)
    assert analog.data.tolist() == pytest.approx([0.0, 5.0], abs=1e-3)
    joined.device.set_outputs(0, [0, 0, 0, 1])
    joined.poll()
    assert outputs.data[0] == 0b1000, "another master's outputs are seen"


def test_busy_is_asked_again_and_a_refusal_is_told() -> None:
    joined = coupler()
    joined.open()
    joined.busy = 3
    joined.write("do", 0b0011)
    assert joined.device.state()["outputs"] == 3
    joined.busy = 4
    with pytest.raises(DeviceError, match="exception 6, busy"):
        joined.write("do", 0b1100)
    assert joined.device.state()["outputs"] == 3


class TestMoxa:
    def test_a_watchdog_that_has_acted_is_cleared_and_told(self) -> None:
        joined = block(safe=0b1)
        joined.open()
        joined.poll(2.0)
        joined.write("do", 0b1111)
        joined.now_s += 1.5
        assert joined.device.state()["outputs"] == 0b1, "its own safe values"
        with pytest.raises(StateLost, match="its own watchdog has acted"):
            joined.poll(0.3)
        joined.open()
        assert "cannot be read; set on the device's web page" in joined.kit.said[0]
        assert joined.kit.said[-1] == "io0: its own watchdog had acted; cleared"
        joined.write("do", 0b10)
        joined.poll(1.0)
        assert joined.device.state()["outputs"] == 0b10

    def test_a_restart_is_seen_by_the_uptime(self) -> None:
        joined = block(at_power_on=0b11)
        joined.open()
        joined.poll(3.0)
        joined.device.power_off()
        joined.device.power_on()
        with pytest.raises(StateLost, match="was switched off or restarted: uptime is 0 after"):
            joined.poll(0.3)
        joined.open()
        joined.poll(1.0)
        assert joined.unit.blocks[1].data[0] == 0b11, "what it has on, it reads"

    def test_a_restart_while_the_link_was_lost_is_seen_by_the_next_opening(self) -> None:
        joined = block()
        assert joined.run(joined.unit._guard.open()) is False
        joined.now_s += 3.0
        assert joined.run(joined.unit._guard.open()) is False, "the cable alone"
        joined.device.power_off()
        joined.device.power_on()
        assert joined.run(joined.unit._guard.open()) is True

    def test_a_block_without_these_registers_is_taken(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Older firmware has neither flag nor uptime: they prove nothing, and that is told."""
        joined = block()
        read_bits, read_input = joined.device.read_bits, joined.device.read_input
        monkeypatch.setattr(
            joined.device,
            "read_bits",
            lambda f, at, n: 2 if at == moxa.WATCHDOG_ALARM else read_bits(f, at, n),
        )
        monkeypatch.setattr(joined.device, "read_input", lambda at, n: 2 if at == 5020 else read_input(at, n))
        joined.open()
        joined.poll(1.0)
        assert [text.split(",")[0] for text in joined.kit.said] == [
            "io0: has no uptime",
            "io0: has no watchdog_alarm",
            "io0: its own watchdog: whether it is set cannot be read; set on the device's web page: communication "
            "watchdog and safe values",
        ]


@pytest.mark.parametrize(("turnaround_s", "misses"), [(0.05, 5), (0.2, 1), (0.5, 1)])
def test_silence_is_a_lost_block_within_half_a_second_or_one_exchange(turnaround_s: float, misses: int) -> None:
    joined = coupler(override={"turnaround_s": turnaround_s})
    assert joined.unit.misses == misses


@pytest.mark.parametrize(
    "made", [lambda: moxa.simulated_block(moxa.Block("E1212")), lambda: wago.simulated(wago.Coupler(8, 8, 2))]
)
def test_a_simulated_block_is_small(made: Callable[[], object]) -> None:
    """pymodbus squares the count of bits when it checks them: that of the Moxa block took 2 GB and 5 s."""
    tracemalloc.start()
    try:
        made()
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()
