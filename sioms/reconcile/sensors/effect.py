"""What an effect of a sensor is: one small object that changes what the simulation believes.

``change(belief, values)`` returns the belief with the effect switched on. A belief is a frozen object of the
subject (a finger, a force sensor); values are arrays in the order of ``parameters``, one number each, or one
for every element where ``each`` is set. At the neutral value of its first parameter an effect does nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import TERM_PREFIX, AnyEffect, Channel

Array = NDArray[np.float64]
Values = Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class Quantity:
    """One parameter, in SI units.

    Attributes:
        lower, upper: physical bounds; outside them it is not that effect.
        size: natural size: a typical effect, the unit of steps.
        each: one number for every element (or component), else one for all.
        phase: an angle that wraps.
        starts: values tried before the fit begins; the first is the default.
    """

    symbol: str
    unit: str
    lower: float
    upper: float
    size: float
    text: str
    each: bool = False
    phase: bool = False
    starts: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorEffect(AnyEffect):
    """One physical effect of a sensor.

    Attributes:
        change: (belief, values) -> belief.
        twins: confounders that are put to the test however many parameters they have.
    """

    parameters: tuple[Quantity, ...]
    change: Callable[[Any, Values], Any]
    twins: tuple[str, ...] = ()

    @property
    def primary(self) -> Quantity:
        """The first parameter says how large the effect is."""
        return self.parameters[0]

    def size(self, count: int) -> int:
        """Number of free numbers on a sensor of ``count`` elements."""
        return sum(count if q.each else 1 for q in self.parameters)

    def check(self, values: Values, count: int) -> dict[str, Array]:
        """Return the values as arrays of the right length.

        Raises:
            ValueError: a name is unknown or missing, or an array has another length.
        """
        if wrong := self.wrong(values):
            raise ValueError(wrong)
        out = {}
        for q in self.parameters:
            value = np.atleast_1d(np.asarray(values[q.symbol], dtype=np.float64))
            need = count if q.each else 1
            if value.shape != (need,):
                raise ValueError(f"read effect {self.name}: {q.symbol} holds {value.size} numbers; needs {need}")
            out[q.symbol] = value
        return out


@dataclass(frozen=True, slots=True)
class SensorModel:
    """A nominal sensor and the effects that are switched on. Immutable.

    Attributes:
        base: the belief without effects.
        count: number of elements or components.
        library: effects by name.
        effects: values per symbol per effect, only what is switched on.
        refine: numbers of the base that are uncertain and fitted along, not named.
    """

    base: Any
    count: int
    library: Mapping[str, SensorEffect]
    effects: Mapping[str, Values] = field(default_factory=dict)
    refine: tuple[Quantity, ...] = ()
    name: str = "sensor"

    def belief(self) -> Any:
        """Return the belief with all effects switched on; nameless terms act on what the others leave."""
        out = self.base
        for name in sorted(self.effects, key=lambda n: n.startswith(TERM_PREFIX)):
            out = self.library[name].change(out, self.effects[name])
        return out

    def with_effect(self, name: str, values: Values) -> SensorModel:
        """Return the model with one effect switched on (or its values changed)."""
        return replace(self, effects={**self.effects, name: self.library[name].check(values, self.count)})

    def without_effect(self, name: str) -> SensorModel:
        """Return the model with one effect switched off."""
        return replace(self, effects={k: v for k, v in self.effects.items() if k != name})

    def with_numbers(self, effects: Mapping[str, Values], base: Mapping[str, float]) -> SensorModel:
        """Return the model with other numbers of its effects, and some of its base."""
        return replace(self, effects=effects, base=replace(self.base, **base) if base else self.base)

    def plain(self, name: str) -> dict[str, Array]:
        """Return an effect's starting values: neutral, the others at their first start."""
        effect, out = self.library[name], {}
        for i, q in enumerate(effect.parameters):
            value = effect.neutral if i == 0 else (q.starts[0] if q.starts else 0.0)
            out[q.symbol] = np.full(self.count if q.each else 1, value)
        return out


def responding(response: Callable[..., Array], *symbols: str) -> Callable[[Any, Values], Any]:
    """Return the change of a belief that gets a response to these parameters, laid in a row."""

    def change(belief: Any, v: Values) -> Any:
        return belief.responding(response, np.concatenate([v[s] for s in symbols]))

    return change


def term(
    name: str,
    equation: str,
    response: Callable[..., Array],
    *parameters: Quantity,
    confounders: tuple[str, ...] = (),
) -> SensorEffect:
    """Return a nameless term: what a refusal may offer where no effect of the library explains the data.

    A term describes the residual in symbols; it claims no cause and is kept out of the list of named effects.
    """
    return SensorEffect(
        name=TERM_PREFIX + name,
        title=equation,
        channel=Channel.SENSOR,
        equation=equation,
        change=responding(response, *(q.symbol for q in parameters)),
        parameters=parameters,
        signature="",
        confounders=confounders,
        separate="",
    )
