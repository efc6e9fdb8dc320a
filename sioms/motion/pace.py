"""Pace: how many commands begin from one tick to the next is bounded, however short they are.

After a short one (less than a PIECES-th of the period) an axis in motion begins as many as longer ones could have been,
one at rest only its first and what is left of a few that all share. What follows waits at rest for the next tick.
Concurrency: that of the bank.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Axes = NDArray[np.int64]
Mask = NDArray[np.bool_]
PIECES = 2
"""Pieces of a period that are not short: time itself bounds how many of them end in a tick, and they keep their
instants.
"""
SPARE_SHARE, BEGIN_S = 0.05, 50e-6
"""Share of the period, and what beginning a command takes of it [s]: how many may follow short ones on axes at rest."""


class Pace:
    """Counts the beginnings of n axes.

    Args:
        begun: commands begun after short ones since the last tick began (n,).
        tick_s: nominal period [s].

    Attributes:
        held: axes whose next command waits for the next tick; whether it then takes over from what runs.
    """

    def __init__(self, begun: NDArray[np.int64], tick_s: float) -> None:
        self.held: dict[int, bool] = {}
        self._begun, self._tick_s = begun, tick_s
        self._pieces = 2 * PIECES
        self._spare = self._spare_a_tick = max(2, int(SPARE_SHARE * tick_s / BEGIN_S))

    def begin_tick(self, dt: float) -> None:
        """A tick begins, dt after the last [s]: further commands may begin."""
        self._begun.fill(0)
        self._pieces = PIECES + int(PIECES * dt / self._tick_s)
        self._spare = self._spare_a_tick

    def take_over(self, axes: Axes) -> Mask:
        """Tell on which axes commands may take over now (m,); on the others they wait."""
        may: Mask = self._begun[axes] < self._pieces
        if not may.all():
            self.held.update(dict.fromkeys(axes[~may].tolist(), True))
        return may

    def follow(self, axes: Axes, duration: NDArray[np.float64], rests: Mask, free: Mask) -> None:
        """Count what follows short commands; take out of ``free`` the axes that have had their share of this tick.

        Args:
            axes: whose commands have ended (m,).
            duration: of what has ended [s].
            rests: whether that leads to rest.
            free: whether another one may begin; written here.
        """
        short = duration * PIECES < self._tick_s
        if not short.any():
            return
        begun = self._begun[axes]
        over = free & short & (begun >= np.where(rests, 1, self._pieces))
        for i in np.flatnonzero(over).tolist():
            if rests[i] and self._spare:
                self._spare -= 1
            else:
                free[i] = False
                self.held[int(axes[i])] = False
        self._begun[axes] = begun + (short & free)

    def forget(self, axes: Axes) -> None:
        """Nothing waits on these axes any more."""
        if self.held:
            for axis in axes.tolist():
                self.held.pop(axis, None)

    def take_held(self) -> tuple[Axes, Axes]:
        """Return the axes whose commands have waited for this tick, and those of them that take over."""
        held, self.held = self.held, {}
        taking = [axis for axis, takes_over in held.items() if takes_over]
        return np.array(list(held), dtype=np.int64), np.array(taking, dtype=np.int64)
