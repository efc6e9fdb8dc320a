"""Logs that were polled at no fixed rate: what is interpolated, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.halves import NOTHING
from sioms.reconcile.model import AxisModel
from sioms.reconcile.polled import _fresh, evened, foretold
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import pack, released
from sioms.reconcile.verdict import Outcome

STEP_S = 0.01


def place(t: np.ndarray) -> np.ndarray:
    return np.asarray(0.1 * np.sin(2.0 * np.pi * 0.7 * t) + 0.03 * np.sin(2.0 * np.pi * 1.9 * t))


def force(t: np.ndarray, hz: float = 2.0) -> np.ndarray:
    return np.asarray(5.0 * np.cos(2.0 * np.pi * hz * t))


def polled(seed: int = 1, jitter: float = 0.4, seconds: float = 12.0, hz: float = 2.0) -> Record:
    """What somebody reads who asks a drive about a hundred times a second."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(STEP_S * rng.uniform(1.0 - jitter, 1.0 + jitter, round(seconds / STEP_S)))
    return Record("log", place(t), force(t, hz), time_s=t)


def test_a_cubic_is_foretold_exactly_however_its_rows_lie() -> None:
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.5, 1.5, 40))
    assert np.abs(foretold(t, 1.0 + t - 0.3 * t**2 + 0.01 * t**3)).max() < 1e-9
    assert np.abs(foretold(t, t**4)).max() > 0.1


def test_rows_of_a_polled_log_are_laid_on_the_grid() -> None:
    (session, notes), log = evened(Session((polled(),)), STEP_S), polled()
    assert log.time_s is not None
    (r,) = session.records
    assert r.time_s is not None and np.ptp(np.diff(r.time_s)) < 1e-12 and len(notes) == 1
    t = log.time_s[2] + r.time_s
    assert np.abs(r.position - place(t)).max() < 2e-5 and np.abs(r.force - force(t)).max() < 0.05
    assert len(session.halves) == 2
    for half in session.halves:
        (h,) = half.records
        assert len(h) == len(r) and np.abs(h.position - place(t)).max() < 5e-4
        assert np.std(h.position - place(t)) > 3.0 * np.std(r.position - place(t)), "half the rows err by more"


def test_late_stamps_of_even_samples_are_left_as_they_are() -> None:
    """A logger that notes late what was sampled in time: the position is smooth on the grid, not at the stamps."""
    rng = np.random.default_rng(3)
    t = STEP_S * np.arange(1200)
    late = Record("log", place(t), force(t), time_s=t + STEP_S * rng.uniform(0.0, 0.45, len(t)))
    for r in (late, replace(late, time_s=t), replace(late, time_s=None)):
        session, notes = evened(Session((r,)), STEP_S)
        assert session.records == (r,) and not session.halves and not notes


@pytest.mark.parametrize("seed", range(5))
def test_a_device_that_is_read_between_its_updates_is_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.cumsum(STEP_S * rng.uniform(0.6, 1.4, 1200))
    news = 0.005 * np.floor(t / 0.005 + rng.uniform())
    with pytest.raises(BadInputError, match="true neither at their times nor at even steps"):
        evened(Session((Record("log", place(news), force(news), time_s=t),)), STEP_S)


@pytest.mark.parametrize("seed", range(3))
def test_late_stamps_beside_a_coarse_encoder_are_left_as_they_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = STEP_S * np.arange(1200)
    seen = np.round(place(t) / 5e-3) * 5e-3
    late = Record("log", seen, force(t), time_s=t + STEP_S * rng.uniform(0.0, 0.45, len(t)))
    assert not evened(Session((late,)), STEP_S)[0].halves


def test_lost_samples_of_an_even_log_are_not_a_poll() -> None:
    t = STEP_S * np.delete(np.arange(1200), np.random.default_rng(4).integers(0, 1200, 60))
    assert not evened(Session((Record("log", place(t), force(t), time_s=t),)), STEP_S)[0].halves


@pytest.mark.parametrize("hz", [0.0, 1.3, 3.2])
def test_slow_motion_between_the_steps_of_an_encoder_is_no_old_news(hz: float) -> None:
    """A controlled axis creeps to its target: for many rows neither position nor force changes by a step."""
    t = 0.001 * np.arange(2200)
    moved = np.maximum(t - 0.2, 0.0)
    step = 2.0 * np.pi / 200_000
    x = step * np.floor((1.0 - np.exp(-moved / 0.2) * np.cos(2.0 * np.pi * hz * moved)) / step)
    session, notes = evened(Session((Record("creeping", x, 3.0 * (1.0 - x), time_s=t),)), 0.001)
    assert not notes and len(session.records[0]) == len(t)


def test_a_gap_parts_the_record_and_rows_that_repeat_old_news_are_left_out() -> None:
    r = polled()
    assert r.time_s is not None
    gap = replace(r, time_s=r.time_s + np.where(np.arange(len(r)) >= 600, 0.5, 0.0))
    session, notes = evened(Session((gap,)), STEP_S)
    assert [p.name for p in session.records] == ["log.1", "log.2"] and "read as 2 records" in notes[0]
    assert not session.continuous
    twice = np.sort(np.concatenate([np.arange(len(r)), np.arange(0, len(r), 4)]))
    times = np.sort(np.concatenate([r.time_s, r.time_s[::4] + 0.002]))
    again, notes = evened(Session((Record("log", r.position[twice], r.force[twice], time_s=times),)), STEP_S)
    assert "rows repeat the one before" in notes[0]
    (even,) = again.records
    assert even.time_s is not None
    assert np.abs(even.position - place(times[0] + r.time_s[2] - r.time_s[0] + even.time_s)).max() < 1e-3


@pytest.mark.parametrize(("hz", "what"), [(28.0, "the force changes faster than that"), (2.0, "")])
def test_a_force_that_the_rows_do_not_resolve_is_refused_with_what_would(hz: float, what: str) -> None:
    log = Session((polled(hz=hz),))
    if not what:
        assert evened(log, STEP_S)[0].halves
        return
    with pytest.raises(BadInputError, match=f"{what}.*poll .* times as often"):
        evened(log, STEP_S)


def test_what_moves_faster_than_it_is_polled_is_refused() -> None:
    r = polled()
    assert r.time_s is not None
    fast = replace(r, position=0.1 * np.sin(2.0 * np.pi * 17.0 * r.time_s))
    with pytest.raises(BadInputError, match="it moves faster than that"):
        evened(Session((fast,)), STEP_S)


AXIS = AxisModel(True, 1e-3, 2e-3, 4e-3, 1e-7, 2.0 * np.pi, 0.1, 20.0)


def driven(model: AxisModel) -> Record:
    """A machine that is driven openly, and polled about a hundred times a second."""
    t = np.arange(20_000) * 1e-3
    push = 0.04 * np.sin(2.0 * np.pi * 0.6 * t) + 0.03 * np.sin(2.0 * np.pi * 1.7 * t) + 0.02 * np.sin(20.0 * t)
    run = released(pack(model), push, np.zeros(7))
    rng = np.random.default_rng(7)
    at = np.cumsum(STEP_S * rng.uniform(0.6, 1.4, 1_950))
    at = at[at < t[-1]]
    seen = np.interp(at, t, run.position) + 2e-6 * rng.standard_normal(len(at))
    return Record("log", seen, np.interp(at, t, push), time_s=at)


def test_of_a_polled_log_only_what_stands_on_half_its_rows_is_named_and_nothing_is_never_said() -> None:
    nominal = replace(AXIS, sample_time_s=STEP_S)
    same = analyse(Session((driven(AXIS),)), nominal, Options(pictures=False))
    assert same.outcome is Outcome.UNEXPLAINED and not same.effects and same.notes[-1] == NOTHING
    hidden = AXIS.with_effect("viscous", {"b_extra": 3e-3})
    found = analyse(Session((driven(hidden),)), nominal, Options(pictures=False))
    assert [e.name for e in found.effects] == ["viscous"]
    (b,) = found.effects[0].parameters
    assert b.low < 3e-3 < b.high and found.effects[0].evidence[-1] == "it stands on every other row of the log"


def test_columns_of_half_the_rows_are_told_whatever_the_steps() -> None:
    log = polled()
    with pytest.raises(BadInputError, match="force has 600 samples, position 1200; needs the same number"):
        analyse(
            Session((replace(log, force=log.force[::2]),)), AxisModel(False, STEP_S, 1.0, 0.1, 1e-6, 0.01, 9.0, 1.0)
        )


@pytest.mark.parametrize("size", [0.1, 0.003, 0.001])
def test_rows_of_a_device_without_news_are_left_out_in_slow_motion_as_well(size: float) -> None:
    """News every 20 ms, read every 10; where it turns round the encoder of 10 um passes less than a step a row."""
    rng = np.random.default_rng(1)
    t = np.cumsum(STEP_S * rng.uniform(0.7, 1.3, 1900))
    number = np.floor(t / 0.02).astype(int)
    news = 0.02 * np.arange(number[-1] + 1)
    x = 1e-5 * np.round(size * (np.sin(np.pi * news) + 0.3 * np.sin(2.2 * np.pi * news)) / 1e-5)
    u = force(news) + 0.05 * rng.standard_normal(len(news))
    fresh = _fresh(Record("log", x[number], u[number], time_s=t))
    assert len(fresh) < 1.08 * len(news)
