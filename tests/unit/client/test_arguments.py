"""What stands for an integer, and what does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sioms.client.arguments import integer


@pytest.mark.parametrize("value", [2, 2.0, np.int32(2), np.float64(2.0)])
def test_flags_are_whole_numbers_of_any_kind(value: Any) -> None:
    assert integer("write io0", value, flags=True) == 2
    assert integer("write io0", True, flags=True) == 1


@pytest.mark.parametrize("value", [2.5, float("nan"), float("inf"), "2", None, [2], np.array([2.0, 3.0])])
def test_what_is_no_whole_number_is_no_flags(value: Any) -> None:
    with pytest.raises(TypeError, match=r"write io0: .*; want an integer"):
        integer("write io0", value, flags=True)


@pytest.mark.parametrize("value", [2.0, True])
def test_elsewhere_a_float_is_no_integer(value: Any) -> None:
    with pytest.raises(TypeError, match="want an integer"):
        integer("IOCTL", value)
