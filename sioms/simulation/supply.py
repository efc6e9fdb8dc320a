"""What all simulated sensors share: a supply that can be switched off, a stream that can stand still, requests that are
refused.
"""

from __future__ import annotations

from collections.abc import Callable

FOREVER = 1 << 30


class Supply:
    """The supply of a device; while it is off the device is mute and deaf.

    Args:
        clock: of the device [s].
        boot: makes the device begin anew at a time of that clock [s], as after its power came back.
        boot_s: time that it takes from power to readiness [s].
    """

    def __init__(self, clock: Callable[[], float], boot: Callable[[float], None], boot_s: float = 0.0) -> None:
        self._clock, self._boot, self._boot_s = clock, boot, boot_s
        self._on_s = float("-inf")
        self.cycles = 0

    @property
    def is_on(self) -> bool:
        """Whether the device hears and speaks."""
        return self._clock() >= self._on_s

    def cycle(self, off_s: str = "0.2") -> None:
        """Switch it off for some time; all volatile state is gone."""
        self.cycles += 1
        self._on_s = self._clock() + float(off_s) + self._boot_s
        self._boot(self._on_s)


class Standstill:
    """Replaces what a device sends by the last thing it sent, for so many messages."""

    def __init__(self) -> None:
        self._left = 0
        self._last: bytes | None = None

    def set(self, count: str = "") -> None:
        """Stand still for so many messages, 0 = no longer, without a number until told so."""
        self._left = int(count) if count else FOREVER

    @property
    def is_on(self) -> bool:
        """Whether the next message is an old one."""
        return self._left > 0

    def bend(self, message: bytes) -> bytes:
        """Return what is sent instead of a message."""
        if self._left and self._last is not None:
            self._left -= 1
            return self._last
        self._last = message
        return message


class Refusals:
    """Requests that the device refuses: so many of the next ones."""

    def __init__(self) -> None:
        self._left = 0

    def set(self, count: str) -> None:
        """Refuse the next COUNT requests."""
        self._left = int(count)

    def take(self) -> bool:
        """Tell whether this request is one of them."""
        self._left = max(0, self._left - 1) if (refused := self._left > 0) else 0
        return refused
