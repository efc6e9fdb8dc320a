"""The twin of a model against the simulation of the workflow: two integrations of one library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor
from sioms.reconcile.effect import NONE, Channel, Effect, Parameter, Ref, Slot
from sioms.reconcile.effects import known, library
from sioms.reconcile.jit import state_function
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import track
from sioms.reconcile.twin import twins

DT = 1e-3
AXIS = AxisModel(True, DT, 2e-3, 1e-3, 1e-9, 2 * np.pi, 0.7, 20.0)
T = np.arange(2500) * DT
FORCE = 0.12 * np.sin(2 * np.pi * 1.3 * T) + 0.05 * np.sin(2 * np.pi * 3.7 * T + 0.3)
CASES: dict[str, dict[str, float]] = {
    "viscous": {"b_extra": 2e-3},
    "viscous_direction": {"b_dir": 5e-4},
    "quadratic_drag": {"c": 1e-4},
    "coulomb": {"Fc": 0.03},
    "coulomb_position": {"Fc": 0.03, "Fm": 0.01, "phase": 0.4, "n": 3.0},
    "stribeck": {"Fc": 0.03, "Fs": 0.05, "vs": 0.3},
    "presliding": {"Fc": 0.03, "xs": 5e-3},
    "lugre": {"Fc": 0.03, "xs": 5e-3, "Fs": 0.05, "vs": 0.3},
    "friction_variation": {"depth": 0.3, "phase": 0.4, "n": 3.0},
    "load_friction": {"mu": 0.2},
    "offset": {"off": 0.02},
    "gravity": {"amp": 0.03, "phase": 0.4},
    "cogging": {"amp": 0.01, "phase": 0.4, "n": 6.0, "amp2": 0.002, "phase2": 1.0},
    "spring": {"k": 0.05},
    "torque_ripple": {"depth": 0.2, "phase": 0.7, "n": 4.0},
    "delay": {"delay": 2.4e-3},
    "lag": {"tau": 3e-3},
    "saturation": {"limit": 0.1},
    "slew_limit": {"rate": 2.0},
    "supply_limit": {"F0": 0.12, "v0": 15.0},
    "thermal_gain": {"loss": 0.8, "tau": 2.0},
    "elastic": {"f_res": 18.0, "load_fraction": 0.4, "zeta": 0.05},
    "payload": {"J_extra": 6e-4},
    "hardening_spring": {"k3": 0.02},
    "asymmetric_spring": {"d": 0.03},
    "dead_band": {"w": 0.03},
    "gain_asymmetry": {"d": 0.1},
    "power_drag": {"c": 5e-3, "n": 1.5},
    "quadratic_direction": {"c": 1e-4},
    "load_square_friction": {"g": 0.4},
    "swinging_load": {"f_res": 1.0, "load_fraction": 0.4, "zeta": 0.02},
}
#: What an effect acts on that does nothing alone.
BESIDE = {"friction_variation": ("coulomb", "stribeck", "presliding", "lugre")}


def driven(model: AxisModel, force: np.ndarray = FORCE) -> tuple[np.ndarray, np.ndarray]:
    """Return the true positions of the twin (second of two motors) and of the simulation."""
    force = np.concatenate([[0.0], force])  # what is recorded from the first sample on may act from before
    motors, effects, laws = twins({1: model}, [Motor(1.0), Motor(1.0, coulomb=5.0)], ["other", "axis"], DT)
    bank, x = MotorBank(motors, DT, effects, laws=laws), []
    for f in force:
        x.append(bank.position[1])
        bank.advance(np.array([0.3, f]))
    run = track(replace(model, controller=None), np.zeros(len(force)), force, None)
    return np.array(x), run.x


@pytest.mark.parametrize(("name", "beside"), [(n, b) for n in sorted(CASES) for b in BESIDE.get(n, ("",))])
def test_the_twin_moves_as_the_simulation(name: str, beside: str) -> None:
    axis = AXIS.with_effect(beside, CASES[beside]) if beside else AXIS
    twin, simulated = driven(axis.with_effect(name, CASES[name]))
    bare, _ = driven(axis)
    size = float(np.max(np.abs(simulated - bare)))
    assert size > 1e-3  # the effect does something
    assert np.max(np.abs(twin - simulated)) < 0.01 * size


def test_all_effects_that_a_plant_can_carry_out_have_a_case() -> None:
    sensor = {n for n, e in library().items() if e.channel is Channel.SENSOR}
    without = {n for n, e in library().items() if e.mechanism is not NONE and e.mechanism.twin is None}
    assert without == {"warming_friction"}
    assert {n for n, e in library().items() if not e.mechanism.bounces} == set(CASES) | sensor | without


def test_backlash_plays_and_hits_as_in_the_simulation() -> None:
    """Two contact models never agree to the bounce; the momentum of both masses does."""
    model = AXIS.with_effect("backlash", {"gap": 0.05, "load_fraction": 0.5, "f_contact": 100.0, "zeta": 0.5})
    twin, simulated = driven(model)
    assert np.sqrt(np.mean((twin - simulated) ** 2)) < 0.02 * np.ptp(simulated)


def test_the_sensor_of_the_twin_reads_as_the_model_says() -> None:
    model = replace(AXIS, resolution=1e-4)
    for name, values in (
        ("encoder_scale", {"gain": 1.02}),
        ("encoder_quantisation", {"factor": 8.0}),
        ("eccentricity", {"amp": 0.01, "phase": 0.5}),
        ("interpolation_error", {"amp": 0.005, "phase": 1.1, "n": 64.0}),
    ):
        model = model.with_effect(name, values)
    motors, effects, laws = twins({0: model}, [Motor(1.0)], ["axis"], DT)
    bank = MotorBank(motors, DT, effects, laws=laws)
    for f in FORCE[:900]:
        bank.advance(np.array([f]))
    x = bank.position[0]
    wanted = 1.02 * (x + 0.01 * np.sin(x + 0.5) + 0.005 * np.sin(64.0 * x + 1.1))
    assert abs(x) > 0.2
    assert abs(bank.encoder.position[0] - wanted) <= 8e-4
    assert round(bank.encoder.position[0] / 8e-4, 6) % 1 == 0


def test_a_users_own_effect_acts_in_the_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    @state_function
    def detent(x, v, u, temperature, p):  # type: ignore[no-untyped-def]
        return -p[0] * np.tanh(5.0 * x)

    own = Effect(
        name="detent", title="detent", channel=Channel.MECHANICS, slot=Slot.FORCE, function=detent,
        equation="F = -h tanh(5 x)", parameters=(Parameter("h", "{F}", Ref.FORCE, 0.0, 1.0, 0.05, "height"),),
        signature="at zero", confounders=("spring",), separate="the whole range",
    )  # fmt: skip
    monkeypatch.setitem(known(), "detent", own)
    twin, _ = driven(replace(AXIS, effects={"detent": {"h": 0.06}}))
    other, _ = driven(AXIS)
    assert np.max(np.abs(twin - other)) > 0.05


def test_a_term_that_no_plant_can_carry_out_is_refused() -> None:
    model = AXIS.with_effect("term_turn_inertia", {"dJ": 1e-4, "phase": 0.0, "n": 1.0})
    with pytest.raises(ValueError, match="switch the effect off"):
        driven(model)
