"""Any sequence of commands and stops keeps limits and continuity, and is taken whole or not at all."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import AxisKind, CommandError, EventKind
from sioms.motion.profile import Bounds, InfeasibleError, Planner, enclosures, leaves, quintic

V, A, J, P = 2.0, 5.0, 100.0, 3.0
TIMED, PASS = MODE.SPECIFIED_TIME, MODE.POSITION | MODE.VELOCITY
position = st.floats(-P, P)
velocity = st.floats(-V, V)
time_s = st.floats(1e-4, 1.5)

command = st.one_of(
    st.builds(lambda p: {"mode": MODE.POSITION, "position": p}, position),
    st.builds(lambda p: {"mode": MODE.POSITION | MODE.RELATIVE, "position": p}, st.floats(-0.5, 0.5)),
    st.builds(lambda p, t: {"mode": MODE.POSITION | TIMED, "position": p, "time": t}, position, time_s),
    st.builds(lambda p, v: {"mode": PASS, "position": p, "velocity": v}, position, velocity),
    st.builds(
        lambda p, v, t: {"mode": PASS | TIMED, "position": p, "velocity": v, "time": t}, position, velocity, time_s
    ),
    st.builds(lambda v, t: {"mode": MODE.VELOCITY | TIMED, "velocity": v, "time": t}, velocity, time_s),
    st.builds(lambda v: {"mode": MODE.VELOCITY, "velocity": v}, velocity),
    st.builds(lambda a, t: {"mode": MODE.ACCELERATION | TIMED, "acceleration": a, "time": t}, st.floats(-A, A), time_s),
    st.builds(lambda j, t: {"mode": MODE.JERK | TIMED, "jerk": j, "time": t}, st.floats(-J, J), time_s),
    st.builds(
        lambda p, v, a: {
            "mode": MODE.POSITION | MODE.SPECIFIED_MAX_VEL_ACC,
            "position": p,
            "max_velocity": v,
            "max_acceleration": a,
        },
        position,
        st.floats(0.1, V),
        st.floats(0.5, A),
    ),
)
step = st.one_of(
    st.tuples(st.just("append"), command, st.integers(1, 400)),
    st.tuples(st.just("replace"), command, st.integers(1, 400)),
    st.tuples(st.just("stop"), st.none(), st.integers(1, 200)),
    st.tuples(st.just("emergency"), st.none(), st.integers(1, 200)),
    st.tuples(st.just("flush"), st.none(), st.integers(1, 50)),
)


def apply(rig, verb, fields):
    try:
        if verb in ("append", "replace"):
            rig.bank.append(records(**fields), rig.axes, rig.now_ns, replace=verb == "replace")
        elif verb == "stop":
            rig.bank.stop(rig.axes, rig.now_ns)
        elif verb == "flush":
            rig.bank.flush(rig.axes)
        else:
            rig.bank.emergency_stop(rig.axes, rig.now_ns)
    except CommandError:
        pass
    if verb == "emergency" or rig.bank.fault_text(0):
        rig.bank.reset(rig.axes)


def check_set_points(rig):
    h = rig.tick_ns * 1e-9
    p, v = rig.trace("commanded_position"), rig.trace("commanded_velocity")
    assert all(np.isfinite(list(h.values())).all() for h in rig.history)
    assert np.abs(p).max() <= P + 1e-7
    assert np.abs(v).max() <= V * (1 + 1e-6)
    # stops and limit stops use the maximum deceleration; between two ticks velocity changes by a h at most
    assert np.abs(np.diff(v)).max(initial=0) <= A * h * (1 + 1e-4) + 1e-9
    # position moves by the mean velocity: no jumps
    assert np.abs(np.diff(p) - 0.5 * (v[1:] + v[:-1]) * h).max(initial=0) <= A * h * h


@settings(max_examples=60)
@given(st.lists(step, min_size=1, max_size=8), st.sampled_from([1_000_000, 700_000, 5_000_000]))
def test_any_sequence_keeps_limits_and_continuity(steps, tick_ns):
    rig = Rig([axis()], tick_ns=tick_ns)
    for verb, fields, ticks in steps:
        apply(rig, verb, fields)
        rig.tick(ticks)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(math.ceil(V / A / (tick_ns * 1e-9)) + 2)
    assert rig.bank.is_idle(rig.axes)
    check_set_points(rig)
    started, ended = rig.kinds().count(EventKind.STARTED), rig.kinds().count(EventKind.ENDED)
    assert ended <= started


@settings(max_examples=40)
@given(st.lists(command, min_size=1, max_size=6), st.booleans())
def test_planning_ahead_changes_nothing_but_when_the_work_is_done(commands, stepper):
    kind = AxisKind.STEPPER if stepper else AxisKind.SERVO
    rigs = [Rig([axis(kind=kind, k=None if stepper else 100.0)]) for _ in range(2)]
    for fields in commands:
        for rig in rigs:
            apply(rig, "append", fields)
    for rig, plan in zip(rigs, (True, False), strict=True):
        rig.tick(1500, plan=plan)
    difference = rigs[0].trace("commanded_position") - rigs[1].trace("commanded_position")
    assert np.abs(difference).max() <= 1e-9


@settings(max_examples=60)
@given(st.lists(command, min_size=1, max_size=30), st.data())
def test_an_array_is_taken_whole_or_not_at_all(commands, data):
    rig = Rig([axis(), axis()])
    written = np.concatenate([records(**c, axis=data.draw(st.integers(0, 1))) for c in commands])
    bad = data.draw(st.none() | st.integers(0, len(commands) - 1))
    if bad is not None:
        field, value = data.draw(st.sampled_from([("axis", 2), ("control_mode", 0x30), ("control_mode", 0x80000008)]))
        written[field][bad] = value
    before = rig.bank.room([0]) + rig.bank.room([1])
    try:
        rig.bank.append(written, rig.axes, rig.now_ns)
        taken = True
    except CommandError:
        taken = False
    assert not (taken and bad is not None)
    started = sum(len(e.axes) for e in rig.bank.take_events() if e.kind is EventKind.STARTED)
    gone = before - rig.bank.room([0]) - rig.bank.room([1])
    assert gone + started == (len(commands) if taken else 0) or bool(rig.bank.fault_text(0) or rig.bank.fault_text(1))


@settings(max_examples=60)
@given(st.lists(st.tuples(st.floats(-0.02, 0.02), st.floats(0.02, 0.3)), min_size=2, max_size=40))
def test_timed_pieces_end_where_and_when_they_say(pieces):
    """n timed pieces: the k-th knot is met at the exact sum of the times before it, for any k."""
    rig = Rig([axis()])
    ends, times = np.cumsum([d for d, _ in pieces]), [t for _, t in pieces]
    try:
        rig.write(mode=[MODE.POSITION | TIMED] * len(pieces), position=ends, time=times)
    except CommandError:
        return
    begin, knots = rig.now_ns, np.cumsum(times)
    rig.tick(math.ceil(knots[-1] * 1e3) + 2)
    assert rig.bank.is_idle([0])
    p = rig.trace("commanded_position")[1:]
    s = 1e-3 * np.arange(1, len(p) + 1)
    for knot, end in zip(knots, ends, strict=True):
        i = int(np.searchsorted(s, knot))
        assert abs(p[i] - end) <= 0.5 * A * 1e-6 * 4 + 1e-7  # at rest at the knot: at most a h^2 / 2 away a tick later
    idle = [e.stamp_ns for e in rig.events if e.kind is EventKind.IDLE]
    assert -1 <= idle[-1] - begin - knots[-1] * 1e9 <= 1e6 + 1


state = st.tuples(position, velocity, st.floats(-A, A))


@settings(max_examples=80)
@given(state, state, st.floats(0.01, 3.0))
def test_quintic_meets_both_ends_and_bernstein_encloses_it(begin, end, time):
    c = quintic(begin, end, time)
    x = np.linspace(0, time, 201)
    p = np.polynomial.polynomial.Polynomial(c)
    scale = max(1.0, *map(abs, c)) * max(1.0, time) ** 5
    for derivative, index in ((p, 0), (p.deriv(), 1), (p.deriv(2), 2)):
        assert abs(derivative(0.0) - begin[index]) <= 1e-9 * scale
        assert abs(derivative(time) - end[index]) <= 1e-9 * scale
    for bernstein, curve in zip(enclosures(c, time), (p, p.deriv(), p.deriv(2)), strict=True):
        values = curve(x)
        slack = 1e-9 * scale
        assert min(bernstein) - slack <= values.min() and values.max() <= max(bernstein) + slack
        middle = 0.5 * (values.min() + values.max())
        if values.max() - values.min() > 1e-3:
            assert leaves(bernstein, values.min(), middle)


@settings(max_examples=80)
@given(command, st.tuples(st.floats(-1, 1), velocity, st.floats(-A, A)))
def test_a_plan_begins_where_it_is_told_and_is_continuous(fields, begin):
    from sioms.motion.commands import COMMAND_DTYPE, Command

    written = np.zeros(1, dtype=COMMAND_DTYPE)
    for name, value in fields.items():
        written["control_mode" if name == "mode" else name] = int(value) if name == "mode" else value
    try:
        plan = Planner().plan(Command._make(written[0].item()), begin, Bounds(V, A, J, -P, P))
    except InfeasibleError:
        return
    at = begin
    for t, *c in plan.segments:
        p = np.polynomial.polynomial.Polynomial(c)
        assert abs(p(0.0) - at[0]) <= 1e-6 and abs(p.deriv()(0.0) - at[1]) <= 1e-6
        assert abs(p.deriv(2)(0.0) - at[2]) <= 1e-5
        if math.isfinite(t):
            at = p(t), p.deriv()(t), p.deriv(2)(t)
    assert abs(at[0] - plan.final[0]) <= 1e-6 and abs(at[1] - plan.final[1]) <= 1e-6
    assert plan.duration == math.inf or abs(sum(s[0] for s in plan.segments) - plan.duration) <= 1e-9
