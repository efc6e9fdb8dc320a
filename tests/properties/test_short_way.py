"""Commands that begin the short way move and tell what they do by the sequencer: the same numbers bit for bit."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import AxisKind, Backlash, CommandError
from sioms.motion.short_way import ShortWay

WEAK = {"jerk_max": None, "following_error_max": np.inf, "force_max": 2.0}
AXES = (
    {"position_min": -0.2, "position_max": 0.2},
    {**WEAK, "kb": -2.0},
    {"kind": AxisKind.STEPPER, "k": None, "start_velocity": 0.05},
    {"backlash": Backlash(0.01)},
)
"""One that follows, one that cannot, a stepper with a start velocity, one that takes up its play."""
LIMITED = MODE.SPECIFIED_MAX_VEL_ACC
value = st.floats(-0.5, 0.5)
index = st.integers(0, len(AXES) - 1)
plain = st.one_of(
    st.builds(lambda i, p: {"axis": i, "mode": MODE.POSITION, "position": p}, index, value),
    st.builds(lambda i: {"axis": i, "mode": MODE.POSITION, "position": 0.0}, index),
    st.builds(lambda i, v: {"axis": i, "mode": MODE.VELOCITY, "velocity": v}, index, value),
    st.builds(lambda i, a: {"axis": i, "mode": MODE.ACCELERATION, "acceleration": a}, index, value),
    st.builds(
        lambda i, p, v, a: {
            "axis": i, "mode": MODE.POSITION | LIMITED, "position": p, "max_velocity": v, "max_acceleration": a,
        },
        index, value, st.floats(0.05, 2.0), st.floats(0.5, 5.0),
    ),
)  # fmt: skip
other = st.one_of(
    st.builds(lambda i, f: {"axis": i, "mode": MODE.FORCE, "force": f}, index, value),
    st.builds(
        lambda i, p: {"axis": i, "mode": MODE.POSITION | MODE.WAIT_FOR_EXTERNAL_SYNCH, "position": p}, index, value
    ),
    st.builds(
        lambda i, p, t: {"axis": i, "mode": MODE.POSITION | MODE.SPECIFIED_TIME, "position": p, "time": t},
        index, value, st.floats(1e-4, 0.5),
    ),
)  # fmt: skip
write = st.tuples(
    st.lists(st.one_of(plain, plain, plain, other), min_size=1, max_size=3), st.booleans(),
    st.floats(0.0, 0.9),
)  # fmt: skip
verb = st.sampled_from(["stop", "emergency", "flush", "synch", "fault"])
turn = st.tuples(st.one_of(write, write, write, verb), st.integers(0, 50), st.booleans())


class Plant:
    """What pushes back: the second axis follows its force, the stepper its output, the others their set-points."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.velocity = rig, 0.0

    def __call__(self, output: np.ndarray, dt: float) -> np.ndarray:
        position = self.rig.raw + self.rig.bank.rows["following_error"]
        self.velocity += (output[1] - 5.0 * self.velocity) * dt
        position[1] = self.rig.raw[1] + self.velocity * dt
        position[2] = output[2]
        return position


def rig(*, short: bool) -> Rig:
    made = Rig([axis(**more) for more in AXES])
    made.plant = Plant(made)
    if not short:
        made.bank._short_way.begin = lambda *_, **__: False
    return made


def do(made: Rig, act: object) -> None:
    bank = made.bank
    try:
        if isinstance(act, tuple):
            commands, replace, part = act
            written = np.concatenate([records(**command) for command in commands])
            bank.append(written, made.axes, made.now_ns + int(part * made.tick_ns), replace=replace)
        elif act == "stop":
            bank.stop([0, 2], made.now_ns)
        elif act == "emergency":
            bank.emergency_stop([1], made.now_ns)
            bank.reset([1])
        elif act == "fault":
            bank.fault([3], "a test", made.now_ns)
            bank.reset(made.axes)
        elif act == "synch":
            bank.synch(made.axes, made.now_ns, made.now_ns)
        else:
            bank.flush([0, 1])
    except CommandError:
        pass


def turn_of(axis_index: int, replace: bool, ticks: int, **fields: object) -> object:
    return (([{"axis": axis_index, **fields}], replace, 0.5), ticks, True)


BEHIND = [
    turn_of(1, False, 60, mode=MODE.POSITION, position=0.5),
    turn_of(1, True, 40, mode=MODE.POSITION, position=0.45),
]
TAKEN_UP = [
    turn_of(3, False, 600, mode=MODE.POSITION, position=0.05),
    turn_of(3, False, 300, mode=MODE.POSITION, position=0.055),
    turn_of(3, True, 300, mode=MODE.POSITION, position=0.06),
]
AT_LIMIT = [
    turn_of(0, False, 600, mode=MODE.VELOCITY, velocity=0.5),
    turn_of(0, True, 5, mode=MODE.POSITION, position=0.0),
]
STOPPED = [turn_of(0, False, 60, mode=MODE.POSITION, position=0.2), ("stop", 2, True), AT_LIMIT[1]]


@settings(max_examples=40)
@example(BEHIND)
@example(TAKEN_UP)
@example(AT_LIMIT)
@example(STOPPED)
@given(st.lists(turn, min_size=1, max_size=10))
def test_the_short_way_and_the_sequencer_do_the_same(turns):
    rigs = [rig(short=True), rig(short=False)]
    for act, ticks, plan in turns:
        for made in rigs:
            do(made, act)
            for _ in range(ticks):
                made.tick(plan=plan)
                made.history[-1]["stopped"] = made.bank.stopped.copy()
    for made in rigs:
        made.tick(100)
    short, general = rigs
    assert short.events == general.events
    for ours, theirs in zip(short.history, general.history, strict=True):
        for name in ours:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    assert short.bank.ends() == general.bank.ends() or np.isnan(short.bank.ends()).any()
    assert short.bank.room(short.axes) == general.bank.room(general.axes)


def test_set_points_in_a_row_and_moves_from_rest_take_it(monkeypatch):
    taken, begin = [], ShortWay.begin

    def note(self, commands, now_ns, *, replace):
        taken.append((begin(self, commands, now_ns, replace=replace), replace))
        return taken[-1][0]

    monkeypatch.setattr(ShortWay, "begin", note)
    made = rig(short=True)
    do(made, ([{"axis": 0, "mode": MODE.POSITION, "position": 0.1}], False, 0.0))
    made.tick(20)
    for position in (0.2, 0.1):
        do(made, ([{"axis": i, "mode": MODE.POSITION, "position": position} for i in (0, 1)], True, 0.5))
        made.tick()
    assert taken == [(True, False), (True, True), (True, True)]
    do(made, ([{"axis": 0, "mode": MODE.POSITION, "position": -0.1}], False, 0.5))  # behind what runs
    made.tick()
    assert taken[-1] == (False, False)
