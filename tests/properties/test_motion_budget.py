"""However short and many the commands are, a tick begins few of them: in order, none lost, and nobody else notices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import EventKind

TIMED, PASS = MODE.SPECIFIED_TIME, MODE.POSITION | MODE.VELOCITY
TICK_S = 1e-3

no_op = st.just({"mode": MODE.POSITION | MODE.RELATIVE, "position": 0.0})
brief = st.floats(1e-9, 4e-4)
at_rest = st.one_of(
    no_op,
    st.builds(lambda t: {"mode": MODE.POSITION | MODE.RELATIVE | TIMED, "position": 0.0, "time": t}, brief),
)
in_motion = st.one_of(
    no_op,
    st.builds(lambda v, t: {"mode": MODE.VELOCITY | TIMED, "velocity": v, "time": t}, st.floats(-0.1, 0.1), brief),
    st.builds(lambda f, t: {"mode": MODE.FORCE | TIMED, "force": f, "time": t}, st.floats(-1, 1), brief),
)
mixes = st.one_of(st.lists(at_rest, min_size=1, max_size=6), st.lists(in_motion, min_size=1, max_size=6))


def begun_a_tick(rig: Rig, most_ticks: int) -> list[int]:
    """Tick until all axes are idle; return how many commands began in each tick."""
    counts = []
    for _ in range(most_ticks):
        rig.events.clear()
        rig.tick()
        counts.append(sum(len(e.axes) for e in rig.events if e.kind is EventKind.STARTED))
        if rig.bank.is_idle(rig.axes):
            break
    return counts


@settings(max_examples=30, deadline=None)
@given(mix=mixes, axes=st.integers(1, 3), replace=st.booleans())
def test_a_tick_begins_few_commands_however_short_they_are(mix, axes, replace):
    rig = Rig([axis(name=f"a{i}") for i in range(axes)], tick_ns=int(TICK_S * 1e9))
    written = np.concatenate(
        [records(axis=list(range(axes)), **{k: [v] * axes for k, v in c.items()}) for c in mix * 10]
    )
    rig.bank.append(written, rig.axes, rig.now_ns, replace=replace)
    counts = begun_a_tick(rig, 20 * len(written))
    assert sum(counts) == len(written), "none is lost"
    assert rig.bank.is_idle(rig.axes)
    # In motion four short ones an axis, at rest one, and two that all share; none of them is longer.
    assert max(counts) <= 5 * axes + 2


def test_no_ops_that_one_write_brings_take_as_many_ticks_as_they_need_and_signal_in_order():
    rig = Rig([axis(), axis(name="y")])
    tokens = [rig.markers.reserve(n) for n in range(1, 9)]
    signals = [tokens[i // 50] if i % 50 == 0 else 0 for i in range(400)]
    mode = [MODE.POSITION | (MODE.SPECIFIED_SIGNAL_MARKER if s else 0) for s in signals]
    written = records(mode=mode, position=[0.0] * 400, signal_marker_number=signals)
    rig.bank.append(written, rig.axes, rig.now_ns)
    counts = begun_a_tick(rig, 1000)
    assert 100 <= len(counts) < 400 and max(counts) <= 6 and max(counts[1:]) <= 3
    assert [number for number, _ in rig.markers.signals] == list(range(1, 9))


@pytest.mark.parametrize("verb", ["stop", "emergency_stop", "flush"])
def test_a_stop_drops_what_waits_for_its_tick(verb):
    rig = Rig([axis()])
    rig.bank.append(records(mode=MODE.POSITION, position=[0.0] * 1000), rig.axes, rig.now_ns)
    rig.tick(3)
    getattr(rig.bank, verb)(rig.axes, *([rig.now_ns] if verb != "flush" else []))
    rig.events.clear()
    rig.tick(20)
    assert rig.bank.is_idle(rig.axes)
    assert not [e for e in rig.events if e.kind is EventKind.STARTED]


def test_nobody_elses_motion_is_another_for_it():
    """Pieces of a tick's length in motion, set-points that replace one another: to the bit as without the flood."""

    def run(flooded: bool) -> np.ndarray:
        rig = Rig([axis(), axis(name="y"), axis(name="z")])
        times = np.arange(1, 300) * TICK_S
        rig.bank.append(
            records(mode=PASS | TIMED, position=0.1 * (1 - np.cos(3 * times)), velocity=0.3 * np.sin(3 * times),
                    time=[TICK_S] * len(times)), [0], rig.now_ns
        )  # fmt: skip
        if flooded:
            rig.bank.append(records(mode=MODE.POSITION, position=[0.0] * 3000), [1], rig.now_ns)
        for i in range(400):
            rig.bank.append(records(mode=MODE.VELOCITY, velocity=0.1 + 1e-4 * i), [2], rig.now_ns, replace=True)
            if flooded:
                rig.bank.is_idle([1])
            rig.tick()
        return np.array([[row[[0, 2]] for row in h.values()] for h in rig.history])

    assert np.array_equal(run(False), run(True))


def test_an_axis_that_is_told_too_often_goes_on_until_the_next_tick():
    rig = Rig([axis()], tick_ns=50_000_000, late_max_s=1.0)
    for i in range(40):  # not plain: judged and begun at once
        rig.bank.take(_judged(rig, 0.1 + 0.001 * i, rig.now_ns + i * 1_000_000), rig.now_ns + i * 1_000_000)
    rig.tick()
    began = [e for e in rig.events if e.kind is EventKind.STARTED]
    assert len(began) <= 6
    rig.tick(40)
    assert rig.field("commanded_velocity") == pytest.approx(0.139)
    assert np.all(np.diff(rig.trace("commanded_velocity")) >= -1e-9), "it never slowed down in between"


def _judged(rig, velocity, now_ns):
    from sioms.motion.queue import verdict

    written = records(
        mode=MODE.VELOCITY | MODE.SPECIFIED_MAX_VEL_ACC,
        velocity=velocity,
        max_velocity=1.0,
        max_acceleration=5.0,
    )
    return verdict(rig.bank.judge(written, rig.axes, now_ns, replace=True))
