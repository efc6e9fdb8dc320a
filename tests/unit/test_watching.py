"""What a bench sees of axes from outside."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from sioms.bench.watching import Watch, halting_ns, slowing_ns

MS = 1_000_000


class Node:
    """A node whose snapshots are given: instants [ms] and speeds."""

    name = "mod0"

    def __init__(self, *seen: tuple[int, float]) -> None:
        self._seen = [
            SimpleNamespace(number=i + 1, stamp_ns=at * MS, commanded_velocity=(speed,), velocity=(speed,))
            for i, (at, speed) in enumerate(seen)
        ]

    def read(self) -> Any:
        return SimpleNamespace(number=8)

    def history(self, after: int, *, gone: bool) -> list[Any]:
        return [each for each in self._seen if each.number > after]


def test_an_axis_that_had_no_ticks_before_it_halted_has_halted() -> None:
    node: Any = Node((100, 1.0), (101, 1.0), (121, 0.0), (122, 0.0))
    for look in (halting_ns, slowing_ns):
        assert look(Watch(node), 110 * MS) == 121 * MS


def test_the_speed_that_must_fall_is_that_of_some_ticks_before() -> None:
    node: Any = Node(*[(at, 1.0) for at in range(100, 111)], (111, 0.9), (112, 0.8))
    assert halting_ns(Watch(node), 110 * MS) == 111 * MS


def test_what_has_been_seen_from_the_middle_on_counts_from_there() -> None:
    node: Any = Node((109, 1.0), (110, 1.0), (111, 0.5))
    assert halting_ns(Watch(node), 110 * MS) == 111 * MS
