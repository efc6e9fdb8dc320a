"""Verbs are written once, and none of them passes by a short write that has been acknowledged and not worked in yet."""

from __future__ import annotations

import errno
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from motion_rig import MODE, Rig, axis, records

from sioms.motion import AxisBank, Bank, CommandError, DriveBank, Homing
from sioms.motion.queue import verdict

Verb = Callable[[Bank, int], Any]
FURTHER = records(mode=MODE.POSITION, position=0.05)
VERBS: dict[str, Verb] = {
    "append": lambda bank, now: bank.append(np.tile(FURTHER, 20), [0, 1], now),
    "offer": lambda bank, now: bank.offer(FURTHER.tolist(), [0, 1], now),
    "judge": lambda bank, now: len(verdict(bank.judge(FURTHER, [0, 1], now)).axes),
    "take": lambda bank, now: bank.take(verdict(bank.judge(FURTHER, [0, 1], now)), now),
    "room": lambda bank, now: bank.room([0, 1]),
    "flush": lambda bank, now: bank.flush([1]),
    "synch": lambda bank, now: bank.synch([0, 1], now, now),
    "stop": lambda bank, now: bank.stop([0], now),
    "emergency_stop": lambda bank, now: bank.emergency_stop([0], now),
    "fault": lambda bank, now: bank.fault([0], "tried", now),
    "abandon": lambda bank, now: bank.abandon([0], now, errno.ERANGE, "tried"),
    "let_go": lambda bank, now: bank.let_go([1]),
    "forget_settings": lambda bank, now: bank.forget_settings([1]),
    "ends": lambda bank, now: bank.ends()[1:],
    "lose_place": lambda bank, now: bank.lose_place([0], "tried", now),
    "break_off": lambda bank, now: bank.break_off([0], "tried", now),
    "fault_text": lambda bank, now: bank.fault_text(0),
    "check_reset": lambda bank, now: bank.check_reset([1], now),
    "reset": lambda bank, now: bank.reset([1]),
    "calibrate": lambda bank, now: bank.calibrate([0], [0.01]),
    "zero": lambda bank, now: bank.zero([0]),
    "set_limits": lambda bank, now: bank.set_limits([0], velocity_max=0.1),
    "get_limits": lambda bank, now: bank.get_limits([0]),
    "home": lambda bank, now: bank.home([0], now),
    "set_homed": lambda bank, now: bank.set_homed([1]),
    "is_latched": lambda bank, now: bank.is_latched(0),
    "is_stopped": lambda bank, now: bank.is_stopped(0),
    "is_in_fault": lambda bank, now: bank.is_in_fault(0),
    "take_faults": lambda bank, now: bank.take_faults(),
    "end_stop": lambda bank, now: bank.end_stop([0]),
    "is_idle": lambda bank, now: bank.is_idle([0, 1]),
    "diagnostics": lambda bank, now: bank.diagnostics([0, 1]),
    "take_events": lambda bank, now: bank.take_events() and None,
}


MOVED = 2e-9
"""What an axis moves by the general way until a stop comes [m]: the short way has not begun then."""


def public(of: type) -> set[str]:
    """Return the names of the public functions that a class defines."""
    return {name for name, _ in inspect.getmembers(of, inspect.isfunction) if not name.startswith("_")}


def test_each_verb_is_written_once() -> None:
    assert set(VERBS) == public(Bank)
    for loop in (AxisBank, DriveBank):
        assert not public(Bank) & set(vars(loop))


@pytest.mark.parametrize("name", VERBS)
@pytest.mark.parametrize("replace", [False, True])
def test_a_verb_after_a_short_write_is_as_after_a_long_one(name: str, replace: bool) -> None:
    rigs = [Rig([axis(homing=Homing(0.1, 0.01, 1)), axis()]) for _ in range(2)]
    rigs[1].bank._queue.admit_plain = lambda *_, **__: None  # type: ignore[method-assign]
    said = []
    for rig in rigs:
        rig.tick(2)
        for index in (0, 1):
            rig.now_ns += 200_000
            rig.bank.append(records(mode=MODE.POSITION, position=0.1, axis=index), [0, 1], rig.now_ns, replace=replace)
        rig.now_ns += 200_000
        try:
            said.append(VERBS[name](rig.bank, rig.now_ns))
        except CommandError as error:
            said.append(str(error))
        rig.now_ns += 400_000 - rig.tick_ns
        rig.tick(80)
    if name == "offer":
        return  # the long way does not take what it offers
    assert said[:1] == said[1:]
    for index in (0, 1):
        for row in ("commanded_position", "status", "buffered", "in_motion"):
            short, long = (rig.trace(row, index) for rig in rigs)
            assert np.allclose(short[5:], long[5:], rtol=0, atol=MOVED), row


def test_a_long_write_is_judged_in_pieces_and_taken_apart_from_them() -> None:
    rig = Rig([axis()], capacity=4096)
    judgement, looked = rig.bank.judge(records(mode=MODE.POSITION, position=[0.0] * 1000), [0], rig.now_ns), []
    check = rig.bank._queue._validator.check
    rig.bank._queue._validator.check = lambda piece, placed: looked.append(len(piece)) or check(piece, placed)
    steps = []
    try:
        while True:
            looked.clear()
            next(judgement)
            steps.append(sum(looked))
    except StopIteration:
        assert not looked  # what is good is taken in a step of its own
    assert steps == [0, 256, 256, 256, 232]
