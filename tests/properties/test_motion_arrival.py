"""Any history of moves, jogs, replacements and stops: a place is reached from its side, inside the limits, or not at
all.

The independent fact is a load with play behind the motor: it follows only when the play is used up, so where it
stands tells from which side the motor came last, and that it came far enough.
"""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis

from sioms.motion import Arrival, AxisKind, Backlash, CommandError, EventKind
from sioms.protocol.flags import AxisStatus as S

V, A, P = 2.0, 5.0, 3.0
PLAY = 0.08
TICK_NS = 5_000_000
TICK_S = TICK_NS * 1e-9
position = st.floats(-P, P)
distance = st.sampled_from([0.1, -0.1, 0.35])

step = st.one_of(
    st.tuples(st.just("move"), position),
    st.tuples(st.just("move"), position),
    st.tuples(st.just("tweak"), st.floats(-0.15, 0.15)),
    st.tuples(st.just("replace"), position),
    st.tuples(st.just("jog"), st.floats(-V, V)),
    st.tuples(st.just("stop"), st.none()),
    st.tuples(st.just("emergency_stop"), st.none()),
)
history = st.lists(st.tuples(step, st.integers(1, 200)), min_size=1, max_size=6)


class Loose(Rig):
    """An axis that follows exactly, and its load behind the play."""

    def __init__(self, given, **changes):
        self.load = 0.0
        super().__init__([given], plant=self.follow, tick_ns=TICK_NS, **changes)

    def follow(self, _output, _dt):
        motor = self.raw + self.bank.rows["following_error"]
        self.load = float(np.clip(self.load, motor[0] - PLAY / 2, motor[0] + PLAY / 2))
        return motor

    def do(self, verb, value):
        try:
            if verb in ("move", "replace"):
                self.write(mode=MODE.POSITION, position=value, replace=verb == "replace")
            elif verb == "tweak":
                self.write(mode=MODE.POSITION | MODE.RELATIVE, position=value)
            elif verb == "jog":
                self.write(mode=MODE.VELOCITY, velocity=value, replace=True)
            else:
                getattr(self.bank, verb)([0], self.now_ns)
                self.check_that_it_only_brakes()
        except CommandError:
            return False
        return True

    def check_that_it_only_brakes(self):
        before = self.field("commanded_velocity")
        begin = len(self.history)
        self.tick(math.ceil(V / A / TICK_S) + 40)
        v = self.trace("commanded_velocity")[begin:]
        assert (v * np.sign(before) >= -1e-9).all() and abs(v[-1]) <= 1e-9, "a stop turns round"
        self.bank.reset([0])


@settings(max_examples=15)
@given(distance, st.booleans(), history)
def test_whatever_came_before_the_load_ends_at_the_same_side_of_its_play(backlash, slow, steps):
    given = axis(backlash=Backlash(backlash, velocity=0.3 if slow else None), arrival=Arrival(settle_s=0.01))
    rig = Loose(given)
    for (verb, value), ticks in steps:
        rig.do(verb, value)
        rig.tick(ticks)
        if rig.bank.fault_text(0):
            rig.bank.reset([0])
    rig.bank.stop([0], rig.now_ns)
    rig.run()
    target = steps[0][1] / 1e3 - 0.4
    assert rig.do("move", target)
    rig.run()
    assert rig.field("commanded_position") == target
    assert abs(rig.load - (target - math.copysign(PLAY / 2, backlash))) <= 1e-9
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    assert np.abs(p).max() <= P + 1e-7 and np.abs(v).max() <= V * (1 + 1e-6)
    assert np.abs(np.diff(v)).max(initial=0) <= A * TICK_S * (1 + 1e-4) + 1e-9


@settings(max_examples=15)
@given(st.lists(st.floats(-0.3, 0.3), min_size=1, max_size=12), st.sampled_from([0.1, -0.1]))
def test_every_tweak_of_a_chain_arrives_with_its_play_taken_up(steps, backlash):
    rig = Loose(axis(backlash=Backlash(backlash)))
    place = 0.0
    for by in steps:
        if not rig.do("tweak", by):
            continue
        place += by
        rig.run()
        assert abs(rig.field("commanded_position") - place) <= 1e-9
        assert abs(rig.load - (place - math.copysign(PLAY / 2, backlash))) <= 1e-9


@settings(max_examples=15)
@given(
    st.lists(st.floats(-0.05, 0.05), min_size=1, max_size=12),
    st.integers(0, 4),
    st.lists(position, min_size=1, max_size=3),
)
def test_a_stepper_is_where_its_encoder_says_or_says_that_it_is_not(losses, retries, places):
    """Steps are lost whenever it comes to rest, any number of times."""
    left, state = list(losses), {"last": 0.0, "lost": 0.0, "moved": False}

    def plant(output, _dt):
        moved = abs(output[0] - state["last"]) > 1e-9
        if state["moved"] and not moved and left:
            state["lost"] += left.pop(0)
        state["last"], state["moved"] = float(output[0]), moved
        return output - state["lost"]

    rig = Rig(
        [axis(kind=AxisKind.STEPPER, k=None, arrival=Arrival(0.01, 1e-3, retries))],
        plant=plant,
        tick_ns=TICK_NS,
    )
    for place in places:
        rig.write(mode=MODE.POSITION, position=place)
        rig.run()
        missed = bool(rig.field("status") & S.MISSED_TARGET)
        assert missed == (abs(rig.field("position") - place) > 1e-3)
        assert rig.bank.diagnostics([0])["retries"][0] <= retries
    assert rig.kinds().count(EventKind.ENDED) == len(places)


@settings(max_examples=15)
@given(st.lists(st.tuples(position, st.integers(1, 300)), min_size=1, max_size=5), st.floats(0.01, 0.5))
def test_a_start_velocity_keeps_the_limits_and_ends_exactly(moves, jump):
    rig = Rig([axis(kind=AxisKind.STEPPER, k=None, start_velocity=jump)], tick_ns=TICK_NS)
    for place, ticks in moves:
        rig.write(mode=MODE.POSITION, position=place, replace=True)
        rig.tick(ticks)
    rig.run()
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    assert p[-1] == moves[-1][0] and np.abs(p).max() <= P + 1e-7 and np.abs(v).max() <= V * (1 + 1e-6)
    speed = np.diff(p) / TICK_S
    change = np.abs(np.diff(speed))
    assert change.max(initial=0) <= 2 * jump + 3 * A * TICK_S
    fast = np.minimum(np.abs(speed[1:]), np.abs(speed[:-1])) > jump + 2 * A * TICK_S
    assert change[fast].max(initial=0) <= 3 * A * TICK_S, "above the start velocity it ramps"
