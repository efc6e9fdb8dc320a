"""Readings of a device at rest: what they are while nothing is wrong, and whether any differs later.

A device at rest publishes the same readings again and again. A reading that differs while its messages are bent was
made out of damaged bytes, or out of the reply to another request.
"""

from __future__ import annotations

import contextlib
import time
from typing import Any

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass

from .station import Node, Station

REST_S = 0.2
BAD = int(AnalogStatus.INVALID)
WIDER = 2.0
"""An analog reading may leave the band that it had at rest by so many of its widths."""
LATER_NS = 50_000_000
"""What a reading was made of may have come so long after its time stamp [ns]."""
NOISY, NOISY_S = 50, 0.6
"""Readings of analog nodes that tell how wide that band is, and how long they are waited for [s]."""


class Calm:
    """Watches all nodes of a device. Use it in a ``with`` block.

    Args:
        station: the driver at work; its device is at rest.

    Attributes:
        wrong: readings that differ, in words.
        traffic: the messages when the first of them was seen.
        count: snapshots looked at.
    """

    def __init__(self, station: Station) -> None:
        self._station = station
        self.wrong: list[str] = []
        self.traffic: list[str] = []
        self.count = 0
        self._nodes = [(node, station.cell.open(node.reader)) for node in station.nodes]
        self._numbers = [0] * len(self._nodes)
        self._still: list[Any] = [None] * len(self._nodes)
        self._learn()

    def __enter__(self) -> Calm:
        return self

    def __exit__(self, *_: object) -> None:
        for _node, opened in self._nodes:
            with contextlib.suppress(OSError):
                opened.close()

    def _learn(self) -> None:
        """Note what the readings are now; the first time so many of an analog node that its noise is known."""
        noise, seen = self._station.noise, dict.fromkeys(range(len(self._nodes)), 0)
        fresh = [i for i, (n, _) in enumerate(self._nodes) if n.node_class is NodeClass.ANALOG and n.name not in noise]
        for i, (_, opened) in enumerate(self._nodes):
            self._numbers[i] = opened.read().number
        began_s = time.monotonic()
        while (took_s := time.monotonic() - began_s) < REST_S or (
            took_s < NOISY_S and any(seen[i] < NOISY for i in fresh)
        ):
            time.sleep(0.02)
            for i, (node, opened) in enumerate(self._nodes):
                for snapshot in opened.history(self._numbers[i]):
                    self._numbers[i] = snapshot.number
                    self._still[i] = _widened(node, self._still[i], snapshot)
                    seen[i] += 1
        for i in fresh:
            if self._still[i] is not None:
                lows, highs = self._still[i]
                noise[self._nodes[i][0].name] = [high - low for low, high in zip(lows, highs, strict=True)]

    def watch(self, seconds: float) -> None:
        """Look at all readings for a time."""
        deadline = time.monotonic() + seconds
        while True:
            self.look()
            if time.monotonic() >= deadline:
                return
            time.sleep(0.015)

    def look(self) -> None:
        """Look at the readings since the last look."""
        for i, (node, opened) in enumerate(self._nodes):
            if self._still[i] is None:
                continue
            for snapshot in opened.history(self._numbers[i], gone=True):
                self._numbers[i] = snapshot.number
                self.count += 1
                text = self._differs(node, self._still[i], snapshot)
                if text and not self.wrong:
                    self.traffic = self._station.exchanges(12, snapshot.stamp_ns + LATER_NS)
                if text:
                    self.wrong.append(text)

    def _differs(self, node: Node, still: Any, snapshot: Any) -> str:
        match node.node_class:
            case NodeClass.AXIS:
                return self._axis_differs(node, still, snapshot)
            case NodeClass.BINARY:
                if snapshot.data != still:
                    return f"{node.name}: data {snapshot.data}, at rest {still}"
            case NodeClass.ANALOG:
                lows, highs = still
                noise = self._station.noise.get(node.name, [0.0] * len(lows))
                for c, (value, status) in enumerate(zip(snapshot.data, snapshot.flags, strict=True)):
                    band = WIDER * max(highs[c] - lows[c], noise[c]) + 1e-9 * abs(highs[c])
                    if not lows[c] - band <= value <= highs[c] + band and not status & BAD:
                        return f"{node.name}: channel {c} reads {value:.6g}, at rest {lows[c]:.6g} to {highs[c]:.6g}"
        return ""

    def _axis_differs(self, node: Node, still: Any, snapshot: Any) -> str:
        axis = self._station.rig.axes[0]
        for c, (position, velocity, moving, status) in enumerate(
            zip(snapshot.position, snapshot.velocity, snapshot.in_motion, snapshot.status, strict=True)
        ):
            if abs(position - still[c]) > axis.tolerance:
                return f"{node.name}: axis {c} at {position:.6g}, it rests at {still[c]:.6g}"
            stopping = status & (AxisStatus.STOPPING | AxisStatus.FAULT)  # a lost device is also stopped
            if abs(velocity) > 0.25 * axis.velocity or (moving and not stopping):
                return f"{node.name}: axis {c} velocity {velocity:.4g}, in_motion {moving}, it is at rest"
        return ""


def _widened(node: Node, still: Any, snapshot: Any) -> Any:
    match node.node_class:
        case NodeClass.AXIS:
            return tuple(snapshot.position)
        case NodeClass.BINARY:
            return tuple(snapshot.data)
    lows, highs = still if still is not None else (snapshot.data, snapshot.data)
    return (
        [min(a, b) for a, b in zip(lows, snapshot.data, strict=True)],
        [max(a, b) for a, b in zip(highs, snapshot.data, strict=True)],
    )
