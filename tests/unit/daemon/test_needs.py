"""What drivers need of the processors: the sentences, what fits, and that the estimate follows kind and rate."""

from __future__ import annotations

from pathlib import Path

import pytest

from sioms.daemon.config import parse
from sioms.daemon.names import BlockInfo, DeviceInfo, NameTable
from sioms.daemon.needs import Machine, need, priorities, shortages, summary, this_machine
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.finding import describe, find_driver, read_settings

TWO = Machine(2, 1.4)


def device(
    kind: str, tick_hz: float, *blocks: tuple[NodeClass, int], priority: int = 0, holds: tuple[str, ...] = (),
    name: str = "d",
) -> DeviceInfo:  # fmt: skip
    made = tuple(
        BlockInfo(str(i), cls, tuple(ChannelInfo(f"c{c}") for c in range(count)), False, 64, 0)
        for i, (cls, count) in enumerate(blocks)
    )
    return DeviceInfo(name, "driver", made, tick_hz, (), 0.1, kind=kind, realtime_priority=priority, holds=holds)


def test_the_estimate_is_near_what_was_measured() -> None:
    """Shares of a processor of one device alone, as the kernel counts them: docs/decisions/0351 and 0570."""
    axes, analog = (NodeClass.AXIS, 4), (NodeClass.ANALOG, 6)
    for estimated, measured in (
        (need(device("compiled", 1000, axes)), 0.045),
        (need(device("compiled", 100, axes)), 0.0081),
        (need(device("stream", 1000, analog)), 0.14),
        (need(device("stream", 200, analog)), 0.051),
        (need(device("tick", 1000, analog)), 0.104),
        (need(device("line", 50, (NodeClass.AXIS, 1))), 0.088),
        (need(device("line", 100, (NodeClass.BINARY, 1), (NodeClass.BINARY, 1))), 0.071),
    ):
        assert measured / 1.3 < estimated < measured * 1.8


def test_what_fits_is_told_and_nothing_else() -> None:
    needs = {"a": 0.1, "b": 0.2, "c": 0.3, "d": 0.4, "e": 0.05}
    assert (
        summary(needs, TWO) == "its drivers need about 1.05 of 2 processors: d 0.40, c 0.30, b 0.20, a 0.10 and 1 more"
    )
    assert shortages(needs, ["a", "b", "gone"], TWO) == []


def test_a_cell_that_does_not_fit_is_told() -> None:
    needs = {"a": 0.7, "b": 0.6}
    (said,) = shortages(needs, [], Machine(1, 0.7))
    assert said.startswith("these devices need about 1.30 of 1 processor: a 0.70, b 0.60; lower their rates")


def test_real_time_has_a_bound_of_its_own() -> None:
    needs = {"a": 0.9, "b": 0.6, "c": 0.1}
    (said,) = shortages(needs, ["a", "b"], TWO)
    assert "need about 1.50 processors in real time, which may use 1.40 of 2 processors: a 0.90, b 0.60" in said
    assert "realtime_priority = 0" in said


def test_one_driver_uses_one_processor() -> None:
    (said,) = shortages({"a": 1.25}, [], TWO)
    assert said == "device a needs about 1.25 processors, and its driver can use one; at most 80% of its rate fit: " + (
        "lower its rate"
    )


def test_this_machine_leaves_something_to_others() -> None:
    machine = this_machine()
    assert machine.processors >= 1 and 0 < machine.realtime < machine.processors


@pytest.mark.parametrize(
    ("driver", "table", "kind", "priority"),
    [
        ("sim-axes", {"axis": [{"name": "x", "motor": {"mass": 1.0}}]}, "compiled", 0),
        ("sim-io", {"outputs": 8}, "tick", 0),
        ("ft300", {"line": {"serial": "/dev/null", "baud": 19200}}, "stream", 50),
        ("modbus-io", {"map": "moxa_e1200", "line": {"tcp": "h:502"}, "model": "E1212"}, "line", 50),
    ],
)
def test_a_driver_is_described_with_its_kind(driver: str, table: dict[str, object], kind: str, priority: int) -> None:
    found = find_driver(driver, "/")
    settings, errors = read_settings(found, table, "/")
    assert not errors
    packed, errors = describe(found, "d", settings)
    assert not errors and packed is not None
    info = DeviceInfo.unpack("d", driver, packed)
    assert (info.kind, info.realtime_priority) == (kind, priority)


def test_the_configuration_has_the_last_word_on_real_time(tmp_path: Path) -> None:
    config, errors = parse(
        '[workcell]\nname = "t"\n[device.a]\ndriver = "x"\n[device.b]\ndriver = "x"\nrealtime_priority = 0\n'
        '[device.c]\ndriver = "y"\nrealtime_priority = 7\n',
        str(tmp_path),
    )
    assert config is not None and not errors
    infos = {name: device("tick", 1.0, priority=50 if name != "c" else 0, name=name) for name in "abc"}
    assert priorities(NameTable(infos, {}), config) == {"a": 50, "b": 0, "c": 7}


def test_what_is_made_of_real_devices_comes_right_behind_them(tmp_path: Path) -> None:
    tables = [f'[device.{name}]\ndriver = "x"\n' for name in ("real", "simulated", "low", "over", "top", "toy", "last")]
    text = '[workcell]\nname = "t"\n' + "".join(tables) + '[device.told]\ndriver = "x"\nrealtime_priority = 0\n'
    config, errors = parse(text, str(tmp_path))
    assert config is not None and not errors
    held = {"over": ("real", "simulated"), "top": ("over",), "toy": ("simulated",), "last": ("low",), "told": ("real",)}
    own = {"real": 50, "low": 1}
    axis = (NodeClass.AXIS, 1)
    infos = {
        n: device("tick", 1.0, axis, priority=own.get(n, 0), holds=tuple(f"{h}.0" for h in held.get(n, ())), name=n)
        for n in config.devices
    }
    found = priorities(NameTable(infos, {}), config)
    assert {name: found[name] for name in held} == {"over": 49, "top": 49, "toy": 0, "last": 1, "told": 0}
