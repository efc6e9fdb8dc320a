"""Soft limits, enforced in every tick for the axes that are not on a profile known to keep inside."""

from __future__ import annotations

import errno

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AxisStatus

from .axis_step import FORCE
from .law import ControlLaw
from .queue import CommandQueue
from .sequencer import Sequencer
from .types import EventKind

Axes = NDArray[np.int64]
TEXT = "stopped at the limit of position or, in force mode, of velocity"


class LimitGuard:
    """Brakes axes whose stopping distance v^2 / (2 a) no longer fits inside their soft limits.

    Velocity, acceleration and jerk commands may lead out of the limits, so may a position profile
    that begins at speed: there the set-point is watched and stands at the limit exactly. In force
    mode the measured state is watched, of velocity too, and the axis goes over to a position-held
    stop that presses no harder than the force that was asked for (force_end.py), and says so: FORCE_ENDED. Concurrency:
    that of the bank.

    Args:
        queue, sequencer: of the bank.
        law: of the bank: it has the speed at which a force ends, and tells where a command's gains are in force.
    """

    def __init__(self, queue: CommandQueue, sequencer: Sequencer, law: ControlLaw) -> None:
        self._queue = queue
        self._law = law
        self._limits = queue.limits
        self._sequencer = sequencer

    def keep(
        self, desired: NDArray[np.float64], desired_velocity: NDArray[np.float64], last_ns: int, now_ns: int
    ) -> bool:
        """Check the guarded axes; return whether one was stopped, so that set-points must be made anew.

        Set-points were last put out at last_ns, so the brake may begin at the instant in between at
        which the distance was just enough, however long the tick was.
        """
        sequencer = self._sequencer
        axes = np.flatnonzero(sequencer.guard)
        force = sequencer.kind[axes] == FORCE
        state = np.stack((desired[axes], desired_velocity[axes]), axis=1)
        if force.any():
            state[force] = sequencer.state(axes[force], now_ns)[:, :2]
        side = self._beyond(axes, state)
        hit = (side != 0) | (force & (np.abs(state[:, 1]) > self._law.speed_most[axes]))
        if not hit.any():
            return False
        for bit, sign in ((AxisStatus.LIMIT_MINUS, -1), (AxisStatus.LIMIT_PLUS, 1)):
            sequencer.outcome[axes[side == sign]] |= int(bit)
        sequencer.outcome[axes[hit & force]] |= int(AxisStatus.FORCE_ENDED)
        self._queue.emit(EventKind.DROPPED, axes[hit], now_ns, errno.ERANGE, TEXT)
        sequencer.drop(axes[hit])
        free = force | self._law.tuned[axes]  # not where their set-points are
        if (hit & free).any():
            sequencer.stop(axes[hit & free], now_ns, now_ns)
        for axis in axes[hit & ~free].tolist():
            self._brake_in_time(np.array([axis]), last_ns, now_ns)
        sequencer.advance(now_ns)
        return True

    def _beyond(self, axes: Axes, state: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return -1 or +1 for the limit that an axis in this state would pass when braked, else 0."""
        v = state[:, 1]
        stand = state[:, 0] + v * np.abs(v) / (2 * self._limits.acceleration[axes])
        minus = (stand < self._limits.minimum[axes]) & (v < 0)
        plus = (stand > self._limits.maximum[axes]) & (v > 0)
        side: NDArray[np.int64] = plus.astype(np.int64) - minus
        return side

    def _brake_in_time(self, axis: Axes, last_ns: int, now_ns: int) -> None:
        store = self._sequencer.store
        early, late = max(last_ns, int(store.segment_ns[axis[0]])), now_ns
        while late - early > 1:
            middle = (early + late) // 2
            if self._beyond(axis, store.state(axis, middle))[0]:
                late = middle
            else:
                early = middle
        self._sequencer.brake(axis, store.state(axis, early), early, self._limits.acceleration[axis])
