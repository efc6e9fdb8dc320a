"""Any verbs in any order on a mixed bank: no stray exception, outputs finite and within limits, a stop stops."""

import numpy as np
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Rig, axis, records

from sioms.motion import SWITCH_HOME, SWITCH_MINUS, SWITCH_PLUS, AxisKind, CommandError, EventKind, Homing
from sioms.protocol.flags import AxisStatus as S

QUANTITY = st.sampled_from(
    [MODE.JERK, MODE.ACCELERATION, MODE.VELOCITY, MODE.POSITION, MODE.POSITION | MODE.VELOCITY, MODE.FORCE,
     MODE.FORCE_VELOCITY, MODE.POSITION | MODE.RELATIVE]
)  # fmt: skip
EXTRA = st.lists(
    st.sampled_from(
        [MODE.SPECIFIED_TIME, MODE.WAIT_FOR_EXTERNAL_SYNCH, MODE.SPECIFIED_GAINS, MODE.SPECIFIED_FORCE_OFFSET,
         MODE.SPECIFIED_MAX_VEL_ACC, MODE.SPECIFIED_MAX_FORCE, MODE.SPECIFIED_WAIT_MARKER, MODE.SPECIFIED_SIGNAL_MARKER]
    ), max_size=3,
)  # fmt: skip


@st.composite
def record(draw):
    mode = draw(QUANTITY)
    for flag in draw(EXTRA):
        mode |= flag
    return {
        "mode": mode, "axis": draw(st.integers(0, 2)), "position": draw(st.floats(-3, 3)),
        "velocity": draw(st.floats(-2, 2)), "acceleration": draw(st.floats(-5, 5)), "jerk": draw(st.floats(-100, 100)),
        "force": draw(st.floats(-10, 10)), "force_velocity": draw(st.floats(-100, 100)),
        "time": draw(st.sampled_from([-1.0, 0.001, 0.05, 0.3])), "k": draw(st.floats(0, 200)),
        "kb": draw(st.floats(-20, 0)), "kp": draw(st.floats(-0.5, 0.5)), "force_offset": draw(st.floats(-1, 1)),
        "max_velocity": draw(st.floats(0.1, 2)), "max_acceleration": draw(st.floats(0.5, 5)),
        "max_force": draw(st.floats(0.5, 10)), "signal_marker_number": draw(st.sampled_from([1, 2])),
        "wait_marker_number": draw(st.sampled_from([1, 2])),
    }  # fmt: skip


verb = st.one_of(
    st.tuples(st.just("write"), record()),
    st.tuples(st.just("write"), record()),
    st.tuples(st.just("replace"), record()),
    *[st.tuples(st.just(name), st.integers(0, 2)) for name in
      ("stop", "emergency_stop", "reset", "flush", "fault", "home", "zero", "limits", "nan")],
    st.tuples(st.just("synch"), st.integers(-3_000_000, 20_000_000)),
    st.tuples(st.just("signal"), st.sampled_from([1, 2])),
    st.tuples(st.just("free"), st.sampled_from([1, 2])),
    st.tuples(st.just("late"), st.integers(2, 120)),
)  # fmt: skip


class Chaos(Rig):
    """Two servos on masses and a stepper, with switches."""

    def __init__(self):
        homing = Homing(velocity=0.5, slow_velocity=0.05, offset=0.0, travel=2.0)
        self.speed = np.zeros(3)
        self.output = np.zeros(3)
        settings = [axis(homing=homing, k=400.0, kb=-40.0), axis(k=400.0, kb=-40.0, following_error_max=0.2),
                    axis(kind=AxisKind.STEPPER, k=None, homing=homing)]  # fmt: skip
        super().__init__(settings, plant=self.move)
        self.tokens = {n: self.markers.reserve(n) for n in (1, 2)}
        self.switches = lambda raw: (
            (raw < -3.2) * SWITCH_MINUS | (raw > 3.2) * SWITCH_PLUS | ((raw < -0.5) & (raw > -0.7)) * SWITCH_HOME
        )

    def move(self, output, dt):
        self.output = output.copy()
        assert np.isfinite(output).all()
        assert np.abs(output[:2]).max() <= 10.0
        raw = self.raw.copy()
        self.speed[:2] += (output[:2] - 2.0 * self.speed[:2]) / 1.0 * dt
        raw[:2] += self.speed[:2] * dt
        raw[2] = output[2]
        return raw

    def do(self, name, given):
        bank, now = self.bank, self.now_ns
        if name in ("write", "replace"):
            fields = dict(given)
            if fields["mode"] & MODE.SPECIFIED_SIGNAL_MARKER:
                fields["signal_marker_number"] = self.tokens[fields["signal_marker_number"]]
            bank.append(records(**fields), self.axes, now, replace=name == "replace")
        elif name == "synch":
            bank.synch(self.axes, now + given, now)
        elif name == "signal":
            self.markers.signal(given, self.markers.table.generation(given), now)
        elif name == "free":
            self.markers.table.free(given)
            self.tokens[given] = self.markers.reserve(given)
        elif name == "late":
            self.now_ns += given * self.tick_ns
        elif name == "limits":
            bank.set_limits([given], velocity_max=1.0)
        elif name == "nan":
            self.raw[given] = np.nan
            bank.tick(now, self.raw)
            self.raw[given] = self.bank.rows["position"][given]
        elif name in ("reset", "flush", "zero"):
            getattr(bank, name)([given])
        elif name == "fault":
            bank.fault([given], "broken")
        else:
            getattr(bank, name)([given], now)


@settings(max_examples=25, phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink))
@given(st.lists(st.tuples(verb, st.integers(0, 60)), min_size=1, max_size=12))
def test_any_verbs_in_any_order(steps):
    cell = Chaos()
    for (name, argument), ticks in steps:
        try:
            cell.do(name, argument)
        except CommandError as e:
            assert e.errno and str(e)
        cell.tick(ticks)
        assert np.isfinite(cell.bank.fields[:10]).all()
    cell.bank.emergency_stop(cell.axes, cell.now_ns)
    cell.tick(1)
    assert all(cell.field("buffered", i) == 0 for i in cell.axes)
    cell.tick(900)
    assert cell.bank.is_idle(cell.axes)
    assert all(cell.field("status", i) & S.EMERGENCY_STOP for i in cell.axes)
    assert not any(cell.field("status", i) & (S.MOVING | S.WAITING_MARKER | S.WAITING_SYNCH) for i in cell.axes)
    still = cell.bank.rows["commanded_velocity"].copy()
    held = [i for i in cell.axes if not cell.field("status", i) & S.FAULT]
    assert np.abs(still[2]) == 0.0 or 2 not in held
    cell.events.clear()
    cell.bank.reset(cell.axes)
    before = cell.bank.rows["commanded_position"].copy()
    cell.tick(20)
    assert EventKind.STARTED not in cell.kinds()
    assert np.array_equal(before[2:], cell.bank.rows["commanded_position"][2:])
