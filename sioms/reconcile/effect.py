"""What an effect is: one small object that says everything the workflow, a plant and a reader need.

An effect enters the simulation as a state function, or through a mechanism of its own. State functions have the
signature ``f(x, v, u, temperature, p)`` with x position [m | rad], v velocity, u actuator force after the drive [N | N
m], temperature the dimensionless heat state and p the parameters in the order of ``Effect.parameters`` and 2 pi / pitch
in ``p[TURN]``; written without branches, the plain form takes arrays of axes, and ``p[i]`` may then be an array too.
Sign convention: a FORCE acts along +x.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Begins the name of a nameless term, of axes and sensors alike.
TERM_PREFIX = "term_"
#: Width of a parameter row handed to a state function; place TURN holds 2 pi / pitch, an eighth number and further ones
#: come after it.
ROW = 11
TURN = 7

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
    """What the state function of an effect returns."""

    FORCE = "force"  # added generalised force f(x, v, u, T, p) [force]
    FRICTION = "friction"  # level >= 0 of dry friction, opposing motion, holding at rest [force]
    GAIN = "gain"  # factor on the actuator force [1]


@dataclass(frozen=True, slots=True)
class Mechanism:
    """A part of an effect that is no function of the state: numbers that the time step reads from the plant row.

    Attributes:
        enter: (row, p) writes the numbers p into the row, by the names of ``kernel``'s places in lower case.
        twin: (p, pitch) returns the effects of ``sioms.plant.effects`` that mean the same; None where no plant can
            carry it out.
        last: enters after all others, as it needs the whole inertia.
        substeps: steps in a millisecond that it needs.
        bounces: impacts whose timing shifts with any number: the cost of a fit is rough.
        warms: what it does depends on what the axis did before.
        builds_up: friction p[0] over the displacement p[1] after a reversal; at rest of level p[2], dropping over the
            speed p[3].
        varies: dry friction, of levels and of what builds up alike, times 1 + p[0] sin(p[2] theta + p[1]).
        column: (motion, wave number, phase, dry friction) returns the force per unit of the first parameter, for the
            screening.
    """

    enter: Callable[[Any, Array], None] = lambda row, p: None
    twin: Callable[[Array, float], Mapping[str, Mapping[str, float]]] | None = None
    last: bool = False
    substeps: int = 2
    bounces: bool = False
    warms: bool = False
    builds_up: bool = False
    varies: bool = False
    column: Callable[[Any, float, float, Array], Array] | None = None


@dataclass(frozen=True, slots=True)
class Seen:
    """What first guesses of an effect go by.

    Attributes:
        scales: natural size of each of its parameters on this axis.
        pitch, max_speed: of the axis.
        force: largest force in the records; travel: range of motion of the longest.
        bounces: whether something in the model does.
        waves: how often in a pitch waves come that the residual has, the strongest first.
    """

    scales: Mapping[str, float]
    pitch: float
    max_speed: float
    force: float
    travel: float
    bounces: bool
    waves: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Trials:
    """How an effect that is not linear in the state is screened: tried in the simulation on a small grid.

    Attributes:
        guesses: values that differ from the parameters' starts.
        further: other values that the best ``FEW`` are tried with.
        kept: so many of them are fitted.
        stretched: its size is a guess, and is stretched to what the records show.
    """

    guesses: Callable[[Seen], Iterable[Mapping[str, float]]]
    further: tuple[Mapping[str, float], ...] = ()
    kept: int = 1
    stretched: bool = True


NONE = Mechanism()


class Over(Enum):
    """The variable over which a law without a name is laid, by its name in a motion."""

    PLACE = "x"
    SPEED = "v"
    FORCE = "u"


class Ref(Enum):
    """The natural size of a parameter on a given axis; bounds and starts are multiples of it."""

    ONE = "1"
    PER_FORCE = "1 / rated force"
    FORCE = "rated force"
    RISE = "rated force / s"
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
    ``least`` is the smallest size (of a factor: distance from one), either way, that is named; what is smaller may
    belong to something else. ``soft`` marks one that may lie at its bound: a contact harder than what is seen is as
    good as hard. ``vanishes`` marks one that at its lower bound makes another effect of this, as every time constant
    does. ``steps``: what is within so many steps of the encoder is not seen.
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
    soft: bool = False
    vanishes: bool = False
    steps: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class AnyEffect:
    """What a physical effect of any subject says of itself. Immutable; share it freely between threads.

    Attributes:
        neutral: value of the first parameter at which nothing changes.
        session: parameters that belong to the session and not to the subject.
        replaces: effects that this one contains or excludes; switching it on switches them off.
        rankable: False where the search can never tell it: a channel of its own decides.
    """

    name: str
    title: str
    channel: Channel
    equation: str
    parameters: tuple[Any, ...]
    signature: str
    confounders: tuple[str, ...]
    separate: str
    neutral: float = 0.0
    session: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()
    rankable: bool = True

    def wrong(self, given: Iterable[str]) -> str:
        """Say which symbols of given values are unknown or missing; empty where none is."""
        known = [p.symbol for p in self.parameters]
        odd = sorted(set(given) ^ set(known))
        return f"read effect {self.name}: parameters {odd} are unknown or missing; needs {known}" if odd else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect(AnyEffect):
    """One physical effect of an axis.

    Attributes:
        function: state function, if it has one, and slot: what that returns.
        mechanism: what it is beside, or instead of, that.
        trials: how it is screened; None for one that is linear in a function of the state.
        sized: the first parameter says how large the effect is.
        by_reach: its typical size is the start's share of the rated force at the farthest place of the records: no
            other length of the axis tells it.
        rotary, linear: kinds of axis on which it makes sense.
        joins: effects of which this one is both at once: it is tried where one of them is in the model already.
        beside: effects one of which must be in the model for this one to be tried; none: it may stand alone.
        over: of a law that is laid over what the records show of a variable: which; its last two parameters are the
            middle and the step of its places.
        takes: (symbol, symbol): in the place of a confounder that has the second number, the first is that.
        ratios: (symbol, symbol, most): the first number is at most so many times the second.
    """

    parameters: tuple[Parameter, ...]
    slot: Slot | None = None
    function: StateFunction | None = None
    mechanism: Mechanism = NONE
    trials: Trials | None = None
    over: Over | None = None
    sized: bool = True
    by_reach: bool = False
    rotary: bool = True
    linear: bool = True
    joins: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    ratios: tuple[tuple[str, str, float], ...] = ()
    takes: tuple[tuple[str, str], ...] = ()

    @property
    def primary(self) -> Parameter:
        """The first parameter says how large the effect is."""
        return self.parameters[0]

    @property
    def is_friction(self) -> bool:
        """Whether it is dry friction, whose level follows the run-in of the axis."""
        return self.mechanism.builds_up or (self.slot is Slot.FRICTION and not self.mechanism.warms)

    @property
    def needs_drive(self) -> bool:
        """Whether it depends on the force of the drive, or on how it moves an inertia."""
        if self.channel is not Channel.MECHANICS or self.mechanism.last:
            return True
        if self.function is None:
            return False
        row = self.row(self.values({p.symbol: p.start for p in self.parameters}), 1.0)
        some = np.full(2, 0.3)
        return bool(np.ptp(self.evaluate(some, some, np.array([-0.7, 2.0]), some, row)) > 0.0)

    def values(self, given: Mapping[str, float]) -> Array:
        """Order named values.

        Args:
            given: value per symbol, SI; every parameter must be there.

        Returns:
            Array of shape (n_parameters,).

        Raises:
            ValueError: a name is unknown or missing.
        """
        if wrong := self.wrong(given):
            raise ValueError(wrong)
        return np.array([given[p.symbol] for p in self.parameters], dtype=np.float64)

    def row(self, values: Array, pitch: float) -> Array:
        """Lay the parameters out as a state function reads them, shape (ROW,)."""
        row = np.zeros(ROW)
        row[: len(values[:TURN])] = values[:TURN]
        row[TURN + 1 : len(values) + 1] = values[TURN:]
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
            TypeError: the effect has no state function.
        """
        if self.function is None:
            raise TypeError(f"evaluate effect {self.name}: it is no function of the state")
        out = self.function(x, v, u, temperature, p)
        return np.broadcast_to(np.asarray(out, dtype=np.float64), np.shape(x)).copy()

    def force(self, x: Array, v: Array, u: Array, temperature: Array, way: Array, p: Array) -> Array:
        """Return the force on the axis of the state function on a motion, shape (n,); ``way``: direction, -1 to 1."""
        value = self.evaluate(x, v, u, temperature, p)
        match self.slot:
            case Slot.FRICTION:
                return -value * way
            case Slot.GAIN:
                return u * (value - 1.0)
            case _:
                return value
