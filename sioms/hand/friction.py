"""The friction rig: a flat strip of rubber is dragged over an indenter under a weight; what the coefficient is.

A module drags at constant speed through its own stiffness; below the indenter a force sensor tells the normal and the
tangential force. While it slides, their ratio is the coefficient; where it sticks and slips by turns it is the mean
over whole cycles, because the force swings as far above as below. Source: dissertation, section 4.2, table 4.2.

The simulated rig takes the coefficient of `sioms.plant.skin`. Not given in the source and chosen: speed 5 mm/s, forces
at 1 kHz with a noise of 10 mN, a static coefficient 10 % above the sliding one where the indenter conforms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.hand.contacts import FINGER_M
from sioms.plant.planar import GRAVITY
from sioms.plant.skin import friction

Floats = NDArray[np.float64]

TABLE = ((math.inf, 3.4), (12.7e-3, 2.0), (2.5e-3, 2.0), (0.3e-3, 1.4))
"""Radius of the indenter [m] and coefficient: table 4.2."""
WEIGHTS_KG = (0.05, 0.1, 0.2, 0.35, 0.5)
RATE_HZ = 1000
_STEPS = 20  # of the simulation in a sample
_TURNS = 0.3  # share of the fluctuation's power in its largest line, from which on it is one of sticking and slipping
_RISES = 0.6  # of a run, until which the force has come to nine tenths of what it ends at
_NOISES = 5.0  # noises of the sensor that a fluctuation is larger than


@dataclass(frozen=True, slots=True)
class Drag:
    """How the simulated rig drags; immutable.

    Args:
        speed: [m/s].
        stiffness: of the module along the way [N/m].
        damping_ratio: of the slider on it.
        conforming: how far the static coefficient lies above the sliding one where the indenter is flat.
        fades: speed at which that has gone [m/s].
        noise_n: of the force sensor.
        time_s: of a run.
    """

    speed: float = 5e-3
    stiffness: float = 17e3
    damping_ratio: float = 0.02
    conforming: float = 0.1
    fades: float = 1e-3
    noise_n: float = 0.01
    time_s: float = 1.5


@dataclass(frozen=True, slots=True)
class Fitted:
    """What a run tells; immutable.

    Args:
        coefficient: while it slides.
        sticks: whether it sticks and slips by turns.
        cycle_hz: of that; nan where it slides evenly.
    """

    coefficient: float
    sticks: bool
    cycle_hz: float


def curvature_on_finger(radius_m: float) -> float:
    """Return rc [m] of the object that touches the finger as an indenter touches the flat strip: 1/rc = 1/R - 1/rb."""
    bend = 1.0 / radius_m - 1.0 / FINGER_M
    return math.inf if abs(bend) < 1e-9 else 1.0 / bend


def drag(radius_m: float, weight_kg: float, how: Drag, seed: int) -> tuple[Floats, Floats]:
    """Drag the strip over an indenter; return the tangential and the normal force [N], sample by sample.

    Args:
        radius_m: of the indenter; infinite for a flat.
        weight_kg: on the strip, moved with it.
        how: the rig.
        seed: of the noise.
    """
    slide, load = friction(radius_m), weight_kg * GRAVITY
    stick = slide * (1.0 + (how.conforming if math.isinf(radius_m) else 0.0))
    damping = 2.0 * how.damping_ratio * math.sqrt(how.stiffness * weight_kg)
    place = speed = 0.0
    h, count = 1.0 / (RATE_HZ * _STEPS), round(how.time_s * RATE_HZ)
    force = np.empty(count)
    for sample in range(count):
        for step in range(_STEPS):
            pulled = how.speed * h * (sample * _STEPS + step)
            spring = how.stiffness * (pulled - place) + damping * (how.speed - speed)
            if speed <= 0.0 and spring <= stick * load:
                speed, acts = 0.0, max(spring, 0.0)
                continue
            acts = load * (slide + (stick - slide) * math.exp(-((speed / how.fades) ** 2)))
            speed = max(speed + h * (spring - acts) / weight_kg, 0.0)
            place += h * speed
        force[sample] = acts
    noise = np.random.default_rng(seed).normal(0.0, how.noise_n, (2, count))
    return force + noise[0], load + noise[1]


def fit(tangential: Floats, normal: Floats, noise_n: float, rate_hz: float = RATE_HZ) -> Fitted:
    """Tell the coefficient of a run, and by the spectrum of the tangential force whether it sticks and slips.

    Args:
        tangential, normal: forces [N], evenly sampled from rest on.
        noise_n: of the sensor.
        rate_hz: of the samples.

    Raises:
        ValueError: nothing slides: the force still rises in the end.
    """
    reached = int(np.argmax(tangential > 0.9 * np.quantile(tangential, 0.95)))
    sliding = slice(reached + (len(tangential) - reached) // 4, None)
    force, load = tangential[sliding], float(np.mean(normal[sliding]))
    if reached > _RISES * len(tangential):
        raise ValueError("fit friction: the tangential force still rises in the end; want a run that slides")
    rest = force - np.mean(force)
    power = np.abs(np.fft.rfft(rest * np.hanning(len(rest)))) ** 2
    top = int(np.argmax(power[1:])) + 1
    line = float(np.sum(power[max(top - 2, 1) : top + 3]) / np.sum(power[1:]))
    sticks = bool(np.std(rest) > _NOISES * noise_n and line > _TURNS)
    hz = top * rate_hz / len(rest)
    if sticks:  # whole cycles
        cycles = max(int(len(force) * hz / rate_hz), 1)
        force = force[: round(cycles * rate_hz / hz)]
    return Fitted(float(np.mean(force)) / load, sticks, hz if sticks else math.nan)


@dataclass(frozen=True, slots=True)
class Row:
    """An indenter's row of the table; immutable.

    Args:
        radius_m: of the indenter.
        source: coefficient by the source.
        coefficient, deviation: ours, mean and standard deviation over the weights.
        over_load: slope of the coefficient over the load, in standard deviations of that slope.
        sticks: in how many of the runs it stuck and slipped by turns.
        cycle_hz: mean of that; nan where it never did.
    """

    radius_m: float
    source: float
    coefficient: float
    deviation: float
    over_load: float
    sticks: int
    cycle_hz: float


def table(how: Drag = Drag(), weights_kg: Sequence[float] = WEIGHTS_KG, seed: int = 1) -> list[Row]:
    """Drag over every indenter of table 4.2 under every weight."""
    rows = []
    for number, (radius, source) in enumerate(TABLE):
        runs = [
            fit(*drag(radius, weight, how, 100 * seed + 10 * number + i), how.noise_n)
            for i, weight in enumerate(weights_kg)
        ]
        found = np.array([run.coefficient for run in runs])
        slope, spread = _slope(np.array(weights_kg), found)
        cycles = [run.cycle_hz for run in runs if run.sticks]
        mean_hz = float(np.mean(cycles)) if cycles else math.nan
        deviation = float(np.std(found, ddof=1))
        rows.append(Row(radius, source, float(found.mean()), deviation, slope / spread, len(cycles), mean_hz))
    return rows


def _slope(x: Floats, y: Floats) -> tuple[float, float]:
    """Return the slope of a line through points and its standard deviation by their scatter."""
    away = x - x.mean()
    slope = float(away @ y / (away @ away))
    rest = y - y.mean() - slope * away
    return slope, max(math.sqrt(float(rest @ rest) / (len(x) - 2) / float(away @ away)), 1e-12)
