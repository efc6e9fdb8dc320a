"""A loading axis relies on its force only while that is measured."""

from __future__ import annotations

import errno
import math
import time
from types import SimpleNamespace
from typing import Any

import pytest
from tool_rig import snapshot

from sioms.lab.loading_axis import LoadingAxis
from sioms.protocol.flags import AnalogStatus, NodeClass

RATE_HZ = 200.0


class Wall:
    """An axis that goes in evenly, and the force on it: both nodes in one, 0 N up to where it is spoilt."""

    name = "press"
    info = SimpleNamespace(channels=[SimpleNamespace(maximum=1.0, limits={"velocity": 0.1, "acceleration": 1.0})])

    def __init__(self, spoilt: dict[str, float], late_s: float = 0.0) -> None:
        self._spoilt, self._late_ns = spoilt, round(late_s * 1e9)
        self._began_ns = time.monotonic_ns()
        self.stopped = 0
        self.axis: Any = SimpleNamespace(
            name="press", info=self.info, read=lambda: self._at(NodeClass.AXIS), keepalive=lambda: None,
            history=lambda after: [self._at(NodeClass.AXIS)], command=lambda **fields: 0, stop=self._stop,
        )  # fmt: skip
        self.force: Any = SimpleNamespace(
            name="cell", read=lambda: self._at(NodeClass.ANALOG), history=lambda after: [self._at(NodeClass.ANALOG)]
        )

    def _stop(self) -> None:
        self.stopped += 1

    def _at(self, node_class: NodeClass) -> Any:
        if node_class is NodeClass.AXIS:
            return _stamped(snapshot(node_class, 1, in_motion=[1]), time.monotonic_ns())
        spoilt = time.monotonic_ns() - self._began_ns > 30_000_000
        given = {name: [value] for name, value in self._spoilt.items()} if spoilt else {}
        return _stamped(snapshot(node_class, 1, **given), time.monotonic_ns() - spoilt * self._late_ns)


def _stamped(reading: Any, stamp_ns: int) -> Any:
    raw = bytearray(reading._raw)
    raw[:16] = (stamp_ns // round(1e9 / RATE_HZ)).to_bytes(8, "little") + stamp_ns.to_bytes(8, "little")
    return type(reading)(bytes(raw), reading._layout)


@pytest.mark.parametrize(
    ("wall", "why"),
    [
        (Wall({"flags": AnalogStatus.INVALID}), "0, invalid"),
        (Wall({"data": 3.0, "flags": AnalogStatus.SATURATED}), "3, saturated"),
        (Wall({"data": math.nan}), "nan, flagged good"),
        (Wall({}, late_s=0.6), r"the force of cell is 0\.\d+ s old; want 0\.5 s"),
    ],
)
def test_a_surface_is_not_felt_for_with_a_force_that_is_not_known(wall: Wall, why: str) -> None:
    wall._began_ns = time.monotonic_ns()
    loading = LoadingAxis(wall.axis, wall.force, 10.0, 0.01)
    loading.tare_n = 0.0
    with pytest.raises(OSError, match=why) as caught:
        loading.learn()
    assert caught.value.errno == errno.EIO and wall.stopped == 1


def test_a_move_under_guard_stops_with_the_error_and_one_that_lets_go_needs_no_force() -> None:
    wall = Wall({"data": math.nan})
    loading = LoadingAxis(wall.axis, wall.force, 10.0, 0.01)
    loading.tare_n = 0.0
    with pytest.raises(OSError, match="nan"):
        loading.move(wall.axis, 0.1)
    assert wall.stopped == 1
    ends = iter([1, 1, 1, 0])
    wall.axis.read = lambda: _stamped(snapshot(NodeClass.AXIS, 1, in_motion=[next(ends)]), 1)
    loading.move(wall.axis, 0.0, guarded=False)
    assert wall.stopped == 1


def test_a_tare_takes_nothing_that_was_felt_before_it_and_comes_late() -> None:
    """On a busy machine the samples of the touch before came behind the move away from it, and were taken for rest."""
    wall, late = Wall({}), iter(range(1, 1 << 30))
    begin_ns = time.monotonic_ns()

    def history(after: int) -> list[Any]:
        """Give 40 samples of 8 N from before, then samples of 1 N of now."""
        old = next(late) <= 40
        stamp_ns = begin_ns - 1_000_000 if old else time.monotonic_ns()
        return [_stamped(snapshot(NodeClass.ANALOG, 1, data=[8.0 if old else 1.0]), stamp_ns)]

    wall.force.history = history
    loading = LoadingAxis(wall.axis, wall.force, 10.0, 0.01)
    wall.axis.read = lambda: _stamped(snapshot(NodeClass.AXIS, 1), 1)
    loading.tare()
    assert loading.tare_n == 1.0
