"""Logs slower than the loop, and logs whose force is a row late: what the rows tell, and what is named from them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from sioms.reconcile.axis import _explained, _upright, analyse
from sioms.reconcile.controlled import runs_the_loop
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import observer
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.sampling import Sampling, read_as, trusted

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


def test_a_step_between_two_rows_makes_what_follows_count_less_and_ringing_does_not() -> None:
    model = replace(read_model(AXES / "s05" / "nominal.json"), sample_time_s=0.005, controller=None)
    t = np.arange(2000.0)
    step = np.where(t < 1000.0, 0.0, 0.2 * model.rated_force) + 1e-3 * np.sin(0.7 * t) * model.rated_force
    ringing = 0.2 * model.rated_force * np.sin(1.5 * t)
    session = Session(tuple(Record("r", np.zeros(2000), force) for force in (step, ringing)))
    noise = observer(model, model.resolution, 1e-3 * model.rated_force)
    stepped, rung = (r.trust for r in trusted(Problem(session, noise), model).session.records)
    assert stepped is not None
    assert rung is not None
    assert stepped[1000:1010].min() < 0.2
    assert stepped[:990].min() > 0.99
    assert stepped[1200:].min() > 0.99
    assert rung.min() > 0.99


def test_a_force_that_was_filtered_before_it_was_logged_is_read_earlier() -> None:
    session, model = logged("s05", 1)
    share = 1.0 - np.exp(-2.0 * np.pi * 40.0 * model.sample_time_s)
    late = tuple(replace(r, force=lfilter([share], [1.0, share - 1.0], r.force)) for r in session.records)
    ready = prepare(Session(late), model, QUICK)
    (said,) = (note for note in ready.notes if "tells the force late" in note)
    assert 2.0 < float(said.split("some ")[1].split(" ms")[0]) < 5.0
    assert "delay" not in ready.names


@pytest.mark.parametrize("period", ["0.0", "0.02", "'fast'"])
def test_a_period_of_the_loop_that_cannot_be_is_refused(tmp_path: Path, period: str) -> None:
    model = replace(read_model(AXES / "s05" / "nominal.json"), controller=None)
    np.savez(tmp_path / "run.npz", x=np.zeros(1000), u=np.zeros(1000))
    columns = "position = { name = 'x', unit = 'rad' }\nforce = { name = 'u', unit = 'N m' }\n"
    (tmp_path / "columns.toml").write_text(f"loop_time_s = {period}\n[columns]\n{columns}")
    with pytest.raises(BadInputError, match="loop_time_s is"):
        read_data(tmp_path, model)


def test_what_has_come_to_lean_on_its_end_leaves() -> None:
    session, model = logged("s05", 5)
    s = _explained(prepare(session, model, QUICK), QUICK)
    limp = s.found.fit.model.with_effect("elastic", {"f_res": 6.0, "load_fraction": 0.1, "zeta": 0.3})
    leaning = replace(s, found=replace(s.found, fit=replace(s.found.fit, model=limp)))
    upright = _upright(leaning).found
    assert "elastic" not in upright.fit.model.effects
    assert (upright.path[-1].action, upright.path[-1].effect) == ("leave", "elastic")
    assert _upright(s) is s


def test_a_log_of_200_hz_of_an_axis_that_hides_nothing_is_silent() -> None:
    session, model = logged("s05", 5)
    controller = read_model(AXES / "s05" / "nominal.json").controller
    found = analyse(session, replace(model, controller=controller), QUICK)
    assert found.outcome.value == "none"
    assert found.model.controller == controller
    assert "force, closed loop" not in [g.channel for g in found.gaps]
    assert any("slower than the loop" in note and "1 ms" in note for note in found.notes)


def test_a_log_of_200_hz_shows_stribeck_friction_and_its_numbers() -> None:
    session, model = logged("s18", 5)
    found = analyse(replace(session, records=session.records[:2]), model, QUICK)
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
