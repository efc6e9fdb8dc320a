"""Homing: the reference is the edge at which the axis slowly leaves its switch against the search direction.

SEARCH fast in the search direction until the switch closes; an end switch in the way turns the
search round. SETTLE until the axis stands. RELEASE slowly against the search direction until the
switch opens: always the same edge, passed the same way. That instant sets the coordinate; FINISH
until the axis stands again.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Protocol, assert_never

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from .queue import CommandQueue
from .settings import HOME_SWITCHES, SWITCH_MINUS, SWITCH_PLUS, AxisSettings, Homing
from .types import EventKind


class Phase(Enum):
    """Where an axis is in its homing."""

    SEARCH = "search"
    SETTLE = "settle"
    RELEASE = "release"
    FINISH = "finish"


class Mover(Protocol):
    """What homing asks of the bank."""

    def drive(self, axis: int, velocity: float, now_ns: int) -> None:
        """Go over to this velocity from the present state."""

    def brake(self, axis: int, now_ns: int) -> None:
        """Stop at maximum deceleration."""

    def stands(self, axis: int) -> bool:
        """Tell whether the axis holds still."""

    def measured(self, axis: int) -> float:
        """Return the measured position."""

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of the axis, also in motion."""


class Progress(Struct):
    """One axis on its way home."""

    homing: Homing
    phase: Phase
    start: float
    turned: bool = False


class HomingRuns:
    """The axes of a bank that are homing now. Concurrency: that of the bank."""

    def __init__(self, settings: Sequence[AxisSettings], queue: CommandQueue, mover: Mover) -> None:
        self._settings = settings
        self._queue = queue
        self._mover = mover
        self._runs: dict[int, Progress] = {}

    @property
    def active(self) -> bool:
        """Tell whether any axis is homing."""
        return bool(self._runs)

    def begin(self, axes: NDArray[np.int64], now_ns: int) -> None:
        """Start homing these axes, which may."""
        for axis in axes.tolist():
            homing = self._settings[axis].homing
            if homing is None:
                continue
            self._runs[axis] = Progress(homing, Phase.SEARCH, self._mover.measured(axis))
            self._mover.drive(axis, homing.direction * homing.velocity, now_ns)

    def cancel(self, axes: NDArray[np.int64]) -> None:
        """Forget the homing of axes that were stopped."""
        for axis in axes.tolist():
            if self._runs.pop(axis, None) is not None:
                self._queue.latched[axis] &= ~int(AxisStatus.HOMING)

    def tick(self, switches: NDArray[np.int64] | None, now_ns: int) -> list[tuple[int, str]]:
        """Advance all runs; return (axis, reason) of those that failed."""
        failed: list[tuple[int, str]] = []
        for axis, run in list(self._runs.items()):
            if switches is None:
                failed.append((axis, "homing needs switches and the device reports none"))
                continue
            reason = self._step(axis, run, int(switches[axis]), now_ns)
            if reason:
                failed.append((axis, reason))
        return failed

    def _step(self, axis: int, run: Progress, switches: int, now_ns: int) -> str:
        mover, homing = self._mover, run.homing
        closed = bool(switches & HOME_SWITCHES[homing.switch])
        if abs(mover.measured(axis) - run.start) > homing.travel:
            return f"homing found no {homing.switch} switch edge within {homing.travel:g} {self._settings[axis].unit}"
        match run.phase:
            case Phase.SEARCH:
                return self._search(axis, run, closed, switches, now_ns)
            case Phase.SETTLE:
                if mover.stands(axis):
                    run.phase = Phase.RELEASE
                    mover.drive(axis, -homing.direction * homing.slow_velocity, now_ns)
            case Phase.RELEASE:
                if not closed:
                    mover.shift(axis, homing.offset - mover.measured(axis))
                    mover.brake(axis, now_ns)
                    run.phase = Phase.FINISH
            case Phase.FINISH:
                if mover.stands(axis):
                    self._finish(axis, now_ns)
            case _:
                assert_never(run.phase)
        return ""

    def _search(self, axis: int, run: Progress, closed: bool, switches: int, now_ns: int) -> str:
        mover, homing = self._mover, run.homing
        if closed:
            run.phase = Phase.SETTLE
            mover.brake(axis, now_ns)
            return ""
        direction = -homing.direction if run.turned else homing.direction
        if switches & (SWITCH_MINUS if direction < 0 else SWITCH_PLUS):
            if run.turned:
                return f"homing met both end switches and no {homing.switch} switch"
            run.turned = True
            mover.drive(axis, -direction * homing.velocity, now_ns)
        return ""

    def _finish(self, axis: int, now_ns: int) -> None:
        del self._runs[axis]
        self._queue.latched[axis] &= ~int(AxisStatus.HOMING)
        self._queue.latched[axis] |= int(AxisStatus.HOMED)
        one = np.array([axis])
        self._queue.find_places(one)
        self._queue.emit(EventKind.HOMED, one, now_ns)
        self._queue.emit(EventKind.IDLE, one, now_ns)
