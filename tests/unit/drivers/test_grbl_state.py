"""Grbl: what others and restarts leave in the controller, and a driver that reckons with it."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drive_rig import Joined

from sioms.drivers.grbl import simulator as grbl
from sioms.drivers.grbl.driver import Grbl
from sioms.motion import ActionKind, DriveAction
from sioms.motion.watch import Order
from sioms.protocol.flags import AxisStatus
from sioms.sdk.exchange import DeviceError, LinkError, StateLost

AXIS = {"name": "x", "letter": "X", "velocity_max": 0.1, "acceleration_max": 0.5}


def board(*, homing: bool = False, factory: bool = False, **keys: Any) -> Joined:
    axis = {**AXIS, "velocity_max": 0.008, "acceleration_max": 0.01} if factory else AXIS
    return Joined(
        Grbl,
        {"axis": [axis], **keys},
        lambda clock: grbl.Controller(1, homing=homing, factory=factory, clock=clock),
    )


def opened(**keys: Any) -> tuple[Joined, grbl.Controller]:
    rig = board(**keys)
    rig.do(rig.unit.open())
    poll(rig, 3)
    return rig, rig.device


def poll(rig: Joined, times: int) -> None:
    for _ in range(times):
        rig.do(rig.unit.poll())
        rig.wait(0.04)


def lost(rig: Joined) -> bool:
    return bool(rig.unit.bank._queue.latched[0] & AxisStatus.POSITION_LOST)


def jog(rig: Joined, velocity: float) -> None:
    rig.do(rig.unit.start_velocity(0, velocity, DriveAction(ActionKind.START, 0, None, 0.1, 0.5)))


def test_a_full_planner_lets_a_line_wait_and_the_line_goes_out_after_a_cancel() -> None:
    rig = board()
    device = rig.device
    said = b"".join(device.take(b"".join(b"$J=G91X%dF6000\n" % n for n in range(41, 48))))
    said += b"".join(device.take(b"".join(b"$J=G91X%dF6000\n" % n for n in range(8, 15))))
    said += b"".join(device.take(b"$J=G91X15F6000\n$J=G91X16F6000\n"))
    assert said.count(b"ok") == 15 and len(device.planner.blocks) == 15
    rig.wait(0.05)
    device.take(b"\x85")
    rig.wait(1.0)
    assert device.planner.position[0] > 10, "the line that waited has gone out"


def test_the_supply_off_is_place_0_and_a_reset_at_rest_keeps_it() -> None:
    rig = board()
    device = rig.device
    device.take(b"$J=G91X10F6000\n")
    rig.wait(1.0)
    assert b"Grbl" in b"".join(device.take(b"\x18")) and device.planner.position == [10.0]
    device.power_cycle("0.1")
    assert device.take(b"?") == []
    rig.wait(0.12)
    assert device.planner.position == [0.0] and device.planner.slip == [10.0] and device.state == "Idle"


def test_factory_settings_run_a_velocity_without_a_withheld_ok() -> None:
    rig, device = opened(factory=True)
    assert "Bf" not in device.report()
    jog(rig, 0.008)
    fullest, speeds = 0, []
    for _ in range(80):
        poll(rig, 1)
        fullest = max(fullest, len(device.planner.blocks))
        speeds.append(device.planner.speed)
    assert 2 <= fullest <= 12
    assert min(speeds[40:]) > 7.9, "without gaps"


@pytest.mark.parametrize("delay_polls", [0, 3])
def test_a_stopped_chain_of_a_slow_controller_does_not_start_again(delay_polls: int) -> None:
    rig, device = opened(factory=True)
    device.settings[110] = 60.0  # it runs at an eighth of what was believed
    jog(rig, 0.008)
    poll(rig, 60 + delay_polls)
    assert len(device.planner.blocks) <= 12 and not device._lines
    rig.do(rig.unit.halt(0, fastest=False))
    poll(rig, 10)
    place = device.planner.position[0]
    poll(rig, 30)
    assert device.planner.position[0] == place and device.state == "Idle"


@pytest.mark.parametrize("stop", ["fault", "stop"])
def test_a_jog_that_is_not_acknowledged_is_braked_with_its_place_kept(stop: str) -> None:
    rig, device = opened()
    heard = device.take
    device.take = lambda data: [] if data.startswith(b"$J") and heard(data) is not None else heard(data)  # type: ignore[method-assign]
    rig.sent.clear()
    rig.unit._moves.asked[0] = (0.2, 0.1)  # as act() does, and the bank
    rig.unit.bank._watch.order(0, Order.POINT, 0.2)
    with pytest.raises(DeviceError, match="no reply"):
        rig.do(rig.unit.start_position(0, 0.2, 0.1, DriveAction(ActionKind.START, 0, None, 0.1, 0.5)))
    rig.wait(0.3)
    assert device.planner.speed > 50
    if stop == "fault":
        rig.do(rig.unit.halt(0, fastest=True))
    else:
        rig.do(rig.unit.stop())
    assert device.planner.speed == 0 and device.planner.slip == [0.0] and device.state == "Idle"
    assert b"\x18" not in b"".join(rig.sent) and not lost(rig)


def test_what_does_not_brake_is_reset_and_its_place_is_lost() -> None:
    rig, device = opened()
    device.foreign("velocity", "50")
    poll(rig, 20)
    heard = device.take
    device.take = lambda data: heard(data.replace(b"\x85", b""))  # type: ignore[method-assign]
    rig.do(rig.unit.halt(0, fastest=True))
    assert device.state == "Alarm" and device.planner.speed == 0 and lost(rig)


@pytest.mark.parametrize("wish", ["cancel", "reset"])
def test_a_quick_stop_brakes_or_resets_as_configured(wish: str) -> None:
    rig, device = opened(quick_stop=wish)
    jog(rig, 0.1)
    poll(rig, 20)
    assert device.planner.speed > 90
    rig.do(rig.unit.halt(0, fastest=True))
    poll(rig, 2)
    assert device.planner.speed == 0
    assert (device.state, device.planner.slip[0] > 0, lost(rig)) == (
        ("Idle", False, False) if wish == "cancel" else ("Alarm", True, True)
    )


@pytest.mark.parametrize("homing", [False, True])
@pytest.mark.parametrize("moving", [False, True])
def test_a_restart_is_told_its_place_is_lost_and_nothing_goes_on(homing: bool, moving: bool) -> None:
    rig, device = opened(homing=homing)
    device.state = "Idle"
    rig.do(rig.unit.start_velocity(0, 0.05, DriveAction(ActionKind.START, 0, None, 0.1, 0.5)))
    poll(rig, 25)
    if not moving:
        rig.do(rig.unit.halt(0, fastest=True))
    rig.wait(2.0)
    device.power_cycle("0.02")
    rig.wait(0.01)
    said = b""
    for _ in range(20):
        rig.now_s += 0.002
        said += b"".join(device.due())
    rig.unit.overhear(said, rig.unit.clock())
    with pytest.raises(StateLost, match="started anew"):
        rig.do(rig.unit.poll())
    assert lost(rig)
    rig.do(rig.unit.open())
    poll(rig, 20)
    assert device.planner.position == [0.0] and device.state == ("Alarm" if homing else "Idle")
    rig.unit.bank.reset(np.array([0]))
    rig.do(rig.unit.reset(0))
    poll(rig, 10)
    assert device.planner.position == [0.0] and device.state == "Idle" and lost(rig)


def at(place_mm: float, **keys: Any) -> tuple[Joined, grbl.Controller]:
    """Return an opened controller at rest at a place."""
    rig = board(**keys)
    rig.device.state, rig.device.planner.position = "Idle", [place_mm]
    rig.do(rig.unit.open())
    poll(rig, 3)
    assert not lost(rig) and rig.device.state == "Idle"
    return rig, rig.device


def test_a_restart_soon_after_a_reset_of_ours_is_told() -> None:
    rig, device = opened()
    rig.wait(0.4)
    device.power_cycle("0")
    rig.unit.overhear(b"".join(device.take(b"")), rig.unit.clock())
    with pytest.raises(StateLost, match="started anew"):
        rig.do(rig.unit.poll())
    assert lost(rig)


@pytest.mark.parametrize("asked", ["poll", "stop", "reset"])
def test_a_greeting_in_place_of_an_answer_is_a_restart(asked: str) -> None:
    rig, device = at(20.0)
    rig.wait(2.0)
    heard = device.take
    device.take = lambda data: device.connected() if data == b"?" else heard(data)  # type: ignore[method-assign]
    reset = DriveAction(ActionKind.RESET, 0, None, 0.1, 0.5)
    hooks = {"poll": rig.unit.poll, "stop": rig.unit.stop, "reset": lambda: rig.unit.act(reset)}
    with pytest.raises(StateLost, match="started anew"):
        rig.do(hooks[asked]())
    device.take = heard  # type: ignore[method-assign]
    if asked != "poll":
        with pytest.raises(StateLost, match="started anew"):
            rig.do(rig.unit.poll())
    assert lost(rig)


def test_a_restart_whose_greeting_is_lost_shows_in_the_place() -> None:
    rig, device = opened()
    jog(rig, 0.05)
    poll(rig, 25)
    assert device.planner.position[0] > 30
    device.power_cycle("0.04")
    rig.wait(0.06)  # what it says unasked is lost
    with pytest.raises(StateLost, match="started anew"):
        rig.do(rig.unit.poll())
    assert lost(rig)
    rig.do(rig.unit.open())
    poll(rig, 20)
    assert device.planner.position == [0.0]


def test_a_pass_through_zero_is_no_restart() -> None:
    rig, device = at(4.0)
    jog(rig, -0.05)
    for _ in range(60):
        poll(rig, 1)
        device.planner.position = [0.0 if abs(p) < 2.0 else p for p in device.planner.position]
    assert device.planner.position[0] < -10 and not lost(rig)


@pytest.mark.parametrize("homing", [False, True])
@pytest.mark.parametrize("place_mm", [20.0, -0.05, 0.0])
def test_a_supply_off_behind_a_lost_link_loses_the_place(homing: bool, place_mm: float) -> None:
    rig, device = at(place_mm, homing=homing)
    device.power_cycle("1.5")
    for _ in range(3):
        with pytest.raises(LinkError):
            rig.do(rig.unit.poll())
        rig.wait(0.1)
    for _ in range(1500):  # nobody hears its greeting
        rig.go_on()
    rig.do(rig.unit.open())
    # at 0, and not locked: nothing that it says without its greeting differs
    told = homing or place_mm != 0
    assert lost(rig) == told
    rig.unit.bank.reset(np.array([0]))
    rig.do(rig.unit.reset(0))
    poll(rig, 5)
    assert lost(rig) == told


def test_a_move_behind_a_lost_link_loses_the_place() -> None:
    rig, device = at(20.0)
    device.foreign("velocity", "10")
    rig.wait(0.1)
    rig.do(rig.unit.open())
    assert lost(rig) and "elsewhere" in rig.unit.bank.fault_text(0)


@pytest.mark.parametrize("tcp", [False, True])
def test_a_greeting_at_the_opening_loses_the_place_unless_each_connection_is_greeted(tcp: bool) -> None:
    rig, device = at(5.0, **({"line": {"tcp": "127.0.0.1:23"}} if tcp else {}))
    jog(rig, 0.05)
    poll(rig, 7)
    heard, told = device.take, [device.connected()]
    device.take = lambda data: told.pop() if told and data == b"?" else heard(data)  # type: ignore[method-assign]
    rig.do(rig.unit.open())
    assert device.planner.slip == [0.0], "braked"
    assert lost(rig) != tcp


@pytest.mark.parametrize("moving", [False, True])
def test_a_reopening_without_a_restart_keeps_the_place(moving: bool) -> None:
    rig, device = at(20.0)
    if moving:
        jog(rig, 0.05)
        poll(rig, 5)
    rig.wait(1.0)
    rig.do(rig.unit.open())
    poll(rig, 5)
    assert (device.planner.position[0] > 21) == moving and not lost(rig)


@pytest.mark.parametrize(
    "left",
    [
        b"G91\nG20\nG92X5\n", b"$J=G91X500F6000\n", b"G91G1X500F600\n", b"!", b"$C\n", b"$J=G91X50F6000", b"$110=1",
        b"$SLP\n", b"\x84",
    ],
)  # fmt: skip
def test_what_another_sender_left_is_ended_by_the_opening(left: bytes) -> None:
    rig = board()
    device = rig.device
    device.take(left)
    rig.wait(0.2)
    rig.do(rig.unit.open())
    assert device.planner.speed == 0 and device.state == ("Alarm" if b"SLP" in left else "Idle")
    assert device.parser.modes() == "G0 G21 G90" and device.settings[110] == 6000
    place = device.planner.position[0]
    poll(rig, 20)
    assert device.planner.position[0] == place and not device.planner.slip[0]


@pytest.mark.parametrize("alarm", [1, 2])
def test_an_alarm_that_leaves_the_controller_deaf_is_ended_by_opening_and_reset(alarm: int) -> None:
    rig, device = opened()
    device.crash(alarm)
    device.due()
    rig.do(rig.unit.reset(0))
    assert device.state == "Idle"
    device.crash(alarm)
    device.due()
    rig.do(rig.unit.open())
    assert device.state == "Alarm" and not device._deaf


def test_a_quick_stop_that_is_not_obeyed_is_sent_again() -> None:
    rig, device = opened()
    rig.do(rig.unit.halt(0, fastest=True))
    device.foreign("velocity", "50")
    poll(rig, 5)
    assert device.planner.speed > 40
    rig.do(rig.unit.halt(0, fastest=True))
    assert device.planner.speed == 0


def test_the_example_of_its_page_fits_a_controller_as_it_ships() -> None:
    page = (Path(__file__).parents[3] / "drivers/grbl/README.md").read_text()
    text = "\n".join(line[4:] for line in page.splitlines() if line.startswith("    "))
    table = tomllib.loads(text)["device"]["mod0"]
    table.pop("driver"), table.pop("line")
    rig = Joined(Grbl, table, lambda clock: grbl.Controller(3, homing=False, factory=True, clock=clock))
    rig.do(rig.unit.open())
    poll(rig, 3)
    jog(rig, -0.008)
    poll(rig, 25)
    assert rig.device.planner.speed == pytest.approx(8.0)


def homed() -> tuple[Joined, grbl.Controller]:
    """Return one that may home and is not locked."""
    keys = {"axis": [AXIS], "homing": True, "homing_timeout_s": 60.0}
    rig = Joined(Grbl, keys, lambda clock: grbl.Controller(1, clock=clock))
    device = rig.device
    rig.do(rig.unit.open())
    poll(rig, 3)
    rig.unit.bank.reset(np.array([0]))
    rig.do(rig.unit.reset(0))
    poll(rig, 3)
    assert device.state == "Idle"
    return rig, device


def search(rig: Joined) -> None:
    rig.unit.bank.home([0], rig.unit.clock())
    rig.poll(2)


def test_a_homing_moves_the_machine_and_ends_at_the_switch() -> None:
    rig, device = homed()
    search(rig)
    speeds = []
    for _ in range(170):
        rig.poll(1, 0.02)
        speeds.append(device.planner.speed)
        if device.homing.is_on:
            assert rig.unit.bank.rows["in_motion"][0]
            rig.device.take(b"?")  # answered at its end, with Home and before its ok
    assert max(speeds) > 20 and 0 < min(s for s in speeds if s) < 2
    assert not rig.unit.bank.rows["in_motion"][0] and rig.unit.bank.rows["status"][0] & AxisStatus.HOMED
    assert rig.unit.bank.rows["position"][0] == pytest.approx(-0.001) and not rig.unit.bank.is_in_fault(0)
    assert device.planner.position[0] + device.planner.slip[0] == pytest.approx(10.0 - 1.0, abs=0.01)


def test_a_homing_that_finds_no_switch_is_a_fault_that_says_so() -> None:
    rig, device = homed()
    device.settings[130] = 20.0  # it looks one and a half times as far
    device.handlers()["reference"]("off")
    search(rig)
    rig.poll(150)
    assert rig.unit.bank.is_in_fault(0) and "ALARM:9" in rig.unit.bank.fault_text(0)
    assert lost(rig) and not rig.unit.bank.rows["status"][0] & AxisStatus.HOMED
    rig.unit.bank.reset([0])
    rig.do(rig.unit.reset(0))
    rig.poll(5)
    assert device.state == "Idle" and lost(rig)


def test_a_homing_that_is_stopped_ends_at_once_and_loses_the_place() -> None:
    rig, device = homed()
    search(rig)
    rig.poll(10)
    assert device.planner.speed > 20
    rig.unit.bank.emergency_stop([0], rig.unit.clock())
    rig._act()
    assert device.planner.speed == 0
    rig.poll(60)
    place = device.planner.position[0] + device.planner.slip[0]
    assert lost(rig) and not rig.unit.bank.rows["status"][0] & AxisStatus.HOMED
    rig.poll(20)
    assert device.planner.position[0] + device.planner.slip[0] == place and device.state == "Alarm"


@pytest.mark.parametrize("at_ms", range(0, 44, 4))
def test_an_alarm_is_told_while_the_controller_hears_nothing(at_ms: int) -> None:
    rig, device = opened()
    jog(rig, 0.05)
    rig.poll(10)
    rig.wait(at_ms / 1000)
    device.crash(1)
    good_s = rig.now_s
    for _ in range(20):
        try:
            rig.poll(1, 0.04)
        except LinkError:  # the alarm came instead of its reply
            continue
        assert rig.now_s - good_s < 0.5, "that would be a lost link"
        good_s = rig.now_s
    assert rig.unit.bank.is_in_fault(0) and "ALARM:1, hard limit" in rig.unit.bank.fault_text(0)
    rig.unit.bank.reset([0])
    rig.do(rig.unit.reset(0))  # at once: what is sent within half a second of the alarm is dropped
    rig.poll(5)
    assert device.state == "Idle" and lost(rig)


def test_a_homing_after_one_that_was_stopped_ends_homed() -> None:
    rig, _ = homed()
    search(rig)
    rig.poll(10)
    rig.unit.bank.stop([0], rig.unit.clock())
    rig._act()
    rig.poll(60)
    rig.unit.bank.reset([0])
    rig.do(rig.unit.reset(0))
    rig.poll(5)
    rig.unit.bank.calibrate([0], [0.0])
    rig.poll(5)
    rig.unit.overhear(b"[MSG:'", rig.unit.clock())  # of a line the rest of which was in a reply
    search(rig)
    rig.poll(170)
    assert not rig.unit.bank.is_in_fault(0), rig.unit.bank.fault_text(0)
    assert not rig.unit.bank.rows["in_motion"][0] and rig.unit.bank.rows["status"][0] & AxisStatus.HOMED
