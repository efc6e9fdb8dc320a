"""A sample time that nothing shows is told, and never passes for an inertia."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.prepare import Options
from sioms.reconcile.rate import SAMPLE_TIME, as_rate, trusted_blindly
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import replay
from sioms.reconcile.verdict import Outcome

DT, COUNT = 1e-3, 4000
#: A lead-lag of numbers per sample, which holds no time; a law with a derivative, which does.
LEAD = Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
RATE = Controller(4.0, 0.0, 0.0, -0.12, 0.0, 1.8, 100.0)
AXIS = AxisModel(True, DT, 2e-3, 1e-3, 2e-5, 2.0 * np.pi, 0.7, 20.0, LEAD)


def recorded(world: AxisModel, seed: int = 3) -> Record:
    """Record a closed loop that is pushed a little, without the time."""
    t = np.arange(COUNT) * world.sample_time_s
    command = 3.5 * np.sin(2.0 * np.pi * 0.5 * t) + 0.4 * np.sin(2.0 * np.pi * 3.1 * t)
    push = 2e-3 * np.random.default_rng(seed).standard_normal(COUNT)
    run = replay(world, Record("run", command, np.zeros(COUNT), command, external=push))
    return Record("run", run.position, run.force, command)


def test_a_law_per_sample_leaves_the_sample_time_open() -> None:
    assert trusted_blindly(Session((recorded(AXIS),)), AXIS)


def test_a_derivative_in_the_law_tells_the_sample_time() -> None:
    model = replace(AXIS, controller=RATE)
    record = recorded(model)
    assert not trusted_blindly(Session((record,)), model)
    assert trusted_blindly(Session((record,)), replace(model, controller=None))
    assert trusted_blindly(Session((record,)), replace(model, sample_time_s=1.3 * DT)), "it makes the force at neither"


def test_a_time_column_tells_the_sample_time() -> None:
    timed = replace(recorded(AXIS), time_s=DT * np.arange(COUNT))
    assert not trusted_blindly(Session((timed,)), AXIS)


def test_another_sample_time_is_no_payload() -> None:
    """Rows every 1 ms that are said to come every 1.2 ms show an axis of 1.44 times the inertia."""
    said = replace(AXIS, sample_time_s=1.2 * DT)
    session = Session((recorded(AXIS), recorded(AXIS, 4)))
    verdict = analyse(session, said, Options(pictures=False))
    assert verdict.outcome in (Outcome.AMBIGUOUS, Outcome.UNEXPLAINED)
    assert any("rests on the stated sample time of 1.2 ms" in note for note in verdict.notes)
    (payload,) = (e for e in verdict.effects if e.name == "payload")
    assert as_rate(said, payload.parameters[0].value) == pytest.approx(DT, rel=0.02)
    assert any("a sample time of 1 ms" in text for text in payload.evidence)
    assert any(SAMPLE_TIME in names for names in verdict.alternatives)
