"""The short way of a write: few records, each of which can be judged by its own fields alone.

A stream of set-points is many small writes, and the arrays of the general way cost the same for one
record as for a thousand. A plain record commands one quantity, and at most limits beside it: its
beginning and its duration cannot make it infeasible at the write. What is not plain, or is bad, goes
the general way, which is also the only one that refuses: every message has one home.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import modes
from .commands import RULES, WIRE_DTYPE, Command, Limits

MOST = 16
"""Records up to which one by one is quicker than as arrays."""
GREATEST = float(np.finfo(np.float64).max)
_QUANTITIES = (
    modes.POSITION, modes.VELOCITY, modes.ACCELERATION, modes.JERK, modes.FORCE, modes.FORCE_VELOCITY,
)  # fmt: skip
_BESIDE = (modes.MAX_VEL_ACC, modes.MAX_FORCE, modes.FORCE_OFFSET, modes.SYNCH)
QUANTITY, BESIDE = sum(_QUANTITIES), sum(_BESIDE)
_PLAIN = frozenset(
    quantity | sum(flag for i, flag in enumerate(_BESIDE) if beside >> i & 1)
    for quantity in _QUANTITIES
    for beside in range(1 << len(_BESIDE))
)
"""Modes of plain records."""
_COLUMN = {name: i for i, name in enumerate(WIRE_DTYPE.names or ())}
AXIS = _COLUMN["axis"]
_MODE, _POSITION = _COLUMN["control_mode"], _COLUMN["position"]
_SIGNAL, _WAIT = _COLUMN["signal_marker_number"], _COLUMN["wait_marker_number"]

Check = tuple[int, NDArray[np.float64] | None, bool]
"""Column of a value, the array (n,) of its bound or None, and whether it must be above zero."""


class PlainCheck:
    """Tells which records are plain and good. Pure; concurrency: that of the bank.

    Args:
        offered: control-mode flags that each axis can do.
        limits: of the axes, kept up to date by their owner.
    """

    def __init__(self, offered: Sequence[int], limits: Limits) -> None:
        self.offered = [int(flags) for flags in offered]
        self._minimum, self._maximum = limits.minimum, limits.maximum
        self._below, self._above = limits.room_below.tolist(), limits.room_above.tolist()
        self._limits = limits
        self._checks: dict[int, tuple[Check, ...]] = {}
        """Of the modes that have been seen."""

    def _checks_of(self, mode: int) -> tuple[Check, ...] | None:
        """Return what is checked of a record of a mode; None for one that is not plain."""
        if mode not in _PLAIN:
            return None
        checks = self._checks[mode] = tuple(
            (_COLUMN[rule.field], getattr(self._limits, rule.bound) if rule.bound else None, rule.positive)
            for rule in RULES
            if mode & rule.flag
        )
        return checks

    def command(self, record: tuple[Any, ...], axis: int) -> Command | None:
        """Return a record of the wire as a command of a bank axis; None when it is not plain, or bad."""
        mode = record[_MODE]
        checks = self._checks.get(mode) or self._checks_of(mode)
        if checks is None or mode & ~self.offered[axis]:
            return None
        for column, bound, positive in checks:
            value = record[column]
            most = GREATEST if bound is None else bound.item(axis)
            if not -most <= value <= most or not -GREATEST <= value <= GREATEST or (positive and value <= 0):
                return None
        if mode & modes.POSITION:  # all plain ones are point moves
            low, high = (
                self._minimum.item(axis) + self._below[axis],
                self._maximum.item(axis) - self._above[axis],
            )
            if not low <= record[_POSITION] <= high:
                return None
        fields = [*record, 0, 0]
        fields[AXIS], fields[_SIGNAL], fields[_WAIT] = axis, 0, 0
        command: Command = Command._make(fields)
        return command
