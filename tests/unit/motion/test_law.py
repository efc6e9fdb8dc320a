"""The control laws against the formula of section F.2.4, written out term by term."""

import numpy as np
import pytest

from sioms.motion import AxisKind, AxisSettings
from sioms.motion.axis_step import FORCE, HOLD, control, follow
from sioms.motion.law import ControlLaw


class Law(ControlLaw):
    """Laws by themselves: one tick from set-points and readings that are given."""

    def step(self, desired, desired_velocity, actual, velocity, dt, force_rows=None):
        arrays = self.arrays
        arrays["desired"][:], arrays["desired_velocity"][:] = desired, desired_velocity
        arrays["position"][:], arrays["velocity"][:] = actual, velocity
        self.kind[:] = HOLD if force_rows is None else np.where(force_rows, FORCE, HOLD)
        self.loop.dt = dt
        control(self.loop)

    def relax(self, axes):
        self.limp[:] = axes
        follow(self.loop)
        self.limp[:] = False


def law_of(*settings, tick_s=1e-3):
    return Law(settings, tick_s)


def test_servo_law_is_that_of_the_text_over_a_random_run():
    k, kz, kp, kb, offset, limit = 30.0, -0.7, 0.2, -4.0, 0.5, 8.0
    law = law_of(AxisSettings("x", k=k, kz=kz, kp=kp, kb=kb, force_offset=offset, force_max=limit))
    rng = np.random.default_rng(3)
    e_last = tau_last = 0.0
    clipped = 0
    for _ in range(200):
        desired, actual, v = rng.normal(0, 0.3, 3)
        law.step(np.array([desired]), np.zeros(1), np.array([actual]), np.array([v]), 1e-3)
        e = desired - actual
        u = k * (e + kz * e_last) - kp * tau_last + kb * v + offset
        tau = min(max(u, -limit), limit)
        assert law.output[0] == pytest.approx(tau, abs=1e-12)
        assert bool(law.saturated[0]) == (u != tau)
        clipped += u != tau
        e_last, tau_last = e, tau
    assert 0 < clipped < 200


def test_the_clipped_torque_is_fed_back_not_the_wish():
    law = law_of(AxisSettings("x", k=100.0, kp=0.5, force_max=1.0))
    for desired, expected in ((1.0, 1.0), (0.0, -0.5)):  # tau[0] = 1, u[1] = -0.5 * 1
        law.step(np.array([desired]), np.zeros(1), np.zeros(1), np.zeros(1), 1e-3)
        assert law.output[0] == expected


def test_force_mode_is_force_plus_damping_plus_offset():
    law = law_of(*[AxisSettings("x", k=100.0, kb=-2.0, force_offset=0.25, force_max=10.0)] * 2)
    law.step(np.array([3.0, 1.0]), np.zeros(2), np.zeros(2), np.array([0.5, 0.0]), 1e-3, np.array([True, False]))
    assert law.output.tolist() == [3.0 - 2.0 * 0.5 + 0.25, 10.0]


def test_stepper_is_dead_beat_by_default():
    law = law_of(AxisSettings("x", kind=AxisKind.STEPPER, velocity_max=1.0, acceleration_max=10.0))
    t = np.arange(1, 300) * 1e-3
    velocity = 9.0 * np.minimum(t, 0.1)
    for position, v in zip(0.5 * velocity * np.minimum(t, 0.1) + 0.9 * np.maximum(t - 0.1, 0), velocity, strict=True):
        law.step(np.array([position]), np.array([v]), np.zeros(1), np.zeros(1), 1e-3)
        assert law.slewed[0] == pytest.approx(position, abs=1e-12)


def test_stepper_output_keeps_velocity_and_acceleration_on_a_jump():
    law = law_of(AxisSettings("x", kind=AxisKind.STEPPER, velocity_max=1.0, acceleration_max=10.0))
    positions, velocities = [0.0], [0.0]
    for _ in range(500):
        law.step(np.array([5.0]), np.zeros(1), np.zeros(1), np.zeros(1), 1e-3)
        positions.append(float(law.slewed[0]))
        velocities.append(float(law.output[0]))
    assert max(np.abs(np.diff(positions))) <= 1e-3 * (1 + 1e-5)
    assert max(np.abs(np.diff(velocities))) <= 1e-2 * (1 + 1e-5)
    assert law.saturated[0]


def test_servo_and_stepper_do_not_touch_each_other():
    mixed = law_of(
        AxisSettings("a", k=20.0, kb=-1.0, force_max=5.0),
        AxisSettings("b", kind=AxisKind.STEPPER, velocity_max=1.0),
    )
    alone = law_of(AxisSettings("a", k=20.0, kb=-1.0, force_max=5.0))
    rng = np.random.default_rng(1)
    for _ in range(50):
        p, v = rng.normal(0, 0.1, 2)
        mixed.step(np.array([p, 0.0]), np.zeros(2), np.zeros(2), np.array([v, 0.0]), 1e-3)
        alone.step(np.array([p]), np.zeros(1), np.zeros(1), np.array([v]), 1e-3)
        assert mixed.output[0] == alone.output[0]


@pytest.mark.parametrize("steps_s", [[1e-3], [1e-3, 1e-3, 7e-3, 1e-3], [0.025, 1e-3, 1e-3]])
def test_stepper_comes_to_rest_on_a_jump_without_swinging(steps_s):
    law = law_of(AxisSettings("x", kind=AxisKind.STEPPER, velocity_max=1.0, acceleration_max=10.0))
    trace = []
    for n in range(3000):
        law.step(np.array([0.2]), np.zeros(1), np.zeros(1), np.zeros(1), steps_s[n % len(steps_s)])
        trace.append(float(law.slewed[0]))
    assert trace[-1] == pytest.approx(0.2, abs=1e-9)
    assert max(trace) < 0.2 + 2 * 10.0 * max(steps_s) ** 2  # a long tick cannot be foreseen
    assert law.output[0] == pytest.approx(0.0, abs=1e-6)


class Loaded:
    """A mass of 1 kg with a little friction, a constant load, and a stop that it may be held at."""

    def __init__(self, ki, load=-5.0):
        self.x = self.v = 0.0
        self.load, self.held = load, False
        self.law = law_of(AxisSettings("x", k=400.0, kb=-40.0, ki=ki, force_max=20.0))

    def go(self, desired, seconds):
        path = []
        for _ in range(round(seconds * 1000)):
            self.law.step(np.array([desired]), np.zeros(1), np.array([self.x]), np.array([self.v]), 1e-3)
            self.v = 0.0 if self.held else self.v + (self.law.output[0] + self.load - 2.0 * self.v) * 1e-3
            self.x += self.v * 1e-3
            path.append(self.x)
        return np.array(path)


def test_an_integral_gain_leaves_no_error_under_a_constant_load():
    assert Loaded(0.0).go(0.02, 5.0)[-1] == pytest.approx(0.02 - 5.0 / 400.0, rel=1e-3)
    assert Loaded(1000.0).go(0.02, 5.0)[-1] == pytest.approx(0.02, abs=1e-6)


def test_an_integral_does_not_wind_up_while_the_axis_is_held():
    free, held = Loaded(1000.0, load=0.0), Loaded(1000.0, load=0.0)
    plain = free.go(0.2, 3.0).max() - 0.2
    held.held = True
    held.go(0.2, 10.0)  # clipped all the time
    held.held = False
    assert held.go(0.2, 3.0).max() - 0.2 == pytest.approx(plain, abs=1e-3)
    assert held.x == pytest.approx(0.2, abs=1e-4)


def test_a_limp_axis_forgets_its_integral():
    axis = Loaded(1000.0)
    axis.go(0.0, 3.0)
    axis.law.relax(np.array([True]))
    axis.law.step(np.array([axis.x]), np.zeros(1), np.array([axis.x]), np.zeros(1), 1e-3)
    assert axis.law.output[0] == 0.0
