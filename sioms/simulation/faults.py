"""Faults of a line, injected into what a device sends. The device does not know of them.

A fault holds for a number of messages. ``mute`` loses replies to requests that were carried out, which is what tells a
master that repeats writes from one that does not; ``deaf`` loses the requests.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

FOREVER = 1 << 30


@dataclass
class Faults:
    """Present faults, each with the number of messages that it still holds for."""

    mute: int = 0
    deaf: int = 0
    noise: int = 0
    double: int = 0
    cut: int = 0
    late: int = 0
    delay_s: float = 0.0
    cut_bytes: int = 1
    chance: random.Random = field(default_factory=lambda: random.Random(1))

    def _due(self, name: str) -> bool:
        left: int = getattr(self, name)
        if left > 0:
            setattr(self, name, left - 1)
        return left > 0

    def hears(self) -> bool:
        """Tell whether the next request reaches the device."""
        return not self._due("deaf")

    def outgoing(self, data: bytes) -> tuple[float, bytes]:
        """Return the extra delay [s] and the bytes that leave instead of ``data``."""
        if self._due("mute"):
            return 0.0, b""
        delay_s = self.delay_s if self._due("late") else 0.0
        if self._due("noise"):
            where, bit = self.chance.randrange(len(data)), self.chance.randrange(8)
            data = data[:where] + bytes((data[where] ^ 1 << bit,)) + data[where + 1 :]
        if self._due("cut"):
            data = data[: max(0, len(data) - self.cut_bytes)]
        if self._due("double"):
            data += data
        return delay_s, data

    def datagrams(self, data: bytes) -> list[tuple[float, bytes]]:
        """Return what leaves instead of one datagram, each with its extra delay [s]; doubled, it leaves twice."""
        copies = 2 if self.double > 0 else 1
        delay_s, bent = self.outgoing(data)
        return [(delay_s, bent[: len(bent) // copies])] * copies if bent else []

    def handlers(self) -> dict[str, Callable[..., None]]:
        """Return the commands that set faults: ``noise 3``, ``late 0.2 1``, ``cut 2 4``, ``mute`` ..., ``clear``."""

        def setter(name: str) -> Callable[..., None]:
            return lambda count="": setattr(self, name, int(count) if count else FOREVER)

        def late(delay_s: str, count: str = "") -> None:
            self.delay_s, self.late = float(delay_s), int(count) if count else FOREVER

        def cut(count: str, size: str = "1") -> None:
            self.cut, self.cut_bytes = int(count), int(size)

        def clear() -> None:
            self.mute = self.deaf = self.noise = self.double = self.cut = self.late = 0

        simple = {name: setter(name) for name in ("mute", "deaf", "noise", "double")}
        return {**simple, "late": late, "cut": cut, "clear": clear}
