"""Reading the configuration: every error is a sentence with its place, all of them at once."""

from __future__ import annotations

import pytest

from sioms.daemon.config import parse

GOOD = """
[workcell]
name = "w"
[device.mod0]
driver = "sim-axes"
tick_hz = 500
on_loss = "stop"
[node."mod0.xy"]
of = "mod0"
channels = ["x", "y"]
[[grant]]
rights = ["read"]
users = ["eva"]
[[emergency_stop]]
node = "io0.bit1"
active = 1
"""


def errors(text: str) -> list[str]:
    return parse(text, "/etc")[1]


def test_a_good_configuration() -> None:
    config, found = parse(GOOD, "/etc")
    assert found == [] and config is not None
    device = config.devices["mod0"]
    assert device.common.driver == "sim-axes" and device.common.on_loss == "stop"
    assert device.settings == {"tick_hz": 500}, "what the daemon does not read belongs to the driver"
    assert config.nodes["mod0.xy"].channels == ["x", "y"]
    assert config.grants[0].nodes == ["*"] and config.stop_sources[0].active == 1
    assert config.folder == "/etc"


def test_a_text_that_is_read_twice_gives_the_same_twice() -> None:
    text = '[device.a]\ndriver = "sim-axes"\nkey = [1]\n[device.b]\nrate = 1\n[strange]\n'
    first, errors = parse(text, "/")
    second, again = parse(text, "/")
    assert first == second and errors == again and errors is not again and len(errors) > 1


def test_all_errors_at_once_in_the_order_of_the_sections() -> None:
    found = errors(
        '[workcel]\n[workcell]\nnam = "x"\n[device.a]\n[device.b]\ndriver = 3\n[node.n]\n[[grant]]\nrights = []\nuser '
        '= ["x"]\n'
    )
    assert [line.split(":")[0].split(";")[0] for line in found] == [
        "[workcel]", "[workcell]", "[device.a]", "[device.b].driver", "[node.n]", "[[grant]] number 1",
    ]  # fmt: skip
    assert "did you mean workcell?" in found[0] and "did you mean name?" in found[1]
    assert "key driver is missing" in found[2] and "did you mean users?" in found[5]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[device.x]\ndriver = 'd'\non_loss = 'halt'", "on_loss"),
        ("[device.x]\ndriver = 'd'\nrealtime_priority = 100", "realtime_priority"),
        ("[device.x]\ndriver = 'd'\nhang_s = 0", "hang_s"),
        ("[device.x]\ndriver = 'd'\nlease_s = 0", "lease_s"),
        ("[device.readonly]\ndriver = 'd'", "not a device name"),
        ("[device.'ä']\ndriver = 'd'", "not a device name"),
        ("[device.'a.b']\ndriver = 'd'", "not a device name"),
        ("[device.a]\ndriver = 'd'\n[node.a]\nof = 'b'", "a device already has this name"),
        ("[node.'a..b']\nof = 'c'", "not a node name"),
        ("[device]\nx = 1", "want a table [device.x]"),
        ("[[device]]\nx = 1", "want tables [device.NAME]"),
        ("[grant]\nrights = ['read']", "want tables [[grant]]"),
        ("grant = 3", "want tables [[grant]]"),
        ("[[grant]]\nrights = ['reed']", "'reed': want one of 'read', 'write', 'stop', 'administer'"),
        ("[device.x]\ndriver = 'd'\non_loss = 'cry'", ".on_loss = 'cry': want one of 'none', 'stop'"),
        ("emergency_stop = 'x'", "want tables [[emergency_stop]]"),
        ("device = 3", "want tables [device.NAME]"),
        ("[workcell]\nmax_sessions = 0", "max_sessions"),
        ("[workcell]\ndaemon_lease_s = -1", "daemon_lease_s"),
        ("[device.x]\ndriver = 'd'\nhang_s = inf", "hang_s"),
        ("[workcell]\ndaemon_lease_s = nan", "daemon_lease_s"),
        ("[workcell]\nsocket_mode = '777 '", "socket_mode"),
        ("[workcell]\nsocket_mode = 432", "socket_mode"),
        ("[quota]\nmarkers = 1024", "[quota]"),
        ("[quota]\nsilent = 0", "silent"),
        ("[[emergency_stop]]\nnode = 'x'\nactive = 2", "active"),
        ("x = [", "line 1: x = [: want ]"),
        ("", "want at least one"),
        ("family = 'x'\n[signals]\na = { address = 1 }", "this is a register map, not a configuration"),
    ],
)
def test_errors(text: str, words: str) -> None:
    assert any(words in line for line in errors(text)), errors(text)


def test_values_at_their_ends_are_taken() -> None:
    text = (
        "[quota]\nmarkers = 1023\n[workcell]\nmax_sessions = 1\nsocket_mode = '660'\n[device.a-b_1]\ndriver = "
        "'d'\nrealtime_priority = 0\n"
    )
    assert errors(text) == []


@pytest.mark.parametrize(
    "value", ["1979-05-27", "[1, 07:32:00]", f"{2**64}", "{a = [1979-05-27]}", "[" * 30 + "]" * 30]
)
def test_values_that_no_driver_can_be_told_are_errors_beside_the_others(value: str) -> None:
    text = f'[device.a]\ndriver = "sim-io"\nodd = {value}\n[device.b]\ndriver = 3\n'
    _, errors = parse(text, "/")
    assert [e for e in errors if e.startswith("[device.a].odd")], errors
    assert [e for e in errors if e.startswith("[device.b]")], errors


@pytest.mark.parametrize("value", ["[" * 3000 + "]" * 3000, "9" * 5000])
def test_what_cannot_be_read_is_one_error(value: str) -> None:
    config, errors = parse(f"x = {value}\n", "/")
    assert config is None and len(errors) == 1 and errors[0].startswith("read configuration: ")
