"""How long a bench measures."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line asks for.

    Attributes:
        quick: seconds instead of minutes.
        trials, soak, frames, files: counts that were asked for, None for the usual.
        targets: of fuzzing, none for all.
        seed: of random numbers.
        picture: file that a sub-bench which draws writes its picture to, empty for none.
    """

    quick: bool = False
    trials: int | None = None
    soak: int | None = None
    frames: int | None = None
    files: int | None = None
    targets: tuple[str, ...] = ()
    seed: int = 1
    picture: str = ""

    def count(self, quick: int, full: int) -> int:
        """Return how many samples to take."""
        return quick if self.quick else full

    def kills(self, quick: int, full: int) -> int:
        """Return how many kills or stops to try."""
        return self.trials if self.trials is not None else self.count(quick, full)

    def slow(self, quick: int, full: int) -> int:
        """Return how often to try what takes a good part of a second: never more than the full number."""
        return min(self.kills(quick, full), full)
