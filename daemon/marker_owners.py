"""Reservation of markers: who owns which number, under which key. Pure."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass

from sioms.protocol.markers import KEY_BITS, MARKERS, MarkerTable, split_token, token_of


class MarkerError(Exception):
    """A marker request is refused.

    Args:
        errno_: EINVAL, EPERM or EBUSY.
        text: sentence without full stop.
    """

    def __init__(self, errno_: int, text: str) -> None:
        super().__init__(text)
        self.errno = errno_


@dataclass(frozen=True, slots=True)
class Reservation:
    """A reserved number: its key, generation, and its owner: a session, or whoever it persists for."""

    number: int
    key: int
    generation: int
    owner: object | None


def _random_key() -> int:
    """Return a key that nobody guesses; the module secrets would take a tenth of the daemon's start."""
    return int.from_bytes(os.urandom(8), "little") % (1 << KEY_BITS) or 1


class MarkerOwners:
    """The daemon's side of the marker table.

    Args:
        table: the shared table.
        random_key: source of keys; replaced in tests.
    """

    def __init__(self, table: MarkerTable, random_key: Callable[[], int] = _random_key) -> None:
        self._table = table
        self._key = random_key
        self._reserved: dict[int, Reservation] = {}
        self._next = 1

    def reserve(self, owner: object | None) -> int:
        """Reserve a number; return its token. Numbers are handed out in turn, so that one freed rests.

        Raises:
            MarkerError: EBUSY, no number is free.
        """
        for offset in range(MARKERS - 1):
            number = (self._next - 1 + offset) % (MARKERS - 1) + 1
            if number not in self._reserved:
                key = self._key()
                generation = self._table.reserve(number, key)
                self._reserved[number] = Reservation(number, key, generation, owner)
                self._next = number % (MARKERS - 1) + 1
                return token_of(number, key)
        raise MarkerError(errno.EBUSY, f"reserve marker: all {MARKERS - 1} are taken; free some")

    def entitled(self, token: int, what: str) -> Reservation:
        """Return the reservation a token belongs to.

        Raises:
            MarkerError: EINVAL, not reserved; EPERM, the key is missing or wrong.
        """
        reservation = self.find(token, what)
        if split_token(token)[1] != reservation.key:
            raise MarkerError(
                errno.EPERM,
                f"{what} marker {reservation.number}: the key is missing or wrong; use the token that its reservation "
                "returned",
            )
        return reservation

    def find(self, token: int, what: str) -> Reservation:
        """Return the reservation of a token or bare number; a token must not be of an earlier one.

        Raises:
            MarkerError: EINVAL, not reserved.
        """
        number, key = split_token(token)
        reservation = self._reserved.get(number)
        if reservation is None or (key and key != reservation.key):
            raise MarkerError(errno.EINVAL, f"{what} marker {number}: not reserved; reserve one first")
        return reservation

    def free(self, reservation: Reservation) -> None:
        """Free a number; its waiters are the caller's to wake."""
        del self._reserved[reservation.number]
        self._table.free(reservation.number)

    def owned_by(self, owner: object) -> list[Reservation]:
        """Return the reservations of a session."""
        return [r for r in self._reserved.values() if r.owner == owner]

    def owners(self) -> list[object | None]:
        """Return who owns markers."""
        return [r.owner for r in self._reserved.values()]

    def count_where(self, condition: Callable[[object | None], bool]) -> int:
        """Return how many reservations have an owner for whom a condition holds."""
        return sum(condition(r.owner) for r in self._reserved.values())

    def is_signalled(self, reservation: Reservation) -> bool:
        """Tell whether a reserved marker has been signalled."""
        return self._table.is_signalled(reservation.number, reservation.generation)

    def signal(self, reservation: Reservation, now_ns: int) -> None:
        """Signal a reserved marker."""
        self._table.signal(reservation.number, reservation.generation, now_ns)
