"""Coordinates of a user: there and back, limits that change their places, and words that turn."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.client.channel import Answer, Call
from sioms.client.coordinates import UserAxis
from sioms.client.node_verbs import AxisVerbs
from sioms.protocol.flags import NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.protocol.verbs import Write

NAMES = list(WRITE[NodeClass.AXIS])
number = st.floats(-10, 10)
direction = st.sampled_from([1, -1])


class Written(AxisVerbs):
    """Takes what an open node would send."""

    name = "axis"

    def __init__(self) -> None:
        self._waiter = self  # type: ignore[assignment]

    async def call(self, call: Call) -> Answer:
        message = call.message
        if isinstance(message, Write):
            self.record = dict(zip(NAMES, AXIS_WRITE.unpack(message.records), strict=True))
            return Answer(0, [])
        return Answer({"position_min": [-1.0, None], "position_max": [2.0, 5.0]}, [])


@given(number, number, direction)
def test_there_and_back(user: float, offset: float, sign: int) -> None:
    axis = UserAxis(Written(), 0, offset, sign)
    assert axis.to_user(axis.to_node(user)) == pytest.approx(user, abs=1e-12)
    assert (axis.to_node(user + 1.0) > axis.to_node(user)) == (sign > 0)


def test_limits_change_their_places_with_the_direction() -> None:
    for axis, sign, expected in (
        (0, 1, (-0.5, 2.5)),
        (0, -1, (-1.5, 1.5)),
        (1, 1, (None, 5.5)),
        (1, -1, (-4.5, None)),
    ):
        assert UserAxis(Written(), axis, 0.5, sign).limits() == expected


def test_what_has_a_direction_turns_and_what_is_a_size_does_not() -> None:
    node = Written()
    axis = UserAxis(node, 1, 0.5, -1)
    axis.move(0.2, velocity=0.1, max_velocity=1.0, max_acceleration=2.0, time=3.0)
    wanted = {"axis": 1, "velocity": -0.1, "max_velocity": 1.0, "max_acceleration": 2.0, "time": 3.0}
    assert {name: node.record[name] for name in wanted} == wanted and node.record["position"] == pytest.approx(0.3)
    axis.move(0.2, relative=True)
    assert node.record["position"] == -0.2
    with pytest.raises(ValueError, match="direction 0"):
        UserAxis(node, direction=0)
