"""The library of effects of a force/torque sensor, in shares of full range.

A user's package lists a ``SensorEffect`` (or a tuple of them) under the entry-point group ``sioms.effects.force``;
``ForceBelief.responding`` takes a function of the reading.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from sioms.reconcile.effect import Channel
from sioms.reconcile.force.belief import Floats, ForceBelief, Loads, lag, late
from sioms.reconcile.library import collect
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, Values, responding, term

GROUP = "sioms.effects.force"
SENSOR, MECHANICS = Channel.SENSOR, Channel.MECHANICS


def _gain(b: ForceBelief, v: Values) -> ForceBelief:
    return replace(b, gain=v["g"])


def squared(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add q l^2 of each component's own load."""
    return reading + p * loads.load**2


def drifting(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add d t."""
    return reading + p * loads.time[:, None]


def warming(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add k (T - T0)."""
    return reading + p * loads.warmth[:, None]


def softening(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Multiply by 1 + k (T - T0)."""
    out: Floats = reading * (1.0 + p[0] * loads.warmth)[:, None]
    return out


def lagging(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add b times the lag of each component's own load; b and reach r per component, power a and share m last."""
    n = reading.shape[1]
    return reading + p[:n] * lag(loads, p[n : 2 * n], float(p[-2]), float(p[-1]))


GAIN = SensorEffect(
    name="gain",
    title="gains that differ from the stated ones",
    channel=SENSOR,
    change=_gain,
    equation="reading_i = (1 + g_i) (stated reading_i)",
    parameters=(Quantity("g", "1", -0.9, 9.0, 0.02, "relative departure of each component's gain", each=True),),
    signature="reading off in proportion to its own load",
    confounders=("cross_talk", "quadratic", "hysteresis"),
    separate="load each component alone, in both directions",
    twins=("cross_talk",),
)
QUADRATIC = SensorEffect(
    name="quadratic",
    title="quadratic terms",
    channel=SENSOR,
    change=responding(squared, "q"),
    equation="reading_i = l_i + q_i l_i^2",
    parameters=(Quantity("q", "1", -1.0, 1.0, 0.01, "at full range, of each component", each=True),),
    signature="off alike for both signs of the load, with its square",
    confounders=("gain", "hysteresis"),
    separate="each component alone in five steps or more, in both directions",
)
DRIFT = SensorEffect(
    name="offset_drift",
    title="zero that drifts with time",
    channel=SENSOR,
    change=responding(drifting, "d"),
    equation="reading_i = l_i + d_i t",
    parameters=(Quantity("d", "1/s", -1.0, 1.0, 1e-5, "of each component", each=True),),
    signature="off in proportion to time, whatever the load",
    confounders=("temperature",),
    separate="ten minutes at zero load at constant temperature, then a temperature step",
    session=("d",),
)
TEMPERATURE = SensorEffect(
    name="temperature",
    title="zero that follows the temperature",
    channel=SENSOR,
    change=responding(warming, "k"),
    equation="reading_i = l_i + k_i (T - T0)",
    parameters=(Quantity("k", "1/K", -1.0, 1.0, 1e-3, "of each component", each=True),),
    signature="off with the temperature, whatever the load",
    confounders=("offset_drift", "temperature_gain"),
    separate="ten minutes at zero load at constant temperature, then a temperature step",
    session=("T0",),
)
TEMPERATURE_GAIN = SensorEffect(
    name="temperature_gain",
    title="gain that follows the temperature",
    channel=SENSOR,
    change=responding(softening, "k"),
    equation="reading = l (1 + k (T - T0))",
    parameters=(Quantity("k", "1/K", -0.2, 0.2, 2e-3, "relative, alike for all components"),),
    signature="off with load times temperature",
    confounders=("temperature", "gain"),
    separate="the same loads cold and warm",
)
HYSTERESIS = SensorEffect(
    name="hysteresis",
    title="hysteresis",
    channel=MECHANICS,
    change=responding(lagging, "b", "r", "a", "m"),
    equation=(
        "reading_i = l_i + b_i ((1 - m) mean over w of (z_w - l_i)/w weighed with w^a - m y_i), z_w the play of width "
        "w about l_i, w up to r_i, y' = 3/r_i l_i' where it falls to 0, 3/r_i l_i' (1 - |y|) beyond"
    ),
    parameters=(
        Quantity("b", "1", 0.0, 0.5, 5e-3, "half width of the loop, of each component", each=True),
        Quantity(
            "r",
            "1",
            5e-3,
            0.5,
            0.05,
            "change of load over which it turns round, of each component",
            each=True,
            starts=(0.03, 0.1, 0.3),
        ),
        Quantity("a", "1", -0.9, 3.0, 0.5, "form of the loop: 0 parabolas, larger fuller at its ends"),
        Quantity("m", "1", 0.0, 1.0, 0.2, "share that forgets where the load turned round"),
    ),
    signature="off one way while the load rises and the other way while it falls",
    confounders=("quadratic", "gain"),
    separate="each component alone up and down in steps, in both directions",
)


def _cross(names: tuple[str, ...]) -> SensorEffect:
    """Cross-talk of a sensor with these components: one row of numbers for each load."""

    def change(b: ForceBelief, v: Values) -> ForceBelief:
        extra = np.stack([v[f"from_{n}"] for n in names], axis=1)
        np.fill_diagonal(extra, 0.0)
        return replace(b, cross=extra)

    return SensorEffect(
        name="cross_talk",
        title="cross-talk between components",
        channel=SENSOR,
        change=change,
        equation="reading_i = l_i + sum over j of x_ij l_j, j not i",
        parameters=tuple(
            Quantity(f"from_{n}", "1", -2.0, 2.0, 0.01, f"reading of each component per load of {n}", each=True)
            for n in names
        ),
        signature="off in proportion to the load of another component",
        confounders=("gain",),
        separate="load each component alone, in both directions",
        twins=("gain",),
    )


def cubed(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add k l^3."""
    return reading + p * (loads.load**2 * loads.load)  # a third power costs ten times as much


def fading(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Multiply by 1 + k t."""
    out: Floats = reading * (1.0 + p[0] * loads.time)[:, None]
    return out


def settling(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add d (1 - exp(-t/tau))."""
    out: Floats = reading - p[:-1] * np.expm1(-loads.time / p[-1])[:, None]
    return out


def coupled(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add k times own load times the first load."""
    return reading + p * loads.load * loads.load[:, :1]


def following(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Take off c of what has not yet come through a lag of tau; c per component, tau last."""
    return reading - p[:-1] * late(loads, float(p[-1]))


def creeping(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add c of the load as it comes through a lag of tau; c per component, tau last."""
    return reading + p[:-1] * (loads.load - late(loads, float(p[-1])))


def bent(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Take off c of what is beyond s, either way; c and s per component."""
    c, s = np.split(p, 2)
    return reading - c * (reading - np.clip(reading, -s, s))


def dulled(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Take off c of what is within s, either way; c and s per component."""
    c, s = np.split(p, 2)
    return reading - c * np.clip(reading, -s, s)


def swelling(reading: Floats, loads: Loads, p: Floats) -> Floats:
    """Add k about a load of m, within w of it; k per component, m and w last."""
    out: Floats = reading + p[:-2] * np.exp(-(((loads.load - p[-2]) / p[-1]) ** 2))
    return out


TERMS = (
    term(
        "late",
        "reading_i = l_i - c_i (l_i - l_i through a lag of tau)",
        following,
        Quantity("c", "1", -1.2, 1.2, 0.01, "what comes late, of each component", each=True),
        Quantity("tau", "s", 1e-3, 1e5, 1.0, "time constant", starts=(2.0, 0.02, 0.1, 0.5, 10.0, 60.0)),
        confounders=("hysteresis", "term_creep"),
    ),
    term(
        "creep",
        "reading_i = l_i + c_i (l_i through a lag of tau)",
        creeping,
        Quantity("c", "1", -1.2, 1.2, 0.01, "what is added in time, of each component", each=True),
        Quantity("tau", "s", 1e-3, 1e5, 1.0, "time constant", starts=(2.0, 0.02, 0.1, 0.5, 10.0, 60.0)),
        confounders=("hysteresis", "gain", "term_late"),
    ),
    term(
        "knee",
        "reading_i = l_i - c_i (|l_i| - s_i) sign(l_i) beyond |l_i| = s_i",
        bent,
        Quantity("c", "1", -1.2, 1.2, 0.02, "slope that is lost there, of each component", each=True),
        Quantity("s", "1", 0.2, 1.0, 0.02, "of full range", each=True, starts=(0.3, 0.45, 0.6, 0.75, 0.9)),
        confounders=("gain", "quadratic", "term_dull"),
    ),
    term(
        "dull",
        "reading_i = l_i - c_i l_i up to |l_i| = s_i, less c_i s_i beyond",
        dulled,
        Quantity("c", "1", -1.2, 1.2, 0.02, "slope that is lost there, of each component", each=True),
        Quantity("s", "1", 1e-3, 0.3, 5e-3, "of full range", each=True, starts=(0.01, 0.03, 0.1)),
        confounders=("gain", "hysteresis", "term_knee"),
    ),
    term(
        "swelling",
        "reading_i = l_i + k_i exp(-((l_i - m)/w)^2)",
        swelling,
        Quantity("k", "1", -1.0, 1.0, 0.01, "size, of each component", each=True),
        Quantity("m", "1", -1.0, 1.0, 0.02, "load", starts=(0.3, -0.9, -0.6, -0.3, 0.0, 0.6, 0.9)),
        Quantity("w", "1", 0.03, 1.0, 0.05, "width", starts=(0.1, 0.25)),
        confounders=("gain", "quadratic"),
    ),
    term(
        "cube",
        "reading_i = l_i + k_i l_i^3",
        cubed,
        Quantity("k", "1", -2.0, 2.0, 0.01, "at full range", each=True),
        confounders=("gain", "quadratic"),
    ),
    term(
        "time",
        "reading = l (1 + k t)",
        fading,
        Quantity("k", "1/s", -0.1, 0.1, 1e-5, "size"),
        confounders=("gain", "temperature_gain"),
    ),
    term(
        "settling",
        "reading_i = l_i + d_i (1 - exp(-t/tau))",
        settling,
        Quantity("d", "1", -1.0, 1.0, 0.01, "at last", each=True),
        Quantity("tau", "s", 0.1, 1e5, 20.0, "time constant", starts=(5.0, 20.0, 60.0, 200.0)),
        confounders=("offset_drift",),
    ),
    term(
        "coupled",
        "reading_i = l_i + k_i l_i l_1",
        coupled,
        Quantity("k", "1", -2.0, 2.0, 0.01, "at full range", each=True),
    ),
)
BUILT_IN = (DRIFT, TEMPERATURE, TEMPERATURE_GAIN, GAIN, QUADRATIC, HYSTERESIS)


@cache
def library(names: tuple[str, ...]) -> dict[str, SensorEffect]:
    """Return every known effect of a sensor with these components, and the nameless terms."""
    own = (_cross(names),) if len(names) > 1 else ()
    return {**collect(GROUP, BUILT_IN), **{e.name: e for e in own}, **{t.name: t for t in TERMS}}
