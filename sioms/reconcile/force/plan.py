"""Programmes of known loads for a force/torque sensor: those of a small catalogue, and those that a stand can apply."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sioms.reconcile.force.belief import Floats, Loads, readings
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.verdict import Proposal

HOLD_S = 10.0
#: A load goes up and down by these shares of the largest, so often.
UP_AND_DOWN, LAPS = np.concatenate([np.linspace(0.0, 1.0, 6), np.linspace(0.8, 0.0, 5)]), 2

#: Name, description and loads.
Plan = tuple[str, str, Loads]


@dataclass(frozen=True, slots=True)
class Push:
    """One way to load a sensor.

    Attributes:
        wrench: components on the sensor per newton [1, m], shape (components,).
        levels: loads to apply, one after the other [N].
    """

    name: str
    text: str
    wrench: tuple[float, ...]
    levels: tuple[float, ...]

    def plan(self, full: Floats) -> Plan:
        """Return its loads as shares of full range."""
        load = np.outer(self.levels, np.array(self.wrench) / full)
        return f"push_{self.name}", self.text, _loads(load, HOLD_S * np.arange(len(load), dtype=np.float64))


def rest(count: int, seconds: float = 600.0) -> Plan:
    """Return some time without a load."""
    time = np.linspace(0.0, seconds, 60)
    text = f"{seconds / 60.0:.3g} minutes at zero load at constant temperature"
    return "rest", text, _loads(np.zeros((60, count)), time)


def _loads(load: Floats, time: Floats, warmth: Floats | None = None) -> Loads:
    return Loads(load, time, 0.0 * time if warmth is None else warmth, np.zeros(len(time), dtype=np.int64))


def catalogue(count: int) -> Sequence[Plan]:
    """Programmes of loads: each component alone, rest, rest with a temperature step, cold and warm."""
    up = np.concatenate([np.linspace(0, 1, 6), np.linspace(0.8, -1, 10), np.linspace(-0.8, 0, 5)])
    alone = np.concatenate([np.outer(up, np.eye(count)[i]) for i in range(count)])
    seconds = HOLD_S * np.arange(len(alone), dtype=np.float64)
    step = np.where(np.arange(60) > 30, 5.0, 0.0)
    twice = np.repeat([-5.0, 5.0], len(alone))
    return (
        (
            "alone",
            "load each component alone in steps up and down, in both directions",
            _loads(alone, seconds),
        ),
        rest(count),
        ("warm", "a temperature step of 5 K at zero load", _loads(np.zeros((60, count)), 0.0 * step, step)),
        (
            "cold and warm",
            "each component alone, cold and 10 K warmer",
            _loads(np.concatenate([alone, alone]), 0.0 * twice, twice),
        ),
    )


def propose(models: Sequence[SensorModel], plans: Sequence[Plan], sigma: Floats) -> tuple[Proposal, ...]:
    """Rank programmes by how far the models differ on them, each pair counted by its worst; best first.

    Args:
        sigma: noise of the readings as shares of full range, shape (components,).
    """
    if len(models) < 2:
        return ()
    found = []
    for name, text, loads in plans:
        said = [readings(m.belief(), loads) / sigma for m in models]
        said = [s - s.mean(0) for s in said]
        apart = min(float(np.sqrt(np.mean((a - b) ** 2))) for i, a in enumerate(said) for b in said[i + 1 :])
        found.append(Proposal(name, text, apart))
    return tuple(sorted(found, key=lambda p: -p.separation))
