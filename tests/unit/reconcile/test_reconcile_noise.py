"""Noise where no force was measured, records that begin in motion, parameters that lean on their bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.fit import Fit
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.plausible import physical
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.screen import SLOW_HZ, instrument_motion
from sioms.reconcile.search import Searcher
from sioms.reconcile.simulate import simulate, track

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 1e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
FRICTION = 0.1
T = np.arange(12000) * 1e-3
COMMAND = 4.0 * np.sin(0.9 * T * (1.0 + 0.05 * T)) * np.minimum(T / 0.3, 1.0) + 0.3 * np.sin(9.0 * T)


def _session(model: AxisModel, start: int = 0) -> Session:
    run = simulate(model, COMMAND)
    return Session((Record("r", run.position[start:], run.force[start:], COMMAND[start:]),))


@pytest.mark.parametrize("controller", [AXIS.controller, None], ids=["loop", "no loop"])
def test_friction_that_is_alike_everywhere_is_no_noise(controller: Controller | None) -> None:
    hidden = AXIS.with_effect("coulomb", {"Fc": FRICTION})
    ready = prepare(_session(hidden), replace(AXIS, controller=controller), Options())
    right = ready.problem.residual(hidden)
    assert ready.problem.noise.drive < 0.2 * FRICTION
    assert np.sqrt(np.mean(ready.problem.residual(AXIS) ** 2)) > 5.0 * np.sqrt(np.mean(right**2))


def test_noise_of_the_current_sensor_is_not_that_of_the_drive() -> None:
    rng, force, measured = np.random.default_rng(4), 4e-3, 4e-2
    run = simulate(AXIS, COMMAND)
    shaken = replace(AXIS, controller=None)
    u = run.force + force * rng.standard_normal(len(T))
    moved = track(shaken, run.position, u, None)
    position = np.round(moved.x / AXIS.resolution) * AXIS.resolution
    record = Record("r", position, run.force, force_measured=u + measured * rng.standard_normal(len(T)))
    ready = prepare(Session((record,)), shaken, Options())
    assert 0.4 * force < ready.problem.noise.drive < 4.0 * force


def test_an_inertia_that_ignores_the_force_is_told_by_the_loop() -> None:
    ready = prepare(_session(AXIS.with_effect("coulomb", {"Fc": FRICTION})), AXIS, Options())
    searcher = Searcher(ready.problem, (), ready.names)
    assert searcher.follows(AXIS.with_effect("coulomb", {"Fc": 0.5 * FRICTION}), AXIS)
    assert not searcher.follows(AXIS.with_effect("payload", {"J_extra": 15.0 * AXIS.inertia}), AXIS)


def test_a_record_may_begin_in_motion() -> None:
    ready = prepare(_session(AXIS, 2345), AXIS, Options())
    (run,) = ready.problem.runs(AXIS)
    rest = simulate(AXIS, COMMAND)
    assert run.v[0] == pytest.approx(rest.v[2345], rel=0.05)
    assert np.max(np.abs(run.innovation[50:])) < 5.0 * AXIS.resolution


def test_a_motion_without_noise_is_found_without_a_loop() -> None:
    ready = prepare(_session(AXIS), replace(AXIS, controller=None), Options())
    (followed,) = instrument_motion(ready.problem, replace(AXIS, controller=None))
    np.testing.assert_allclose(followed.x[500:-500], COMMAND[500:-500], atol=0.02)
    session = Session(tuple(replace(r, command=None) for r in ready.problem.session.records))
    (slow,) = instrument_motion(replace(ready.problem, session=session), AXIS)
    fast = np.fft.rfftfreq(len(slow.u), 1e-3) > 4.0 * SLOW_HZ
    spectrum = np.abs(np.fft.rfft(slow.u * np.hanning(len(slow.u)))) ** 2
    assert spectrum[fast].sum() < 1e-4 * spectrum.sum()


@pytest.mark.parametrize(("name", "values", "is_one"), [
    ("elastic", {"f_res": 20.0, "load_fraction": 0.4, "zeta": 0.05}, True),
    ("elastic", {"f_res": 20.0, "load_fraction": 0.4, "zeta": 0.25}, True),
    ("elastic", {"f_res": 20.0, "load_fraction": 0.4, "zeta": 0.3}, False),
    ("lugre", {"Fc": 0.1, "xs": 0.003 * 2 * np.pi, "Fs": 0.15, "vs": 0.2}, True),
    ("lugre", {"Fc": 0.1, "xs": 0.003 * 2 * np.pi, "Fs": 0.15, "vs": 2e-4 * 20.0}, False),
    ("lugre", {"Fc": 0.1, "xs": 1e-5 * 2 * np.pi, "Fs": 0.15, "vs": 0.2}, False),
    ("encoder_scale", {"gain": 0.95}, True),
    ("encoder_scale", {"gain": 0.985}, False),
    ("encoder_scale", {"gain": 0.8}, False),
    ("presliding", {"Fc": 0.1, "xs": 0.003 * 2 * np.pi}, True),
    ("presliding", {"Fc": 0.1, "xs": 0.005 * 2 * np.pi}, False),
    ("payload", {"J_extra": 20.0 * 2e-3}, False),
    ("payload", {"J_extra": -0.1e-3}, True),
    ("payload", {"J_extra": -0.01e-3}, False),
    ("stribeck", {"Fc": 0.05, "Fs": 0.1, "vs": 0.2}, True),
    ("stribeck", {"Fc": 0.01, "Fs": 0.1, "vs": 0.2}, False),
    ("offset", {"off": -0.7}, False),
    ("swinging_load", {"f_res": 0.8, "load_fraction": 0.4, "zeta": 0.02}, True),
    ("swinging_load", {"f_res": 0.15, "load_fraction": 0.4, "zeta": 0.02}, False),
    ("thermal_gain", {"loss": 0.3, "tau": 10000.0}, True),
    ("backlash", {"gap": 0.01, "load_fraction": 0.4, "f_contact": 400.0, "zeta": 2.0}, True),
])  # fmt: skip
def test_a_number_that_leans_on_its_bound_is_another_effect(name: str, values: dict[str, float], is_one: bool) -> None:
    fit = Fit(AXIS.with_effect(name, values), (), np.zeros(1), np.empty((1, 0)))
    assert physical(fit, name) is is_one
