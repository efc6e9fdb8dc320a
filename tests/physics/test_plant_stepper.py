"""Stepper bank: follows within its torque, falls out of step beyond it, locks again on a multiple of four."""

import math

import numpy as np
import pytest

from sioms.plant.stepper import Stepper, StepperBank

TICK_S = 1e-3
BELT = Stepper(mass=0.4, step=2e-4, hold_force=60.0, corner_velocity=0.4, coulomb=3.0)


def ramp(bank, acceleration, top, seconds):
    """Turn the field at constant acceleration up to a velocity; return positions and lags."""
    position, velocity = bank.reading.copy(), 0.0
    for _ in range(round(seconds / TICK_S)):
        velocity = min(velocity + acceleration * TICK_S, top)
        position += velocity * TICK_S
        bank.advance(position)
    return position


def rest(bank, ticks=400):
    for _ in range(ticks):
        bank.advance(bank.reading.copy())


def test_follows_and_settles_on_the_field():
    bank = StepperBank([BELT], TICK_S)
    goal = ramp(bank, 2.0, 0.3, 0.5)
    assert not bank.stalled[0]
    rest(bank)
    assert bank.lost_steps[0] == 0
    # Friction holds the rotor off the field by at most asin(c/F) of the electrical turn.
    band = BELT.step * 2 / math.pi * math.asin(BELT.coulomb / BELT.hold_force)
    assert abs(bank.position[0] - goal[0]) <= band + BELT.step / BELT.microsteps


def test_static_lag_is_the_arcsine_of_the_load():
    motor = Stepper(mass=0.4, step=2e-4, hold_force=60.0, load_force=-30.0, microsteps=1000)
    bank = StepperBank([motor], TICK_S)
    rest(bank, 3000)
    assert bank.position[0] == pytest.approx(-2 * 2e-4 / math.pi * math.asin(0.5), rel=1e-4)


def test_small_oscillation_has_the_rotor_frequency():
    motor = Stepper(mass=0.4, step=2e-4, hold_force=60.0, damping_ratio=0.0, microsteps=1000, start=0.0)
    bank = StepperBank([motor], 1e-4)
    bank.velocity[:] = 1e-3
    signs = []
    for _ in range(4000):
        bank.advance(np.zeros(1))
        signs.append(bank.position[0] > 0)
    turns = np.flatnonzero(np.diff(np.array(signs, dtype=int)) == 1)
    period = (turns[-1] - turns[0]) / (len(turns) - 1) * 1e-4
    assert 1 / period == pytest.approx(math.sqrt(motor.stiffness / motor.mass) / (2 * math.pi), rel=0.01)


@pytest.mark.parametrize("acceleration, holds", [(120.0, True), (200.0, False)])
def test_pull_out_by_acceleration(acceleration, holds):
    """The holding force less friction carries (60 - 3)/0.4 = 142 m/s^2, and no more."""
    bank = StepperBank([Stepper(mass=0.4, step=2e-4, hold_force=60.0, coulomb=3.0)], TICK_S)
    position, seconds = 0.0, 0.0
    slow = acceleration / 0.02  # the acceleration itself rises over 20 ms, so that nothing swings
    velocity = 0.0
    for _ in range(60):
        seconds += TICK_S
        velocity += min(slow * seconds, acceleration) * TICK_S
        position += velocity * TICK_S
        bank.advance(np.array([position]))
    assert bank.stalled[0] != holds


def test_stall_lasts_until_the_field_stops_and_costs_whole_turns():
    bank = StepperBank([BELT], TICK_S)
    ramp(bank, math.inf, 1.2, 0.2)
    assert bank.stalled[0]
    stuck = bank.position[0]
    ramp(bank, math.inf, 1.2, 0.5)
    assert bank.stalled[0] and abs(bank.position[0] - stuck) < 0.01 * 1.2 * 0.5
    rest(bank)
    assert not bank.stalled[0]
    lost = bank.lost_steps[0]
    assert lost > 1000 and lost % 4 == 0
    band = BELT.step * 2 / math.pi * math.asin(BELT.coulomb / BELT.hold_force) + BELT.step / BELT.microsteps
    assert abs(bank.position[0] + lost * BELT.step - bank.reading[0]) <= band
    before = bank.position[0]
    ramp(bank, 2.0, 0.2, 0.2)
    rest(bank)
    assert bank.lost_steps[0] == lost
    assert bank.position[0] - before == pytest.approx(0.2 * 0.2 - 0.2**2 / 4, abs=2 * BELT.step)


def test_microsteps_round_the_field():
    bank = StepperBank([BELT], TICK_S)
    bank.advance(np.array([1.3 * BELT.step / 16]))
    assert bank.reading[0] == pytest.approx(BELT.step / 16)


def test_switches_follow_the_rotor():
    bank = StepperBank([Stepper(mass=0.4, step=2e-4, hold_force=60.0, home=0.01, limit_plus=0.05)], TICK_S)
    assert bank.at_home[0] and not bank.at_limit_plus[0]
    ramp(bank, 2.0, 0.2, 0.5)
    assert not bank.at_home[0] and bank.at_limit_plus[0]


@pytest.mark.parametrize(
    "change, word",
    [
        ({"mass": 0.0}, "mass"),
        ({"coulomb": 60.0}, "hold_force"),
        ({"mass": 1e-7}, "substeps"),
        ({"step": -1.0}, "step"),
    ],
)
def test_refuses_what_no_stepper_can_be(change, word):
    with pytest.raises(ValueError, match=word):
        StepperBank([Stepper(**{"mass": 0.4, "step": 2e-4, "hold_force": 60.0} | change)], TICK_S)


def test_field_far_too_fast_does_not_drag_by_aliasing():
    """A field of 4.02 steps a substep looks like one of 0.02 step to who samples it: the rotor must not follow."""
    bank = StepperBank([Stepper(mass=0.4, step=2e-4, hold_force=60.0, coulomb=3.0)], TICK_S)
    field = 0.0
    for _ in range(300):
        field += 4.02 * BELT.step * bank.substeps
        bank.advance(np.array([field]))
    assert bank.stalled[0] and abs(bank.position[0]) < 8 * BELT.step


@pytest.mark.parametrize("corner, holds", [(math.inf, True), (0.05, False)])
def test_pull_out_by_speed(corner, holds):
    """At six times the corner speed 60 N fall to 60/sqrt(37) = 9.9 N, less than the friction."""
    motor = Stepper(mass=0.4, step=2e-4, hold_force=60.0, coulomb=30.0, corner_velocity=corner)
    bank = StepperBank([motor], TICK_S)
    ramp(bank, 1.0, 0.3, 0.5)
    assert bank.stalled[0] != holds
