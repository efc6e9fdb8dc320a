"""How numbers of the axis go in time, and the force that this makes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sioms.reconcile.effect import TERM_PREFIX, Array
from sioms.reconcile.timed import Timed
from sioms.reconcile.verdict import Estimate, NamedEffect
from sioms.reconcile.windows import Number, View


@dataclass(frozen=True, slots=True)
class Course:
    """How numbers change.

    Attributes:
        text: what changes, how, and when.
        estimates: of the changes, and of what else the course is made of.
        forces: that the changes make in every record, shape (n,) each, [{F}].
        left: squares of the whole residual that they leave.
        count: of the numbers that were fitted.
        again: fits the same course to another view.
        beside: effects that may be a part of it, as of ``Timed``.
    """

    name: str
    equation: str
    text: str
    estimates: tuple[Estimate, ...]
    forces: tuple[Array, ...]
    left: float
    count: int
    again: Callable[[View], Course]
    beside: tuple[str, ...] = ()

    def timed(self, share: float) -> Timed:
        """Describe the force, which is this share of the residual's energy."""
        first = self.estimates[0]
        errors = 1.96 * abs(first.value) / max(first.high - first.value, 1e-300)
        said = f"whatever the axis does, {self.text}; that is {100 * share:.0f} % of the residual energy"
        term = NamedEffect(
            TERM_PREFIX + self.name,
            f"{self.equation} ({self.text})",
            self.equation,
            "mechanics",
            self.estimates,
            share,
            errors,
            None,
            (said,),
        )
        return Timed(self.forces, self.left, term, self.text, self.beside)


def estimate(view: View, number: Number, size: float, spread: float) -> Estimate:
    """Describe the change of a number, with the interval of normal errors."""
    unit = number.unit.format(F=view.model.force_unit, x=view.model.position_unit)
    size, wide = float(size), 1.96 * float(spread)
    return Estimate(number.symbol, size, size - wide, size + wide, unit, f"change of the {number.text}")
