"""Bessel functions by recurrence are those of scipy, order by order."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import jv

from sioms.tactile.bessel import bessel


@pytest.mark.parametrize("highest", [1, 16, 17, 32])
def test_all_orders_are_those_of_scipy(highest: int) -> None:
    z = np.concatenate([[0.0, 1e-9, 1e-3], np.geomspace(0.01, 400.0, 300), np.arange(1.0, 200.0), [highest - 1e-9]])
    found = bessel(highest, z)
    assert found.shape == (z.size, highest + 1)
    assert np.abs(found - jv(np.arange(highest + 1), z[:, None])).max() < 1e-14


def test_small_functions_keep_their_digits() -> None:
    """Terms of a narrow strip are divided by the argument."""
    z = np.array([1e-9, 1e-4, 0.1, 1.0])
    ratio = bessel(8, z)[:, 1:] / z[:, None]
    assert ratio == pytest.approx(jv(np.arange(1, 9), z[:, None]) / z[:, None], rel=1e-12)
