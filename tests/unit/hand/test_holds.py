"""Holds in a recording of a workcell: found where both fingers touch and nothing moves, and told by their means."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from recording_rig import START_NS, write_slots

from sioms.hand.command import record
from sioms.hand.holds import Stream, holds
from sioms.hand.survey import COLUMNS, rows_of
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo
from sioms.protocol.records import READ
from sioms.reconcile.files.hand import read_grasps
from sioms.tactile.quality import Quality
from sioms.tactile.sensing import CHANNELS

HZ, LENGTH_S = 50, 24.0
#: From when until when both fingers touch [s], and the loads then by the time [s]: the middle of 1 s at the end counts.
TOUCHED = ((2.0, 12.0), (14.0, 22.0))
LOADS = ((2.0, 0.5), (7.0, 1.0), (14.0, 1.8))
Floats = NDArray[np.float64]


def load_at(time_s: float) -> float:
    """Return the load of both fingers [N]."""
    return next((load for begin, load in LOADS[::-1] if time_s >= begin), 0.0)


def is_touched(time_s: float) -> bool:
    return any(begin <= time_s < end for begin, end in TOUCHED)


def node(name: str, columns: dict[str, Callable[[float], list[float]]], names: list[str], axis: bool) -> Any:
    """Return a node of a recording and its snapshots."""
    node_class = NodeClass.AXIS if axis else NodeClass.ANALOG
    channels = [ChannelInfo(one, "").pack() for one in names]
    told = NodeInfo([name, int(node_class), False, channels, -1, float(HZ), 16, "dev", "x", 2])
    order, count, n = list(READ[node_class]), round(HZ * LENGTH_S), len(names)
    found = np.zeros((count, 4 + len(order) * n), "<u8")
    found[:, 0] = np.arange(1, count + 1)
    found[:, 1] = START_NS + np.arange(count) * (1_000_000_000 // HZ)
    for column, value in columns.items():
        first = 4 + order.index(column) * n
        rows = np.array([value(i / HZ) for i in range(count)])
        as_words = rows.astype("<i8") if column == "flags" else rows.astype("<f8")
        found[:, first : first + n] = np.ascontiguousarray(as_words).view("<u8")
    return told, found


def cell(path: Path, doubt: Quality = Quality.GOOD, pace: float = 1.0, invalid_after_s: float = math.inf) -> Path:
    """Write a recording: two grasps of one object, the first one under two loads; a turn of links from 16 to 17 s."""

    def joints(sign: float) -> Callable[[float], list[float]]:
        return lambda t: [0.1 * sign, 0.2, 1.5 + 0.3 * min(max(t - 16.0, 0.0), 1.0)]

    def shape(time_s: float) -> list[float]:
        told = dict.fromkeys([name for name, *_ in CHANNELS], 0.0)
        if is_touched(time_s):
            told |= {"touched": 1.0, "angle": 1.4, "load": load_at(time_s) / 20e-3, "quality": float(doubt.value)}
        else:
            told |= {"quality": float(Quality.NO_CONTACT.value)}
        return list(told.values())

    def wrist(sign: float) -> Callable[[float], list[float]]:
        return lambda t: [sign * load_at(t) * is_touched(t), 0.0, 0.0, 0.0, 0.0, 0.0]

    def flags(time_s: float) -> list[float]:
        return [float(AnalogStatus.INVALID) if time_s > invalid_after_s else 0.0] * 6

    def behind(_: float) -> list[float]:
        return [0.0, 0.0, 0.25]

    nodes = [
        node(name, {"position": joints(sign), "following_error": behind}, ["x", "y", "th"], True)
        for name, sign in (("left", -1.0), ("right", 1.0))
    ]
    nodes += [node(f"touch{i}.shape", {"data": shape}, [name for name, *_ in CHANNELS], False) for i in (1, 2)]
    nodes += [
        node(f"wrist{i}", {"data": wrist(sign), "flags": flags}, ["fx", "fy", "fz", "tx", "ty", "tz"], False)
        for i, sign in ((1, -1.0), (2, 1.0))
    ]
    nodes += [node("hand.force", {"data": lambda t: [0.0, pace]}, ["force", "pace"], False)]
    return write_slots(path, [one for one, _ in nodes], [told for _, told in nodes])


def taken(tmp_path: Path, *words: str, source: str = "day.mcap") -> list[list[float]]:
    """Run ``sioms hand record --from``; return the rows."""
    parser = argparse.ArgumentParser()
    record.add_arguments(parser)
    out = tmp_path / "day.csv"
    assert record.run(parser.parse_args(["-o", str(out), "--from", str(tmp_path / source), *words])) == 0
    return rows_of(out.read_text())


def test_each_hold_under_one_load_is_a_row_and_each_contact_a_grasp(tmp_path: Path) -> None:
    cell(tmp_path / "day.mcap")
    rows = taken(tmp_path, "--disk", "0.02", "--thing", "3")
    read = read_grasps(tmp_path / "day.csv")
    # 2 to 7 s, 7 to 12 s; 14 to 16 s, and after the turn 17 to 22 s
    assert [row[1] for row in rows] == [0.0, 0.0, 1.0, 1.0]
    assert read.load[:, 1].tolist() == pytest.approx([0.5, 1.0, 1.8, 1.8])
    assert read.joints[:, 5].tolist() == pytest.approx([1.5, 1.5, 1.5, 1.8])
    assert read.command[:, 2] == pytest.approx(read.joints[:, 2] + 0.25)
    assert read.wrist[:, 1, 0] == pytest.approx(read.load[:, 1])
    assert set(read.thing) == {3} and set(read.kind) == {1} and not read.slip.any()
    again = taken(tmp_path, "--append", "--bar", "0.03", "--thing", "4")  # another object of the session
    assert [row[1] for row in again] == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert len(read_grasps(tmp_path / "day.csv")) == 8


def test_an_object_of_which_nothing_is_known_is_neither_disk_nor_bar(tmp_path: Path) -> None:
    cell(tmp_path / "day.mcap", invalid_after_s=0.0)
    taken(tmp_path)
    read = read_grasps(tmp_path / "day.csv")
    assert set(read.kind) == {0} and not read.known.any()
    assert not read.weighed.any()  # what a sensor says is invalid is no force


def test_in_slow_motion_a_hold_is_as_long_in_the_hands_own_time(tmp_path: Path) -> None:
    """At half the pace the hold from 14 to 16 s takes one second, which is too short."""
    cell(tmp_path / "day.mcap", pace=0.5)
    assert [row[COLUMNS.index("th2")] for row in taken(tmp_path)] == pytest.approx([1.5, 1.5, 1.8])


@pytest.mark.parametrize(("change", "words", "said"), [
    ({"doubt": Quality.POOR_FIT}, (), "there is no hold in it"),
    ({}, ("--modules", "left", "wrist1"), "wrist1"),
    ({}, ("--fingers", "touch1.shape", "wrist2"), "want the node shape of a finger"),
    ({}, ("--fingers", "touch1.shape", "touch3.shape"), "no node touch3.shape is recorded"),
    ({}, ("--plane",), "want it without --plane"),
    ({}, ("--slips", "--bar", "0.03"), "want it without --plane, --slips"),
])  # fmt: skip
def test_a_recording_without_grasps_is_refused_in_a_sentence(
    tmp_path: Path, change: dict[str, Any], words: tuple[str, ...], said: str
) -> None:
    cell(tmp_path / "day.mcap", **change)
    with pytest.raises((ValueError, OSError), match=said):
        taken(tmp_path, *words)
    assert not (tmp_path / "day.csv").exists()


def test_loads_that_swing_against_each_other_once_a_second_are_a_hold_and_those_that_go_on_are_none() -> None:
    """The object sticks to the platen; on the average of a second nothing moves. A grasp that turns is no hold."""
    time_s = np.arange(0.0, 6.0, 0.01)
    swing = 0.2 * np.sin(2.0 * math.pi * time_s / 1.1)

    def told(turning: float) -> list[Stream]:
        module = np.zeros((len(time_s), 12))
        module[:, 2] = 1.5 + 5e-3 * swing + turning * time_s
        loads = [1.0 + swing, 1.0 - swing]
        fingers = [np.stack([1.4 + 0.2 * swing, load], axis=1) for load in loads]
        yes = np.ones(len(time_s), dtype=np.bool_)
        return [
            Stream(time_s, module[:, :6], (0, 1, 2, 10, 11, 12)), Stream(time_s, module[:, 6:], (3, 4, 5, 13, 14, 15)),
            *(Stream(time_s, finger, (6 + i, 8 + i), yes) for i, finger in enumerate(fingers)),
        ]  # fmt: skip

    (row,) = holds(told(0.0))
    assert row[10:12] == pytest.approx([1.0, 1.0], abs=0.03) and row[8] == pytest.approx(1.4, abs=6e-3)
    assert holds(told(0.1)) == []
    for count in (0, 1, 150):  # too short
        cut = [s.touched if s.touched is None else s.touched[:count] for s in told(0.0)]
        pairs = zip(told(0.0), cut, strict=True)
        assert holds([Stream(s.time_s[:count], s.values[:count], s.columns, yes) for s, yes in pairs]) == []
