"""Records on an even grid: jittering stamps, lost samples, gaps."""

from __future__ import annotations

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
    return Record(
        "r", x[kept], np.cos(7.0 * t)[kept], index=(np.arange(N) % 1000 == 7)[kept], time_s=time[kept]
    )


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
