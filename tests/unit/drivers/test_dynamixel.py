"""Dynamixel: what outlives torque, mode, watchdog and restart, and what the driver makes of it."""

from __future__ import annotations

import random
from typing import Any

import pytest
from drive_rig import LIMITS, Joined

from sioms.drivers.dynamixel import codec
from sioms.drivers.dynamixel import simulator as dynamixel
from sioms.drivers.dynamixel.driver import Dynamixel
from sioms.motion import ActionKind, Command, DriveAction
from sioms.protocol.flags import ControlMode
from sioms.sdk.exchange import DeviceError, LinkError, StateLost

ACTION = DriveAction(ActionKind.START, 0, None, 0.07, 1.0)
STEPS_PER_M = 4096 / 0.05


def joined(mode: str = "extended_position", **keys: Any) -> Joined:
    axis = {"name": "x", "id": 1, "mode": mode, "travel_per_turn": 0.05, **LIMITS, "velocity_max": 0.07}
    if mode == "current":
        axis["force_per_ampere"] = 1.0
    return Joined(Dynamixel, {"axis": [axis], **keys}, lambda clock: dynamixel.Bus([1], clock=clock))


def opened(mode: str = "extended_position", **keys: Any) -> tuple[Joined, dynamixel.Servo]:
    rig = joined(mode, **keys)
    rig.do(rig.unit.open())
    rig.do(rig.unit.poll())
    return rig, rig.device.servos[1]


def go(rig: Joined, goal: float, polls: int = 250) -> None:
    rig.command(control_mode=int(ControlMode.POSITION), position=goal)
    rig.poll(polls)


# --- stale set-points -----------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["velocity", "position", "extended_position", "current"])
@pytest.mark.parametrize("left", [0, 1, 3, 4, 5, 16])
def test_nothing_that_another_master_left_moves_a_servo_that_is_switched_on(mode: str, left: int) -> None:
    rig = joined(mode)
    one = rig.device.servos[1]
    one.put(11, left, 1)
    for address, value, size in ((100, 500, 2), (102, 700, 2), (104, 150, 4), (116, 3900, 4)):
        one.put(address, value, size)
    seen: list[float] = []
    look = lambda: seen.append(abs(one.mover.velocity))  # noqa: E731
    rig.do(rig.unit.open(), look)
    rig.wait(0.5, look)
    assert one.table[64] == 1 and one.table[11] == {"velocity": 1, "position": 3, "extended_position": 4}.get(mode, 0)
    assert max(seen) < 10


@pytest.mark.parametrize("quick_stop", ["torque_off", "hold"])
def test_a_stale_velocity_does_not_come_back_after_an_emergency_stop(quick_stop: str) -> None:
    rig, one = opened("velocity", quick_stop=quick_stop)
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    rig.wait(0.3)
    assert one.mover.velocity > 3500
    rig.do(rig.unit.halt(0, fastest=True))
    rig.poll(50)
    assert one.mover.velocity == 0
    seen: list[float] = []
    rig.do(rig.unit.start_velocity(0, -0.01, ACTION), lambda: seen.append(one.mover.velocity))
    rig.wait(0.2, lambda: seen.append(one.mover.velocity))
    assert max(seen) <= 0 and one.mover.velocity == pytest.approx(-0.01 * STEPS_PER_M, rel=0.05)


def test_nothing_is_switched_on_while_a_stop_is_latched() -> None:
    rig = joined()
    rig.unit.bank.emergency_stop([0], 1)
    rig.do(rig.unit.open())
    assert rig.device.servos[1].table[64] == 0
    rig.unit.bank.reset([0])
    rig.do(rig.unit.start_position(0, 0.03, 0.05, ACTION))
    assert rig.device.servos[1].table[64] == 1


def test_a_goal_goes_in_one_packet_with_its_limits() -> None:
    """After a change of mode, a watchdog and a restart the profile is 0, which is without limit."""
    rig, one = opened()
    seen: list[float] = []
    one.put(108, 0, 4)
    one.put(112, 0, 4)  # unseen by any poll
    rig.do(rig.unit.start_position(0, 0.045, 0.02, ACTION))
    rig.wait(1.0, lambda: seen.append(one.mover.velocity))
    assert max(seen) == pytest.approx(0.02 * STEPS_PER_M, rel=0.03)


# --- restarts and other masters -------------------------------------------------------------------


def restarted(rig: Joined, off_s: float = 0.01) -> None:
    rig.device.power_cycle(off_s)
    rig.wait(off_s + 0.02)


@pytest.mark.parametrize("turns", [0, 2])
def test_a_restart_within_the_lost_link_time_is_noticed(turns: int) -> None:
    rig, one = opened()
    goal = turns * 0.05 + 0.03
    go(rig, goal, 250)
    assert one.mover.position == pytest.approx(goal * STEPS_PER_M, abs=1)
    restarted(rig)
    assert one.table[64] == 0 and one.table[98] == 0
    with pytest.raises(StateLost):
        rig.do(rig.unit.poll())
    rig.do(rig.unit.open())
    assert one.table[98] == 25 and one.get(108, 4) > 0 and one.get(112, 4) > 0
    # of one turn it knows its place: an absolute encoder; of more it counts within one
    assert ("position lost" in rig.unit.bank.fault_text(0)) == (turns > 0)
    assert one.table[64] == (turns == 0)
    rig.poll(5)


def test_a_restart_in_motion_loses_the_place() -> None:
    rig, _ = opened()
    go(rig, 0.2, 15)
    restarted(rig)
    with pytest.raises(StateLost):
        rig.do(rig.unit.poll())
    rig.do(rig.unit.open())
    assert "position lost" in rig.unit.bank.fault_text(0)


def test_a_restart_that_the_link_loss_hid_loses_the_turns() -> None:
    rig, _ = opened()
    go(rig, 0.12, 250)
    restarted(rig, 4.0)
    rig.do(rig.unit.open())
    assert "position lost" in rig.unit.bank.fault_text(0)


def test_a_servo_that_went_on_loses_nothing() -> None:
    rig, one = opened()
    go(rig, 0.12, 250)
    rig.wait(60.0)  # its clock began anew twice
    one.heard_s = rig.now_s
    rig.do(rig.unit.open())
    assert not rig.unit.bank.fault_text(0)
    rig.poll(200, 0.2)  # and again
    assert not rig.unit.bank.fault_text(0)


@pytest.mark.parametrize(
    ("kind", "value", "words"),
    [
        ("velocity", 900, "register"),
        ("torque", 0, "register 64"),
        ("mode", 16, "register"),
        ("position", 3000, "register"),
    ],
)
def test_another_master_is_noticed(kind: str, value: float, words: str) -> None:
    rig, one = opened()
    one.foreign(kind, value)
    with pytest.raises(StateLost, match=words):
        rig.do(rig.unit.poll())
    rig.do(rig.unit.open())
    assert one.table[11] == 4 and one.table[98] == 25
    rig.poll(50)
    assert one.mover.velocity == 0


def test_readings_that_stand_still_are_noticed() -> None:
    rig, _ = opened()
    rig.device.handlers()["freeze"]()
    with pytest.raises(StateLost, match="clock"):
        rig.poll(100)


def test_a_stop_between_a_poll_and_its_reply_makes_the_poll_void() -> None:
    rig, _ = opened("velocity")
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    poll = rig.unit.poll()
    request = poll.send(None)
    reply = request.decode(b"".join(rig.device.take(request.data)))
    rig.do(rig.unit.halt(0, fastest=True))
    with pytest.raises(StopIteration):  # not StateLost: the goal that it read was that of then
        poll.send(reply)


def test_one_late_image_is_no_restart() -> None:
    rig, _ = opened("velocity")
    old = rig.unit._bus.read(1, 64, 72)
    late = rig.device.take(old.data)
    rig.do(rig.unit.start_velocity(0, 0.01, ACTION))
    rig.wait(0.4)
    rig.poll(3)
    take = rig.device.take
    rig.device.take = lambda data: setattr(rig.device, "take", take) or (take(data) and late)
    rig.do(rig.unit.poll())
    rig.poll(3)


# --- watchdog -------------------------------------------------------------------------------------


@pytest.mark.parametrize("quick_stop", ["torque_off", "hold"])
def test_an_expired_watchdog_is_a_fault_and_no_goal_before_it_comes_back(quick_stop: str) -> None:
    rig, one = opened("velocity", quick_stop=quick_stop)
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    rig.wait(1.5)
    assert one.table[98] == 0xFF and one.get(108, 4) == 0
    rig.do(rig.unit.poll())
    assert "watchdog expired" in rig.unit.bank.fault_text(0)
    seen: list[float] = []
    rig.do(rig.unit.halt(0, fastest=True), lambda: seen.append(abs(one.mover.velocity)))
    rig.unit.bank.reset([0])
    rig.do(rig.unit.reset(0), lambda: seen.append(abs(one.mover.velocity)))
    rig.poll(10)
    assert one.table[98] == 25 and one.table[64] == 1 and max(seen) == 0


def test_a_watchdog_that_is_not_kept_refuses_to_open() -> None:
    rig = joined()
    one = rig.device.servos[1]
    write = one.write
    one.write = lambda address, data: 0 if address == 98 else write(address, data)
    with pytest.raises(DeviceError, match=r"reads 0, 25 was written; firmware before 38"):
        rig.do(rig.unit.open())
    rig = joined(watchdog_s=0.0)
    rig.do(rig.unit.open())


def test_low_return_levels_are_raised() -> None:
    for level in (0, 1):
        rig = joined()
        rig.device.servos[1].put(68, level, 1)
        rig.do(rig.unit.open())
        assert rig.device.servos[1].table[68] == 2


def test_a_shutdown_is_cleared_by_reset_and_loses_turns_only() -> None:
    for goal, lost in ((0.03, False), (0.12, True)):
        rig, one = opened()
        go(rig, goal, 250)
        one.shut_down(32)
        rig.poll(5)
        assert "overload" in rig.unit.bank.fault_text(0)
        rig.unit.bank.reset([0])
        rig.do(rig.unit.reset(0))
        assert one.table[70] == 0
        assert ("position lost" in rig.unit.bank.fault_text(0)) == lost


def test_a_start_that_follows_a_reset_is_not_made_void_by_it() -> None:
    rig, one = opened()
    reset = rig.unit.act(DriveAction(ActionKind.RESET, 0, None, 0.07, 1.0))
    command = Command(*[0] * len(Command._fields))._replace(control_mode=int(ControlMode.POSITION), position=0.03)
    start = rig.unit.act(DriveAction(ActionKind.START, 0, command, 0.07, 1.0))  # handed out while the reset runs
    rig.do(reset)
    rig.do(start)
    assert one.get(116, 4) == round(0.03 * STEPS_PER_M)


# --- the line -------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [60, 190, 0xFFF0])
def test_a_stop_gets_through_to_a_receiver_that_waits_for_the_end_of_a_packet(length: int) -> None:
    rig, one = opened("velocity")
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    rig.wait(0.3)
    rig.device.take(b"\xff\xff\xfd\x00\x01" + length.to_bytes(2, "little") + b"\x03")
    began_s = rig.now_s
    rig.do(rig.unit.halt(0, fastest=True))
    assert one.table[64] == 0 and rig.now_s - began_s < 0.1


def test_zeros_complete_no_packet() -> None:
    chance = random.Random(5)
    for _ in range(300):
        whole = codec.packet(1, 3, chance.randbytes(chance.randrange(3, 20)))
        for cut in range(8, len(whole) - 1):
            receiver = dynamixel.Receiver()
            assert receiver.take(whole[:cut] + bytes(300)) == []


def test_a_line_that_loses_half_of_all_does_not_lose_a_stop() -> None:
    chance = random.Random(2)
    rig, one = opened("velocity")
    take = rig.device.take
    for _ in range(100):
        rig.device.take = take
        rig.do(rig.unit.open())  # the servo's watchdog may have acted meanwhile
        rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
        rig.wait(0.05)
        rig.device.take = lambda data: take(data[: chance.randrange(len(data) + 1)] if chance.random() < 0.5 else data)
        for _ in range(20):
            try:
                rig.do(rig.unit.halt(0, fastest=True))
            except LinkError:
                continue
            break
        assert one.table[64] == 0
