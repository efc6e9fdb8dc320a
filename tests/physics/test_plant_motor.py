"""Motor bank against facts that do not use its formulas: quadrature, energy, limits, orders."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sioms.plant.effects import build_effects
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor, Wall

TICK_S = 1e-3


def run(bank, force, ticks):
    """Step a bank; force is a number or a function of the tick's start time."""
    positions = np.empty((ticks, bank.position.size))
    for tick in range(ticks):
        value = force(tick * TICK_S) if callable(force) else force
        bank.advance(np.full(bank.position.size, value))
        positions[tick] = bank.position
    return positions


def one(effects=None, substeps=4, tick_s=TICK_S, **parameters):
    return MotorBank([Motor(**parameters)], tick_s, build_effects({"x": effects or {}}, ["x"]), substeps)


def test_moving_motor_agrees_with_quadrature():
    bank = one(mass=2.0, viscous=3.0, coulomb=1.0)
    run(bank, 8.0, 500)
    solution = solve_ivp(lambda t, y: [y[1], (8 - 3 * y[1] - 1) / 2], (0, 0.5), [0, 0], rtol=1e-11, atol=1e-13)
    assert bank.position[0] == pytest.approx(solution.y[0, -1], rel=1e-9)
    assert bank.velocity[0] == pytest.approx(solution.y[1, -1], rel=1e-9)


@pytest.mark.parametrize("force, rests", [(0.0, True), (-1.9, True), (-2.5, False)])
def test_stop_inside_a_tick_then_rest_or_return(force, rests):
    """A thrown mass slows by F - c, stops between two ticks, and stays unless the force exceeds stiction."""
    mass, sliding, stiction, speed = 1.5, 1.0, 2.0, 0.0123
    bank = one(mass=mass, coulomb=sliding, stiction=stiction)
    bank.velocity[:] = speed
    run(bank, force, 100)
    slowing = (sliding - force) / mass
    stop_s, stop_m = speed / slowing, speed**2 / 2 / slowing
    if rests:
        assert bank.velocity[0] == 0.0
        assert bank.position[0] == pytest.approx(stop_m, rel=1e-12)
    else:
        back = (force + sliding) / mass
        assert bank.velocity[0] == pytest.approx(back * (0.1 - stop_s), rel=1e-10)
        assert bank.position[0] == pytest.approx(stop_m + back * (0.1 - stop_s) ** 2 / 2, rel=1e-10)


def test_stiction_threshold_is_sharp():
    held = one(mass=1.0, coulomb=1.0, stiction=2.0)
    freed = one(mass=1.0, coulomb=1.0, stiction=2.0)
    assert np.all(run(held, math.nextafter(2.0, 0), 50) == 0.0)
    run(freed, 2.0 * (1 + 1e-12), 1)
    assert freed.velocity[0] == pytest.approx((2.0 - 1.0) / 1.0 * TICK_S)


def test_friction_however_stiff_never_drives():
    """Viscous and dry friction a million times stiffer than the tick: monotone to rest, no chatter."""
    bank = one(mass=1e-3, viscous=1e6, coulomb=1e3)
    bank.velocity[:] = 5.0
    positions = run(bank, 0.0, 10)
    assert bank.velocity[0] == 0.0
    assert np.all(np.diff(positions[:, 0]) >= 0) and positions[-1, 0] < 1e-6


def test_terminal_velocity_differs_by_direction():
    effects = {
        "viscous": {"coefficient": 1.0, "coefficient_minus": 3.0},
        "coulomb": {"level": 0.5, "level_minus": 1},
    }
    plus = one(effects, mass=0.1, viscous=1.0)
    minus = one(effects, mass=0.1, viscous=1.0)
    run(plus, 6.0, 3000)
    run(minus, -6.0, 3000)
    assert plus.velocity[0] == pytest.approx((6 - 0.5) / 2.0, rel=1e-9)
    assert minus.velocity[0] == pytest.approx(-(6 - 1.0) / 4.0, rel=1e-9)


def test_energy_balance_of_a_driven_axis():
    """Work of the drive = kinetic energy + work against friction, by quadrature of the fine motion."""
    bank = one(mass=1.3, viscous=0.7, coulomb=0.4, tick_s=1e-4)
    work = loss = 0.0
    for tick in range(20_000):
        force = 5 * math.sin(tick * 1e-4 * 7)
        before_x, before_v = bank.position[0], bank.velocity[0]
        bank.advance(np.array([force]))
        moved = bank.position[0] - before_x
        work += force * moved
        loss += 0.4 * abs(moved) + 0.7 * moved * (before_v + bank.velocity[0]) / 2
    kinetic = 1.3 * bank.velocity[0] ** 2 / 2
    assert work == pytest.approx(kinetic + loss, rel=1e-4)
    assert loss > 0.3 * work


def test_undamped_pendulum_keeps_its_energy():
    """Leapfrog: over 30 periods the energy error stays bounded and does not drift."""
    bank = one({"gravity": {"amplitude": 4.0}}, mass=1.0, start=2.0)
    energy = []
    for _ in range(12_000):
        bank.advance(np.zeros(1))
        energy.append(bank.velocity[0] ** 2 / 2 - 4 * math.cos(bank.position[0]))
    energy = np.array(energy) + 4 * math.cos(2.0)
    assert np.max(np.abs(energy)) < 1e-5
    assert abs(energy[-3_000:].mean() - energy[:3_000].mean()) < 1e-7


def smooth_error(substeps, effects, parameters, rhs, force):
    bank = one(effects, substeps=substeps, tick_s=0.01, **parameters)
    for _ in range(20):
        bank.advance(np.array([force]))
    start = [parameters.get("start", 0.0), 0.0]
    solution = solve_ivp(rhs, (0, 0.2), start, rtol=1e-12, atol=1e-14, method="DOP853")
    return abs(bank.position[0] - solution.y[0, -1])


@pytest.mark.parametrize(
    "effects, parameters, rhs",
    [
        ({"spring": {"stiffness": 300.0, "rest": 0.1}}, {"mass": 1.0, "viscous": 2.0},
         lambda t, y: [y[1], 5 - 2 * y[1] - 300 * (y[0] - 0.1)]),
        ({"gravity": {"amplitude": 9.0, "phase": 1.0}, "quadratic_drag": {"coefficient": 4.0}}, {"mass": 0.2},
         lambda t, y: [y[1], (5 - 9 * math.sin(y[0] + 1) - 4 * y[1] * abs(y[1])) / 0.2]),
        ({"stribeck": {"rise": 1.0, "velocity": 0.3}}, {"mass": 1.0, "coulomb": 1.0},
         lambda t, y: [y[1], 5 - 1 - math.exp(-((y[1] / 0.3) ** 2))]),
        ({}, {"mass": 0.5, "force_constant": 2.0, "resistance_ohm": 1.0, "supply_v": 2.0},
         lambda t, y: [y[1], min(5.0, 2 * (2 - 2 * y[1])) / 0.5]),
    ],
)  # fmt: skip
def test_second_order(effects, parameters, rhs):
    errors = [smooth_error(substeps, effects, parameters, rhs, 5.0) for substeps in (4, 8, 16, 32)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-4
    assert orders.mean() > 1.7


def test_supply_limits_speed_and_stall():
    parameters = {"mass": 0.01, "force_constant": 0.5, "resistance_ohm": 2.0, "supply_v": 12.0}
    bank = one(**parameters)
    bank.advance(np.array([100.0]))
    assert bank.drive_force[0] == pytest.approx(0.5 * 12 / 2, rel=0.1)
    run(bank, 100.0, 2000)
    assert bank.velocity[0] == pytest.approx(12 / 0.5, rel=1e-6)


def test_wall_rest_depth_and_no_pull():
    """At rest the wall bears the drive; a retreating axis is never held back."""
    wall = Wall(position=0.01, stiffness=5e4, damping=200.0)
    bank = one(mass=1.0, coulomb=0.0, wall=wall)
    run(bank, 20.0, 3000)
    assert bank.contact_force[0] == pytest.approx(20.0, rel=1e-6)
    assert bank.position[0] == pytest.approx(0.01 + 20 / 5e4, rel=1e-6)
    for _ in range(50):
        bank.advance(np.array([-200.0]))
        assert bank.contact_force[0] >= 0.0
    assert bank.position[0] < 0.01 and bank.contact_force[0] == 0.0


def test_impact_agrees_with_quadrature_with_an_event():
    bank = one(mass=0.5, wall=Wall(position=0.0, stiffness=2e3, damping=5.0), start=-0.05)
    bank.velocity[:] = 1.0
    run(bank, 0.0, 120)

    def rhs(t, y):
        press = max(0.0, 2e3 * y[0] + 5 * y[1]) if y[0] > 0 else 0.0
        return [y[1], -press / 0.5]

    solution = solve_ivp(rhs, (0, 0.12), [-0.05, 1.0], rtol=1e-10, atol=1e-12, max_step=1e-4)
    assert bank.velocity[0] == pytest.approx(solution.y[1, -1], rel=2e-3)
    assert bank.velocity[0] < 0


def test_free_ticks_and_substeps_agree():
    """The whole-tick shortcut before a far wall is the same motion as the one without a wall."""
    walled = one(mass=1.0, viscous=1.0, coulomb=0.3, wall=Wall(0.5, 1e4))
    free = one(mass=1.0, viscous=1.0, coulomb=0.3)
    run(walled, 2.0, 300)
    run(free, 2.0, 300)
    assert walled.position[0] == pytest.approx(free.position[0], rel=1e-12)


def test_end_stop_is_inelastic_and_lets_go():
    bank = one(mass=1.0, stop_plus=0.02, limit_plus=0.018)
    run(bank, 5.0, 500)
    assert bank.position[0] == 0.02 and bank.velocity[0] == 0.0 and bank.at_limit_plus[0]
    run(bank, -5.0, 50)
    assert bank.position[0] == pytest.approx(0.02 - 5 * 0.05**2 / 2, rel=1e-9) and not bank.at_limit_plus[0]


def test_two_masses_ring_at_their_resonance_and_keep_momentum():
    effects = {"elastic": {"frequency_hz": 40.0, "damping": 0.0, "load_fraction": 0.3}}
    bank = one(effects, mass=2.0)
    bank.velocity[:] = 1.0
    twist = []
    for _ in range(1000):
        bank.advance(np.zeros(1))
        twist.append(bank.position[0] - bank.load_position[0])
        momentum = 1.4 * bank.velocity[0] + 0.6 * bank.load_velocity[0]
        assert momentum == pytest.approx(1.4, rel=1e-9)
    crossings = np.flatnonzero(np.diff(np.signbit(twist)))
    frequency = (len(crossings) - 1) / 2 / ((crossings[-1] - crossings[0]) * TICK_S)
    assert frequency == pytest.approx(40.0, rel=0.01)


def test_backlash_moves_alone_through_the_gap():
    effects = {"backlash": {"gap": 0.01, "load_fraction": 0.5}}
    bank = one(effects, mass=2.0)
    positions = run(bank, 1.0, 130)
    free = np.flatnonzero(positions[:, 0] < 0.005)
    # Through half the gap only the motor's mass is moved, afterwards both.
    seconds = (free[-1] + 1) * TICK_S
    assert positions[free[-1], 0] == pytest.approx(1.0 * seconds**2 / 2, rel=1e-6)
    assert bank.load_position[0] > 0.0
    run(bank, 1.0, 900)
    assert bank.position[0] - bank.load_position[0] == pytest.approx(0.005, abs=2e-4)


def test_delay_shifts_impulse_exactly():
    bank = one({"delay": {"delay_s": 0.0034}}, mass=2.0)
    run(bank, 4.0, 100)
    assert bank.velocity[0] == pytest.approx(4.0 / 2.0 * (0.1 - 0.0034), rel=1e-12)


def test_lag_loses_the_impulse_of_its_time_constant():
    bank = one({"lag": {"tau_s": 0.005}}, mass=2.0)
    run(bank, 4.0, 200)
    assert bank.velocity[0] == pytest.approx(4.0 / 2.0 * (0.2 - 0.005), rel=1e-6)


def test_thermal_gain_settles():
    bank = one({"thermal_gain": {"loss": 0.25, "tau_s": 0.1, "rated_force": 3.0}}, mass=1.0, viscous=1.0)
    run(bank, 3.0, 20_000)
    assert bank.drive_force[0] == pytest.approx(3.0 / 1.25, rel=1e-6)


def test_presliding_springs_back():
    """Below its level Dahl friction is a spring; far beyond it is dry friction."""
    bank = one({"presliding": {"level": 2.0, "stiffness": 1e4}}, mass=1.0, viscous=50.0)
    run(bank, lambda t: min(0.02 * t, 0.02), 2000)
    assert bank.position[0] == pytest.approx(0.02 / 1e4, rel=0.02)
    run(bank, 12.0, 4000)
    assert bank.velocity[0] == pytest.approx((12.0 - 2.0) / 50.0, rel=1e-3)


@pytest.mark.parametrize(("yielding", "within"), [(0.0, 1e-6), (1.5, 2e-4)])
def test_all_dry_friction_varies_and_drag_does_not(yielding, within):
    """Pushed one way over a varying floor, against quadrature: Coulomb, Stribeck and Dahl friction with the factor,
    drag without.
    """
    depth, pitch, phase = 0.4, 0.03, 0.7
    effects = {
        "friction_variation": {"depth": depth, "pitch": pitch, "phase": phase},
        "stribeck": {"rise": 1.0, "velocity": 0.1},
        "quadratic_drag": {"coefficient": 20.0},
    }
    if yielding:
        effects["presliding"] = {"level": yielding, "stiffness": 4e3}
    bank = one(effects, mass=2.0, viscous=3.0, coulomb=1.0)
    run(bank, 9.0, 500)

    def slopes(t, y):
        share = 1 + depth * np.sin(2 * np.pi * y[0] / pitch + phase)
        dry = share * (1.0 + np.exp(-((y[1] / 0.1) ** 2))) + y[2]
        rise = 4e3 * y[1] * (1 - y[2] / (yielding * share)) if yielding else 0.0
        return [y[1], (9 - 3 * y[1] - 20 * y[1] ** 2 - dry) / 2, rise]

    end = solve_ivp(slopes, (0, 0.5), [0, 0, 0], rtol=1e-10, atol=1e-12).y[:, -1]
    assert end[0] > 4 * pitch
    assert bank.position[0] == pytest.approx(end[0], rel=within)
    assert bank.velocity[0] == pytest.approx(end[1], rel=within)


@pytest.mark.parametrize("place", [0.0075, 0.0225])
def test_friction_that_varies_holds_as_it_is_at_that_place(place):
    """At the crest 1.5 of the breakaway force hold, in the trough 0.5; a push beyond it moves the axis both ways."""
    most = 2.0 * (1 + 0.5 * np.sin(2 * np.pi * place / 0.03))
    for way in (1.0, -1.0):
        bank = one(
            {"friction_variation": {"depth": 0.5, "pitch": 0.03}},
            mass=1.0,
            coulomb=1.0,
            stiction=2.0,
            start=place,
        )
        run(bank, 0.98 * way * most, 100)
        assert bank.position[0] == place
        run(bank, 1.02 * way * most, 100)
        assert way * (bank.position[0] - place) > 0


def test_a_stop_and_a_return_over_a_varying_floor_agree_with_quadrature():
    """Thrown against a constant push, the axis stops and comes back under a friction that varies."""
    bank = one({"friction_variation": {"depth": 0.6, "pitch": 0.02}}, mass=0.5, coulomb=1.0, substeps=8)
    bank.velocity[:] = 0.5
    run(bank, -3.0, 200)

    def level(x):
        return 1 + 0.6 * np.sin(2 * np.pi * x / 0.02)

    def stopped(t, y):
        return y[1]

    stopped.terminal = True
    ask = {"rtol": 1e-11, "atol": 1e-14}
    there = solve_ivp(lambda t, y: [y[1], (-3 - level(y[0])) / 0.5], (0, 0.2), [0, 0.5], events=stopped, **ask)
    back = solve_ivp(lambda t, y: [y[1], (-3 + level(y[0])) / 0.5], (there.t[-1], 0.2), [there.y[0, -1], 0.0], **ask)
    assert back.y[0, -1] < 0.8 * there.y[0, -1]
    assert bank.position[0] == pytest.approx(back.y[0, -1], abs=1e-5)
    assert bank.velocity[0] == pytest.approx(back.y[1, -1], abs=1e-4)


def test_stop_under_viscous_friction_agrees_with_quadrature():
    """One long tick: the velocity comes to zero under b and c together, then the force drives it back."""
    bank = one(mass=0.5, viscous=20.0, coulomb=1.0, tick_s=0.1)
    bank.velocity[:] = 0.4
    bank.advance(np.array([-3.0]))

    def stopped(t, y):
        return y[1]

    stopped.terminal = True
    there = solve_ivp(
        lambda t, y: [y[1], (-3 - 1 - 20 * y[1]) / 0.5],
        (0, 0.1),
        [0, 0.4],
        rtol=1e-11,
        atol=1e-14,
        events=stopped,
    )
    rest = [there.y[0, -1], 0.0]
    back = solve_ivp(lambda t, y: [y[1], (-3 + 1 - 20 * y[1]) / 0.5], (there.t[-1], 0.1), rest, rtol=1e-11, atol=1e-14)
    assert bank.position[0] == pytest.approx(back.y[0, -1], rel=1e-8)
    assert bank.velocity[0] == pytest.approx(back.y[1, -1], rel=1e-8)


def test_wall_within_the_reach_of_a_strong_push_is_not_jumped():
    """From rest just before the wall: the same motion as when the substeps are forced by a void effect."""
    parameters = {"mass": 0.1, "wall": Wall(position=1e-6, stiffness=1e4)}
    bank, stepped = one(**parameters), one({"gravity": {"amplitude": 0.0}}, **parameters)
    for _ in range(50):
        bank.advance(np.array([50.0]))
        stepped.advance(np.array([50.0]))
        assert bank.position[0] == pytest.approx(stepped.position[0], rel=1e-12)
    assert bank.contact_force[0] > 0
