"""All errors of a configuration in one run, each with its line."""

from __future__ import annotations

import msgspec
import pytest

from sioms.daemon.config import parse
from sioms.daemon.lines import with_lines
from sioms.wording import every_error

TEXT = """[workcell]
nam = "x"
max_sessions = 0

[[grant]]
rights = ["read"]
[[grant]]
rights = ["fly"]
[device.a]
driver = "d"
on_loss = "halt"
realtime_priority = 100
[[device.a.axis]]
name = "x"
[[device.a.axis]]
mass = "heavy"
"""


def test_every_wrong_value_is_told_with_its_line() -> None:
    config, errors = parse(TEXT, "")
    with_lines(TEXT, errors)
    assert [error.split(": ")[0] for error in errors] == ["line 2", "line 3", "line 11", "line 12", "line 8"]
    assert config is not None and "a" in config.devices, "its driver is asked all the same, and tells its own errors"
    told = [
        "[device.a].axis[1].mass: wrong",
        "[device.a].axis[0]: key unit is missing",
        "[device.z]: not there",
    ]
    with_lines(TEXT, told)
    assert [each.partition(" ")[2][:3].strip(": ") for each in told[:2]] == ["16", "13"] and told[2].startswith(
        "[device.z]"
    )


class Axis(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    mass: float = 1.0


class Device(msgspec.Struct, forbid_unknown_fields=True):
    axis: list[Axis]
    rate: float = 1.0
    spare: Axis | None = None
    more: list[Axis] | None = None

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise ValueError("rate below 0")


def test_all_errors_of_nested_tables() -> None:
    table = {"axis": [{"name": 1, "mass": "x"}, {"mas": 2.0}], "rate": "fast", "raet": 1}
    assert every_error("d", table, Device) == [
        "d: unknown key raet; did you mean rate?",
        "d.axis[0].name: want a text in quotes, got an integer",
        "d.axis[0].mass: want a number, got a text in quotes",
        "d.axis[1]: unknown key mas; did you mean mass?",
        "d.axis[1]: key name is missing",
        "d.rate: want a number, got a text in quotes",
    ]
    optional = {"axis": [], "spare": {"name": "x", "mas": 1.0}, "more": [{"name": "x"}, {"nam": "x"}]}
    assert every_error("d", optional, Device) == [
        "d.spare: unknown key mas; did you mean mass?",
        "d.more[1]: unknown key nam; did you mean name?",
        "d.more[1]: key name is missing",
    ]
    assert every_error("d", {"axis": [], "rate": -1.0}, Device) == ["d: rate below 0"]
    assert every_error("d", {"axis": []}, Device) == []


AXES = '''name = "top"
[workcel]
[[workcell.x]]
a = 1
[ device . "mod0" ]
description = """
history = 1
[device.no]
"""
  history = "x"   # here
[[device.mod0.axis]]
name = "x"
motor.mass = "heavy"
[[device.mod0.axis]]
name = "y"
position_max = 0.0
  position_min = 1.0
[[workcell]]
[[emergency_stop]]
node = "nosuch"
'''


@pytest.mark.parametrize(
    ("error", "line"),
    [
        ("[name]: unknown section", 1),
        ("[workcel]: unknown section; did you mean workcell?", 2),
        ("[workcell]: unknown key x; there are: name", 3),
        ("[device.mod0].history: want an integer, got a text in quotes", 10),
        ("[device.mod0]: key rate is missing", 5),
        ("[device.mod0].axis[0].motor.mass: want a number, got a text in quotes", 13),
        ("[device.mod0].axis[1].motor.mass: want", 14),
        ("[device.mod0]: axis y: position_min 1 is not below position_max 0", 17),
        ("[device.mod0]: axis y: it has no encoder", 14),
        ("[device.mod0]: axis z: no such axis", 5),
        ("[device.mod0].axis[1].position_min = 2020-01-01: no key of a device takes a date", 17),
        ("[workcell]: want a table {...}, got a list [...]", 18),
        ("[[emergency_stop]] number 1: node = nosuch; want the name of one binary input", 20),
        ("[device.other]: not there", 0),
    ],
)
def test_lines_of_tables_keys_and_named_axes(error: str, line: int) -> None:
    told = [error]
    with_lines(AXES, told)
    assert told == [f"line {line}: {error}" if line else error]
