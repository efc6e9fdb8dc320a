"""The library of axis effects, and how users add their own.

A user's package lists an ``Effect`` (or a tuple of them) under the entry-point group
``sioms.effects``; it then takes part in the workflow, in model files and in simulated axes.
"""

from __future__ import annotations

from functools import cache

from sioms.reconcile.effect import Effect
from sioms.reconcile.effects import (
    amplifier,
    drags,
    drive,
    friction,
    position,
    power,
    sensor,
    smooth,
    springs,
    terms,
    transmission,
)
from sioms.reconcile.library import collect

GROUP = "sioms.effects"
BUILT_IN: tuple[Effect, ...] = (
    *sensor.EFFECTS,
    *drive.EFFECTS,
    *amplifier.EFFECTS,
    *power.EFFECTS,
    *friction.EFFECTS,
    *drags.EFFECTS,
    *position.EFFECTS,
    *springs.EFFECTS,
    *transmission.EFFECTS,
)


@cache
def library() -> dict[str, Effect]:
    """Return every known effect by name: the built-in ones and those of installed packages.

    Raises:
        ValueError: an entry point is no effect, or takes a name that is in use.
    """
    return collect(GROUP, BUILT_IN)


@cache
def known() -> dict[str, Effect]:
    """Return the library and, beside it, the nameless terms that a refusal may offer."""
    return {**library(), **{t.name: t for t in (*terms.TERMS, *smooth.LAWS)}}
