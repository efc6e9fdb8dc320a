"""The axis simulation against scipy's solvers, closed solutions, energy and order of convergence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import Pair, corrections, coupled, observer, response, rigid
from sioms.reconcile.records import Record
from sioms.reconcile.simulate import replay, simulate, track

DT = 1e-3
LOOP = Controller(20.0, -0.985, -0.7, -1e-4, 0.0, 1.8, 100.0)
AXIS = AxisModel(True, DT, 2e-3, 1e-3, 1e-9, 2 * np.pi, 0.7, 20.0, LOOP)
TIME = np.arange(1500) * DT
COMMAND = 1.2 * np.sin(2 * np.pi * 1.1 * TIME) + 0.3 * np.sin(2 * np.pi * 4.3 * TIME)
Rate = Callable[[float, np.ndarray, float], list[float]]


def reference(
    rate: Rate, states: int, read: Callable[[np.ndarray], float] = lambda s: float(s[0])
) -> tuple[np.ndarray, np.ndarray]:
    """Close the loop around an ODE, sample by sample, with a solver of its own (DOP853, 1e-11)."""
    state, e0, u0, y0, v = np.zeros(states), 0.0, 0.0, 0.0, 0.0
    alpha = 1 - np.exp(-2 * np.pi * 100 * DT)
    ys, us = [], []
    for c in COMMAND:
        y = read(state)
        v += alpha * ((y - y0) / DT - v)
        e = c - y
        u = float(np.clip(20.0 * (e - 0.985 * e0) + 0.7 * u0 - 1e-4 * v, -1.8, 1.8))
        e0, u0, y0 = e, u, y
        ys.append(y)
        us.append(u)
        state = solve_ivp(rate, (0, DT), state, args=(u,), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return np.array(ys), np.array(us)


def gravity(t: float, s: np.ndarray, u: float) -> list[float]:
    return [s[1], (u - 1e-3 * s[1] + 0.2 * np.sin(s[0] + 0.4) + 0.05 * np.sin(7 * s[0] + 1.0)) / 2e-3]


def two_masses(t: float, s: np.ndarray, u: float) -> list[float]:
    jm, jl = 2e-3 * 0.45, 2e-3 * 0.55
    k = (2 * np.pi * 18) ** 2 * 2e-3 * 0.55 * 0.45
    d = 2 * 0.05 * np.sqrt(k * 2e-3 * 0.55 * 0.45)
    link = k * (s[0] - s[2]) + d * (s[1] - s[3])
    return [s[1], (u - 1e-3 * s[1] - link) / jm, s[3], link / jl]


def warm(t: float, s: np.ndarray, u: float) -> list[float]:
    return [s[1], (u * (1 - 0.6 * s[2]) - 1e-3 * s[1]) / 2e-3, ((u / 0.7) ** 2 - s[2]) / 2.0]


CASES = {
    "gravity and cogging": (
        gravity,
        2,
        {
            "gravity": {"amp": 0.2, "phase": 0.4},
            "cogging": {"amp": 0.05, "phase": 1.0, "n": 7.0, "amp2": 0.0, "phase2": 0.0},
        },
    ),
    "two masses": (two_masses, 4, {"elastic": {"f_res": 18.0, "load_fraction": 0.55, "zeta": 0.05}}),
    "heat": (warm, 3, {"thermal_gain": {"loss": 0.6, "tau": 2.0}}),
}


@pytest.mark.parametrize("case", sorted(CASES))
def test_the_closed_loop_agrees_with_scipy_far_below_a_count(case: str) -> None:
    rate, states, effects = CASES[case]
    model = AXIS
    for name, values in effects.items():
        model = model.with_effect(name, values)
    run = simulate(model, COMMAND)
    y, u = reference(rate, states)
    count = 1e-4  # a fine encoder of such an axis
    assert np.max(np.abs(run.position - y)) < 0.3 * count
    assert np.max(np.abs(run.force - u)) < 0.004 * 0.7  # the drive noise of a good drive


def test_a_test_signal_and_a_push_from_outside_are_in_the_loop() -> None:
    """Pulses added to the controller's force, and others that act on the axis alone, against scipy's solver."""
    n = 400
    added, push = np.zeros(n), np.zeros(n)
    added[100:120], push[200:230] = 0.5, -0.3
    state, e0, u0, y0, v, ys, us = np.zeros(2), 0.0, 0.0, 0.0, 0.0, [], []
    alpha = 1 - np.exp(-2 * np.pi * 100 * DT)
    for c, more, outer in zip(COMMAND[:n], added, push, strict=True):
        y = float(state[0])
        v += alpha * ((y - y0) / DT - v)
        e = c - y
        own = float(np.clip(20.0 * (e - 0.985 * e0) + 0.7 * u0 - 1e-4 * v, -1.8, 1.8))
        e0, u0, y0 = e, own, y
        u = float(np.clip(own + more, -1.8, 1.8))
        ys.append(y)
        us.append(u)
        state = solve_ivp(gravity, (0, DT), state, args=(u + outer,), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    model = AXIS
    for name, values in CASES["gravity and cogging"][2].items():
        model = model.with_effect(name, values)
    record = Record("pulses", np.array(ys), np.array(us), COMMAND[:n], feedforward=added, external=push)
    run = replay(replace(model, resolution=1e-13), record)
    assert np.max(np.abs(run.position - record.position)) < 1e-5 * np.ptp(record.position)
    assert np.max(np.abs(run.force - record.force)) < 1e-3 * np.ptp(record.force)
    blind = replay(model, replace(record, external=None))
    assert np.max(np.abs(blind.position - record.position)) > 1e-3 * np.ptp(record.position)


def test_the_error_falls_with_the_square_of_the_step() -> None:
    model = AXIS.with_effect("gravity", {"amp": 0.2, "phase": 0.4})
    fine = replace(model, resolution=1e-13)
    best = simulate(fine, COMMAND, substeps=64).position
    errors = [float(np.max(np.abs(simulate(fine, COMMAND, substeps=n).position - best))) for n in (1, 2, 4)]
    assert 3.0 < errors[0] / errors[1] < 5.0
    assert 3.0 < errors[1] / errors[2] < 5.0


def test_coulomb_friction_stops_where_energy_says_and_holds() -> None:
    """J v0^2 / 2 = Fc s; afterwards a force below Fc moves nothing."""
    coast = replace(AXIS, viscous=0.0, controller=None).with_effect("coulomb", {"Fc": 0.05})
    push, level = 0.4, 0.05
    force = np.concatenate([np.full(20, push), np.zeros(400), np.full(100, 0.9 * level)])
    run = track(coast, np.zeros(len(force)), force, None)
    a = (push - level) / 2e-3
    x0, v0 = 0.5 * a * 0.02**2, a * 0.02
    stop = x0 + 0.5 * 2e-3 * v0**2 / level
    assert run.x[-1] == pytest.approx(stop, rel=1e-9)
    assert np.all(run.v[-150:] == 0.0)


@pytest.mark.parametrize("force", [0.11, -0.11])
def test_stribeck_friction_holds_up_to_breakaway_and_then_runs_away(force: float) -> None:
    model = replace(AXIS, viscous=0.0, controller=None).with_effect("stribeck", {"Fc": 0.05, "Fs": 0.1, "vs": 0.1})
    held = track(model, np.zeros(200), np.full(200, 0.9 * force), None)
    assert np.all(held.x == 0.0)
    free = track(model, np.zeros(200), np.full(200, force), None)
    assert np.sign(free.v[-1]) == np.sign(force)
    assert abs(free.v[-1]) > 0.15 * (abs(force) - 0.05) / 2e-3


def test_dahl_friction_builds_up_exponentially_over_its_length() -> None:
    """Pushed slowly one way, F = Fc (1 - exp(-x / xs)): the closed solution of Dahl's equation."""
    model = replace(AXIS, viscous=0.0, controller=None).with_effect("presliding", {"Fc": 0.05, "xs": 1e-2})
    ramp = 0.04 * np.arange(4000) / 4000
    run = track(model, np.zeros(4000), ramp, None)
    wanted = -1e-2 * np.log(1.0 - ramp / 0.05)
    assert np.all(run.v[500:] > 0.0)
    np.testing.assert_allclose(run.x[1000:], wanted[1000:], rtol=0.04)


@pytest.mark.parametrize("depth", [0.0, 0.3])
@pytest.mark.parametrize("speed", [0.02, 0.4])
def test_lugre_friction_agrees_with_an_ordinary_solver(speed: float, depth: float) -> None:
    """Driven to and fro so that it yields, breaks away and drops, over a level that varies or not: LuGre's equation by
    scipy.
    """
    fc, fs, vs, xs, b, j = 0.05, 0.08, 0.15, 1e-2, 1e-3, 2e-3
    values = {"Fc": fc, "xs": xs, "Fs": fs, "vs": vs}
    model = replace(AXIS, viscous=b, controller=None).with_effect("lugre", values)
    if depth > 0.0:
        model = model.with_effect("friction_variation", {"depth": depth, "phase": 0.8, "n": 7.0})
    t = np.arange(1500) * DT
    force = (fs + speed * 0.1) * np.sin(2 * np.pi * 1.5 * t)

    def slopes(time: float, y: np.ndarray) -> list[float]:
        x, v, f = y
        g = (fc + (fs - fc) * np.exp(-((v / vs) ** 2))) * (1.0 + depth * np.sin(7.0 * x + 0.8))
        u = force[min(int(time / DT + 1e-9), len(force) - 1)]
        return [v, (u - f - b * v) / j, fs / xs * (v - abs(v) * f / g)]

    y, wanted = np.zeros(3), []
    for k in range(len(t)):
        wanted.append(y)
        y = solve_ivp(slopes, (t[k], t[k] + DT * (1 - 1e-6)), y, rtol=1e-8, atol=1e-10).y[:, -1]
    x = np.array(wanted)[:, 0]
    run = track(model, np.zeros(len(t)), force, None)
    assert np.ptp(x) > 20 * xs
    np.testing.assert_allclose(run.x, x, atol=2e-3 * np.ptp(x))


@pytest.mark.parametrize("law", ["presliding", "stribeck"])
def test_friction_that_varies_over_the_turn_agrees_with_an_ordinary_solver(law: str) -> None:
    """Pushed one way by a force that swings, over three waves: level and hysteresis times the factor, solved by
    scipy.
    """
    fc, fs, vs, xs, b, j = 0.05, 0.09, 2.0, 5e-2, 1e-3, 2e-3
    values = {"Fc": fc, "Fs": fs, "vs": vs} if law == "stribeck" else {"Fc": fc, "xs": xs}
    model = replace(AXIS, viscous=b, controller=None).with_effect(law, values)
    model = model.with_effect("friction_variation", {"depth": 0.35, "phase": 0.8, "n": 3.0})
    force = 0.14 + 0.04 * np.sin(2 * np.pi * 3.0 * np.arange(600) * DT)

    def slopes(t: float, y: np.ndarray, u: float) -> list[float]:
        x, v, f = y
        share = 1.0 + 0.35 * np.sin(3.0 * x + 0.8)
        if law == "stribeck":
            return [v, (u - share * (fc + (fs - fc) * np.exp(-((v / vs) ** 2))) - b * v) / j, 0.0]
        return [v, (u - f - b * v) / j, (share * fc - f) * abs(v) / (share * xs)]

    y, wanted = np.zeros(3), []
    for u in force:
        wanted.append(y)
        y = solve_ivp(slopes, (0, DT), y, args=(u,), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    x = np.array(wanted)[:, 0]
    assert np.ptp(x) > 2 * np.pi
    run = track(model, np.zeros(len(force)), force, None)
    np.testing.assert_allclose(run.x, x, atol=2e-5 * np.ptp(x))


@pytest.mark.parametrize("place", [np.pi / 6, np.pi / 2])
def test_friction_that_varies_holds_as_it_is_at_that_place(place: float) -> None:
    model = replace(AXIS, viscous=0.0, controller=None).with_effect("stribeck", {"Fc": 0.03, "Fs": 0.06, "vs": 0.1})
    model = model.with_effect("friction_variation", {"depth": 0.5, "phase": 0.0, "n": 3.0})
    most, there = 0.06 * (1.0 + 0.5 * np.sin(3.0 * place)), np.full(100, place)
    for way in (1.0, -1.0):
        assert np.all(track(model, there, np.full(100, 0.98 * way * most), None).v == 0.0)
        assert way * track(model, there, np.full(100, 1.02 * way * most), None).v[-1] > 0.0


def test_lugre_friction_that_vanishes_with_speed_still_holds_at_rest() -> None:
    model = replace(AXIS, viscous=0.0, controller=None).with_effect(
        "lugre", {"Fc": 0.0, "xs": 1e-3, "Fs": 0.08, "vs": 0.05}
    )
    held = track(model, np.zeros(4000), 0.05 * np.arange(4000) / 4000, None)
    assert 1e-4 < np.ptp(held.x) < 3e-3  # pushed slowly it yields like a spring and no farther
    free = track(model, np.zeros(400), np.full(400, 0.12), None)
    assert np.all(np.isfinite(free.x))
    assert free.v[-1] == pytest.approx(0.12 * 0.4 / 2e-3, rel=0.1)


def test_backlash_conserves_momentum_and_hides_the_load() -> None:
    model = replace(AXIS, viscous=0.0, controller=None).with_effect(
        "backlash", {"gap": 0.5, "load_fraction": 0.6, "f_contact": 120.0, "zeta": 0.1}
    )
    push = np.concatenate([np.full(20, 0.2), np.zeros(4000)])
    run = track(model, np.zeros(len(push)), push, None)
    assert run.v[21] == pytest.approx(0.2 * 0.02 / (0.4 * 2e-3), rel=1e-6)  # the motor alone
    assert np.mean(run.v[-2000:]) == pytest.approx(0.2 * 0.02 / 2e-3, rel=0.02)  # both together


def test_a_delay_moves_the_force_by_its_time() -> None:
    model = replace(AXIS, controller=None).with_effect("delay", {"delay": 2.4e-3})
    force = np.zeros(20)
    force[5] = 1.0
    run = track(model, np.zeros(20), force, None)
    np.testing.assert_allclose(run.applied[7:9], [0.6, 0.4], atol=1e-9)
    assert np.sum(np.arange(20) * run.applied) == pytest.approx(5 + 2.4, abs=1e-9)


def test_the_linear_filter_is_the_answer_of_the_observer_to_a_missing_force() -> None:
    """Track a motion made with an extra force; the innovation must be that force through ``response``."""
    noise = observer(AXIS, 1e-4, 2e-3)
    t = np.arange(2000) * DT
    known_force, extra = 0.1 * np.sin(7 * t), 0.02 * np.sin(11 * t + 1)
    a, b = rigid(AXIS)
    s, y = np.zeros(2), []
    for f in known_force + extra:
        y.append(s[0])
        s = a @ s + b * f
    run = track(replace(AXIS, controller=None), np.array(y), known_force, noise)
    expected = response(AXIS, noise, extra)
    forgotten = slice(100, None)  # the first speed is read off the motion, not known to be none
    np.testing.assert_allclose(run.innovation[forgotten], expected[forgotten], atol=2e-4 * np.max(np.abs(expected)))


def test_the_expected_innovation_is_what_a_right_model_leaves() -> None:
    """Noise of known size through an exact recursion: variance as designed, and white."""
    rng = np.random.default_rng(5)
    noise = observer(AXIS, 1e-4, 2e-3)
    a, b = rigid(AXIS)
    s, y, n = np.zeros(2), [], 20000
    for f in 2e-3 * rng.standard_normal(n):
        y.append(s[0] + 1e-4 * rng.standard_normal())
        s = a @ s + b * f
    e = track(replace(AXIS, controller=None), np.array(y), np.zeros(n), noise).innovation[200:]
    assert np.std(e) == pytest.approx(noise.innovation, rel=0.03)
    assert abs(np.corrcoef(e[1:], e[:-1])[0, 1]) < 0.03


PAIR = Pair(2e-3, 0.55, (2 * np.pi * 18) ** 2 * 2e-3 * 0.55 * 0.45, 1.2e-3, 1e-3)


def shaken_pair(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Drive two masses by a force of many steps and by noise; return position with noise and force without."""
    rng = np.random.default_rng(seed)
    a, b = coupled(PAIR, DT)
    force = np.repeat(0.2 * rng.standard_normal(n // 100), 100)
    s, y = np.zeros(4), np.zeros(n)
    for i, f in enumerate(force + 2e-3 * rng.standard_normal(n)):
        y[i] = s[0] + 1e-4 * rng.standard_normal()
        s = a @ s + b * f
    return y, force


def test_a_sampled_pair_is_the_solution_of_its_differential_equation() -> None:
    a, b = coupled(PAIR, DT)
    start = np.array([0.01, 0.3, -0.02, 0.1])
    s = solve_ivp(
        lambda t, s: [s[1], (0.3 - link(s) - 1e-3 * s[1]) / 0.9e-3, s[3], link(s) / 1.1e-3],
        (0, DT),
        start,
        method="DOP853",
        rtol=1e-11,
        atol=1e-13,
    ).y[:, -1]
    np.testing.assert_allclose(a @ start + b * 0.3, s, rtol=1e-8)


def link(s: np.ndarray) -> float:
    return float(PAIR.stiffness * (s[0] - s[2]) + PAIR.damping * (s[1] - s[3]))


def test_the_observer_of_a_transmission_that_rings_leaves_no_tone() -> None:
    """With both masses corrected alike, what noise set ringing rings on for a second in the innovation."""
    y, force = shaken_pair(3, 20000)
    noise = observer(AXIS, 1e-4, 2e-3)
    zeta = PAIR.damping / (2.0 * np.sqrt(PAIR.stiffness * 2e-3 * 0.55 * 0.45))
    model = replace(AXIS, controller=None).with_effect("elastic", {"f_res": 18.0, "load_fraction": 0.55, "zeta": zeta})
    e = track(model, y, force, noise).innovation[500:]
    alike = innovations(y, force, np.array([*noise.gain, *noise.gain]))[500:]
    own = innovations(y, force, np.array(corrections(noise, PAIR, DT)[:4]))[500:]
    np.testing.assert_allclose(e, own, atol=0.1 * np.std(own))  # of second order in the step
    lags = range(1, 120)
    assert max(abs(np.corrcoef(e[k:], e[:-k])[0, 1]) for k in lags) < 0.03
    assert max(abs(np.corrcoef(alike[k:], alike[:-k])[0, 1]) for k in lags) > 0.2


def innovations(y: np.ndarray, force: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Follow a measured pair by a recursion of its own."""
    a, b = coupled(PAIR, DT)
    s, out = np.zeros(4), np.zeros(len(y))
    for i, f in enumerate(force):
        out[i] = y[i] - s[0]
        s = a @ (s + gain * out[i]) + b * f
    return out


def test_a_missing_force_on_a_pair_leaves_what_the_linear_filter_says() -> None:
    noise = observer(AXIS, 1e-4, 2e-3)
    extra = 0.02 * np.sin(11 * np.arange(2000) * DT + 1)
    a, b = coupled(PAIR, DT)
    s, y = np.zeros(4), np.zeros(2000)
    for i, f in enumerate(extra):
        y[i] = s[0]
        s = a @ s + b * f
    e = innovations(y, np.zeros(2000), np.array(corrections(noise, PAIR, DT)[:4]))
    np.testing.assert_allclose(response(AXIS, noise, extra, PAIR), e, atol=1e-6 * np.max(np.abs(e)))


def test_out_of_contact_nothing_moves_the_load() -> None:
    """A motor in the middle of its gap is measured elsewhere than expected: it is moved, as one of its own mass, and
    the load is not.
    """
    noise = observer(AXIS, 1e-4, 2e-3)
    model = replace(AXIS, controller=None).with_effect(
        "backlash", {"gap": 0.1, "load_fraction": 0.6, "f_contact": 120.0, "zeta": 0.2}
    )
    y = np.where(np.arange(400) < 50, 0.0, 1e-3)
    run = track(model, y, np.zeros(400), noise)
    alone = observer(replace(AXIS, inertia=0.4 * AXIS.inertia), 1e-4, 2e-3)
    free = track(replace(AXIS, controller=None, inertia=0.4 * AXIS.inertia), y, np.zeros(400), alone)
    np.testing.assert_allclose(run.innovation, free.innovation, atol=1e-9)
    gain = corrections(noise, Pair(2e-3, 0.6, 300.0, 0.01, 1e-3), DT)
    assert gain[4:] == (*alone.gain, 0.0, 0.0)
