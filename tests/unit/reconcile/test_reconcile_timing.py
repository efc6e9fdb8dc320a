"""Records on an even grid: jittering stamps, lost samples, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.effect import Array
from sioms.reconcile.records import Record, Session
from sioms.reconcile.timing import on_grid, places

DT = 5e-4
N = 6000


def _record(time: Array, kept: Array) -> Record:
    t = np.arange(N) * DT
    x = np.sin(7.0 * t)
    return Record("r", x[kept], np.cos(7.0 * t)[kept], index=(np.arange(N) % 1000 == 7)[kept], time_s=time[kept])


def test_stamps_that_jitter_hide_no_sample_and_make_none() -> None:
    rng = np.random.default_rng(1)
    stamps = 40.0 + 1.0003 * DT * np.arange(N) + 0.1 * DT * rng.standard_normal(N)
    assert np.array_equal(places(stamps, DT), np.arange(N))
    session, notes = on_grid(Session((_record(stamps, np.arange(N)),)), DT)
    assert session.records[0].filled is None
    assert not notes


@pytest.mark.parametrize("share", [0.005, 0.1])
def test_lost_samples_are_put_back_where_they_were(share: float) -> None:
    rng = np.random.default_rng(2)
    kept = np.flatnonzero(rng.random(N) > share)
    session, notes = on_grid(Session((_record(np.arange(N) * DT, kept),)), DT)
    (r,) = session.records
    assert len(r) == kept[-1] - kept[0] + 1
    whole = np.sin(7.0 * DT * np.arange(kept[0], kept[-1] + 1))
    np.testing.assert_allclose(r.position, whole, atol=1e-6)
    assert r.filled is not None
    assert int(r.filled.sum()) == len(r) - len(kept)
    assert r.index is not None
    assert set(np.flatnonzero(r.index) + kept[0]) <= {k * 1000 + 7 for k in range(6)}
    assert "lost" in notes[0]


def test_a_gap_parts_a_record_and_short_rests_are_left_out() -> None:
    kept = np.concatenate([np.arange(0, 2000), np.arange(2100, 2300), np.arange(2500, N)])
    session, notes = on_grid(Session((_record(np.arange(N) * DT, kept),)), DT)
    assert [len(r) for r in session.records] == [2000, N - 2500]
    assert not session.continuous
    np.testing.assert_allclose(session.records[1].position[0], np.sin(7.0 * 2500 * DT))
    assert "gaps" in notes[0]


def test_stamps_of_another_clock_are_left_for_the_check() -> None:
    assert places(np.arange(N) * 2.0 * DT, DT) is None
    backwards = np.arange(N) * DT
    backwards[3000:] -= 0.5
    assert places(backwards, DT) is None


def test_stamps_in_whole_steps_that_come_late_hide_no_sample() -> None:
    late = np.round(np.arange(N) + np.random.default_rng(3).uniform(0.0, 0.7, N)) * DT
    assert np.any(np.diff(late) == 0.0)
    session, notes = on_grid(Session((_record(late, np.arange(N)),)), DT)
    np.testing.assert_allclose(session.records[0].position, np.sin(7.0 * DT * np.arange(N)), atol=1e-12)
    assert session.records[0].filled is None
    assert "jitter" in notes[0]


def test_rows_that_stand_twice_count_once() -> None:
    rows = np.sort(np.concatenate([np.arange(N), [500, 3000, 3001, 5000]]))
    session, notes = on_grid(Session((_record(np.arange(N) * DT, rows),)), DT)
    np.testing.assert_allclose(session.records[0].position, np.sin(7.0 * DT * np.arange(N)), atol=1e-12)
    assert "4 rows" in notes[0]


@pytest.mark.parametrize("stamped", [True, False])
def test_values_that_are_no_numbers_are_lost_samples(stamped: bool) -> None:
    whole = _record(np.arange(N) * DT, np.arange(N))
    position = whole.position.copy()
    position[[100, 101, 2500]] = np.nan
    torn = replace(whole, position=position, time_s=whole.time_s if stamped else None)
    session, notes = on_grid(Session((torn,)), DT)
    np.testing.assert_allclose(session.records[0].position, whole.position, atol=1e-6)
    assert "3 of 6000" in notes[0]
