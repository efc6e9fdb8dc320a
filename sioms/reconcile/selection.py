"""What a search did, step by step, and what it found: alike for axes and sensors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from sioms.reconcile.effect import Array

M = TypeVar("M")
F = TypeVar("F")


@dataclass(frozen=True)  # without slots, as ``rules.Rival``
class Step(Generic[M]):
    """One step: what was done, what it saved, what remained.

    Attributes:
        action: "start", "add", "leave", "simplify", "restart", "swap" or "noise read again".
        effect: what it was done with.
        ratio: root mean square of the residual, in units of what noise leaves.
        saved: share of the residual's energy on held-out blocks.
        rivals: share that each of the others that were tried would have saved.
    """

    action: str
    effect: str
    ratio: float
    saved: float
    model: M
    rivals: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Found(Generic[F, M]):
    """Result of a search: the fit, its held-out losses by block, and how it came about."""

    fit: F
    losses: Array
    path: tuple[Step[M], ...]
