"""A value that is flagged INVALID is no number for those who are told no flags."""

from __future__ import annotations

import math
from struct import pack, unpack
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.client.snapshot import SNAPSHOT, Layout
from sioms.protocol.flags import AnalogStatus, NodeClass

FLAGS = (0, int(AnalogStatus.INVALID | AnalogStatus.OVERRUN), int(AnalogStatus.SATURATED), 0, 0, 0)
SEEN: Any = SNAPSHOT[NodeClass.ANALOG](
    pack("<4Q6d6q", 1, 10**9, 0, 0, *range(1, 7), *FLAGS), Layout(NodeClass.ANALOG, 6, list(range(6)), -1)
)


def shown(values: Any) -> list[str]:
    return [f"{value:g}" for value in values]


def test_a_snapshot_tells_what_is_known() -> None:
    assert shown(SEEN.known) == ["1", "nan", "3", "4", "5", "6"]
    assert shown(SEEN.data) == ["1", "2", "3", "4", "5", "6"], "what the driver has published, with its flags"


def test_a_wrench_for_ros() -> None:
    ros2 = pytest.importorskip("sioms.bridges.ros2")
    message = ros2._wrench(SimpleNamespace(name="force0"))(SEEN)
    assert shown(unpack("<6d", message[-48:])) == ["1", "nan", "3", "4", "5", "6"]


def test_a_reading_for_bluesky() -> None:
    devices = pytest.importorskip("sioms.bridges.bluesky.devices")
    detector = SimpleNamespace(info=SimpleNamespace(node_class=NodeClass.ANALOG), keys="abcdef")
    told = devices.Device.told(detector, SEEN)
    assert math.isnan(told["b"]["value"]) and told["c"]["value"] == 3
