"""Every state of the skills, every fault: the hand is at rest in the end, and the fault is named."""

from __future__ import annotations

import copy
import errno
import math
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import pytest

from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.running import carried_out
from sioms.hand.shape import Touch
from sioms.hand.skills import Skills, _touches
from sioms.hand.touch import Failed, Fault, Felt, Manner, Reading, Sensed, Setpoint, State
from sioms.plant.outline import polygon
from sioms.plant.planar import Body

MM = 1e-3
RIG = Rig(every=4, compiled=False, free_m=1e-3, open_m=0.1)
MANNER = Manner(force_n=0.5, frames=10, tap_frames=20)
HULL = polygon([(-24 * MM, -14 * MM), (20 * MM, -20 * MM), (26 * MM, 6 * MM), (-6 * MM, 24 * MM)], 2 * MM)
STATES = (State.OPEN, State.CLOSE, State.SENSE, State.FEEL, State.ROLL, State.HOLD)
"""Those in which the hand moves or waits; IDLE, CLASSIFY and REGRASP take no tick of their own."""


@lru_cache(maxsize=1)
def _grasped() -> tuple[PlaneHand, Skills, Sensed]:
    hand = PlaneHand(Body(HULL), (2 * MM, 3 * MM, 0.2), RIG, seed=1)
    skills = Skills(hand.hand, hand.reading, MANNER)
    return hand, skills, hand.run(skills.grasp())


@dataclass
class Trial:
    """A skill in the state that is asked for, and what is done to it from the tenth tick there on."""

    hand: PlaneHand
    skills: Skills
    ticks: Generator[Setpoint, Reading, Any]
    harm: Callable[[Trial, Reading], Reading]
    state: State
    there: int = 0

    def tick(self, setpoint: Setpoint) -> Reading:
        """Go on by a tick; harm what is read."""
        if self.there > 10:
            return self.harm(self, self.hand.tick(setpoint))
        reading = self.hand.tick(setpoint)
        self.there += self.skills.state is self.state
        return reading

    def run(self) -> None:
        """Carry the skill out."""
        carried_out(self.ticks, self.tick, self.hand.reading.time_s, 60.0)


def _round(skills: Skills, found: Sensed) -> Generator[Setpoint, Reading, Any]:
    """Open and feel round the object, whatever a plan of the regrasp would be."""
    yield from skills._open()
    return (yield from skills._feel_round(_touches(found)))


def trial(state: State, harm: Callable[[Trial, Reading], Reading]) -> Trial:
    """Return a skill that comes to a state."""
    hand, skills, found = copy.deepcopy(_grasped())
    ticks: Any = {
        State.OPEN: skills.release, State.CLOSE: lambda: skills.regrasp(found), State.SENSE: skills.feel,
        State.FEEL: lambda: skills._guarded("regrasp", _round(skills, found)), State.ROLL: skills.roll,
        State.HOLD: lambda: skills.hold(0.5),
    }[state]  # fmt: skip
    skills.manner = replace(MANNER, taps=0 if state is State.CLOSE else 14, frames=60 if state is State.SENSE else 10)
    return Trial(hand, skills, ticks(), harm, state)


def fingers(change: Callable[[Felt], Felt]) -> Callable[[Trial, Reading], Reading]:
    """Return what changes all that finger 2 feels."""
    return lambda _, reading: replace(reading, fingers=(reading.fingers[0], change(reading.fingers[1])))


def halted(why: str) -> Callable[[Trial, Reading], Reading]:
    """Return what a hand of a cell says when its driver has halted it."""

    def raises(_: Trial, reading: Reading) -> Reading:
        raise OSError(errno.EIO, why)

    return raises


def dies(trial: Trial, reading: Reading) -> Reading:
    """Finger 2 gives no more frames."""
    trial.hand.silent.setdefault(1, trial.hand.world.time_s)
    return reading


def coincide(_: Trial, reading: Reading) -> Reading:
    """The fingers' centres are read at one place."""
    x, y, th, *_rest = reading.joints
    return replace(reading, joints=(x, y, th, x, y, th))


FAULTS: dict[str, tuple[Callable[[Trial, Reading], Reading], Fault, str]] = {
    "blind": (fingers(lambda _: Felt(None)), Fault.STALE, "finger 2 cannot be relied on: it is blind"),
    "late": (lambda _, reading: replace(reading, ages_s=(0.0, 0.3)), Fault.STALE, "finger 2 .* 0.30 s old"),
    "dead finger": (dies, Fault.STALE, "finger 2 cannot be relied on: its frame is 0.1"),
    "no age": (lambda _, reading: replace(reading, ages_s=(math.nan, 0.0)), Fault.STALE, "finger 1 .* nan s old"),
    "no force": (fingers(lambda felt: replace(felt, force=math.nan)), Fault.STALE, "its force is not known"),
    "time stands": (
        lambda trial, reading: replace(reading, time_s=trial.skills.now.time_s), Fault.STALE, "do not go on in time",
    ),
    "overload": (fingers(lambda felt: replace(felt, force=9.0)), Fault.OVERLOAD, "finger 2 bears 9.0 N"),
    "singular": (coincide, Fault.SINGULAR, "distance of the fingers' centres is 0.0 m"),
    "no place": (
        lambda _, reading: replace(reading, joints=(math.nan, *reading.joints[1:])), Fault.SINGULAR, "centres is nan m",
    ),
    "lost axis": (halted("left: its device is gone"), Fault.HALTED, "left: its device is gone"),
    "lost world": (halted("right: in fault, its world is gone"), Fault.HALTED, "its world is gone"),
    "stop": (halted("hand: emergency stop"), Fault.HALTED, "hand: emergency stop"),
    "lease": (halted("hand: the lease of its client is over"), Fault.HALTED, "the lease"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("state", STATES, ids=lambda state: state.value)
def test_every_fault_in_every_state_is_named_and_ends_at_rest(state: State, fault: str) -> None:
    harm, named, words = FAULTS[fault]
    one = trial(state, harm)
    with pytest.raises(OSError if named is Fault.HALTED else Failed, match=words):
        one.run()
    assert one.there > 10 and one.skills.state is State.FAULT and not one.skills.holds
    last = one.skills.events[-1]
    assert last.fault is named and one.skills._what in last.text
    _rests(one)


@pytest.mark.parametrize("state", [State.CLOSE, State.SENSE, State.FEEL, State.ROLL, State.HOLD], ids=lambda s: s.value)
def test_a_finger_that_turns_doubtful_is_told(state: State) -> None:
    one = trial(state, fingers(lambda felt: replace(felt, doubt="POOR_FIT")))
    with pytest.raises(Failed, match=r"finger 2 says 'POOR_FIT' in \d+ of \d+ frames") as failed:
        one.run()
    assert failed.value.fault is one.skills.events[-1].fault is Fault.DOUBTFUL
    _rests(one)


def test_what_no_module_reaches_any_more_is_not_moved_to() -> None:
    one = trial(State.CLOSE, lambda trial, reading: reading)
    one.skills.manner = replace(MANNER, reach=(-1.0, 1.0, 0.5, 1.0))
    with pytest.raises(Failed, match=r"regrasp object: module 1 would have to be at") as failed:
        one.run()
    assert failed.value.fault is Fault.OUT_OF_REACH
    _rests(one)


def test_the_first_fault_is_told_whatever_ends_while_the_hand_lets_go() -> None:
    def pressed_then_halted(trial: Trial, reading: Reading) -> Reading:
        if trial.skills.state is State.FAULT:
            raise OSError(errno.EIO, "left: its device is gone")
        return replace(reading, fingers=(reading.fingers[0], replace(reading.fingers[1], force=9.0)))

    one = trial(State.HOLD, pressed_then_halted)
    with pytest.raises(Failed, match="finger 2 bears 9"):
        one.run()
    assert one.skills.events[-1].fault is Fault.OVERLOAD


def test_a_finger_that_presses_and_tells_no_place_is_told() -> None:
    """Its force stops the tap, its frames lack the place: nothing but time ends that."""
    one = trial(State.FEEL, fingers(lambda _: Felt(True, math.nan, force=0.2)))
    one.skills.manner = replace(MANNER, close_s=12.0)
    with pytest.raises(Failed, match=r"after 12 s finger 2 has told no place where it touches; its force is 0.20 N"):
        one.run()
    assert one.skills.events[-1].fault is Fault.DOUBTFUL
    _rests(one)


def test_a_finger_that_touches_beside_its_array_has_met_nothing() -> None:
    beside = fingers(lambda felt: replace(felt, doubt="OUT_OF_ARC|IMPRECISE"))
    one = trial(
        State.FEEL, lambda trial, reading: beside(trial, reading) if trial.skills.state is State.FEEL else reading
    )
    one.skills.manner = replace(MANNER, taps=1)
    one.run()
    told = [event.text for event in one.skills.events if "places round it" in event.text]
    assert told == ["felt 2 places round it: no parallel grasp"]


def test_touches_that_leave_nothing_between_them_end_as_too_small() -> None:
    one = trial(State.FEEL, lambda _, reading: reading)
    foil = [
        Touch((x, sign * 1e-4), sign * 0.5 * math.pi, math.inf, math.inf) for x in (-5e-3, 5e-3) for sign in (1.0, -1.0)
    ]
    one.hand.run(one.skills.release())
    one.ticks = one.skills._guarded("feel", one.skills._feel_round(foil))
    with pytest.raises(Failed, match=r"by 0 touches round it 0 mm are left of it; want one wider than 5 mm") as failed:
        one.run()
    assert failed.value.fault is Fault.TOO_SMALL
    _rests(one)


def _rests(one: Trial) -> None:
    """Nothing moves any more, and nobody commands it to."""
    hand = one.hand
    joints = list(hand.joints)
    for _ in range(200):
        hand.tick(Setpoint(tuple(one.skills._goal), (0.0,) * 6, 0.0, frozen=True))
    assert hand.joints == joints
    assert max(abs(v) for finger in hand.world.fingers for v in finger.speed) < 2e-4
    assert max(map(abs, hand.world.speed)) < 2e-4
