"""When an effect counts, and when a confounder is ruled out (decision 0063): alike for axes and sensors."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from sioms.reconcile.blocks import better
from sioms.reconcile.effect import Array
from sioms.reconcile.selection import Found, Step
from sioms.reconcile.thresholds import DOUBTFUL, GAIN, SWAPS


class Fitted(Protocol):
    """A fit: its model, and the squares that it leaves."""

    @property
    def model(self) -> Any: ...

    @property
    def cost(self) -> float: ...


F = TypeVar("F", bound=Fitted)
M = TypeVar("M")


def negligible(lost: float, errors: float) -> bool:
    """Say whether a loss counts for nothing: small, or not large and within one standard error."""
    return lost < GAIN or (errors < 1.0 and lost < DOUBTFUL)


@dataclass(frozen=True)  # with slots, calling Rival[Fit] fails in Python 3.11: typing sets an attribute of its own
class Rival(Generic[F]):
    """A confounder refitted in the place of a named effect.

    Attributes:
        missed: share of the contribution of ``effect`` that it cannot reproduce.
        allowed: share below which it is not ruled out.
        errors: by how many standard errors it is worse on held-out blocks.
        excess: by how much more than the named model it leaves, as a share of what that leaves.
        told: how the records tell it apart though it reproduces nearly all of the effect; empty: they do not.
    """

    effect: str
    rival: str
    missed: float
    allowed: float
    errors: float
    excess: float
    fit: F
    told: str = ""

    @property
    def open(self) -> bool:
        """True where the data do not rule the rival out."""
        return not self.told and self.missed_little

    @property
    def missed_little(self) -> bool:
        """True where it reproduces nearly all of the effect, or is hardly worse on held-out blocks."""
        return self.missed < self.allowed or (self.errors < 1.0 and self.excess < DOUBTFUL)


def weighed(
    found: Found[F, M],
    names: Iterable[str],
    bare: Callable[[str], F],
    replacements: Callable[[F, str, float], Iterable[tuple[str, F, float, float | None]]],
    loss: Callable[[F], Array],
) -> list[Rival[F]]:
    """Refit confounders in the place of each named effect.

    Args:
        names: effects that may be another.
        bare: fit without one of them.
        replacements: of the fit without an effect, its name and what it contributes: yields a confounder, its fit, the
            share that it must miss to be ruled out, and the share that it misses where that is not told by the costs.
        loss: held-out loss of each block.

    Returns:
        Of each confounder of each effect the fit that misses least, the closest first.
    """
    out = []
    for name in names:
        without = bare(name)
        contribution = without.cost - found.fit.cost
        if contribution <= 0.0:
            continue
        for other, fit, allowed, missed in replacements(without, name, contribution):
            _, errors = better(found.losses, loss(fit))
            share = (fit.cost - found.fit.cost) / contribution if missed is None else missed
            out.append(Rival(name, other, share, allowed, errors, fit.cost / found.fit.cost - 1.0, fit))
    return closest(out)


def closest(rivals: Iterable[Rival[F]]) -> list[Rival[F]]:
    """Keep of each confounder of each effect the fit that misses least, the closest first."""
    best: dict[tuple[str, str], Rival[F]] = {}
    for r in rivals:
        if (r.effect, r.rival) not in best or r.missed < best[r.effect, r.rival].missed:
            best[r.effect, r.rival] = r
    return sorted(best.values(), key=lambda r: r.missed)


def told_apart(
    name: str,
    confounders: Container[str],
    rivals: Iterable[Rival[F]],
    path: Iterable[Step[Any]],
    present: Container[str],
    wider: Container[str] = (),
) -> tuple[dict[str, str], dict[str, str]]:
    """Say of each confounder of a named effect why it is ruled out, or why it is not.

    Args:
        present: effects of the model, which rule nothing out.
        wider: effects that contain this one: the search has tried them in its place, and they did not save enough more.

    Returns:
        Reasons of those ruled out, and of those left open, by name.
    """
    mine = [r for r in rivals if r.effect == name]
    still = {
        r.rival: f"explains {100 * (1.0 - max(r.missed, 0.0)):.3g} % of the effect as well" for r in mine if r.open
    }
    ruled = {
        rival: "contains this effect, and explains no more with more parameters"
        if rival in wider and gain < step.saved + GAIN
        else f"removed {100 * gain:.3g} % of the residual where this effect removed {100 * step.saved:.3g} %"
        for step in path
        if step.effect == name
        for rival, gain in step.rivals.items()
        if rival in confounders and rival not in present and rival not in still
    }
    refitted = {
        r.rival: r.told
        or f"leaves {100 * r.missed:.1f} % of the effect unexplained, {r.errors:.1f} standard errors worse"
        for r in mine
        if not r.open
    }
    return {**refitted, **{rival: why for rival, why in ruled.items() if rival not in refitted}}, still


def settle(
    found: Found[F, M],
    rivals: Callable[[Found[F, M]], list[Rival[F]]],
    wins: Callable[[Rival[F], Found[F, M]], bool],
    search: Callable[[M], Found[F, M]],
    ratio: Callable[[F], float],
    progress: Callable[[str], None],
) -> tuple[Found[F, M], list[Rival[F]]]:
    """Find the rivals; where one does better than what is named, search on from it, ``SWAPS`` times at most.

    A step adds what saves most beside the effects of that moment; what came later may have made a confounder the better
    one.

    Args:
        rivals: of what was found, refitted.
        wins: whether one does better.
        search: from a model.
        ratio: residual of a fit in units of what noise leaves.
    """
    others = rivals(found)
    for _ in range(SWAPS):
        best = next((r for r in others if wins(r, found)), None)
        if best is None:
            break
        progress(f"{best.rival} does better than {best.effect}: searching on from it")
        further = search(best.fit.model)
        saved = 1.0 - best.fit.cost / found.fit.cost
        step = Step("swap", f"{best.effect} to {best.rival}", ratio(best.fit), saved, best.fit.model)
        found = Found(further.fit, further.losses, (*found.path, step, *further.path[1:]))
        others = rivals(found)
    return found, others
