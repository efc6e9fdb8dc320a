"""The Modbus axis driver against the simulated drives' register models: motions, stops, limits, configurations."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from modbus_rig import RIGS, Rig, az_rig, leadshine_rig

from sioms.drivers.modbus.axis import MAPS, ModbusAxis
from sioms.drivers.modbus.regmap_files import named_map
from sioms.drivers.modbus.simulated import oriental_az
from sioms.motion import CommandError
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.sdk.exchange import DeviceError


@RIGS
def test_a_move_takes_its_time_and_arrives(make: Callable[..., Rig]) -> None:
    rig = make()
    rig.write(ControlMode.POSITION, position=0.1)
    # trapezoid: 0.1/0.1 + 0.1/1.0 = 1.1 s
    assert rig.until_idle() == pytest.approx(1.1, abs=0.1)
    assert rig.position == pytest.approx(0.1, abs=1e-5)
    rig.write(ControlMode.POSITION | ControlMode.RELATIVE, position=-0.02)
    rig.until_idle()
    assert rig.position == pytest.approx(0.08, abs=1e-5)
    assert not rig.status & (AxisStatus.MOVING | AxisStatus.FAULT)


@RIGS
@pytest.mark.parametrize("duration_s", [0.5, 1.0, 4.1])
def test_a_move_of_given_time_is_there_in_time(make: Callable[..., Rig], duration_s: float) -> None:
    rig = make()
    rig.write(ControlMode.POSITION | ControlMode.SPECIFIED_TIME, position=-0.04, time=duration_s)
    took_s = rig.until_idle()
    assert took_s == pytest.approx(duration_s, abs=0.06)
    assert rig.position == pytest.approx(-0.04, abs=1e-5)


@RIGS
def test_limits_of_a_command_reach_the_drive(make: Callable[..., Rig]) -> None:
    rig = make()
    mode = ControlMode.POSITION | ControlMode.SPECIFIED_MAX_VEL_ACC
    rig.write(mode, position=0.1, max_velocity=0.02, max_acceleration=0.2)
    rig.go(1.0)
    assert rig.bank.rows["velocity"][0] == pytest.approx(0.02, rel=0.02)
    assert rig.until_idle() == pytest.approx(0.1 / 0.02 + 0.02 / 0.2 - 1.0, rel=0.05)


@RIGS
def test_velocity_goes_on_while_polled_and_ends_without(make: Callable[..., Rig]) -> None:
    rig = make()
    for velocity in (-0.05, 0.02):
        rig.write(ControlMode.VELOCITY, velocity=velocity)
        rig.go(1.5)
        assert rig.bank.rows["velocity"][0] == pytest.approx(velocity, rel=0.02)
    rig.bus.now_s += 1.0
    # nobody polled: the drive's own dead-man has ended the motion
    assert rig.drive.state()["velocity"] == 0


@RIGS
def test_stop_and_emergency_stop(make: Callable[..., Rig]) -> None:
    rig = make()
    for verb, latch in (("stop", False), ("emergency_stop", True)):
        rig.write(ControlMode.VELOCITY, velocity=0.1)
        rig.go(0.5)
        assert rig.drive.state()["velocity"] > 0
        getattr(rig.bank, verb)([0], rig.bus.clock_ns())
        for action in rig.bank.take_actions():
            rig.act(action)
        rig.until_idle(1.0)
        assert rig.drive.state()["velocity"] == 0
        assert bool(rig.status & AxisStatus.EMERGENCY_STOP) is latch
    with pytest.raises(CommandError, match="emergency stop"):
        rig.write(ControlMode.VELOCITY, velocity=0.1)
    rig.bank.reset([0])
    rig.go(0.1)
    rig.write(ControlMode.POSITION, position=0.0)
    rig.until_idle()
    assert rig.position == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("deaf", [False, True])
@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
def test_a_slow_ramp_of_a_command_does_not_prolong_a_stop(verb: str, deaf: bool) -> None:
    """An AZ drive brakes for STOP with the ramp of the operation that runs; and is stopped if it takes no other."""
    rig = az_rig()
    rig.write(ControlMode.VELOCITY, velocity=0.1)
    rig.go(0.5)
    slow = ControlMode.VELOCITY | ControlMode.SPECIFIED_MAX_VEL_ACC
    rig.write(slow, velocity=0.09, max_velocity=0.1, max_acceleration=0.05)
    rig.go(0.3)
    assert rig.drive.state()["velocity"] > 0
    if deaf:
        rig.drive.operate = lambda: None
    getattr(rig.bank, verb)([0], rig.bus.clock_ns())
    for action in rig.bank.take_actions():
        rig.act(action)
    took_s = rig.until_idle(5.0)
    assert rig.drive.state()["velocity"] == 0
    assert took_s > 1.0 if deaf else took_s < 0.3


@RIGS
@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
def test_a_stop_voids_a_start_that_still_waits_for_the_line(make: Callable[..., Rig], verb: str) -> None:
    """The kit lets a stop overtake; what was asked before must not move the axis after it."""
    rig = make()
    rig.write(ControlMode.VELOCITY, velocity=0.1)
    rig.bus.run(rig.unit.poll())
    waiting = [rig.unit.act(action) for action in rig.bank.take_actions()]
    assert len(waiting) == 1
    getattr(rig.bank, verb)([0], rig.bus.clock_ns())
    for action in rig.bank.take_actions():
        rig.act(action)
    sent = len(rig.bus.sent)
    rig.bus.run(waiting[0])
    assert len(rig.bus.sent) == sent
    rig.go(0.3)
    assert rig.drive.state()["velocity"] == 0


def test_a_stop_between_the_messages_of_a_jog(make: Callable[..., Rig] = leadshine_rig) -> None:
    rig = make()
    rig.write(ControlMode.VELOCITY, velocity=0.05)
    rig.bus.run(rig.unit.poll())
    (action,) = rig.bank.take_actions()
    jog = rig.unit.act(action)
    first = jog.send(None)
    assert first.data[2:4] == bytes.fromhex("01e1")
    rig.bus.run(rig.unit.stop())
    with pytest.raises(StopIteration):
        jog.send(None)
    rig.go(0.2)
    assert rig.drive.state()["velocity"] == 0


def test_a_stop_between_the_messages_of_a_move_by_a_map_of_ones_own() -> None:
    """A drive whose target, speed and start are registers of their own: what is told in three messages is stopped in
    between.
    """
    whole = named_map("leadshine", MAPS).commands["position"].writes[0]
    parts = [
        {
            "address": 0x6200 + at,
            "items": [{k: v for k, v in msgspec.to_builtins(whole.items[i]).items() if v is not None}],
        }
        for at, i in ((0, 0), (1, 1), (3, 2), (4, 3), (5, 4))
    ]
    start = {"address": 0x6002, "function": "single", "items": [{"value": 0x10}]}
    override = {"commands": {"position": {"writes": [*parts, start]}}}
    rig = leadshine_rig(override=override)
    rig.write(ControlMode.POSITION, position=0.1)
    rig.until_idle()
    assert rig.position == pytest.approx(0.1, abs=1e-5), "it moves so"
    for told in range(1, 7):
        rig.write(ControlMode.POSITION, position=0.0)
        rig.bus.run(rig.unit.poll())
        (action,) = rig.bank.take_actions()
        move, reply = rig.unit.act(action), None
        for _ in range(told):
            exchange = move.send(reply)
            reply = exchange.decode(rig.bus.answer(exchange.data))
        rig.bus.run(rig.unit.stop())
        with pytest.raises(StopIteration):
            move.send(reply)
        rig.bank.action_failed(action, "stopped", rig.bus.clock_ns())
        rig.go(0.3)
        assert rig.drive.state()["velocity"] == 0, told
        rig.bank.reset([0])
        rig.go(0.1)
        assert rig.position == pytest.approx(0.1, abs=1e-3 if told == 6 else 1e-5), told


@RIGS
@pytest.mark.parametrize("by", ["stop", "emergency_stop", "new driver"])
def test_stops_of_a_drive_that_brakes_already(make: Callable[..., Rig], by: str) -> None:
    """Stopped from 0.1 m/s at 0.25 m/s^2, and again each 40 ms: it brakes no longer, and never turns back."""
    rig = make()
    mode = ControlMode.POSITION | ControlMode.SPECIFIED_MAX_VEL_ACC
    rig.write(mode, position=0.4, max_velocity=0.1, max_acceleration=0.25)
    rig.go(1.0)
    assert rig.bank.rows["velocity"][0] == pytest.approx(0.1, rel=0.02)
    place, began_s = rig.position, rig.bus.now_s
    rig.bank.stop([0], rig.bus.clock_ns())
    places = [place]
    while rig.drive.state()["velocity"] != 0:
        assert rig.bus.now_s < began_s + 1.0
        if by == "new driver":
            rig.bus.run(rig.unit.open())
        else:
            getattr(rig.bank, by)([0], rig.bus.clock_ns())
        rig.go(0.04)
        places.append(rig.position)
    rig.go(0.3)
    places.append(rig.position)
    assert (np.diff(places) >= -1e-9).all()
    assert 0 < places[-1] - place < 0.1**2 / (2 * 0.25) + 0.1 * 0.1, "the braking distance and 100 ms"
    assert rig.bank.is_idle([0])


def test_a_stop_that_overtakes_a_reset_does_not_make_it_void() -> None:
    rig = leadshine_rig()
    rig.drive.raise_alarm(0x40)
    rig.go(0.1)
    rig.bank.reset([0])
    (reset,) = [action for action in rig.bank.take_actions() if not action.is_stop]
    waiting = rig.unit.act(reset)
    rig.bus.run(rig.unit.stop())
    rig.bus.run(waiting)
    assert bytes.fromhex("18011111") in b"".join(data[2:6] for data in rig.bus.sent)
    rig.bank.action_done(reset, rig.bus.clock_ns())
    rig.go(0.2)
    assert rig.drive.state()["alarm"] == 0 and rig.bank.is_idle([0])


@RIGS
def test_homing(make: Callable[..., Rig]) -> None:
    rig = make()
    rig.write(ControlMode.POSITION, position=0.03)
    rig.until_idle()
    rig.bank.home([0], rig.bus.clock_ns())
    rig.until_idle()
    assert rig.status & AxisStatus.HOMED and not rig.status & AxisStatus.HOMING
    assert rig.position == 0


@pytest.mark.parametrize("late_s", [0.0, 0.02, 0.06])
def test_a_homing_that_the_drive_begins_late_is_not_the_one_before(late_s: float) -> None:
    """Until it begins it tells of the homing before: at rest, and homed."""
    rig = leadshine_rig()
    rig.bank.home([0], rig.bus.clock_ns())
    rig.until_idle()
    rig.go(0.3)
    rig.drive.mover.origin += 20000.0  # the machine's zero is elsewhere now: a strap has slipped
    write, read = rig.drive.write, rig.drive.read
    taken: list[tuple[float, Any]] = []

    def late_read(*what: Any) -> Any:
        while taken and rig.bus.now_s >= taken[0][0]:
            write(*taken.pop(0)[1])
        return read(*what)

    rig.drive.read = late_read
    rig.drive.write = lambda *what: taken.append((rig.bus.now_s + late_s, what))
    rig.bank.home([0], rig.bus.clock_ns())
    rig.poll()
    rig.go(late_s + 0.1)
    assert rig.drive.state()["velocity"] != 0 and rig.status & AxisStatus.HOMING
    rig.until_idle()
    assert rig.status & AxisStatus.HOMED and not rig.bank.fault_text(0)
    assert rig.position == 0 and rig.drive.state()["place"] == pytest.approx(0.0, abs=1.0)


@RIGS
def test_a_homing_that_another_master_ends_is_no_home(make: Callable[..., Rig]) -> None:
    """The drive stands, without an alarm, and has no reference; one family tells of that by its position only."""
    rig = make()
    rig.write(ControlMode.POSITION, position=0.15)
    rig.until_idle()
    for _ in range(2):  # the second time from a reference that it had
        rig.bank.home([0], rig.bus.clock_ns())
        rig.go(0.3)
        assert rig.drive.state()["velocity"] != 0
        if make is leadshine_rig:
            rig.drive.trigger(0x40)
        else:
            rig.drive.write(16, 0x7C, [0, oriental_az.STOP])
            rig.drive.write(16, 0x7C, [0, 0])
        rig.go(1.0)
        assert rig.status & AxisStatus.HOMING, "it may go on"
        rig.go(3.0)
        assert rig.status & AxisStatus.POSITION_LOST and not rig.status & (AxisStatus.HOMED | AxisStatus.HOMING)
        assert "the homing was broken off" in rig.bank.fault_text(0)
        rig.bank.reset([0])
        rig.go(0.3)
    rig.bank.home([0], rig.bus.clock_ns())
    rig.until_idle()
    assert rig.status & AxisStatus.HOMED and not rig.status & AxisStatus.POSITION_LOST


@RIGS
def test_an_alarm_in_motion_is_told_by_name_and_reset(make: Callable[..., Rig]) -> None:
    rig = make()
    rig.write(ControlMode.POSITION, position=0.4)
    rig.go(0.5)
    rig.drive.raise_alarm(0x40 if make is leadshine_rig else 0x30)
    rig.until_idle(2.0)
    assert rig.status & AxisStatus.FAULT
    assert ("current sensing" if make is leadshine_rig else "overload") in rig.bank.fault_text(0)
    rig.bank.reset([0])
    rig.go(0.2)
    assert not rig.status & AxisStatus.FAULT and rig.drive.state()["alarm"] == 0
    rig.write(ControlMode.POSITION, position=0.0)
    rig.until_idle()
    assert rig.position == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("leaves_code", [False, True])
def test_an_alarm_that_ends_between_two_answers_is_none(monkeypatch: pytest.MonkeyPatch, *, leaves_code: bool) -> None:
    """The status is read first, then the code of the alarm that it tells of."""
    rig = leadshine_rig()
    drive, read = rig.drive, rig.drive.read

    def ends(function: int, address: int, count: int) -> Any:
        if address <= 0x2203 < address + count and not leaves_code:
            drive.alarm = 0
        return read(function, address, count)

    monkeypatch.setattr(drive, "read", ends)
    drive.raise_alarm(0x40)
    rig.go(0.5)
    assert bool(rig.status & AxisStatus.FAULT) is leaves_code


def test_an_alarm_that_only_a_power_cycle_clears_is_not_reset() -> None:
    rig = az_rig()
    rig.drive.raise_alarm(0x41)
    rig.go(0.1)
    rig.bank.reset([0])
    rig.go(0.2)
    assert rig.status & AxisStatus.FAULT
    assert "only a power cycle clears it" in rig.bank.fault_text(0)


def test_over_travel_faults_the_az() -> None:
    rig = az_rig()
    rig.drive.mover.high = 2000
    rig.write(ControlMode.POSITION, position=0.1)
    rig.until_idle()
    assert "hardware over-travel" in rig.bank.fault_text(0)
    assert rig.position == pytest.approx(0.02)


@RIGS
@pytest.mark.parametrize("way", [1, -1])
def test_a_velocity_ends_before_the_soft_limit(make: Callable[..., Rig], way: int) -> None:
    rig = make()
    rig.write(ControlMode.POSITION, position=0.45 * way)
    rig.until_idle()
    for speed in (0.1, 0.02):
        rig.write(ControlMode.VELOCITY, velocity=speed * way)
        rig.until_idle(10.0)
        assert 0.45 < abs(rig.position) <= 0.5
        assert rig.status & (AxisStatus.LIMIT_PLUS if way > 0 else AxisStatus.LIMIT_MINUS)
        assert rig.drive.state()["velocity"] == 0
    rig.write(ControlMode.VELOCITY, velocity=-0.05 * way)
    rig.go(0.5)
    assert rig.drive.state()["velocity"] * way < 0, "away from the limit it may run"


def test_a_disabled_drive_is_told() -> None:
    rig = leadshine_rig()
    rig.drive.write(6, 0x000F, [0])
    rig.go(0.1)
    assert rig.bank.fault_text(0) == "the drive is switched off"


def test_a_reversed_axis() -> None:
    rig = leadshine_rig(travel_per_turn=-0.01)
    rig.write(ControlMode.POSITION, position=0.02)
    rig.until_idle()
    assert rig.drive.state()["position"] == -20000 and rig.position == pytest.approx(0.02)
    rig.write(ControlMode.VELOCITY, velocity=0.05)
    rig.go(0.5)
    assert rig.drive.state()["velocity"] < 0 < rig.bank.rows["velocity"][0]


def test_a_drive_with_another_gearing_is_refused() -> None:
    with pytest.raises(DeviceError, match="pulses_per_turn is 10000; the configuration says") as caught:
        leadshine_rig(pulses_per_turn=1600.0)
    assert caught.value.errno == errno.ENODEV


def test_the_drive_cannot_pass_a_position() -> None:
    rig = leadshine_rig()
    try:
        rig.write(ControlMode.POSITION | ControlMode.VELOCITY, position=0.1, velocity=0.01)
    except CommandError:
        return
    rig.go(0.2)
    assert "cannot pass a position" in rig.bank.fault_text(0)
    assert rig.drive.state()["position"] == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"map": "leadshin"}, "no shipped map has this name; did you mean leadshine"),
        ({"map": "/nowhere/leadshine.toml"}, "read register map /nowhere/leadshine.toml: no such file"),
        ({"map": "moxa_e1200"}, "describes no axis"),
        ({"line": {"udp": "h:1"}}, "Modbus runs on serial and tcp"),
        (
            {"poll_hz": 20.0},
            "poll_hz = 20: a round takes 50 ms and the drive stops after 50 ms; want at least 26.7",
        ),
        (
            {"line": {"serial": "/x", "baud": 9600}},
            "1 drives on the line: a round takes .* want a faster line",
        ),
        ({"axis": []}, "axis: none given"),
        ({"axis": [{"name": "a"}, {"name": "b"}]}, "2 axes have address = 1"),
        (
            {"axis": [{"name": "a", "velocity_max": 1e3}]},
            "axis a: velocity_max: speed 1000 is .* in the register",
        ),
        ({"axis": [{"name": "a", "position_max": 1e7}]}, "axis a: position_max: position 1e.07"),
        ({"axis": [{"name": "a", "address": 300}]}, "address of a unit is 300"),
        ({"axis": [{"name": "a", "travel_per_turn": 0.0}]}, "axis a: travel_per_turn is 0"),
        (
            {"axis": [{"name": "a", "override": {"signals": {"status": {"addres": 1}}}}]},
            "signals.status.addres: unknown key; did you mean address",
        ),
    ],
)
def test_bad_configurations(change: dict[str, Any], words: str) -> None:
    table = {"map": "leadshine", "line": {"serial": "/x"}, "axis": [{"name": "a"}], **change}
    with pytest.raises(ValueError, match=words):
        ModbusAxis.describe("mod0", msgspec.convert(table, ModbusAxis.Settings))


def test_several_drives_are_several_blocks() -> None:
    axes = [{"name": "x", "address": 1}, {"name": "y", "address": 2, "velocity_by": "path"}]
    table = {"map": "leadshine", "line": {"serial": "/x"}, "axis": axes}
    description = ModbusAxis.describe("mod0", msgspec.convert(table, ModbusAxis.Settings))
    assert [(block.name, block.channels[0].name) for block in description.blocks] == [("x", "x"), ("y", "y")]
