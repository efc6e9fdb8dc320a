"""What a motor carries on a spring, simulated elsewhere and seen late: nothing makes energy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from sioms.plant.carried import Carried, most_late
from sioms.plant.motor import MotorBank
from sioms.plant.outline import disk
from sioms.plant.parameters import Motor
from sioms.plant.planar import Body, Mount, World

TICK_S = 1e-3
MASS, INERTIA = 1.4, 3e-4
MOUNT = Mount(stiffness=2.5e4, turn_stiffness=3.0, mass=0.2, inertia=2e-4)


class Coupled:
    """Three free motors and the finger that they carry; each side sees the other some ticks late."""

    def __init__(self, mount: Mount, late: int, told: bool) -> None:
        self.mount, self._told = mount, told
        self.world = World(Body(disk(0.02)), [mount], [[0.0, 0.0, 0.0]], (5.0, 5.0, 0.0))
        self.motors = MotorBank([Motor(mass) for mass in (MASS, MASS, INERTIA)], TICK_S)
        self.carried = Carried(np.array([MASS, MASS, INERTIA]), TICK_S)
        self._axes = [[0.0, 0.0, 0.0]] * (late + 1)
        self._ends = [self._end()] * (late + 1)

    def _end(self) -> tuple[list[float], list[list[float]]]:
        finger = self.world.fingers[0]
        stiffness, damping, _ = zip(*self.mount.springs, strict=True)
        return list(finger.joint_force), [list(finger.place), list(finger.speed), list(stiffness), list(damping)]

    def step(self) -> None:
        """Go on by a tick."""
        force, far = self._ends.pop(0)
        if self._told:
            self.carried.far[:] = far
            force = self.carried.force(self.motors.position, self.motors.velocity, np.zeros(3)).tolist()
        self.motors.load_force[:] = force
        self.motors.advance(np.zeros(3))
        self._axes.append(self.motors.position.tolist())
        self.world.command([self._axes.pop(0)], TICK_S)
        self.world.advance(TICK_S, 4)
        self._ends.append(self._end())

    @property
    def energy(self) -> float:
        """Of motors, finger and the springs between where they truly are [J]."""
        finger, total = self.world.fingers[0], 0.0
        for (stiffness, _, behind), mass, i in zip(self.mount.springs, (MASS, MASS, INERTIA), range(3), strict=True):
            way = float(self.motors.position[i]) - finger.place[i]
            rate = float(self.motors.velocity[i])
            total += 0.5 * (stiffness * way**2 + behind * finger.speed[i] ** 2 + mass * rate**2)
        return total


def _energies(cell: Coupled, ticks: int = 1500) -> list[float]:
    cell.world.fingers[0].speed[:] = [0.1, -0.05, 2.0]
    found = [cell.energy]
    for _ in range(ticks):
        cell.step()
        found.append(cell.energy)
    return found


@pytest.mark.parametrize("late", [0, 1, 3, 6])
def test_energy_does_not_grow(late: int) -> None:
    found = _energies(Coupled(MOUNT, late, told=True))
    assert max(found) < 1.05 * found[0]
    # What no spring damps is the motion of both together; ends that see each other late brake that, too.
    alone = sum(
        0.5 * (behind * speed) ** 2 / (behind + mass)
        for (_, _, behind), mass, speed in zip(MOUNT.springs, (MASS, MASS, INERTIA), (0.1, -0.05, 2.0), strict=True)
    )
    assert found[200] < 1.01 * alone and found[-1] <= found[200]


def test_a_force_that_comes_late_makes_energy_where_the_spring_that_is_told_makes_none() -> None:
    held = replace(MOUNT, mass=50.0, inertia=0.05, damping_ratio=0.045)  # as good as fixed, as by a contact
    forced = _energies(Coupled(held, 5, told=False), 600)
    told = _energies(Coupled(held, 5, told=True), 600)
    assert max(forced) > 100.0 * forced[0]
    assert max(told) < 1.05 * told[0]


def test_the_bound_on_lateness_is_that_of_the_impedance() -> None:
    stiffness, damping, _ = MOUNT.springs[2]
    most_s = most_late(stiffness, damping)

    def least(late_s: float) -> float:
        omega = np.linspace(1.0, 0.25 / late_s, 2000)
        z = damping + stiffness / (1j * omega)
        return float(np.min(z.real - np.abs((z * np.exp(-1j * omega * late_s)).real)))

    assert least(0.98 * most_s) >= -1e-3 * damping
    assert least(1.05 * most_s) < -1e-2 * damping
    assert most_late(0.0, 1.0) == math.inf


def test_no_stiffness_is_too_high_for_the_tick() -> None:
    motors = MotorBank([Motor(1e-3)], TICK_S)
    carried = Carried(np.array([1e-3]), TICK_S)
    carried.far[:] = [[1.0], [0.0], [1e8], [1.0]]
    for _ in range(50):
        motors.load_force[:] = carried.force(motors.position, motors.velocity, np.zeros(1))
        motors.advance(np.zeros(1))
        assert abs(float(motors.position[0])) < 1.5
    assert float(motors.position[0]) == pytest.approx(1.0, abs=1e-3)
