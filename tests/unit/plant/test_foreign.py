"""Twins are found by an entry point; nobody who has none asks for one."""

from __future__ import annotations

import pytest

from sioms.plant.foreign import twin


@pytest.mark.parametrize("kind", ["axes", "finger", "force"])
def test_what_makes_twins_is_installed(kind: str) -> None:
    assert callable(twin(kind))


def test_a_kind_that_nobody_makes_is_refused_with_the_group() -> None:
    with pytest.raises(ValueError, match=r"\(tentacle\).*sioms\.twins"):
        twin("tentacle")
