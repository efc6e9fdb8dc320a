"""TMCL: a module out of step, one that restarts, one that does not keep what it was told."""

from __future__ import annotations

import random
from typing import Any

import pytest
from drive_rig import CHARACTER_S, LIMITS, Joined

from sioms.drivers.tmcl import simulator as tmcl
from sioms.drivers.tmcl.codec import Op
from sioms.drivers.tmcl.driver import Tmcl
from sioms.motion import ActionKind, DriveAction
from sioms.protocol.flags import AxisStatus
from sioms.sdk.exchange import DeviceError, LinkError, StateLost

AXIS = {"name": "x", "motor": 0, "travel_per_turn": 0.01, "microsteps_per_turn": 51200, **LIMITS}
ACTION = DriveAction(ActionKind.START, 0, None, 0.1, 1.0)
PER_M = 51200 / 0.01


def opened(table: dict[str, Any] | None = None, **given: Any) -> Joined:
    rig = Joined(Tmcl, {"axis": [AXIS], **(table or {})}, lambda clock: tmcl.Module(clock=clock, **given))
    rig.do(rig.unit.open())
    rig.do(rig.unit.poll())
    return rig


def running(**given: Any) -> Joined:
    rig = opened(**given)
    rig.do(rig.unit.start_velocity(0, 0.05, ACTION))
    rig.wait(0.3)
    assert rig.device.motors[0].mover.velocity == pytest.approx(0.05 * PER_M)
    return rig


# --- into step ------------------------------------------------------------------------------------


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("stray", range(1, 9))
def test_a_stop_gets_through_to_a_module_out_of_step(stray: int, silent: bool) -> None:
    rig = running(silent=silent)
    rig.device.take(bytes(random.Random(stray).choices(range(2, 256), k=stray)))
    began_s = rig.now_s
    rig.do(rig.unit.halt(0, fastest=True))
    took_s = rig.now_s - began_s
    assert rig.device.motors[0].mover.top_speed == 0
    assert took_s < (1.0 if silent else 0.15)
    rig.wait(0.5)
    rig.sent.clear()
    rig.do(rig.unit.poll())  # all is in step again
    assert all(len(data) == 9 for data in rig.sent)


@pytest.mark.parametrize("lost", range(9))
def test_a_stop_that_lost_a_byte_is_sent_again(lost: int) -> None:
    rig = running()
    whole = rig.device.take
    rig.device.take = lambda data: [
        setattr(rig.device, "take", whole),
        whole(data[:lost] + data[lost + 1 :]),
    ][1]
    rig.do(rig.unit.halt(0, fastest=True))
    assert rig.device.motors[0].mover.top_speed == 0


def test_a_stop_between_the_single_bytes_of_a_poll() -> None:
    """The stop gets the module into step; the poll, when it goes on, must not shift it out again."""
    rig = running()
    rig.device.take(b"\x55")
    poll = rig.unit.poll()
    assert rig.device.take(poll.send(None).data)[0][2] == 1
    first = poll.throw(LinkError("status 1"))
    rig.device.take(first.data)
    rig.do(rig.unit.halt(0, fastest=True))
    assert rig.device.motors[0].mover.top_speed == 0
    poll.send(None)
    rig.sent.clear()
    rig.do(rest(poll))
    assert all(len(data) == 9 for data in rig.sent)


def rest(steps: Any) -> Any:
    """Go on with steps whose last yield has been answered by nothing."""
    yield from steps


@pytest.mark.parametrize("silent", [False, True])
def test_whatever_the_line_loses_the_module_obeys_nothing_that_was_not_sent(silent: bool) -> None:
    chance = random.Random(7)
    rig = opened(silent=silent)
    device, obeyed, sent = rig.device, [], set()
    answer, take = device._answer, device.take

    def note(telegram: bytes) -> list[bytes]:
        if sum(telegram[:8]) % 256 == telegram[8] and telegram[0] in (0, 1):
            obeyed.append(telegram)
        replies: list[bytes] = answer(telegram)
        return replies

    def disturbed(data: bytes) -> list[bytes]:
        sent.add(data)
        if len(data) == 9 and chance.random() < 0.1:
            start = chance.randrange(9)
            data = data[:start] + data[start + chance.randrange(1, 10) :]
        elif chance.random() < 0.05:
            data = bytes(chance.choices(range(2, 256), k=chance.randrange(1, 9))) + data
        replies: list[bytes] = take(data)
        return replies

    device._answer, device.take = note, disturbed
    for i in range(400):
        value = chance.choice((0.0199, 1019 / PER_M, chance.uniform(-0.09, 0.09)))
        steps = (
            rig.unit.poll, lambda: rig.unit.halt(0, fastest=False),
            lambda value=value: rig.unit.start_velocity(0, value, ACTION),
            lambda value=value: rig.unit.start_position(0, value, 0.05, ACTION),
        )[i % 4]()  # fmt: skip
        try:
            rig.do(steps)
        except LinkError:
            pass
        except StateLost:
            rig.do(rig.unit.open())
    assert len(obeyed) > 300
    assert {telegram for telegram in obeyed if telegram[1] in (1, 2, 4, 5, 9, 13)} <= sent
    assert abs(device.motors[0].mover.velocity) <= 0.1 * PER_M


# --- restarts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "polls", "words"),
    [
        ({}, 1, "clock"),
        ({"ticks": False}, 1, "heartbeat"),
        ({"ticks": False, "keeps_heartbeat": True}, 3, "parameter [45] of motor 0 is 512000, not"),
        ({"keeps_heartbeat": True}, 1, "clock"),
    ],
)
def test_a_restart_within_the_lost_link_time_is_noticed(given: dict[str, Any], polls: int, words: str) -> None:
    rig = opened(**given)
    rig.do(rig.unit.start_position(0, 0.03, 0.05, ACTION))
    rig.wait(1.5)
    for _ in range(4):
        rig.do(rig.unit.poll())
    rig.device.power_cycle(0.01)
    rig.wait(0.05)
    with pytest.raises(StateLost, match=words):
        for _ in range(polls):
            rig.do(rig.unit.poll())
    rig.do(rig.unit.open())
    motor = rig.device.motors[0]
    assert (rig.device.globals[68], motor.parameters[4], motor.parameters[5]) == (
        500,
        0.1 * PER_M,
        1.0 * PER_M,
    )
    assert "position lost" in rig.unit.bank.fault_text(0)
    rig.do(rig.unit.poll())


def test_a_new_driver_of_a_module_that_went_on_loses_no_place() -> None:
    rig = opened()
    rig.do(rig.unit.open())
    assert not rig.unit.bank.fault_text(0)


def test_a_module_that_restarted_unseen_keeps_to_the_limits() -> None:
    rig = opened()
    rig.do(rig.unit.start_position(0, 0.03, 0.05, ACTION))
    rig.wait(1.5)
    rig.device.power_cycle(0.01)
    rig.wait(0.05)
    rig.do(rig.unit.start_position(0, 0.06, 0.05, ACTION))  # before any poll
    fastest: list[float] = []
    rig.wait(1.0, lambda: fastest.append(abs(rig.device.motors[0].mover.velocity)))
    assert max(fastest) == pytest.approx(0.05 * PER_M)


def test_ramps_and_heartbeat_of_another_master_are_noticed() -> None:
    for parameter, words in ((4, "parameter 4"), (5, "parameter 5")):
        rig = opened()
        rig.device.motors[0].parameters[parameter] *= 2
        with pytest.raises(StateLost, match=words):
            for _ in range(3):
                rig.do(rig.unit.poll())
        rig.do(rig.unit.open())
        assert not rig.unit.bank.fault_text(0), "its place is where it was"
    rig = opened()
    rig.device.globals[68] = 0
    with pytest.raises(StateLost, match="heartbeat"):
        for _ in range(3):
            rig.do(rig.unit.poll())


def test_readings_that_stand_still_are_noticed() -> None:
    rig = opened()
    rig.device.handlers()["freeze"]()
    with pytest.raises(StateLost, match="clock"):
        for _ in range(20):
            rig.wait(0.05)
            rig.do(rig.unit.poll())


def test_a_clock_that_passes_its_end_is_no_restart() -> None:
    rig = opened()
    rig.device._began_s -= (2**32 - 500) / 1000 - (rig.now_s - rig.device._began_s)
    rig.unit._ticks = None
    for _ in range(100):
        rig.wait(0.02)
        rig.do(rig.unit.poll())


def test_a_driver_that_was_held_up_takes_nothing_for_a_restart() -> None:
    rig = opened()
    for _ in range(5):
        poll = rig.unit.poll()
        reply = rig.device.take(poll.send(None).data)[0]
        rig.wait(0.4)  # between the reply and its reading
        step = poll.send(rig.unit._module.exchange(Op.GGP, 132).decode(reply))
        rig.do(first_then(step, poll))


def first_then(step: Any, steps: Any) -> Any:
    """Go on with steps from one that they have yielded."""
    while True:
        try:
            value = yield step
            step = steps.send(value)
        except StopIteration:
            return


# --- dead-man -------------------------------------------------------------------------------------


def test_a_heartbeat_that_is_not_kept_refuses_to_open() -> None:
    rig = Joined(Tmcl, {"axis": [AXIS]}, lambda clock: tmcl.Module(clock=clock))
    answer = rig.device._global
    rig.device._global = lambda command, *rest: answer(10, *rest) if command == 9 else answer(command, *rest)
    with pytest.raises(DeviceError, match=r"reads 0 ms, 500 was set"):
        rig.do(rig.unit.open())


def test_an_evaluation_board_opens_without_dead_man_when_told_so() -> None:
    with pytest.raises(DeviceError, match="heartbeat_s = 0 accepts"):
        opened(heartbeat=False, ticks=False)
    rig = opened({"heartbeat_s": 0.0}, heartbeat=False, ticks=False)
    rig.device.power_cycle(0.01)
    rig.wait(0.05)
    with pytest.raises(StateLost):
        for _ in range(2):
            rig.do(rig.unit.poll())


def test_the_stop_goes_out_though_the_end_of_the_search_is_refused() -> None:
    rig = opened({"axis": [{**AXIS, "homing": True}]})
    rig.do(rig.unit.home(0))
    rig.wait(0.2)
    rig.device.handlers()["refuse"]("1")
    rig.do(rig.unit.halt(0, fastest=True))
    assert rig.device.motors[0].mover.top_speed == 0 and not rig.device.motors[0].searching


@pytest.mark.parametrize("pause_s", [0.3, 0.8])
def test_a_search_that_the_heartbeat_has_ended_is_no_homing(pause_s: float) -> None:
    rig = opened({"axis": [{**AXIS, "homing": True}]})
    rig.unit.bank.home([0], 0)
    rig.do(rig.unit.home(0))
    for _ in range(5):
        rig.wait(0.02)
        rig.do(rig.unit.poll())
    assert rig.device.motors[0].searching
    rig.wait(pause_s)
    rig.do(rig.unit.poll())
    found = AxisStatus(int(rig.unit.bank.rows["status"][0]))
    assert (AxisStatus.POSITION_LOST in found) == (pause_s > 0.5) and AxisStatus.HOMED not in found
    assert rig.unit._homes[0] == bool(rig.device.motors[0].searching) == (pause_s < 0.5)
    assert ("home again" in rig.unit.bank.fault_text(0)) == (pause_s > 0.5)


def home(rig: Joined, phase: int | None) -> AxisStatus:
    """Home, with an RFS STOP of another master in a phase of the search; return the status when it is over."""
    rig.unit.bank.home([0], rig.unit.clock())
    rig._act()
    for _ in range(400):
        if phase in (0, rig.device.motors[0].searching):
            rig.device._search(rig.device.motors[0], 1)
        rig.poll()
        if not rig.unit._homes[0]:
            break
    rig.poll(10)
    assert not rig.device.motors[0].searching
    return AxisStatus(int(rig.unit.bank.rows["status"][0]))


@pytest.mark.parametrize("phase", [0, 1, 2, None])
def test_a_search_that_another_master_ends_is_no_homing(phase: int | None) -> None:
    """Nothing in the module says so but its count, which is 0 where it has found its switch."""
    rig = opened({"axis": [{**AXIS, "homing": True}]})
    rig.device.motors[0].parameters[194], rig.device.motors[0].mover.low = int(0.2 * PER_M), -500_000.0
    for _ in range(2):  # the second time its place is lost already, or known
        found = home(rig, phase)
        assert (AxisStatus.HOMED in found) == (phase is None) != (AxisStatus.POSITION_LOST in found)
        assert ("broken off, by another master" in rig.unit.bank.fault_text(0)) == (phase is not None)
        assert AxisStatus.HOMING not in found
        rig.unit.bank.reset([0])
        rig.poll(10)
    assert AxisStatus.HOMED in home(rig, None)


def test_single_bytes_take_their_time_at_9600() -> None:
    table = {"axis": [AXIS], "line": {"serial": "/x", "baud": 9600}}
    rig = Joined(Tmcl, table, lambda clock: tmcl.Module(clock=clock))
    assert rig.unit._pad_s == pytest.approx(0.01 + 10 * 10 / 9600)
    assert CHARACTER_S < 10 / 9600


@pytest.mark.parametrize("wrong", range(5))
def test_one_reply_of_another_parameter_is_no_restart(wrong: int) -> None:
    """Replies do not tell of which parameter they are: one that comes late answers what was asked after it."""
    rig = opened()
    take, asked = rig.device.take, []

    def late(data: bytes) -> list[bytes]:
        replies: list[bytes] = take(data)
        if data[1] in (6, 10):
            asked.append(data)
            if len(asked) == wrong + 1 and data[2] in (4, 5, 68, 132):
                head = replies[0][:4] + (12345678).to_bytes(4, "big")
                return [head + bytes((sum(head) % 256,))]
        return replies

    for _ in range(12):
        asked.clear()
        rig.device.take = late
        rig.do(rig.unit.poll())
        rig.device.take = take
        rig.wait(0.02)
    assert not rig.unit.bank.fault_text(0)


@pytest.mark.parametrize("turnaround_s", [0.05, 0.15])
@pytest.mark.parametrize("baud", [9600, 115200])
def test_a_poll_that_loses_two_replies_is_no_lost_link(turnaround_s: float, baud: int) -> None:
    """One reply of a hundred is lost on a poor line, and so two in every 500th poll."""
    rig = opened({"turnaround_s": turnaround_s, "line": {"serial": "/x", "baud": baud}})
    whole, asked = rig.device.take, 0

    def take(data: bytes) -> list[bytes]:
        nonlocal asked
        asked += len(data) == 9
        return [] if asked in (2, 4) and len(data) == 9 and whole(data) else whole(data)

    began_s, rig.device.take = rig.now_s, take
    rig.do(rig.unit.poll())
    assert asked > 6 and 2 * turnaround_s < rig.now_s - began_s < rig.unit.silence_s
