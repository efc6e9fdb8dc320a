"""What simulated axes bear: forces from nodes, and the springs of a finger that a simulated world tells of.

A world that is gone, stands still, or shows nothing newer than `world_age_max_s` says nothing of now. Motors that went
on against it would stretch springs whose far ends nobody moves. So they then bear nothing and brakes hold them, as they
hold what its drive lets go, which loads would push along; whoever sees to the axes puts what moves in fault.

Concurrency: one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.plant.carried import Carried
from sioms.plant.motor import MotorBank
from sioms.protocol.flags import AnalogStatus
from sioms.sdk.driver import InputNode

Array = NDArray[np.float64]

JOINTS = 3
"""Of a finger: x, y and th, the first motors of who carries it."""
_INVALID = int(AnalogStatus.INVALID)
_BRAKE = 2.0
"""Force of a brake over the greatest of its drive."""


class Borne:
    """The loads of a bank of motors.

    Args:
        motors: the bank.
        servos: tables of its axes.
        carries: node of a world with a finger's joints; empty: none is carried.
        age_max_s: a reading of that node that is older tells nothing.
        tick_s: of the motors' simulation.
        inputs: returns a node by its name.

    Attributes:
        is_known: whether the loads were known in the last tick; else brakes are to hold.
    """

    def __init__(
        self, motors: MotorBank, servos: Sequence[Any], carries: str, age_max_s: float, tick_s: float,
        inputs: Callable[[str], InputNode],
    ) -> None:  # fmt: skip
        self._motors, self._inputs = motors, inputs
        self._nodes = [(row, axis.load_node) for row, axis in enumerate(servos) if axis.load_node]
        self._constant = motors.load_force.copy()
        self._load = self._constant.copy()
        """Beside what is carried."""
        self._carries, self._age_ns = carries, round(age_max_s * 1e9)
        mass = np.array([axis.motor.mass for axis in servos[:JOINTS]])
        self._carried = Carried(mass, tick_s) if carries else None
        self._most = np.array([axis.motor.force_max for axis in servos[:JOINTS]])
        self._brake = _BRAKE * np.array([axis.force_max for axis in servos])
        self.is_known = self._braked = False

    @property
    def any(self) -> bool:
        """Whether there is anything to bear."""
        return bool(self._nodes) or self._carried is not None

    def missing(self, now_ns: int) -> str:
        """Return the first node that cannot be read, empty when all can."""
        names = [self._carries, *(node for _, node in self._nodes)]
        return next((name for name in names if name and self._inputs(name).read(now_ns) is None), "")

    def take(self, now_ns: int) -> str:
        """Take the loads from their nodes; return why they are not known, empty when they are."""
        why = ""
        if self._carried is not None:
            seen, why = self._read(self._carries, now_ns, self._age_ns)
            self._carried.far[:] = 0.0 if seen is None else seen["value"].reshape(4, -1)
        for row, node in self._nodes:
            seen, lacks = self._read(node, now_ns, 0)
            self._load[row] = self._constant[row] + (0.0 if seen is None else float(seen["value"][0]))
            why = why or lacks
        if why:
            self._load[:] = self._constant
        self.is_known = not why
        return why

    def _read(self, node: str, now_ns: int, age_ns: int) -> tuple[Mapping[str, NDArray[Any]] | None, str]:
        """Return a reading, or None and why it tells nothing; an age of 0: as old as its device may be."""
        entry = self._inputs(node)
        seen = entry.read(now_ns)
        if seen is None:
            return None, f"{node}: no load is known; want the simulated world there"
        if int(seen["flags"][0]) & _INVALID:
            return None, f"{node}: its simulated world stands still; want all axes there that it reads"
        old_ns = now_ns - entry.stamp_ns
        if 0 < age_ns < old_ns:
            return None, f"{node}: its simulated world is {old_ns * 1e-9:.3f} s late; want at most {age_ns * 1e-9:g} s"
        return seen, ""

    def press(self, forces: Array, let_go: NDArray[np.bool_]) -> None:
        """Have the motors bear their loads in the next tick.

        Args:
            forces: of their drives, shape (n,) [N or N m].
            let_go: whose drives do not hold them, shape (n,): brakes do.
        """
        motors = self._motors
        motors.load_force[:] = self._load
        if self._carried is not None:
            first = slice(JOINTS)
            drive = np.minimum(np.maximum(forces[first], -self._most), self._most) + self._load[first]
            motors.load_force[first] += self._carried.force(motors.position[first], motors.velocity[first], drive)
        held = let_go | (not self.is_known)
        if self._braked or held.any():
            motors.brake(self._brake * held)
            self._braked = bool(held.any())
