"""Logs slower than the loop, and logs whose force is a row late: what the rows tell, and what is named from them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.checks import runs_the_loop
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.sampling import Sampling, read_as
from sioms.tools.reconcile_input import read_data, read_model

AXES = Path(__file__).parents[2] / "physics" / "reconcile_axes"
QUICK = Options(pictures=False)


def logged(name: str, every: int) -> tuple[Session, AxisModel]:
    """Every so many rows of a recorded axis whose loop runs at 1 kHz, as somebody has them who knows no controller."""
    model = read_model(AXES / name / "nominal.json")
    records = read_data(AXES / name, model).records
    rows = [Record(r.name, r.position[::every], r.force[::every], r.command[::every]) for r in records]  # type: ignore[index]
    return Session(tuple(rows)), replace(model, sample_time_s=every * model.sample_time_s, controller=None)


def test_the_mean_of_a_sample_is_that_of_the_curve_half_a_period_of_the_loop_late() -> None:
    t, w, late = np.arange(400.0), 0.3, 0.2
    record = Record("r", t, np.sin(w * t), external=np.cos(w * t), force_measured=np.sin(w * t))
    (r,) = read_as(Session((record,)), Sampling(late)).records
    middle = slice(10, -10)
    expected = (np.cos(w * (t - late)) - np.cos(w * (t + 1.0 - late))) / w
    np.testing.assert_allclose(r.force[middle], expected[middle], atol=1e-4)
    np.testing.assert_allclose(r.force_measured[middle], expected[middle], atol=1e-4)  # type: ignore[index]
    np.testing.assert_allclose(
        r.external[middle],  # type: ignore[index]
        ((np.sin(w * (t + 1.0)) - np.sin(w * t)) / w)[middle],
        atol=1e-4,
    )


def test_a_force_that_is_a_row_late_is_taken_from_the_row_after() -> None:
    (r,) = read_as(Session((Record("r", np.zeros(4), np.arange(4.0)),)), Sampling(None)).records
    assert r.force.tolist() == [1.0, 2.0, 3.0, 3.0]


def test_a_controller_that_makes_the_rows_tells_that_they_are_those_of_the_loop() -> None:
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    assert runs_the_loop(session, model)
    assert not runs_the_loop(session, replace(model, controller=None))
    assert not prepare(session, model, QUICK).held


def test_a_log_of_200_hz_of_an_axis_that_hides_nothing_is_silent() -> None:
    session, model = logged("s05", 5)
    controller = read_model(AXES / "s05" / "nominal.json").controller
    found = analyse(session, replace(model, controller=controller), QUICK)
    assert found.outcome.value == "none"
    assert found.model.controller == controller
    assert [g.channel for g in found.gaps] == ["force, short windows"]
    assert any("slower than the loop" in note and "1 ms" in note for note in found.notes)


def test_a_log_of_200_hz_shows_stribeck_friction_and_its_numbers() -> None:
    session, model = logged("s18", 5)
    found = analyse(session, model, QUICK)
    (effect,) = found.effects
    values = {p.symbol: p.value for p in effect.parameters}
    assert effect.name == "stribeck"
    assert values["Fc"] == pytest.approx(6.473, rel=0.03)
    assert values["Fs"] == pytest.approx(12.344, rel=0.03)


def test_a_force_logged_with_the_row_after_is_found_by_the_motion() -> None:
    model = replace(read_model(AXES / "s05" / "nominal.json"), controller=None)
    session = read_data(AXES / "s05", model)
    late = tuple(Record(r.name, r.position[1:], r.force[:-1]) for r in session.records)
    ready = prepare(Session(late), model, QUICK)
    assert any("taken from the row after" in note for note in ready.notes)
    np.testing.assert_array_equal(ready.problem.session.records[0].force[:-1], session.records[0].force[1:-1])


def test_rows_of_the_loop_are_read_as_such_without_a_controller() -> None:
    session, model = logged("s05", 1)
    ready = prepare(session, model, QUICK)
    assert ready.held
    assert not ready.points


def test_a_period_that_is_told_needs_no_search_and_leaves_delays_to_be_named() -> None:
    session, model = logged("s05", 5)
    ready = prepare(replace(session, loop_time_s=0.001), model, QUICK)
    assert ready.points
    assert "delay" in ready.names
    assert "delay" not in prepare(session, model, QUICK).names
    assert not prepare(replace(session, loop_time_s=model.sample_time_s), model, QUICK).points


@pytest.mark.timeout(60)
def test_a_pool_of_two_threads_serves_the_fits_of_all_readings() -> None:
    session, model = logged("s05", 5)
    with ThreadPoolExecutor(2) as pool:
        ready = prepare(session, model, replace(QUICK, mapper=pool.map))
    assert ready.points
