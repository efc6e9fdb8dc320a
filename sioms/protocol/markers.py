"""Marker table: one-shot synchronisation flags in memory shared by the daemon and the drivers.

A marker is named by a number; a reservation returns a *token*, an integer that carries number and
key. Signalling and freeing need the token, waiting takes either. A token stays below 2**50, so it
survives a passage through a double in a stream of numbers.

The daemon alone reserves and frees. Anyone who maps the table (daemon and drivers, never clients)
may signal. A signal stores the generation it meant, so a late signal for a freed and re-reserved
number cannot satisfy the new one, and an old waiter sees the generation move on.

Words of a marker: generation, signalled generation, key (0 = free), stamp_ns of the signal.
"""

MARKERS = 1024
"""Numbers 1 to 1023 can be reserved; 0 means none."""
NUMBER_BITS = 10
KEY_BITS = 40
WORDS = 4
TABLE_SIZE = MARKERS * WORDS * 8


def token_of(number: int, key: int) -> int:
    """Return the token of a marker number (1 to 1023) and its key (1 to 2**40 - 1)."""
    return key << NUMBER_BITS | number


def split_token(token: int) -> tuple[int, int]:
    """Return (number, key) of a token; the key of a bare number is 0."""
    return token & (MARKERS - 1), token >> NUMBER_BITS


class MarkerTable:
    """View of the table in a writable buffer of TABLE_SIZE bytes.

    Concurrency: reserve and free by one process only; signal and state by any, from one thread each.
    """

    def __init__(self, buffer: memoryview) -> None:
        self._words = buffer[:TABLE_SIZE].cast("Q")

    def release(self) -> None:
        """Drop the view, so that the mapping can be closed."""
        self._words.release()

    def reserve(self, number: int, key: int) -> int:
        """Reserve a free number under a key; return its new generation."""
        base = number * WORDS
        generation = self._words[base] + 1
        self._words[base] = generation
        self._words[base + 3] = 0
        self._words[base + 2] = key
        return generation

    def free(self, number: int) -> None:
        """Free a number; waiters of this generation will see it gone."""
        base = number * WORDS
        self._words[base + 2] = 0
        self._words[base] += 1

    def generation(self, number: int) -> int:
        """Return the present generation; it moves on when the number is freed or reserved."""
        return self._words[number * WORDS]

    def is_reserved(self, number: int) -> bool:
        """Tell whether the number is reserved."""
        return 0 < number < MARKERS and self._words[number * WORDS + 2] != 0

    def is_key(self, number: int, key: int) -> bool:
        """Tell whether the key is that of the reservation."""
        return 0 < number < MARKERS and key != 0 and self._words[number * WORDS + 2] == key

    def signal(self, number: int, generation: int, stamp_ns: int) -> bool:
        """Signal once; return whether this call was the first for this generation."""
        base = number * WORDS
        if self._words[base + 1] == generation:
            return False
        self._words[base + 3] = stamp_ns
        self._words[base + 1] = generation
        return True

    def is_signalled(self, number: int, generation: int) -> bool:
        """Tell whether this generation of the marker has been signalled."""
        return self._words[number * WORDS + 1] == generation

    def stamp_ns(self, number: int) -> int:
        """Return the time of the last signal [ns, CLOCK_MONOTONIC], 0 when none."""
        return self._words[number * WORDS + 3]
