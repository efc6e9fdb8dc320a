"""Register maps: the shipped ones hold, and each mistake is named with its place and its cure."""

import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest

import sioms.drivers
from sioms.drivers.modbus.axis import ModbusAxis
from sioms.drivers.modbus.regmap_files import RegisterMapError, load_map, parse_map
from sioms.protocol.flags import ControlMode

MAPS = Path(sioms.drivers.__file__).parent / "modbus" / "maps"


@pytest.mark.parametrize("path", sorted(MAPS.glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_maps_hold(path: Path) -> None:
    assert load_map(path).family == path.stem


def leadshine() -> dict[str, Any]:
    return tomllib.loads((MAPS / "leadshine.toml").read_text())


def put(document: dict[str, Any], place: str, value: Any) -> None:
    *path, last = place.split("/")
    node: Any = document
    for key in path:
        node = node[int(key)] if isinstance(node, list) else node.setdefault(key, {})
    if isinstance(node, list):
        node[int(last)] = value
    else:
        node[last] = value


ITEM = "commands/position/writes/0/items/2"


@pytest.mark.parametrize(
    ("place", "value", "sentence"),
    [
        ("signals/position/adress", 1, "signals.position.adress: unknown key; did you mean address"),
        ("signals/position/address", "x", "signals.position.address = 'x': want an integer, got a text in quotes"),
        ("signals/position/type", "int32", "signals.position.type = 'int32': unknown; did you mean i32"),
        (
            "signals/position/type",
            "word",
            "signals.position.type = 'word': unknown; there are: u16, i16, u32",
        ),
        ("signals/position/unit", "furlong", "unknown unit 'furlong'; there are: A, mA, V"),
        ("signals/position/unit", "puls", "signals.position.unit: unknown unit 'puls'; did you mean pulse"),
        (
            "signals/position/address",
            0x1002,
            "inside signals.position (0x1002 to 0x1003 of the holding table)",
        ),
        ("signals/position/address", 0xFFFF, "address 0xffff with 2 places leaves 0 to 0xffff"),
        ("signals/position/scale", 0, "signals.position: scale is 0; want another number"),
        ("signals/name", {"address": 0x100, "type": "text"}, "signals.name: a text needs words"),
        ("signals/big", {"address": 0x8000, "count": 126}, "126 places; one message reads at most 125"),
        ("poll/allways", ["status"], "poll.allways: unknown group; did you mean always"),
        ("poll/seldom", ["allarm"], "poll.seldom: unknown signal allarm; did you mean alarm"),
        ("poll/always", ["status", "velocity"], "poll.always: position is missing, the axis reads it"),
        ("identify/0", {"signal": "status"}, "identify[0]: tests nothing"),
        ("axis/modes", ["POSITON"], "axis.modes: unknown mode POSITON; did you mean POSITION"),
        ("axis/modes", ["FORCE"], "axis.modes: FORCE needs commands.force"),
        ("axis/status/moving", {"signal": "status", "bit": 16}, "bit 16 of status; want 0 to 15"),
        ("axis/status", {}, "neither moving nor done"),
        ("commands/stop/repeat", False, "commands.stop: repeat is false; a stop must be repeatable"),
        (
            "commands/relative/repeat",
            True,
            "commands.relative: repeat is true, but relative has an effect each time",
        ),
        ("commands/stopp", {"writes": []}, "commands.stopp: unknown command; did you mean stop"),
        (
            "commands/home/writes/0/items/0/value",
            70000,
            "70000 does not fit a register of type u16; want 0 to 65535",
        ),
        ("commands/home/writes/0/items/0/source", "speed", "has both value and source; want exactly one"),
        ("commands/home/writes/0/items/0", {}, "has neither value nor source"),
        (
            "commands/home/writes/0/items/0",
            {"values": [1, 2], "differs_from": "stat"},
            "items[0].differs_from: unknown signal stat; did you mean status",
        ),
        (
            "commands/home/writes/0/items/0",
            {"values": [1, 1], "differs_from": "status"},
            "values are [1, 1]; want two that differ",
        ),
        ("commands/home/writes/0/items/0", {"values": [1, 2]}, "values without differs_from"),
        ("commands/home/writes/0/items/0/values", [1, 2], "has both value and values; want exactly one"),
        (
            "commands/watchdog",
            {"writes": [{"address": 1, "items": [{"source": "timeout", "unit": "s"}]}]},
            "dead_man.proof: missing; what commands.watchdog sets must be read back",
        ),
        ("dead_man/proof", [{"signal": "status"}], "dead_man.proof[0]: tests nothing; want equals"),
        (
            "dead_man/proof",
            [{"signal": "statu", "equals": 1}],
            "proof[0]: unknown signal statu; did you mean status",
        ),
        (
            "dead_man/proof",
            [{"signal": "status", "source": "speed"}],
            "dead_man.proof[0]: unknown quantity speed; want timeout",
        ),
        (
            "dead_man/tripped",
            {"signal": "status", "equals": 1},
            "dead_man.tripped: needs commands.watchdog_restart, which ends it",
        ),
        ("restart/counter", "uptim", "restart.counter: unknown signal uptim"),
        (
            "restart/token",
            "",
            "restart.token: needs commands.token, which writes it; want both or neither",
        ),
        ("restart/maximum", 1, "restart: the token is 1 to 1; want a wider range"),
        (
            "commands/home/writes/0/items",
            [{"type": "u32", "value": 1}],
            "function single writes one register, not 2",
        ),
        (f"{ITEM}/source", "sped", "unknown quantity sped; did you mean speed"),
        (f"{ITEM}/unit", "pulse", "speed cannot be in 'pulse'; want one of rpm, pulse/s"),
        (f"{ITEM}/maximum", 70000, "maximum 70000 does not fit type u16"),
        ("dead_man/refresh", ["jog"], "dead_man.refresh: unknown command jog"),
        ("dead_man/timeout_s", 0.0, "dead_man.timeout_s: is 0.0 s; want more than 0"),
        ("alarms/codes/high", "x", "alarms.codes: 'high' is not a number"),
        ("alarms/signal", "alarms", "alarms: unknown signal alarms; did you mean alarm"),
        ("ports/do", {"signal": "enable", "node_class": "binary"}, "want coil or discrete"),
        ("modells", {}, "modells: unknown key; did you mean models"),
    ],
)
def test_each_mistake_has_its_sentence(place: str, value: Any, sentence: str) -> None:
    document = leadshine()
    put(document, place, value)
    with pytest.raises(RegisterMapError) as caught:
        parse_map(document, "x.toml")
    assert sentence in str(caught.value)
    assert str(caught.value).startswith("read register map x.toml: ")


def test_a_bound_that_does_not_fit_its_register() -> None:
    oven = Path(__file__).parents[3] / "examples" / "drivers" / "oven.toml"
    assert load_map(oven, {"ports": {"target": {"maximum": 3276.7}}})
    with pytest.raises(
        RegisterMapError,
        match=r"ports.target.maximum: 3276.8 degC does not fit i16 at 0x0020, which takes -3276.8 to 3276.7",
    ):
        load_map(oven, {"ports": {"target": {"maximum": 3276.8}}})
    with pytest.raises(
        RegisterMapError,
        match=r"ports.target.minimum: -1 degC does not fit u16 at 0x0020, which takes 0 to 6553.5",
    ):
        load_map(oven, {"signals": {"target": {"type": "u16"}}, "ports": {"target": {"minimum": -1.0}}})


def test_all_mistakes_come_at_once() -> None:
    document = leadshine()
    del document["title"]
    document["signals"]["status"]["adress"] = document["signals"]["alarm"]["unitt"] = 1
    document["axis"]["status"]["moving"]["bit"] = "two"
    with pytest.raises(RegisterMapError) as caught:
        parse_map(document, "x.toml")
    assert len(caught.value.problems) == 4


def test_overrides_and_unreadable_files(tmp_path: Path) -> None:
    changed = load_map(MAPS / "leadshine.toml", {"signals": {"alarm": {"address": 0x2204}}})
    assert changed.signals["alarm"].address == 0x2204
    assert changed.signals["status"].address == 0x1003
    with pytest.raises(RegisterMapError, match="no such file"):
        load_map(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("family = ")
    with pytest.raises(RegisterMapError, match="no TOML: line 1: family =: no value"):
        load_map(tmp_path / "bad.toml")


def test_the_smallest_axis_of_the_documentation_is_a_map(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "register-maps.md").read_text()
    (tmp_path / "mydrive.toml").write_text(text.partition("```toml\n")[2].partition("```")[0])
    axis = {
        "name": "x", "address": 1, "travel_per_turn": 0.01, "pulses_per_turn": 10000,
        "velocity_max": 0.1, "acceleration_max": 1.0,
    }  # fmt: skip
    table = {
        "map": str(tmp_path / "mydrive.toml"),
        "line": {"serial": "/dev/x", "baud": 115200},
        "axis": [axis],
    }
    settings = msgspec.convert(table, ModbusAxis.Settings)
    (block,) = ModbusAxis.describe("slide0", settings).blocks
    assert ControlMode.VELOCITY in ControlMode(block.channels[0].modes)
