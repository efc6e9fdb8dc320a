"""The planner of a simulated Grbl controller: straight lines one after the other, with look-ahead, holds and jog
cancel.

Lengths in mm, speeds in mm/s; it knows nothing of lines of text.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

BLOCKS = 15
SLIP_S = 0.03
"""How long a rotor goes on after its pulses end at once."""


@dataclass
class Block:
    """A straight line."""

    target: list[float]
    feed: float


class Planner:
    """Blocks, and where the axes are.

    Args:
        axes: how many.
        settings: of the controller, read as it goes: 110.. greatest speeds [mm/min], 120.. accelerations [mm/s^2].
        admit: called when a block has left, so that waiting lines may come in.
    """

    def __init__(self, axes: int, settings: Mapping[int, float], admit: Callable[[], None]) -> None:
        self.settings, self._admit = settings, admit
        self.position = [0.0] * axes
        self.slip = [0.0] * axes
        self.blocks: deque[Block] = deque()
        self.speed = 0.0
        self.holding = self.cancelling = False

    @property
    def end(self) -> list[float]:
        """Where the last block ends."""
        return self.blocks[-1].target if self.blocks else self.position

    def add(self, target: list[float], feed: float, *, jog: bool) -> None:
        """Take a block; a jog after a cancel that has come to its end is a new one."""
        if jog and not self.blocks:
            self.cancelling = False
        self.blocks.append(Block(target, feed))

    def clear(self) -> None:
        """Forget all blocks and holds; the speed is somebody else's matter."""
        self.blocks.clear()
        self.holding = self.cancelling = False

    def end_at_once(self) -> None:
        """End all motion: the rotors go on for a little, and nobody counts it."""
        if self.blocks and self.speed:
            way = self._way(self.blocks[0])
            length = math.hypot(*way) or 1.0
            self.slip = [s + w / length * self.speed * SLIP_S for s, w in zip(self.slip, way, strict=True)]
        self.clear()
        self.speed = 0.0

    def _way(self, block: Block) -> list[float]:
        return [t - p for t, p in zip(block.target, self.position, strict=True)]

    def _limits_along(self, way: list[float], length: float) -> tuple[float, float]:
        """Return greatest speed and acceleration along a line, so that no axis passes its own."""
        shares = [abs(w) / length for w in way]
        speed = min(self.settings[110 + i] / 60 / s for i, s in enumerate(shares) if s > 1e-9)
        rate = min(self.settings[120 + i] / s for i, s in enumerate(shares) if s > 1e-9)
        return speed, rate

    def _straight_ahead(self, way: list[float], length: float) -> float:
        """Return how far it goes straight on, over this block and those behind it."""
        total, unit, at = length, [w / length for w in way], self.blocks[0].target
        for block in list(self.blocks)[1:]:
            step = [t - a for t, a in zip(block.target, at, strict=True)]
            size = math.hypot(*step)
            if size < 1e-9:
                continue
            if sum(u * s for u, s in zip(unit, step, strict=True)) / size < 0.9999:
                break
            total, at = total + size, block.target
        return total

    def step(self, dt: float) -> bool:
        """Move for a moment; return whether that ended all motion."""
        if not self.blocks:
            return False
        block = self.blocks[0]
        way = self._way(block)
        length = math.hypot(*way)
        if length < 1e-7:
            return self._finish()
        top, rate = self._limits_along(way, length)
        if self.holding or self.cancelling:
            wanted = 0.0
        else:
            half = rate * dt / 2
            ahead = math.sqrt(half * half + 2 * rate * self._straight_ahead(way, length)) - half
            wanted = min(block.feed / 60, top, max(ahead, rate * dt))
        self.speed += max(-rate * dt, min(rate * dt, wanted - self.speed))
        if self.speed <= 0.0:
            return self._rest()
        share = min(1.0, self.speed * dt / length)
        self.position = [p + w * share for p, w in zip(self.position, way, strict=True)]
        if share == 1.0:
            self.position = list(block.target)
            return self._finish()
        return False

    def _finish(self) -> bool:
        self.blocks.popleft()
        self._admit()
        if self.blocks:
            return False
        self.speed = 0.0
        return True

    def _rest(self) -> bool:
        self.speed = 0.0
        if self.cancelling:
            self.cancelling = False
            self.blocks.clear()
            return True
        return False
