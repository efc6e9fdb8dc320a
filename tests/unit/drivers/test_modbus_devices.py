"""Modbus drivers against the simulated devices' register models, on an invented clock: no line, no sleeping."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from steps_rig import carry_out

from sioms.drivers.modbus.axis import MAPS, ModbusAxis
from sioms.drivers.modbus.io import ModbusIo
from sioms.drivers.modbus.regmap import named_map
from sioms.drivers.modbus.simulated import leadshine, moxa, oriental_az
from sioms.motion import CommandError, DriveAction
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.records import NodeClass, numpy_dtype
from sioms.sdk.codec.modbus import frame_rtu, frame_tcp
from sioms.sdk.exchange import DeviceError, Exchange, LinkError, Pause, StateLost, Step, Steps
from sioms.sdk.markers import Markers

EXCHANGE_S = 0.003


class Kit:
    """What a line driver needs of the kit."""

    def __init__(self) -> None:
        self.markers = Markers(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda number: None)
        self.said: list[str] = []

    def log(self, level: str, text: str) -> None:
        """Take what the driver says."""
        self.said.append(text)


class Bus:
    """A line whose drives are register models; each exchange takes 3 ms of the invented time."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.drives: dict[int, Any] = {}
        self.sent: list[bytes] = []
        self.broken: Callable[[Exchange], bytes | None] = lambda exchange: None

    def clock_ns(self) -> int:
        return round(self.now_s * 1e9)

    def answer(self, request: bytes) -> bytes:
        drive, function, address = self.drives[request[0]], request[1], int.from_bytes(request[2:4], "big")
        if function == 3:
            words = drive.read(3, address, int.from_bytes(request[4:6], "big"))
            if not isinstance(words, list):
                return frame_rtu(request[0], bytes((0x83, int(words))))
            return frame_rtu(request[0], bytes((3, 2 * len(words))) + np.array(words, ">u2").tobytes())
        values = [int.from_bytes(request[4:6], "big")]
        if function == 16:
            values = np.frombuffer(request[7:-2], ">u2").tolist()
        refused = drive.write(function, address, values)
        if refused:
            return frame_rtu(request[0], bytes((function | 0x80, int(refused))))
        return request if function == 6 else frame_rtu(request[0], request[1:6])

    def run(self, steps: Steps) -> Any:
        """Run a hook to its end."""
        return carry_out(steps, self._carry)

    def _carry(self, step: Step) -> Any:
        if isinstance(step, Pause):
            self.now_s += step.duration_s
            return None
        assert isinstance(step, Exchange)
        self.now_s += EXCHANGE_S
        self.sent.append(step.data)
        reply = self.broken(step) or self.answer(step.data)
        assert step.want(reply) == len(reply)
        return step.decode(reply)


class Rig:
    """A driver of one drive, polled at 50 Hz as the kit does."""

    def __init__(self, family: str, model: Any, table: dict[str, Any]) -> None:
        self.bus = Bus()
        self.drive = model(lambda: self.bus.now_s)
        self.bus.drives[1] = self.drive
        device = {"map": family, "line": {"serial": "/dev/null"}, "axis": [{"name": "x", **table}]}
        kit = Kit()
        self.said = kit.said
        self.driver = ModbusAxis("mod0", msgspec.convert(device, ModbusAxis.Settings), kit)  # type: ignore[arg-type]
        self.unit: Any = self.driver.units[0]
        self.unit._clock = self.bus.clock_ns
        self.bank = self.unit.bank
        self.bus.run(self.unit.open())
        self.poll()

    def poll(self) -> None:
        self.bus.run(self.unit.poll())
        for action in self.bank.take_actions():
            self.act(action)

    def act(self, action: DriveAction) -> None:
        now_ns = self.bus.clock_ns()
        try:
            self.bus.run(self.unit.act(action))
        except (DeviceError, LinkError) as error:
            self.bank.action_failed(action, str(error), now_ns)
        else:
            self.bank.action_done(action, self.bus.clock_ns())

    def go(self, duration_s: float) -> None:
        end_s = self.bus.now_s + duration_s
        while self.bus.now_s < end_s:
            start_s = self.bus.now_s
            self.poll()
            self.bus.now_s = max(self.bus.now_s, start_s + 0.02)

    def until_idle(self, limit_s: float = 30.0) -> float:
        """Poll until the axis is idle; returns how long that took."""
        start_s = self.bus.now_s
        while not self.bank.is_idle([0]):
            self.go(0.02)
            assert self.bus.now_s < start_s + limit_s, "never idle"
        return self.bus.now_s - start_s

    def write(self, mode: ControlMode, **fields: float) -> None:
        records = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        records["control_mode"] = int(mode)
        for name, value in fields.items():
            records[name] = value
        self.bank.append(records, [0], self.bus.clock_ns())

    @property
    def position(self) -> float:
        return float(self.bank.rows["position"][0])

    @property
    def status(self) -> AxisStatus:
        return AxisStatus(int(self.bank.rows["status"][0]))


LIMITS = {"position_min": -0.5, "position_max": 0.5, "velocity_max": 0.1, "acceleration_max": 1.0}


def leadshine_rig(**more: Any) -> Rig:
    return Rig("leadshine", leadshine.Drive, LIMITS | {"travel_per_turn": 0.01, "homing": True} | more)


def az_rig(**more: Any) -> Rig:
    table = LIMITS | {"travel_per_turn": 0.01, "pulses_per_turn": 1000.0, "homing": True}
    return Rig("oriental_az", lambda clock: oriental_az.Drive(clock, 0.2), table | more)


RIGS = pytest.mark.parametrize("make", [leadshine_rig, az_rig])


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


def power_cycle(rig: Rig, off_s: float = 0.05) -> None:
    rig.drive.power_off()
    rig.bus.now_s += off_s
    rig.drive.power_on()


def lost_and_reopened(rig: Rig, words: str) -> None:
    """Poll until the unit is lost for what it has forgotten; open it again, as the kit does."""
    with pytest.raises(StateLost, match=words) as caught:
        rig.go(0.4)
    rig.bank.fault([0], str(caught.value), rig.bus.clock_ns())
    rig.bus.run(rig.unit.open())
    rig.go(0.1)


def test_a_drive_that_was_off_has_lost_its_place_and_a_reset_does_not_find_it() -> None:
    """Off for 50 ms, between two polls: position 0 there is 0.08 m here."""
    rig = leadshine_rig()
    rig.write(ControlMode.POSITION, position=0.08)
    rig.until_idle()
    power_cycle(rig)
    lost_and_reopened(rig, "was switched off or restarted: path15_pause is 0")
    assert rig.status & AxisStatus.POSITION_LOST and rig.status & AxisStatus.FAULT
    rig.bank.reset([0])
    rig.go(0.2)
    assert not rig.status & AxisStatus.FAULT
    with pytest.raises(CommandError, match="position lost"):
        rig.write(ControlMode.POSITION, position=0.09)
    rig.go(0.2)
    assert rig.drive.state()["place"] == 80000
    rig.bank.home([0], rig.bus.clock_ns())
    rig.until_idle()
    assert rig.drive.state()["place"] == 0 and not rig.status & AxisStatus.POSITION_LOST
    rig.write(ControlMode.POSITION, position=0.02)
    rig.until_idle()
    assert rig.drive.state()["place"] == 20000


def test_a_jump_is_looked_at_at_once_and_is_one_fault() -> None:
    """The watch sees the jump before the token is due: the token is read in the next poll, not after a RESET."""
    rig = leadshine_rig()
    rig.write(ControlMode.POSITION, position=0.08)
    rig.until_idle()
    rig.bus.sent.clear()
    while not any(data[2:4] == bytes.fromhex("627e") for data in rig.bus.sent):
        rig.poll()  # until one that has just read the token
        rig.bus.now_s += 0.02
    power_cycle(rig, 0.01)
    began_s = rig.bus.now_s
    with pytest.raises(StateLost, match="was switched off or restarted"):
        while rig.bus.now_s < began_s + 0.15:
            rig.poll()
            rig.bus.now_s += 0.01


def test_a_drive_that_was_off_while_its_link_was_lost_has_lost_its_place_too() -> None:
    rig = leadshine_rig()
    rig.write(ControlMode.POSITION, position=0.05)
    rig.until_idle()
    rig.bus.run(rig.unit.open())  # the cable alone: nothing is lost
    rig.go(0.1)
    assert not rig.status & AxisStatus.POSITION_LOST
    power_cycle(rig, 4.0)
    rig.bus.run(rig.unit.open())
    rig.go(0.1)
    assert rig.status & AxisStatus.POSITION_LOST
    assert "it was switched off, and counts from another zero" in rig.bank.fault_text(0)


def test_a_drive_that_homes_by_itself_when_switched_on_is_stopped() -> None:
    rig = leadshine_rig()
    rig.drive.write(6, leadshine.PR_CONTROL, [leadshine.HOME_AT_POWER_ON])
    rig.drive.write(6, 0x1801, [0x2211])  # to its non-volatile memory, with the token
    rig.write(ControlMode.POSITION, position=0.2)
    rig.until_idle()
    power_cycle(rig)
    rig.bus.now_s += 0.3
    assert rig.drive.state()["velocity"] < 0, "it runs home, and nobody told it to"
    rig.bus.run(rig.unit.open())
    rig.go(0.2)
    assert rig.drive.state()["velocity"] == 0


def test_a_drive_with_an_absolute_encoder_keeps_its_place() -> None:
    rig = az_rig()
    rig.write(ControlMode.POSITION, position=0.08)
    rig.until_idle()
    power_cycle(rig)
    lost_and_reopened(rig, "was switched off or restarted: operation_255_delay is 0")
    assert rig.status & AxisStatus.FAULT and not rig.status & AxisStatus.POSITION_LOST
    rig.bank.reset([0])
    rig.go(0.1)
    rig.write(ControlMode.POSITION, position=0.09)
    rig.until_idle()
    assert rig.drive.state()["place"] == 9000


@pytest.mark.parametrize("code", [0x33, 0x4A])
def test_an_alarm_of_the_encoder_says_that_the_place_is_lost(code: int) -> None:
    rig = az_rig()
    rig.write(ControlMode.POSITION, position=0.08)
    rig.until_idle()
    rig.drive.raise_alarm(code)
    rig.go(0.1)
    assert rig.status & AxisStatus.POSITION_LOST
    rig.drive.alarm = 0
    rig.bank.reset([0])
    rig.go(0.2)
    assert rig.status & AxisStatus.POSITION_LOST
    rig.bank.calibrate([0], [0.08])
    rig.write(ControlMode.POSITION, position=0.07)
    rig.until_idle()
    assert not rig.status & AxisStatus.POSITION_LOST


@RIGS
def test_what_another_master_left_running_ends_before_anything_is_switched_on(
    make: Callable[..., Rig],
) -> None:
    rig = make()
    rig.drive.foreign("velocity", 3000.0)
    rig.bus.now_s += 1.0
    sent = len(rig.bus.sent)
    rig.bus.run(rig.unit.open())
    assert rig.drive.state()["velocity"] == 0
    place = rig.drive.state()["place"]
    enable = bytes.fromhex("01 06 00 0f" if make is leadshine_rig else "01 10 00 7c")
    assert any(data.startswith(enable) for data in rig.bus.sent[sent:])
    rig.go(0.5)
    assert rig.drive.state()["place"] == place
    rig.bank.reset([0])
    rig.bank.calibrate([0], [0.1])
    rig.go(0.2)
    rig.write(ControlMode.POSITION, position=0.1)
    rig.until_idle()
    assert abs(rig.drive.state()["place"] - place) <= 5


@RIGS
def test_a_drive_that_does_not_come_to_rest_is_not_opened(make: Callable[..., Rig]) -> None:
    rig = make()

    def insists(exchange: Exchange) -> None:
        rig.drive.foreign("velocity", 3000.0)

    rig.bus.broken = insists
    with pytest.raises(DeviceError, match="still moves 5 s after it was told to stop; look for another master"):
        rig.bus.run(rig.unit.open())


@RIGS
@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
def test_a_stop_that_the_drive_is_too_busy_for_is_sent_until_it_rests(make: Callable[..., Rig], verb: str) -> None:
    rig = make(velocity_by="path") if make is leadshine_rig else make()
    rig.write(ControlMode.VELOCITY, velocity=0.1)
    rig.go(0.5)
    busy = 10

    def refuses(exchange: Exchange) -> bytes | None:
        nonlocal busy
        if exchange.data[1] == 3 or not busy:
            return None
        busy -= 1
        return frame_rtu(1, bytes((exchange.data[1] | 0x80, 6)))

    rig.bus.broken = refuses
    getattr(rig.bank, verb)([0], rig.bus.clock_ns())
    began_s = rig.bus.now_s
    while rig.drive.state()["velocity"]:
        rig.go(0.02)
        assert rig.bus.now_s - began_s < 2.0, "it runs on"
    assert busy == 0


@pytest.mark.parametrize("code", [5, 6])
def test_a_drive_that_is_busy_or_still_at_work_is_no_fault(code: int) -> None:
    """Exception 6: not done, ask again; exception 5: taken, and still worked at."""
    rig = leadshine_rig()
    left = 1

    def once(exchange: Exchange) -> bytes | None:
        nonlocal left
        if exchange.data[1] == 3 or not left:
            return None
        left -= 1
        if code == 5:
            rig.bus.answer(exchange.data)
        return frame_rtu(1, bytes((exchange.data[1] | 0x80, code)))

    rig.bus.broken = once
    rig.write(ControlMode.POSITION, position=0.05)
    rig.until_idle()
    assert rig.position == pytest.approx(0.05, abs=1e-5) and not rig.status & AxisStatus.FAULT


def test_the_alarm_of_an_earlier_silence_is_reset_by_the_opening_and_no_other() -> None:
    rig = az_rig()
    for code, left in ((0x85, 0), (0x30, 0x30)):
        rig.drive.raise_alarm(code)
        rig.bus.run(rig.unit.open())
        assert rig.drive.state()["alarm"] == left


def test_silence_at_rest_is_an_alarm_too() -> None:
    rig = az_rig()
    rig.bus.now_s += 0.3
    rig.go(0.1)
    assert "RS-485 communication time-out" in rig.bank.fault_text(0)


def test_a_drive_that_keeps_no_token_is_taken_and_that_is_told() -> None:
    """A register that the drive does not have, or that does not keep what is written, proves nothing."""
    rig = leadshine_rig()
    write = rig.drive.write
    rig.drive.write = lambda f, at, values: None if at == 0x627E else write(f, at, values)
    rig.bus.run(rig.unit.open())
    rig.go(1.0)
    assert not rig.status & AxisStatus.POSITION_LOST
    assert rig.said == ["x (address 1): path15_pause does not keep what is written, so it proves nothing"]


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


class TestIo:
    def make(self, **table: Any) -> tuple[Any, moxa.Block]:
        settings = {"map": "moxa_e1200", "line": {"tcp": "h:502"}, "model": "E1212", **table}
        driver = ModbusIo("io0", msgspec.convert(settings, ModbusIo.Settings), Kit())
        return driver.units[0], moxa.Block(settings["model"])

    def run(self, block: moxa.Block, steps: Steps) -> None:
        value = None
        with pytest.raises(StopIteration):
            while True:
                exchange = steps.send(value)
                value = exchange.decode(self.answer(block, exchange.data))

    def answer(self, block: moxa.Block, request: bytes) -> bytes:
        function, address = request[7], int.from_bytes(request[8:10], "big")
        count = int.from_bytes(request[10:12], "big")
        if function == 4:
            words = block.read_input(address, count)
            body = bytes((4, 2 * count)) + np.array(words, ">u2").tobytes()
        elif function == 15:
            bits = int.from_bytes(request[13:], "little")
            assert block.write_bits(address, [bits >> i & 1 for i in range(count)]) is None
            body = request[7:12]
        else:
            bits = sum(bit << i for i, bit in enumerate(block.read_bits(function, address, count)))
            size = (count + 7) // 8
            body = bytes((function, size)) + bits.to_bytes(size, "little")
        return frame_tcp(int.from_bytes(request[:2], "big"), 1, body)

    def test_ports(self) -> None:
        unit, block = self.make(safe={"do": 3})
        inputs, outputs = unit.blocks
        assert (inputs.spec.name, outputs.spec.name) == ("", "do")
        assert outputs.spec.safe == (3,) and not inputs.spec.writable
        self.run(block, unit.open())
        block.set_input(4, 1)
        self.run(block, unit.write_outputs(outputs.spec, [0], [0x81]))
        self.run(block, unit.poll())
        assert block.do == [1, 0, 0, 0, 0, 0, 0, 1]
        assert (inputs.data[0], outputs.data[0]) == (0x10, 0x81)
        self.run(block, unit.poll())
        assert inputs.edges[0] == 1

    def test_analog(self) -> None:
        unit, block = self.make(model="E1240")
        (values,) = unit.blocks
        assert [c.name for c in values.spec.channels][:2] == ["ai0", "ai1"] and values.spec.channels[0].unit == "V"
        block.ramps[2] = (0.0, 0.0, 5.0, 0.0)
        block.ramps[3] = (0.0, 0.0, 12.0, 0.0)
        self.run(block, unit.open())
        self.run(block, unit.poll())
        assert values.data[2] == pytest.approx(5.0, abs=1e-3) and values.flags.tolist() == [
            0,
            0,
            0,
            1,
            0,
            0,
            0,
            0,
        ]

    def test_another_model_is_refused(self) -> None:
        unit, _ = self.make()
        with pytest.raises(DeviceError, match="model is 'E1240'; the configuration says E1212"):
            self.run(moxa.Block("E1240"), unit.open())

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"model": "E1122"}, "not in the map; did you mean E1"),
            ({"model": ""}, "model: none given; one of E1210"),
            ({"model": "", "channels": {"dii": 4}}, "channels.dii: no such port; did you mean di"),
            ({"channels": {"di": 40}}, "channels.di = 40; want 0 to 16"),
            ({"safe": {"di": 1}}, "safe.di: no output of this device"),
            ({"safe": {"do": 256}}, "safe.do = 256; want an integer from 0 to 255"),
            ({"main": "ai"}, "main = ai: no port of this device"),
            ({"watchdog_s": 1.0}, "the map cannot set one"),
            ({"map": "leadshine"}, "describes no ports"),
        ],
    )
    def test_bad_configurations(self, change: dict[str, Any], words: str) -> None:
        table = {"map": "moxa_e1200", "line": {"tcp": "h:502"}, "model": "E1212", **change}
        with pytest.raises(ValueError, match=words):
            ModbusIo.describe("io0", msgspec.convert(table, ModbusIo.Settings))
