"""Sentences of a verdict on what remains, and on what was named beside it."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.stats import binom

from sioms.reconcile.bends import Bend
from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.refuse import loud_turns
from sioms.reconcile.thresholds import CHANCE, MOSTLY, UNEXPLAINED
from sioms.reconcile.uneven import Uneven


def of_change(title: str, change: Uneven, ratio: float) -> str:
    return (
        f"{title}: what remains is {ratio:.2g} times what noise would leave, and {100 * change.share:.0f} % of it are "
        f"explained where its numbers change with {change.variable}; its law is another one"
    )


def of_bend(title: str, b: Bend) -> str:
    return (
        f"{title}: where all numbers may follow, its {b.what} comes to another value than that of the law "
        f"({b.errors:.1f} standard errors); its law is another one"
    )


def of_doubts(titles: Sequence[str]) -> str:
    return (
        f"{' and '.join(titles)}: less is explained by it than remains above the noise, so it may be a part of what "
        "remains; the model without it is as likely"
    )


def of_hanging(titles: Sequence[str]) -> str:
    return (
        f"{' and '.join(titles)}: how large it is hangs on the exponents of the laws beside it, which these records do "
        "not tell; with neighbours of theirs there may be none"
    )


def of_inertia(nominal: AxisModel, model: AxisModel) -> str:
    return (
        f"the inertia, refined, comes to {model.inertia / nominal.inertia:.3g} times the stated one, the end of what "
        "is tried: with it the model hardly listens to its force, and stands for something else"
    )


def of_much(ratio: float, share: float) -> str:
    ordered = (
        f"the state of the axis orders {100 * share:.0f} % of it, in no form that is known"
        if share > UNEXPLAINED
        else "no state of the axis orders it"
    )
    return f"what remains is {ratio:.1f} times what noise would leave; {ordered}"


def of_bursts(problem: Problem, fit: Fit, burst: float) -> str:
    """Say what bursts of the residual are, as far as that shows."""
    text = f"the residual comes in bursts ({100 * burst:.0f} % of its energy in a tenth of the time)"
    turning, loud, usual = loud_turns(problem, fit)
    if turning > MOSTLY * loud and binom.sf(turning - 1, loud, usual) < CHANCE:
        return (
            f"{text}, {turning} of {loud} where the motion turns, starts or stops (which is {100 * usual:.0f} % of the "
            "time): play, presliding or stick-slip in a form that no effect of the library has, rather than a "
            "disturbance from outside"
        )
    return f"{text} that no state of the axis orders: a disturbance from outside, not an effect"
