"""What stands for an integer, and what does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sioms.client.arguments import checked, integer
from sioms.protocol import verbs


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


def test_a_wrong_argument_of_several_is_named() -> None:
    with pytest.raises(TypeError, match=r"^open mod0: lease: None is NoneType; want a number$"):
        checked("open mod0", verbs.Open("mod0", 2, None, None))  # type: ignore[arg-type]


def test_what_is_too_long_is_not_repeated_whole() -> None:
    with pytest.raises(
        ValueError, match=r"^open x{100}x*\.\.\.: node: 5000 characters; want a name of at most "
    ) as found:
        checked("open " + 5000 * "x", verbs.Open(5000 * "x", 2, None, 0.0))
    assert len(str(found.value)) < 300
