"""The mapped unit sends the vendors' golden frames and reads their replies back into SI."""

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sioms.drivers
from sioms.drivers.modbus.registers import Gearing
from sioms.drivers.modbus.regmap_files import load_map
from sioms.drivers.modbus.unit import MappedUnit
from sioms.sdk.codec.modbus import RtuUnit, SerialLine, TcpUnit, frame_rtu, frame_tcp
from sioms.sdk.exchange import DeviceError, Exchange, Pause, Steps

MAPS = Path(sioms.drivers.__file__).parent / "modbus" / "maps"
LINE = SerialLine(115200)


def drive(steps: Steps, answer: Callable[[Exchange], bytes]) -> tuple[list[Exchange], Any]:
    """Run a generator with the replies that ``answer`` makes; returns the exchanges and its value."""
    sent: list[Exchange] = []
    value: Any = None
    try:
        while True:
            step = steps.send(value)
            if isinstance(step, Pause):
                value = None
                continue
            assert isinstance(step, Exchange)
            sent.append(step)
            value = step.decode(answer(step))
    except StopIteration as end:
        return sent, end.value


def echo(exchange: Exchange) -> bytes:
    """Answer a write as a device does."""
    return exchange.data if exchange.data[1] in (5, 6) else frame_rtu(exchange.data[0], exchange.data[1:6])


def unit(family: str, gearing: Gearing) -> MappedUnit:
    return MappedUnit(load_map(MAPS / f"{family}.toml"), RtuUnit(1, LINE), gearing, "mod0")


# 10 mm a turn; 200 rpm = 33.33 mm/s; 50 ms to 1000 rpm = 333.3 turns/s^2 = 3.333 m/s^2
LEADSHINE = unit("leadshine", Gearing(0.01, 10000))
RAMP = {"acceleration": 10 / 3, "deceleration": 10 / 3}
AZ = unit("oriental_az", Gearing(0.01, 1000))


@pytest.mark.parametrize(
    ("device", "name", "quantities", "wires"),
    [
        (
            LEADSHINE,
            "position",
            {"position": 0.01, "speed": 0.1 / 3, **RAMP},
            ["01 10 62 00 00 08 10 00 01 00 00 27 10 00 c8 00 32 00 32 00 00 00 10 ae 33"],
        ),
        (
            LEADSHINE,
            "relative",
            {"position": -0.01, "speed": 0.1 / 3, **RAMP},
            ["01 10 62 00 00 08 10 00 41 ff ff d8 f0 00 c8 00 32 00 32 00 00 00 10 45 d4"],
        ),
        (LEADSHINE, "stop", {}, ["01 06 60 02 00 40 37 fa"]),
        (LEADSHINE, "fastest", {}, ["01 06 60 02 00 40 37 fa"]),
        (LEADSHINE, "home", {}, ["01 06 60 02 00 20 37 d2"]),
        (LEADSHINE, "reset", {}, ["01 06 18 01 11 11 12 f6"]),
        (LEADSHINE, "jog_plus", {}, ["01 06 18 01 40 01 2e aa"]),
        (LEADSHINE, "enable", {}, ["01 06 00 0f 00 01 78 09"]),
        (LEADSHINE, "disable", {}, ["01 06 00 0f 00 00 b9 c9"]),
        (
            AZ,
            "relative",
            {"position": 0.085, "speed": 0.02, "acceleration": 0.015, "deceleration": 0.015},
            [
                "01 10 00 58 00 10 20 00 00 00 00 00 00 00 02 00 00 21 34 00 00 07 d0 00 00 05 dc 00 00 05 dc "
                "00 00 03 e8 00 00 00 01 1c 08"
            ],
        ),
        (
            AZ,
            "stop",
            {},
            ["01 10 00 7c 00 02 04 00 00 00 20 f5 06", "01 10 00 7c 00 02 04 00 00 00 00 f4 de"],
        ),
        (
            AZ,
            "home",
            {},
            ["01 10 00 7c 00 02 04 00 00 00 10 f5 12", "01 10 00 7c 00 02 04 00 00 00 00 f4 de"],
        ),
        (AZ, "disable", {}, ["01 10 00 7c 00 02 04 00 00 00 40 f5 2e"]),
        (
            AZ,
            "reset",
            {},
            ["01 10 01 80 00 02 04 00 00 00 01 37 9f", "01 10 01 80 00 02 04 00 00 00 00 f6 5f"],
        ),
    ],
)
def test_commands_are_the_golden_frames(
    device: MappedUnit, name: str, quantities: dict[str, float], wires: list[str]
) -> None:
    sent, _ = drive(device.command(name, **quantities), echo)
    assert [exchange.data.hex(" ") for exchange in sent] == wires
    assert {exchange.repeatable for exchange in sent} == {device.rmap.commands[name].repeat}


def test_a_poll_is_the_fewest_messages() -> None:
    assert len(AZ.plan(AZ.rmap.poll["always"])) == 2
    assert len(LEADSHINE.plan(LEADSHINE.rmap.poll["always"])) == 3


def test_readings_are_si() -> None:
    # position 1000 pulses (10 mm) falling at 200 pulses/s (2 mm/s), 12 rpm
    words = {0x7E: [0, 0x2020], 0xCC: [0, 1000, 0xFFFF, 0xFFF4, 0xFFFF, 0xFF38]}

    def answer(exchange: Exchange) -> bytes:
        registers = words[int.from_bytes(exchange.data[2:4], "big")]
        body = b"".join(word.to_bytes(2, "big") for word in registers)
        return frame_rtu(1, bytes((3, len(body))) + body)

    _, values = drive(AZ.read(AZ.plan(AZ.rmap.poll["always"])), answer)
    assert values["output"] == 0x2020
    assert values["position"] == pytest.approx(0.01)
    assert values["velocity"] == values["velocity_rpm"] == pytest.approx(-0.002)


@pytest.mark.parametrize(
    ("device", "quantities", "words"),
    [
        (
            LEADSHINE,
            {"position": 1e6, "speed": 0.03, **RAMP},
            "position 1e.06 is 1e.12 pulse in the register",
        ),
        (LEADSHINE, {"position": 0.0, "speed": 1e-5, **RAMP}, "speed 1e-05 is 0 rpm .* takes 1 to 6000"),
        (LEADSHINE, {"position": 0.0, "speed": 2.0, **RAMP}, "want 0.000166667 to 1"),
        (
            LEADSHINE,
            {"position": 0.0, "speed": 0.1, "acceleration": 0.0, "deceleration": 1.0},
            "acceleration 0 is inf",
        ),
        (LEADSHINE, {"position": float("nan"), "speed": 0.1, **RAMP}, "position nan"),
    ],
)
def test_a_quantity_that_does_not_fit_is_refused(device: MappedUnit, quantities: dict[str, float], words: str) -> None:
    with pytest.raises(DeviceError, match=words) as caught:
        drive(device.command("position", **quantities), echo)
    assert caught.value.errno == errno.EINVAL


def test_identity() -> None:
    def answer(value: int) -> Callable[[Exchange], bytes]:
        return lambda exchange: frame_rtu(1, bytes((3, 2)) + value.to_bytes(2, "big"))

    drive(LEADSHINE.identify({"pulses_per_turn": 10000}), answer(10000))
    with pytest.raises(DeviceError, match="pulses_per_turn is 1600; the configuration says pulses_per_turn = 10000"):
        drive(LEADSHINE.identify({"pulses_per_turn": 10000}), answer(1600))

    def model(exchange: Exchange) -> bytes:
        return frame_tcp(int.from_bytes(exchange.data[:2], "big"), 1, b"\x04\x14" + b"E1212".ljust(20, b"\0"))

    moxa = MappedUnit(load_map(MAPS / "moxa_e1200.toml"), TcpUnit(1), name="io0")
    drive(moxa.identify({"model": "E1212"}), model)
    with pytest.raises(DeviceError, match="identify io0: model is 'E1212'; the configuration says E1240"):
        drive(moxa.identify({"model": "E1240"}), model)


def test_alarm_texts() -> None:
    assert AZ.alarm_text(0) == ""
    assert AZ.alarm_text(0x85) == "alarm 0x85, RS-485 communication time-out"
    assert AZ.alarm_text(0x41) == "alarm 0x41, EEPROM; only a power cycle clears it"
    assert AZ.alarm_text(0x999) == "alarm 0x999, not in the map"


def test_arrays_of_a_smaller_model() -> None:
    rmap = load_map(MAPS / "moxa_e1200.toml")
    moxa = MappedUnit(rmap, TcpUnit(1), counts={"ai": 2, "di": 6})
    plan = moxa.plan(["ai", "di"])
    replies = {4: b"\x04\x04\xff\xff\x80\x00", 2: b"\x02\x01\x2a"}

    def answer(exchange: Exchange) -> bytes:
        return frame_tcp(int.from_bytes(exchange.data[:2], "big"), 1, replies[exchange.data[7]])

    _, values = drive(moxa.read(plan), answer)
    assert values["di"] == 0x2A
    assert values["ai"] == pytest.approx([10.0, 5.0000763])
