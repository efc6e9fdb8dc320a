"""The library of effects of the tactile finger. Angles in radians, lengths in metres, outputs as fractions.

A user's package lists a ``SensorEffect`` (or a tuple of them) under the entry-point group
``sioms.effects.tactile``; ``Belief.responding`` takes a function of the output for what the belief has no field for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from sioms.reconcile.effect import Channel
from sioms.reconcile.finger.belief import Belief, Scene
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.library import collect
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, Values, responding

GROUP = "sioms.effects.tactile"
DEG = np.pi / 180.0


def _added(field: str, symbol: str) -> Callable[[Belief, Values], Belief]:
    """Return the change that adds a parameter to a number of the belief, or to that of every element."""

    def change(b: Belief, v: Values) -> Belief:
        old = getattr(b, field)
        new = old + v[symbol] if isinstance(old, np.ndarray) else old + float(v[symbol][0])
        changed: Belief = replace(b, **{field: new})  # type: ignore[arg-type]
        return changed

    return change


def _gain(b: Belief, v: Values) -> Belief:
    return replace(b, gain=b.gain * (1.0 + v["g"]))


def _depth(b: Belief, v: Values) -> Belief:
    return replace(b, radius=np.clip(b.radius + v["dr"], b.core + 1e-5, b.outer - 1e-5))


def _poisson(b: Belief, v: Values) -> Belief:
    return replace(b, poisson=float(np.clip(b.poisson + v["dnu"][0], 0.0, 0.5)))


def _core(b: Belief, v: Values) -> Belief:
    return replace(b, core=min(b.core + float(v["dc"][0]), float(b.radius.min()) - 1e-4))


def _drift(b: Belief, v: Values) -> Belief:
    return replace(b, temperature=b.temperature + v["k"], common=b.common + float(v["k"][0]))


def _creep(b: Belief, v: Values) -> Belief:
    return replace(b, creep=float(v["c"][0]), creep_time=float(v["tau"][0]))


def _sliding(b: Belief, v: Values) -> Belief:
    return replace(b, friction=b.friction + float(v["f"][0]), apex=float(v["apex"][0]))


def pulled(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add A exp(-|distance| / range)."""
    if scene.distance is None:
        return output
    out: Floats = output + p[0] * np.exp(-np.abs(scene.distance) / p[1])
    return out


def _strip(b: Belief, v: Values) -> Belief:
    period = float(v["period"][0])
    loud, wide = ((float(v[a][0]), float(v[turn][0]), period) for a, turn in (("G", "phase"), ("W", "turn")))
    return replace(b, uneven=loud, strip=wide)


def _peak(b: Belief, v: Values) -> Belief:
    return replace(b, peak=(float(v["c"][0]), float(v["width"][0])))


def leaked(output: Floats, scene: Scene, p: Floats) -> Floats:
    """Add a share of both neighbours."""
    out = output.copy()
    out[:, 1:] += p[0] * output[:, :-1]
    out[:, :-1] += p[0] * output[:, 1:]
    return out


def _nothing(b: Belief, v: Values) -> Belief:
    """Leave outputs as they are: found and taken off in the frames themselves."""
    return b


SENSOR, ACTUATOR, MECHANICS = Channel.SENSOR, Channel.ACTUATOR, Channel.MECHANICS

GAIN = SensorEffect(
    name="gain_scatter",
    title="gains that differ from the stated ones",
    channel=SENSOR,
    change=_gain,
    equation="gain_i = stated gain_i (1 + g_i)",
    parameters=(Quantity("g", "1", -0.9, 9.0, 0.1, "relative departure of each element's gain", each=True),),
    signature="output too large or too small in one proportion wherever and however it is touched, element by element",
    confounders=("depth_scatter", "poisson", "strip_inhomogeneity", "soft_skin"),
    separate="edge touches every degree across each element: depth changes the width of the profile, gain does not",
    twins=("depth_scatter", "strip_inhomogeneity"),
)
ANGLE = SensorEffect(
    name="angle_scatter",
    title="elements away from their stated places",
    channel=SENSOR,
    change=_added("angle", "dt"),
    equation="t_i = stated t_i + dt_i",
    parameters=(Quantity("dt", "rad", -0.14, 0.14, 0.01, "departure of each element's angle", each=True),),
    signature="residual like the slope of the profile, of its own size and sign for each element",
    confounders=("angle_offset", "sliding_friction", "gain_scatter", "depth_scatter"),
    separate="edge touches every degree across each element",
)
DEPTH = SensorEffect(
    name="depth_scatter",
    title="elements at other depths than stated",
    channel=SENSOR,
    change=_depth,
    equation="rs_i = stated rs_i + dr_i",
    parameters=(Quantity("dr", "m", -1.2e-3, 1.2e-3, 2e-4, "departure of each element's radius", each=True),),
    signature="profile higher and narrower, or lower and wider, element by element",
    confounders=("gain_scatter", "poisson"),
    separate="edge touches every degree across each element: the width of the profile tells the depth",
    twins=("gain_scatter",),
)
OFFSET = SensorEffect(
    name="angle_offset",
    title="finger and fixture turned against each other",
    channel=ACTUATOR,
    change=_added("offset", "off"),
    equation="place of touch = commanded place + off",
    parameters=(Quantity("off", "rad", -0.2, 0.2, 0.01, "how much further round every touch is"),),
    signature="residual like the slope of the profile, alike for all elements",
    confounders=("angle_scatter", "sliding_friction"),
    separate="the same touches while the indenter drags the other way",
    session=("off",),
)
POISSON = SensorEffect(
    name="poisson",
    title="another Poisson's ratio",
    channel=MECHANICS,
    change=_poisson,
    equation="nu = stated nu + dnu",
    parameters=(Quantity("dnu", "1", -0.16, 0.04, 0.02, "departure of Poisson's ratio"),),
    signature="under the touch and beside it in another proportion, alike for all elements",
    confounders=("adhesion", "hertz", "gain_scatter", "depth_scatter"),
    separate="the same places with an edge and with a flat: adhesion needs a wide contact, Poisson's ratio does not",
)
CORE = SensorEffect(
    name="core_radius",
    title="a core of another radius",
    channel=MECHANICS,
    change=_core,
    equation="ra = stated ra + dc",
    parameters=(Quantity("dc", "m", -6e-4, 6e-4, 1e-4, "departure of the core's radius"),),
    signature="profile wider and larger, or narrower and smaller, alike for all elements",
    confounders=("poisson", "depth_scatter", "soft_skin", "strip_peak", "cross_talk"),
    separate="the same places with an edge and with a flat, over a decade of loads",
    twins=("depth_scatter",),
)
QUADRATIC = SensorEffect(
    name="quadratic",
    title="quadratic response of the electronics",
    channel=SENSOR,
    change=_added("quadratic", "q"),
    equation="d = l + q l^2, l the linear output",
    parameters=(
        Quantity("q", "1", -20.0, 20.0, 2.0, "quadratic coefficient of each element, per unit of output", each=True),
    ),
    signature="residual with the square of the output",
    confounders=("hertz", "gain_scatter", "creep"),
    separate="a decade of loads at one place with an edge and with a flat",
    twins=("hertz",),
)
TEMPERATURE = SensorEffect(
    name="temperature_drift",
    title="drift with temperature, alike for all elements",
    channel=SENSOR,
    change=_drift,
    equation="d = d + k (T - T0)",
    parameters=(Quantity("k", "1/K", -0.5, 0.5, 2e-3, "drift of the output"),),
    signature="untouched outputs move together with the temperature",
    confounders=("creep", "temperature_scatter"),
    separate="a temperature step of 2 K at zero load",
    session=("T0",),
)
TEMPERATURE_EACH = SensorEffect(
    name="temperature_scatter",
    title="drift with temperature, element by element",
    channel=SENSOR,
    change=_added("temperature", "k"),
    equation="d_i = d_i + k_i (T - T0)",
    parameters=(Quantity("k", "1/K", -0.5, 0.5, 2e-3, "drift of each element's output", each=True),),
    signature="untouched outputs move with the temperature, each in its own proportion",
    confounders=("creep", "temperature_drift"),
    separate="a temperature step of 2 K at zero load",
    session=("T0",),
    replaces=("temperature_drift",),
)
CREEP = SensorEffect(
    name="creep",
    title="creep (c > 0) or relaxation (c < 0)",
    channel=MECHANICS,
    change=_creep,
    equation="d(t) = d (1 - c exp(-t/tau)), t since the load came on",
    parameters=(
        Quantity("c", "1", -0.6, 0.6, 0.05, "share of a step that comes late"),
        Quantity("tau", "s", 0.02, 300.0, 0.3, "time constant", starts=(0.1, 0.4, 1.0, 3.0, 12.0)),
    ),
    signature="outputs go on rising (or fall) in one proportion while the load stays",
    confounders=("temperature_drift", "gain_scatter", "quadratic"),
    separate="one touch held for 30 s at constant temperature, and a temperature step at zero load",
    twins=("gain_scatter",),
)
PROXIMITY = SensorEffect(
    name="proximity",
    title="pull of a conducting indenter on the elements' fields",
    channel=SENSOR,
    change=responding(pulled, "A", "range"),
    equation="d_i = d_i + A exp(-|t_i - t_c| / range), A < 0",
    parameters=(
        Quantity("A", "1", -0.5, 0.0, 5e-3, "output that the indenter draws at its own place"),
        Quantity("range", "rad", 0.03, 2.0, 0.05, "angle over which it falls to 1/e", starts=(0.12, 0.25, 0.6)),
    ),
    signature="output lowered wherever the indenter is near, whatever the load",
    confounders=("adhesion", "poisson"),
    separate="bring a grounded and an insulating indenter near before the touch",
)
STRIP = SensorEffect(
    name="strip_inhomogeneity",
    title="copper strips make the layer uneven",
    channel=MECHANICS,
    change=_strip,
    equation="l = l (1 + G sin(2 pi t_c/period + phase)), half width (1 + W sin(2 pi t_c/period + turn))",
    parameters=(
        Quantity("G", "1", 0.0, 0.5, 0.02, "amplitude of the gain over the place of touch"),
        Quantity("phase", "rad", -np.pi, np.pi, 0.3, "phase at angle zero", phase=True),
        Quantity(
            "period",
            "rad",
            0.03,
            1.2,
            2e-3,
            "distance of the strips",
            starts=tuple(2.0 * np.pi / n for n in (*range(8, 22, 1), *range(22, 73, 1))),
        ),
        Quantity("W", "1", -0.5, 0.5, 0.02, "amplitude of the width of contact"),
        Quantity("turn", "rad", -np.pi, np.pi, 0.3, "its phase at angle zero", phase=True),
    ),
    signature="all elements too loud and too quiet together, periodic in the place of touch",
    confounders=("gain_scatter",),
    separate="touches in steps of less than half a period over several periods",
    twins=("gain_scatter",),
)
PEAK = SensorEffect(
    name="strip_peak",
    title="elements more sensitive right over their strips",
    channel=SENSOR,
    change=_peak,
    equation="l_i = l_i (1 + c exp(-((t_i - t_c)/width)^2))",
    parameters=(
        Quantity("c", "1", -0.6, 1.5, 0.05, "how much more an element answers to what is right over it"),
        Quantity("width", "rad", 0.02, 0.5, 0.03, "angle over which that falls to 1/e", starts=(0.04, 0.07, 0.12, 0.2)),
    ),
    signature="profile too high in its middle in one proportion at all loads, alike for all elements",
    confounders=("depth_scatter", "poisson", "quadratic", "cross_talk", "gain_scatter", "proximity", "hertz"),
    separate="edge touches every degree across each element, at a decade of loads",
)
ADHESION = SensorEffect(
    name="adhesion",
    title="the indenter sticks to the skin",
    channel=MECHANICS,
    change=_added("adhesion", "share"),
    equation="q = share * (tangential traction of full adhesion)",
    parameters=(Quantity("share", "1", 0.0, 1.4, 0.4, "share of full adhesion (edge resolved to a/256)"),),
    signature="profile narrower the wider the contact, alike for all elements",
    confounders=("poisson", "hertz", "proximity"),
    separate="the same places with an edge and with a flat: adhesion needs a wide contact, Poisson's ratio does not",
)
SOFT = SensorEffect(
    name="soft_skin",
    title="softer skin, or a shorter contact, than stated",
    channel=MECHANICS,
    change=_added("soft", "s"),
    equation="u(P) = stated u(P (1 + s)): strains go with the load over shear modulus and length of contact",
    parameters=(Quantity("s", "1", -0.8, 4.0, 0.05, "stated over true stiffness and length of contact, less one"),),
    signature="all outputs too large in one proportion, and contacts as wide as under larger loads",
    confounders=("gain_scatter", "force_gain", "poisson", "creep", "hertz", "strip_peak"),
    separate="a decade of loads at one place with an edge and with a flat; a known weight on the load cell",
    twins=("gain_scatter",),
)
HERTZ = SensorEffect(
    name="hertz",
    title="widths of contact as on a half plane",
    channel=MECHANICS,
    change=_added("hertz", "share"),
    equation="p = (1 - share) p(rigid core) + share p(Hertz)",
    parameters=(Quantity("share", "1", -0.5, 1.5, 0.4, "1 is Hertz's half plane, 0 the rigid core"),),
    signature="profile under wide indenters too wide, more at higher loads",
    confounders=("adhesion", "poisson", "quadratic"),
    separate="flats over a decade of loads",
)
SLIDING = SensorEffect(
    name="sliding_friction",
    title="the indenter drags over the skin",
    channel=MECHANICS,
    change=_sliding,
    equation="q = f p; the apex leaves the middle of contact by ``apex`` of the exact shift",
    parameters=(
        Quantity("f", "1", -2.0, 2.0, 0.1, "coefficient of friction, positive towards larger angles"),
        Quantity("apex", "1", 0.0, 1.0, 0.3, "0: places are middles of contact, 1: apexes"),
    ),
    signature="profile lopsided, the same way for all elements",
    confounders=("angle_offset", "angle_scatter"),
    separate="the same touches while the indenter drags the other way",
    session=("apex",),
)
CROSSTALK = SensorEffect(
    name="cross_talk",
    title="an element hears its neighbours",
    channel=SENSOR,
    change=responding(leaked, "x"),
    equation="d_i = d_i + x (d_(i-1) + d_(i+1))",
    parameters=(Quantity("x", "1", -0.4, 0.4, 0.02, "share of each neighbour"),),
    signature="a second profile one pitch away",
    confounders=("depth_scatter", "poisson"),
    separate="a calibration voltage on one element at a time",
)
CELL = SensorEffect(
    name="force_gain",
    title="the load cell's scale is off",
    channel=SENSOR,
    change=_added("cell", "g"),
    equation="reading = P (1 + g)",
    parameters=(Quantity("g", "1", -0.8, 4.0, 0.02, "relative error of the load cell"),),
    signature="the load cell off in one proportion while the outputs agree with the commanded load",
    confounders=("gain_scatter",),
    separate="hang a known weight on the load cell",
)
MAINS = SensorEffect(
    name="mains_line",
    title="a line of the mains in the outputs",
    channel=SENSOR,
    change=_nothing,
    equation="d = d + a sin(2 pi f t + phase)",
    parameters=(
        Quantity("a", "1", 0.0, 0.5, 1e-3, "amplitude"),
        Quantity("f", "Hz", 0.0, 1e6, 1.0, "frequency"),
    ),
    signature="a line in the spectrum of untouched frames",
    confounders=(),
    rankable=False,
    separate="untouched frames at full rate for 30 s",
)
DEAD = SensorEffect(
    name="dead_element",
    title="an element that does not answer",
    channel=SENSOR,
    change=_nothing,
    equation="d_i = const",
    parameters=(Quantity("index", "1", 0.0, 1e4, 1.0, "its number, from 0"),),
    signature="a reading that neither noise nor touch moves",
    confounders=("gain_scatter",),
    rankable=False,
    separate="touch it",
)

BUILT_IN = (
    MAINS,
    DEAD,
    TEMPERATURE,
    TEMPERATURE_EACH,
    CELL,
    GAIN,
    QUADRATIC,
    CROSSTALK,
    PROXIMITY,
    ANGLE,
    OFFSET,
    DEPTH,
    POISSON,
    CORE,
    HERTZ,
    ADHESION,
    SLIDING,
    CREEP,
    STRIP,
    PEAK,
    SOFT,
)


@cache
def library() -> dict[str, SensorEffect]:
    """Return every known effect of a finger by name: the built-in ones and those of installed packages."""
    return collect(GROUP, BUILT_IN)
