"""Snapshots of an axis, some late and some lost, on the grid of its rate."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sioms.reconcile.live.record import uniform

DT = 1e-3
SPEED = 0.5


def snapshots(at: list[float]) -> list[SimpleNamespace]:
    """Snapshots at times [ticks] of an axis at constant speed under a force that counts the ticks."""
    return [
        SimpleNamespace(
            stamp_ns=round(t * DT * 1e9),
            position=[SPEED * t * DT],
            force=[float(t)],
            commanded_position=[0.0],
        )
        for t in at
    ]


def test_a_lost_tick_is_filled_in_with_the_force_that_was_held() -> None:
    ticks = [t for t in range(600) if t not in (100, 300, 301)]
    (record,) = uniform("run", snapshots(ticks), DT)  # type: ignore[arg-type]
    assert record.name == "run"
    assert len(record) == 600
    np.testing.assert_allclose(record.position, SPEED * DT * np.arange(600), atol=1e-12)
    assert record.force[[99, 100, 101]] == pytest.approx([99.0, 99.0, 101.0])
    assert record.force[[300, 301, 302]] == pytest.approx([299.0, 299.0, 302.0])
    assert record.filled is not None
    assert np.flatnonzero(record.filled).tolist() == [100, 300, 301]


def test_a_place_that_is_filled_in_goes_on_as_the_motion_did() -> None:
    """A straight line between 299 and 302 would lie 1e-6 off: a jump of the speed that no force has made."""
    ticks = [t for t in range(600) if t not in (100, 300, 301)]
    seen = snapshots(ticks)
    for each, t in zip(seen, ticks, strict=True):
        each.position = [0.5 * 1.0 * (t * DT) ** 2]
    (record,) = uniform("run", seen, DT)  # type: ignore[arg-type]
    np.testing.assert_allclose(record.position, 0.5 * (DT * np.arange(600)) ** 2, atol=1e-12)


def test_a_long_hole_parts_the_record_and_a_short_piece_is_left_out() -> None:
    ticks = [*range(400), *range(420, 500), *range(540, 1000)]
    first, second = uniform("run", snapshots(ticks), DT)  # type: ignore[arg-type]
    assert (first.name, second.name) == ("run_1", "run_2")
    assert (len(first), len(second)) == (400, 460)
    assert second.position[0] == pytest.approx(SPEED * DT * 540)
    assert first.time_s is not None
    assert second.time_s is not None
    assert second.time_s[0] == 0.0


def test_nothing_long_enough_is_no_record() -> None:
    assert uniform("run", snapshots([*range(200), *range(300, 500)]), DT) == []  # type: ignore[arg-type]
    assert uniform("run", snapshots([0]), DT) == []  # type: ignore[arg-type]
