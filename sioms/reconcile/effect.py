"""What an effect is: one small object that says everything the workflow, a plant and a reader need.

An effect enters the simulation through exactly one slot. State functions have the signature
``f(x, v, u, temperature, p)`` with x position [m | rad], v velocity, u actuator force after the
drive [N | N m], temperature the dimensionless heat state and p the parameters in the order of
``Effect.parameters`` and 2 pi / pitch in ``p[TURN]``; written without branches, the plain form takes arrays of axes, and
``p[i]`` may then be an array too. Sign convention: a FORCE acts along +x.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Begins the name of a nameless term, of axes and sensors alike.
TERM_PREFIX = "term_"
#: Width of a parameter row handed to a state function; the last place holds 2 pi / pitch.
ROW = 8
TURN = ROW - 1

Array = NDArray[np.float64]
#: A float in the compiled time step, an array of axes in a vectorised plant.
Number = Any
StateFunction = Callable[..., Number]


class Channel(Enum):
    """Where an effect lives; the workflow goes through them in this order."""

    SENSOR = "sensor"
    ACTUATOR = "actuator"
    MECHANICS = "mechanics"


class Slot(Enum):
    """How an effect enters the time step."""

    FORCE = "force"  # added generalised force f(x, v, u, T, p) [force]
    FRICTION = "friction"  # level >= 0 of dry friction, opposing motion, holding at rest [force]
    GAIN = "gain"  # factor on the actuator force [1]
    INERTIA = "inertia"  # p[0] added to the inertia
    DELAY = "delay"  # p[0] transport delay of the command [s]
    LAG = "lag"  # p[0] time constant of the drive [s]
    LIMIT = "limit"  # p[0] largest actuator force [force]
    THERMAL = "thermal"  # gain 1 - p[0] T, T' = ((u / rated)^2 - T) / p[1]
    # friction p[0] that builds up over the displacement p[1] after reversal; at rest of level p[2], dropping over the speed p[3]
    HYSTERESIS = "hysteresis"
    ELASTIC = "elastic"  # two masses: resonance p[0] [Hz], load fraction p[1], damping ratio p[2]
    BACKLASH = "backlash"  # two masses: gap p[0], load fraction p[1]
    SCALE = "scale"  # measured = p[0] * true
    ECCENTRICITY = "eccentricity"  # measured = true + p[0] sin(theta + p[1])
    MODULATION = "modulation"  # inertia J + p[0] sin(p[2] theta + p[1])
    VARIATION = (
        "variation"  # dry friction, of levels and hysteresis alike, times 1 + p[0] sin(p[2] theta + p[1])
    )
    WARMING = "warming"  # friction level p[0] T beside the others, T' = (|v| - T) / p[1]
    LATTICE = "lattice"  # counts come in multiples of p[0]


class Ref(Enum):
    """The natural size of a parameter on a given axis; bounds and starts are multiples of it."""

    ONE = "1"
    FORCE = "rated force"
    INERTIA = "nominal inertia"
    DAMPING = "rated force / largest speed"
    STIFFNESS = "rated force / pitch"
    DRAG = "rated force / largest speed squared"
    SPEED = "largest speed"
    PITCH = "pitch"
    TIME = "s"
    FREQUENCY = "Hz"
    ANGLE = "rad"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: symbol, unit with {F} and {x} for the axis's own units, and bounds in ``ref``.

    ``fixed`` marks numbers that are searched, not differentiated (orders, lattice factors).
    ``phase`` marks an angle: free, wrapped, without bounds that mean anything.
    ``shape`` marks a force in which the effect is not linear.
    ``least`` is the smallest size (of a factor: distance from one), either way, that is named; what is smaller may belong to something else.
    """

    symbol: str
    unit: str
    ref: Ref
    lower: float
    upper: float
    start: float
    text: str
    fixed: bool = False
    phase: bool = False
    least: float = 0.0
    shape: bool = False


@dataclass(frozen=True, slots=True)
class Effect:
    """One physical effect. Immutable; share it freely between threads.

    Attributes:
        function: state function of the FORCE, FRICTION and GAIN slots, else None.
        rotary, linear: kinds of axis on which it makes sense.
        rankable: False where moving data can never tell it from its look-alike.
        replaces: effects that this one contains or excludes; switching it on switches them off.
        joins: effects of which this one is both at once: it is tried where one of them is in the model already.
        beside: effects one of which must be in the model for this one to be tried; none: it may stand alone.
        ratios: (symbol, symbol, most): the first number is at most so many times the second.
        session: parameters that belong to the session and not to the axis.
    """

    name: str
    title: str
    channel: Channel
    slot: Slot
    equation: str
    parameters: tuple[Parameter, ...]
    signature: str
    lookalikes: tuple[str, ...]
    separate: str
    function: StateFunction | None = None
    rotary: bool = True
    linear: bool = True
    rankable: bool = True
    session: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()
    joins: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    ratios: tuple[tuple[str, str, float], ...] = ()

    @property
    def primary(self) -> Parameter:
        """The first parameter says how large the effect is."""
        return self.parameters[0]

    def values(self, given: Mapping[str, float]) -> Array:
        """Order named values.

        Args:
            given: value per symbol, SI; every parameter must be there.

        Returns:
            Array of shape (n_parameters,).

        Raises:
            ValueError: a name is unknown or missing.
        """
        known = [p.symbol for p in self.parameters]
        if set(given) != set(known):
            odd = sorted(set(given) ^ set(known))
            raise ValueError(
                f"read effect {self.name}: parameters {odd} are unknown or missing; needs {known}"
            )
        return np.array([given[s] for s in known], dtype=np.float64)

    def row(self, values: Array, pitch: float) -> Array:
        """Lay the parameters out as a state function reads them, shape (ROW,)."""
        row = np.zeros(ROW)
        row[: len(values)] = values
        row[TURN] = 2.0 * np.pi / pitch
        return row

    def evaluate(self, x: Array, v: Array, u: Array, temperature: Array, p: Array) -> Array:
        """Evaluate the state function on arrays, for a vectorised plant.

        Args:
            x, v, u, temperature: states of the axes, shape (n,).
            p: rows as ``row`` lays them out, shape (ROW,), or (ROW, n) for n different axes.

        Returns:
            Force, friction level or gain, shape (n,), by the slot.

        Raises:
            TypeError: the slot has no state function.
        """
        if self.function is None:
            raise TypeError(
                f"evaluate effect {self.name}: slot {self.slot.value} is no function of the state"
            )
        out = self.function(x, v, u, temperature, p)
        return np.broadcast_to(np.asarray(out, dtype=np.float64), np.shape(x)).copy()
