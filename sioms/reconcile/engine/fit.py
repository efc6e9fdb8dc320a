"""What is free in a model of any subject, and a fit of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from sioms.reconcile.descent import descend
from sioms.reconcile.effect import Array

#: In the place of an effect: the nominal model itself.
BASE = "base"


class Model(Protocol):
    """A nominal model and the effects that are switched on. Immutable."""

    @property
    def effects(self) -> Mapping[str, Mapping[str, Any]]: ...

    @property
    def base(self) -> Any: ...

    def without_effect(self, name: str) -> Self: ...

    def with_numbers(self, effects: Mapping[str, Mapping[str, Any]], base: Mapping[str, float]) -> Self:
        """Return the model with all numbers of its effects, and some of the nominal model, replaced."""
        ...


M = TypeVar("M", bound=Model)


@dataclass(frozen=True, slots=True)
class Free:
    """One free number: of an effect, or of the nominal model.

    Attributes:
        scale: its natural size, the unit of steps and slopes.
        lower, upper: its bounds; a phase has none.
        index: of the element whose number it is; None where the effect's parameter is a plain number.
        each: every element has one of its own.
    """

    effect: str
    symbol: str
    scale: float
    lower: float
    upper: float
    phase: bool = False
    index: int | None = None
    each: bool = False


@dataclass(frozen=True)  # without slots, as ``rules.Rival``
class Fit(Generic[M]):
    """A fitted model.

    Attributes:
        residual: at the optimum, shape (n,), in units of the floor.
        jacobian: d residual / d (number / scale), shape (n, k).
    """

    model: M
    free: tuple[Free, ...]
    residual: Array
    jacobian: Array

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.residual @ self.residual)

    @property
    def ratio(self) -> float:
        """Root mean square of the residual, in units of the floor."""
        return float(np.sqrt(np.mean(self.residual**2)))


def get(model: Model, free: Sequence[Free]) -> Array:
    """Read the free numbers, shape (k,)."""

    def one(f: Free) -> float:
        value: Any = getattr(model.base, f.symbol) if f.effect == BASE else model.effects[f.effect][f.symbol]
        return float(value if f.index is None else value[f.index])

    return np.array([one(f) for f in free], dtype=np.float64)


def put(model: M, free: Sequence[Free], values: Array) -> M:
    """Return the model with the free numbers set; phases are wrapped to (-pi, pi]."""
    effects: dict[str, dict[str, Any]] = {
        name: {s: v.copy() if isinstance(v, np.ndarray) else v for s, v in given.items()}
        for name, given in model.effects.items()
    }
    base: dict[str, float] = {}
    for f, value in zip(free, values, strict=True):
        v = float(np.angle(np.exp(1j * value))) if f.phase else float(value)
        if f.effect == BASE:
            base[f.symbol] = v
        elif f.index is None:
            effects[f.effect][f.symbol] = v
        else:
            effects[f.effect][f.symbol][f.index] = v
    return model.with_numbers(effects, base)


def fitted(
    model: M,
    free: tuple[Free, ...],
    residual: Callable[[M], Array],
    slopes: Callable[[Array, Array], Array],
    iterations: int,
    tolerance: float,
    **how: float,
) -> Fit[M]:
    """Descend from a model in some of its numbers, within their bounds.

    Args:
        residual: of a model, shape (n,); slopes, iterations, tolerance, how: as of ``descend``.
    """
    if not free:
        r = residual(model)
        return Fit(model, free, r, np.empty((len(r), 0)))
    wraps = np.array([f.phase for f in free])
    at, r, j = descend(
        lambda x: residual(put(model, free, x)),
        slopes,
        get(model, free),
        np.array([f.scale for f in free]),
        np.where(wraps, -np.inf, [f.lower for f in free]),
        np.where(wraps, np.inf, [f.upper for f in free]),
        iterations,
        tolerance,
        **how,
    )
    return Fit(put(model, free, at), free, r, j)
