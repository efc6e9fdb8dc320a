"""A loading axis relies on its force only while that is measured."""

from __future__ import annotations

import errno
import math
import time
from types import SimpleNamespace
from typing import Any

import pytest
from tool_rig import snapshot

from sioms.lab import loading_axis
from sioms.lab.loading_axis import LoadingAxis
from sioms.lab.stopping import ExperimentStopped
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


class Slow:
    """An axis that presses on a spring, and a program that gets no turn for 0.4 s now and then, in their own time."""

    name = "press"
    surface_m, stiffness = 2e-3, 2000.0

    def __init__(self) -> None:
        self.now_ns, self.turns = 10**9, 0
        self.place = self.target = self.deepest = 0.0
        self.velocity = 0.0
        self.commands = 0
        info = SimpleNamespace(channels=[SimpleNamespace(maximum=0.02, limits={"velocity": 0.1, "acceleration": 1.0})])
        self.axis: Any = SimpleNamespace(
            name="press", info=info, keepalive=lambda: None, command=self.command, stop=self.stop,
            read=lambda: self.snapshot(NodeClass.AXIS), history=lambda after: [self.snapshot(NodeClass.AXIS)],
        )  # fmt: skip
        self.force: Any = SimpleNamespace(
            name="cell", read=lambda: self.snapshot(NodeClass.ANALOG),
            history=lambda after: [self.snapshot(NodeClass.ANALOG)],
        )  # fmt: skip

    def sleep(self, wait_s: float) -> None:
        self.turns += 1
        self.pass_by(wait_s + 0.4 * (self.turns % 25 == 0))

    def pass_by(self, time_s: float) -> None:
        self.now_ns += round(time_s * 1e9)
        self.place = min(self.target, self.place + self.velocity * time_s)
        self.deepest = max(self.deepest, self.place)

    def command(self, **fields: Any) -> int:
        self.target, self.velocity = fields["position"], fields["max_velocity"]
        self.commands += 1
        return -1

    def stop(self) -> None:
        self.target = self.place

    def snapshot(self, node_class: NodeClass) -> Any:
        self.pass_by(0.0)
        if node_class is NodeClass.AXIS:
            given: dict[str, Any] = {"position": [self.place], "in_motion": [int(self.place < self.target)]}
        else:
            given = {"data": [max(0.0, self.place - self.surface_m) * self.stiffness]}
        return _stamped(snapshot(node_class, 1, **given), self.now_ns)


def test_a_program_that_gets_no_turn_presses_no_deeper(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow()
    clock = SimpleNamespace(sleep=slow.sleep, monotonic=lambda: slow.now_ns * 1e-9, monotonic_ns=lambda: slow.now_ns)
    monkeypatch.setattr(loading_axis, "time", clock)
    loading = LoadingAxis(slow.axis, slow.force, 3.0, 1e-3)
    loading.tare_n = 0.0
    way, force = loading._feel(loading_axis.FEEL_M_S, 0.3)
    assert force[-1] > 0.3 and way[-1] == pytest.approx(slow.surface_m + force[-1] / slow.stiffness, abs=1e-4)
    most_m = 2 * loading_axis.FEEL_M_S * loading_axis.AHEAD_S
    assert slow.deepest <= slow.surface_m + 0.3 / slow.stiffness + most_m
    slow.target = slow.place = slow.stiffness = 0.0
    slow.commands = 0
    with pytest.raises(ExperimentStopped, match=r"no 0\.3 N on cell up to 0\.02 m"):
        loading._feel(loading_axis.FEEL_M_S, 0.3)
    assert slow.commands < 0.02 / (0.5 * loading_axis.FEEL_M_S * loading_axis.AHEAD_S) + 2
