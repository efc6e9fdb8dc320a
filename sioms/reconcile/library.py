"""Collect effects: the built-in ones and those that installed packages bring through an entry point."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TypeVar

from sioms.reconcile.effect import AnyEffect

E = TypeVar("E", bound=AnyEffect)


def collect(group: str, built_in: tuple[E, ...]) -> dict[str, E]:
    """Return the effects of one entry-point group by name.

    Raises:
        ValueError: an entry point is no effect of the kind of the built-in ones, or takes a name that is in use.
    """
    found, kind = {e.name: e for e in built_in}, type(built_in[0])
    for point in entry_points(group=group):
        given = point.load()
        for effect in given if isinstance(given, tuple) else (given,):
            if not isinstance(effect, kind):
                raise ValueError(f"load effect {point.name}: got {type(effect).__name__}; needs {kind.__name__}")
            if effect.name in found:
                raise ValueError(f"load effect {point.name}: the name {effect.name} is in use; choose another")
            found[effect.name] = effect
    return found
