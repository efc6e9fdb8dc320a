"""The Modbus axis driver and drives that lose supply, link or place, are busy, silent, or left running by another."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from modbus_rig import RIGS, Rig, az_rig, leadshine_rig

from sioms.drivers.modbus.simulated import leadshine
from sioms.motion import CommandError
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.sdk.codec.modbus import frame_rtu
from sioms.sdk.exchange import DeviceError, Exchange, StateLost


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
