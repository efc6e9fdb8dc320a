"""Session parameters are found where a session differs, and stay at nothing where it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.fit import Problem
from sioms.reconcile.floor import OF_WINDOWS, Floor
from sioms.reconcile.gaps import measure, session_states
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import observer
from sioms.reconcile.records import Record, Session
from sioms.reconcile.session import State, applied, knobs
from sioms.reconcile.simulate import replay, simulate

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-5, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
MODEL = AXIS.with_effect("coulomb", {"Fc": 0.06}).with_effect("gravity", {"amp": 0.1, "phase": 0.3})
T = np.arange(6000) * 1e-3
COMMAND = 3.5 * np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)


def problem(world: AxisModel) -> Problem:
    """Record a world with the noise of a good drive."""
    rng = np.random.default_rng(4)
    run = simulate(world, COMMAND)
    force = run.force + 1e-3 * rng.standard_normal(len(T))
    record = Record("next day", run.position, run.force, COMMAND, force)
    return Problem(Session((record,)), observer(AXIS, 1e-5, 2e-3))


def test_the_parameters_that_matter_are_those_of_the_model() -> None:
    assert knobs(AXIS) == ("offset", "viscous")
    assert knobs(MODEL) == ("offset", "dry", "viscous", "zero")
    assert "heat" in knobs(AXIS.with_effect("thermal_gain", {"loss": 0.5, "tau": 10.0}))


def test_a_new_session_is_estimated_and_judged_apart_from_the_frozen_model() -> None:
    changed = replace(MODEL, effects={**MODEL.effects, "coulomb": {"Fc": 0.069}, "offset": {"off": 0.02}})
    p = problem(changed)
    (state,) = session_states(p, MODEL)
    assert state.offset == pytest.approx(0.02, rel=0.1)
    assert state.dry == pytest.approx(1.15, rel=0.03)
    for gap in measure(p, AXIS, MODEL, Floor(1.0, 1.0, OF_WINDOWS), (state,)):
        assert gap.session is not None
        assert gap.frozen is not None
        assert gap.session < 0.3 * gap.frozen
        assert gap.after == pytest.approx(gap.frozen, rel=0.5)  # the frozen score is not improved by it


@pytest.mark.parametrize("seed", range(3))
def test_chance_asks_for_no_change(seed: int) -> None:
    """What the noise of a second gains by a few numbers is no session's."""
    noise = 0.01 * np.random.default_rng(seed).standard_normal(1000)
    quiet = Record("chance", COMMAND[:1000], np.zeros(1000), COMMAND[:1000], external=noise)
    run = replay(MODEL, quiet)
    record = Record("chance", run.position, run.force, COMMAND[:1000])
    (state,) = session_states(Problem(Session((record,)), observer(AXIS, 1e-5, 0.01)), MODEL)
    assert state == State()


def test_the_same_session_asks_for_no_change() -> None:
    (state,) = session_states(problem(MODEL), MODEL)
    assert state == State()


def test_a_shifted_encoder_turns_the_phases_with_it() -> None:
    record = problem(MODEL).session.records[0]
    _, seen = applied(MODEL, record, State(zero=0.5))
    np.testing.assert_allclose(seen.position, record.position - 0.5)
    np.testing.assert_allclose(seen.command, COMMAND - 0.5)  # type: ignore[arg-type]
