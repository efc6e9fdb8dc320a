"""Coordinates of a user: there and back, limits that change their places, and words that turn."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.client.command import command
from sioms.client.coordinates import UserAxis
from sioms.protocol.flags import NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE

NAMES = list(WRITE[NodeClass.AXIS])
number = st.floats(-10, 10)
direction = st.sampled_from([1, -1])


class Written:
    """Takes what an open node would send."""

    def move(self, position: float, axis: int, *, replace: bool, timeout: float | None, **words: Any) -> int:
        self.record = dict(
            zip(NAMES, AXIS_WRITE.unpack(command(axis, position=position, **words)), strict=True)
        )
        return 0

    def limits(self) -> dict[str, list[float | None]]:
        return {"position_min": [-1.0, None], "position_max": [2.0, 5.0]}


@given(number, number, direction)
def test_there_and_back(user: float, offset: float, sign: int) -> None:
    axis = UserAxis(Written(), 0, offset, sign)  # type: ignore[arg-type]
    assert axis.to_user(axis.to_node(user)) == pytest.approx(user, abs=1e-12)
    assert (axis.to_node(user + 1.0) > axis.to_node(user)) == (sign > 0)


def test_limits_change_their_places_with_the_direction() -> None:
    for axis, sign, expected in (
        (0, 1, (-0.5, 2.5)),
        (0, -1, (-1.5, 1.5)),
        (1, 1, (None, 5.5)),
        (1, -1, (-4.5, None)),
    ):
        assert UserAxis(Written(), axis, 0.5, sign).limits() == expected  # type: ignore[arg-type]


def test_what_has_a_direction_turns_and_what_is_a_size_does_not() -> None:
    node = Written()
    axis = UserAxis(node, 1, 0.5, -1)  # type: ignore[arg-type]
    axis.move(0.2, velocity=0.1, max_velocity=1.0, max_acceleration=2.0, time=3.0)
    wanted = {"axis": 1, "velocity": -0.1, "max_velocity": 1.0, "max_acceleration": 2.0, "time": 3.0}
    assert {name: node.record[name] for name in wanted} == wanted and node.record[
        "position"
    ] == pytest.approx(0.3)
    axis.move(0.2, relative=True)
    assert node.record["position"] == -0.2
    with pytest.raises(ValueError, match="direction 0"):
        UserAxis(node, direction=0)  # type: ignore[arg-type]
