"""What is called untouched is touched by nothing before the final statement; a floor is an estimate of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sioms.reconcile.axis import analyse
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.floor import lap, lap_floor
from sioms.reconcile.prepare import UNTOUCHED, Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.report.pictures import _trace_picture
from sioms.reconcile.timed import Timed
from sioms.reconcile.verdict import Gap, NamedEffect

AXES = Path(__file__).parents[2] / "physics" / "reconcile_axes"
QUICK = Options(pictures=False)
DT = 1e-3


def altered(record: Record, chance: np.random.Generator) -> Record:
    """Return a record whose untouched part comes from another world: another drive, another lattice, another noise."""
    start = int((1.0 - UNTOUCHED) * len(record))
    late = np.arange(len(record)) >= start
    measured = record.force_measured
    return replace(
        record,
        position=np.where(late, record.position + 1e-3 * chance.normal(size=len(record)), record.position),
        force_measured=None
        if measured is None
        else np.where(late, 0.3 * np.roll(measured, 9) + chance.normal(size=len(record)), measured),
    )


@pytest.mark.parametrize("name", ["s05", "s18"])
def test_channels_and_noise_know_nothing_of_the_untouched_part(name: str) -> None:
    model = read_model(AXES / name / "nominal.json")
    session = read_data(AXES / name, model)
    chance = np.random.default_rng(3)
    other = replace(session, records=tuple(altered(r, chance) for r in session.records))
    one, two = (prepare(s, model, QUICK) for s in (session, other))
    assert one.findings == two.findings
    assert one.names == two.names
    assert one.problem.noise == two.problem.noise
    np.testing.assert_array_equal(one.problem.residual(one.model), two.problem.residual(two.model))


def laps(count: int, external: np.ndarray | None) -> Record:
    """Return laps of one command whose force follows it, with noise of 0.1 N and what acts from outside."""
    chance, n = np.random.default_rng(5), 2000
    path = np.tile(np.sin(2.0 * np.pi * np.arange(n) / n), count)
    push = np.zeros(count * n) if external is None else external
    force = 3.0 * path - push + 0.1 * chance.normal(size=count * n)
    return Record("laps", 0.01 * path, force, command=0.01 * path, external=external)


def test_laps_of_all_inputs_show_the_noise() -> None:
    record = laps(4, None)
    assert lap(record, DT) == 2000
    assert lap_floor(record, 2000)[0] == pytest.approx(0.1, rel=0.05)
    repeated = laps(4, np.tile(np.linspace(0.0, 5.0, 2000), 4))
    assert lap(repeated, DT) == 2000


def test_laps_of_the_command_alone_are_none_where_a_known_force_differs() -> None:
    assert lap(laps(4, np.cumsum(np.random.default_rng(2).normal(size=8000)) * 0.05), DT) == 0
    test_signal = laps(4, None)
    assert lap(replace(test_signal, feedforward=np.random.default_rng(1).normal(size=8000)), DT) == 0


def test_a_floor_above_what_is_reached_stays_what_it_is() -> None:
    gap = Gap("force, closed loop", "N", 3.0, 0.8, 1.0)
    assert gap.floor == 1.0 and gap.closed == 1.0
    assert Gap("force, closed loop", "N", 0.9, 0.8, 1.0).closed == 0.0
    assert Gap("force, closed loop", "N", 3.0, 2.0, 1.0).closed == pytest.approx(0.5)


def test_pictures_show_the_records_that_count_and_floor_and_remainder_are_two_numbers() -> None:
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    session = replace(session, records=session.records[:3])  # nothing is hidden, and there is less to search
    *first, last = session.records
    shown = analyse(replace(session, records=tuple(first), final=(last,)), model, Options()).traces
    assert [(t.name, t.untouched_s) for t in shown] == [(last.name, 0.0)]
    verdict = analyse(session, model, Options())
    assert verdict.gaps
    for gap in verdict.gaps:
        assert gap.floor != gap.after and gap.floor_from
    assert [t.name for t in verdict.traces] == [r.name for r in session.records]
    for trace, record in zip(verdict.traces, session.records, strict=True):
        assert trace.untouched_s == pytest.approx((1.0 - UNTOUCHED) * len(record) * model.sample_time_s, abs=2e-3)
    for axes, trace in zip(_trace_picture(Figure(), verdict).axes, verdict.traces, strict=True):
        (shade,) = axes.patches
        assert isinstance(shade, Rectangle)
        assert (shade.get_x(), shade.get_x() + shade.get_width()) == pytest.approx(
            (trace.untouched_s, trace.time_s[-1])
        )


def test_a_force_in_time_is_not_looked_for_in_records_that_had_none() -> None:
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    *first, last = session.records
    ready = prepare(Session(tuple(first), final=(last,)), model, QUICK)
    term = NamedEffect("term_time", "a force in time", "f(t)", "force", (), 0.0, 0.0, None, ())
    force = Timed(tuple(np.ones(len(r)) for r in first), 0.0, term, "a force in time")
    beside = ready.beside(force)
    assert beside.final.session.records[0].external is ready.final.session.records[0].external
    np.testing.assert_array_equal(beside.problem.session.records[0].external, np.ones(len(first[0])))
