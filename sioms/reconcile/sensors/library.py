"""Collect effects: the built-in ones and those that installed packages bring through an entry point."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points

from sioms.reconcile.sensors.effect import SensorEffect


@cache
def collect(group: str, built_in: tuple[SensorEffect, ...]) -> dict[str, SensorEffect]:
    """Return the effects of one entry-point group by name.

    Raises:
        ValueError: an entry point is no effect, or takes a name that is in use.
    """
    found = {e.name: e for e in built_in}
    for point in entry_points(group=group):
        given = point.load()
        for effect in given if isinstance(given, tuple) else (given,):
            if not isinstance(effect, SensorEffect):
                raise ValueError(
                    f"load effect {point.name}: got {type(effect).__name__}; needs a SensorEffect"
                )
            if effect.name in found:
                raise ValueError(
                    f"load effect {point.name}: the name {effect.name} is in use; choose another"
                )
            found[effect.name] = effect
    return found
