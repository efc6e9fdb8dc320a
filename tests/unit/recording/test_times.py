"""The time of a recording: whatever clock its cell has, and however often that begins anew, UTC is right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import recording_rig
from recording_rig import NODES, OFFSET_NS, START_NS, slots, write

from sioms.protocol.clock import UNKNOWN_NS, Clock, Wall
from sioms.recording.live.times import CellTime
from sioms.recording.messages import NodeFormat
from sioms.recording.reader import Recording
from sioms.recording.rewrite import rewrite

ELSEWHERE_NS = 7_000_000_000_000


class Elsewhere(Clock):
    """The clock of a machine that was started earlier than this one by so much."""

    def __init__(self, ahead_ns: int) -> None:
        self._ahead_ns = ahead_ns
        self.wall = Wall(OFFSET_NS - ahead_ns, UNKNOWN_NS, 0)

    @property
    def offset_ns(self) -> int:
        return self._ahead_ns


def test_utc_is_that_of_the_cell_and_goes_on_over_a_new_start_of_its_machine() -> None:
    clock = CellTime(Elsewhere(ELSEWHERE_NS))
    assert clock.offset_ns == OFFSET_NS - ELSEWHERE_NS
    before_ns = clock.now_ns()
    assert not clock.resume(Elsewhere(ELSEWHERE_NS + 1000)), "another estimate of the same clock"
    assert clock.shift_ns == 0
    assert clock.resume(Elsewhere(-5_000_000_000)), "its machine was started 5 s after ours"
    assert 0 <= clock.now_ns() - before_ns < 10**9
    assert clock.resume(Elsewhere(-90_000_000_000)) and 0 <= clock.now_ns() - before_ns < 10**9


def test_instants_of_snapshots_are_moved_and_values_are_not() -> None:
    for node in NODES:
        raw = slots(node, 1, 5)
        form = NodeFormat(node, -1, 1, lambda *_: 1, OFFSET_NS)
        moved = form._shifted(raw, -1000)
        assert (moved[:, 1] == raw[:, 1] - 1000).all() and (moved[:, [0, 2]] == raw[:, [0, 2]]).all()
        assert (moved[:, 3] == raw[:, 3]).all(), "0: it shows nothing that was acknowledged"
        instants = len(node.channels) if node.node_class.name == "BINARY" else 0
        assert (moved[:, 4:] != raw[:, 4:]).any(axis=0).sum() == instants
        assert len(form.messages(raw, -1000)) == len(form.messages(raw))


def test_recordings_of_two_clocks_are_merged_by_utc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = write(tmp_path / "one.mcap", 20)
    offset, start = OFFSET_NS - ELSEWHERE_NS, START_NS + ELSEWHERE_NS + 1_000_000_000
    with monkeypatch.context() as patched:
        patched.setattr(recording_rig, "OFFSET_NS", offset)
        patched.setattr(recording_rig, "START_NS", start)
        two = write(tmp_path / "two.mcap", 20, first=500)
    both = tmp_path / "both.mcap"
    assert rewrite([str(one), str(two)], str(both)) == []
    with Recording(both) as recording:
        table, events = recording.table("mod0"), recording.events()
        assert recording.offset_ns == OFFSET_NS
    assert np.allclose(np.diff(table.stamps_ns[[0, 20]]), 1_000_000_000 + 499_000_000), "in the clock of the first"
    assert events[5].stamp_ns - events[0].stamp_ns == 1_000_000_000
