"""Commands that were dropped leave nothing behind: what comes after them runs as on axes that never had any."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from motion_rig import MODE, Cell, Rig, axis, records

from sioms.motion import CommandError

SYNCH, TIMED = MODE.WAIT_FOR_EXTERNAL_SYNCH, MODE.SPECIFIED_TIME
MS = 1_000_000
Step = tuple[str, Any, int]

place = st.floats(-0.2, 0.2).map(lambda x: round(x, 3))
command = st.one_of(
    st.builds(lambda p, s: {"mode": MODE.POSITION | s, "position": p}, place, st.sampled_from([0, SYNCH])),
    st.builds(
        lambda p, t, s: {"mode": MODE.POSITION | TIMED | s, "position": p, "time": t},
        place, st.sampled_from([0.4, 0.9]), st.sampled_from([0, SYNCH]),
    ),
    st.builds(
        lambda v, t, s: {"mode": MODE.VELOCITY | TIMED | s, "velocity": v, "time": t},
        place, st.sampled_from([0.1, 0.3, -1.0]), st.sampled_from([0, SYNCH]),
    ),
)  # fmt: skip
axes = st.sampled_from([[0], [1], [0, 1]])
ticks = st.integers(0, 60)
step = st.one_of(
    st.tuples(st.sampled_from(["append", "replace"]), st.tuples(command, axes), ticks),
    st.tuples(st.just("synch"), st.tuples(st.integers(0, 400), axes), ticks),
    st.tuples(st.sampled_from(["flush", "stop"]), axes, ticks),
)
gated = {"mode": MODE.POSITION | SYNCH, "position": 0.1}
armed = st.builds(
    lambda fields, lead: [("append", (fields, [0, 1]), 3), ("synch", (lead, [0, 1]), 2)],
    st.sampled_from([gated, {"mode": MODE.VELOCITY | TIMED | SYNCH, "velocity": 0.05, "time": 0.4}]),
    st.integers(50, 400),
)
"""A start that is given but still to come."""
begun = st.builds(
    lambda first, last: first + last, st.lists(step, max_size=4), st.one_of(armed, st.lists(step, max_size=2))
)
death = st.sampled_from(["flush", "stop", "emergency", "fault", "replaced", "place"])


GO = {"mode": MODE.POSITION, "position": 0.1}
TIMED_MOVE = {"mode": MODE.VELOCITY | TIMED, "velocity": 0.05, "time": 0.3}


class Moved:
    """A bank of two axes with its plant; ``run`` lets time pass."""

    def __init__(self, closed_by_host: bool, start: list[float], now_ns: int) -> None:
        self.host = closed_by_host
        if closed_by_host:
            self.rig: Any = Rig([axis(), axis()], start=start)
        else:
            self.rig = Cell(2, start)
        self.rig.now_ns = max(self.rig.now_ns, now_ns)
        self.bank: Any = self.rig.bank
        self.run(3)
        self.traces: list[np.ndarray] = []

    def run(self, count: int) -> None:
        for _ in range(count):
            self.rig.tick() if self.host else self.rig.poll()
            if hasattr(self, "traces"):
                self.traces.append(self.bank.rows["commanded_position" if self.host else "position"].copy())

    def do(self, verb: str, what: Any, pause: int) -> None:
        now_ns = self.rig.now_ns
        try:
            if verb in ("append", "replace"):
                fields, chosen = what
                self.bank.append(
                    np.concatenate([records(**fields, axis=i) for i in chosen]), [0, 1], now_ns,
                    replace=verb == "replace",
                )  # fmt: skip
            elif verb == "synch":
                self.bank.synch(what[1], now_ns + what[0] * MS, now_ns)
            elif verb == "stop":
                self.bank.stop(what, now_ns)
            else:
                self.bank.flush(what)
        except CommandError:
            pass
        if not self.host:
            self.rig.send()
        self.run(pause)

    def die(self, how: str) -> None:
        """End all commands, in one of the ways in which they end; wait until the axes rest."""
        both, now_ns = [0, 1], self.rig.now_ns
        if how == "flush":
            self.bank.flush(both)
        elif how == "stop":
            self.bank.stop(both, now_ns)
        elif how == "emergency":
            self.bank.emergency_stop(both, now_ns)
        elif how == "replaced":
            self.do("replace", ({"mode": MODE.VELOCITY | TIMED, "velocity": 0.01, "time": 0.02}, both), 0)
        else:
            (self.bank.fault if how == "fault" else self.bank.lose_place)(both, "of the test", now_ns)
        if not self.host:
            self.rig.send()
        self.run(4)
        for patience in (200, 400):
            for _ in range(patience):
                if self.bank.is_idle(both):
                    break
                self.run(1)
            if self.bank.is_idle(both):
                break
            self.bank.stop(both, self.rig.now_ns)  # a jog, which a flush leaves alone
        assert self.bank.is_idle(both)
        self.bank.reset(both)
        if how == "place":
            self.bank.set_homed(both)
        self.run(4)

    def at(self) -> list[float]:
        return [float(p) for p in (self.rig.raw if self.host else [d.position for d in self.rig.drives])]


@pytest.mark.parametrize("closed_by_host", [True, False])
@example([("append", (gated, [0]), 3), ("synch", (300, [0]), 2)], "flush", [("append", (GO, [0]), 0)])
@example([("append", (gated, [0]), 3), ("synch", (300, [0]), 2)], "stop", [("append", (GO, [0]), 0)])
@example([("append", (TIMED_MOVE, [0]), 9)], "stop", [("append", (TIMED_MOVE, [0]), 0)])
@settings(max_examples=30, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(before=begun, how=death, after=st.lists(step, min_size=1, max_size=4))
def test_what_follows_runs_as_if_there_had_been_nothing(
    closed_by_host: bool, before: list[Step], how: str, after: list[Step]
) -> None:
    used = Moved(closed_by_host, [0.0, 0.0], 0)
    for each in before:
        used.do(*each)
    used.die(how)
    fresh = Moved(closed_by_host, used.at(), used.rig.now_ns - 3 * (MS if closed_by_host else 10 * MS))
    assert fresh.rig.now_ns == used.rig.now_ns
    used.traces.clear()
    fresh.traces.clear()
    used.rig.events.clear()
    fresh.rig.events.clear()
    used.bank.take_events()
    for moved in (used, fresh):
        for each in after:
            moved.do(*each)
        moved.run(60)
    np.testing.assert_allclose(used.traces, fresh.traces, rtol=0, atol=1e-9)
    told = [[(e.kind, e.axes, e.stamp_ns, e.errno) for e in moved.rig.events] for moved in (used, fresh)]
    assert told[0] == told[1]
