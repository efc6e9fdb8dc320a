"""Marker access of a driver process, for the banks."""

from __future__ import annotations

import errno
from collections.abc import Callable

from sioms.motion import CommandError
from sioms.protocol.markers import MarkerTable, split_token


class Markers:
    """MarkerPort of the motion core, on the shared table.

    Args:
        table: the marker table.
        signalled: called with the number after a first signal, so that the daemon wakes waiting clients.
    """

    def __init__(self, table: MarkerTable, signalled: Callable[[int], None]) -> None:
        self._table = table
        self._signalled = signalled

    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        """Return (number, generation) of a reserved marker.

        Raises:
            CommandError: EINVAL, not reserved; EPERM, to signal takes the token.
        """
        number, key = split_token(token_or_number)
        what = "signal" if signal else "wait for"
        if token_or_number < 0 or not self._table.is_reserved(number):
            raise CommandError(errno.EINVAL, f"{what} marker {number}: not reserved; reserve one first")
        if (signal or key) and not self._table.is_key(number, key):
            raise CommandError(
                errno.EPERM,
                f"{what} marker {number}: the key is missing or wrong; use the token of its reservation",
            )
        return number, self._table.generation(number)

    def state(self, number: int, generation: int) -> bool | None:
        """Tell whether the marker is signalled; None when it has been freed."""
        if self._table.generation(number) != generation:
            return None
        return self._table.is_signalled(number, generation)

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        """Signal the marker, unless it has been freed."""
        if self._table.generation(number) == generation and self._table.signal(number, generation, now_ns):
            self._signalled(number)
