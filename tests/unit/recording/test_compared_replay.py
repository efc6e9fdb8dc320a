"""What a replay publishes is compared with its recording to the end, row by row, wherever pieces of either end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from sioms.bench.recorder import _compare

ROWS = np.random.default_rng(5).integers(0, 1 << 63, (50, 9)).astype(np.uint64)
ROWS[:, 0] = np.arange(7, 57)
WIDTH = 6
"""Tick and five values."""


def replayed(first: int) -> Any:
    """Return the rows from one on, numbered by their places, at other times."""
    rows = ROWS.copy()
    rows[:, 0], rows[:, 1], rows[:, 3] = np.arange(1, 51), 5, 6
    return rows[first - 1 :]


def pieces(rows: Any, size: int) -> Iterator[Any]:
    return iter(np.split(rows, range(size, len(rows), size)))


@pytest.mark.parametrize("sizes", [(50, 50), (7, 20), (20, 7), (1, 3)])
def test_rows_are_compared_to_the_end(sizes: tuple[int, int]) -> None:
    def compared(rows: Any) -> tuple[int, int, int]:
        return _compare(pieces(ROWS, sizes[0]), pieces(rows, sizes[1]))

    assert compared(replayed(1)) == (0, 50 * WIDTH, 1)
    assert compared(replayed(4)) == (0, 47 * WIDTH, 4)
    assert compared(replayed(4)[:-5]) == (5 * WIDTH, 47 * WIDTH, 4)
    assert compared(np.delete(replayed(4), [10, 11], axis=0)) == (2 * WIDTH, 47 * WIDTH, 4)
    for column in (2, 4, 8):
        other = replayed(4)
        other[20, column] += np.uint64(1)
        assert compared(other) == (1, 47 * WIDTH, 4)
