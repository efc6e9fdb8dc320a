"""Stops of axes that a force holds back, or that a force command moves: braked by the ramp, held by what they carry."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.motion.settings import Watch
from sioms.protocol.flags import AxisStatus

from .test_behind import Mass
from .test_stops_as_configured import FORCE, GAINS, MAX_FORCE, VELOCITY, end_by, rig_of


class Rough(Mass):
    """A mass with dry friction, whose place is read in steps."""

    def __init__(self, friction: float, **plant: float) -> None:
        super().__init__(**plant)
        self.friction = friction

    def __call__(self, force: np.ndarray, dt: float) -> np.ndarray:
        before = self.velocity
        super().__call__(force, dt)
        loss = self.friction * dt / self.mass
        turns = before * self.velocity < 0.0
        self.velocity -= np.sign(self.velocity) * min(loss, abs(self.velocity))
        if turns and abs(force[0] + self.pull) <= self.friction:
            self.velocity = 0.0
        return np.round(np.array([self.position]), 6)


@pytest.mark.parametrize("acceleration", (0.3, 0.6))
@pytest.mark.parametrize("most", (3.2, 3.5, 4.0))
def test_what_resists_an_axis_that_is_held_back_brakes_it_and_not_all_its_force(
    most: float, acceleration: float
) -> None:
    plant = Rough(3.0, mass=2.0, viscous=4.0)
    rig = rig_of(plant, velocity_max=0.5, k=825043.0, kz=-0.914, kb=0.0, force_max=100.0, acceleration_max=acceleration)
    rig.write(mode=VELOCITY, velocity=0.2)
    rig.tick(1500)
    rig.write(mode=VELOCITY | MAX_FORCE, velocity=0.2, max_force=most, replace=True)
    rig.tick(30)
    before, place = len(rig.history), plant.position
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1500)
    stopped = np.diff(rig.trace("position")[before:]) * 1e3
    assert -np.diff(stopped).min() * 1e3 < 2 * (3.0 + 4.0 * 0.2) / 2.0 + 1.0  # [m/s^2] the friction's, not 100 N's
    assert rig.trace("force")[before:].min() > -10.0
    assert rig.trace("position").max() - plant.position < 5e-5
    assert plant.position - place < 0.2**2 / (2 * acceleration) + 0.005
    assert rig.bank.is_idle(rig.axes)


@pytest.mark.parametrize("most", (0.01, 0.5))
def test_the_damping_of_an_axis_that_is_held_back_is_no_kick(most: float) -> None:
    """With friction it slows down by itself; where its set-point is put, the law has its damping on it at once."""
    plant = Rough(1.0, mass=0.5, viscous=1.0)
    rig = rig_of(plant, velocity_max=0.5, k=2000.0, kb=-73.0, force_max=100.0, acceleration_max=8.0)
    rig.write(mode=VELOCITY, velocity=0.4)
    rig.tick(500)
    rig.write(mode=VELOCITY | MAX_FORCE, velocity=0.4, max_force=most, replace=True)
    rig.tick(30)
    before = len(rig.history)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1500)
    stopped = np.diff(rig.trace("position")[before:]) * 1e3
    assert -np.diff(stopped).min() * 1e3 < 8.0 + (1.0 + 1.0 * 0.4) / 0.5 + 1.0  # [m/s^2]
    assert rig.bank.is_idle(rig.axes) and abs(plant.velocity) < 1e-3


@pytest.mark.parametrize(("pull", "back"), ((0.0, 0.005), (-5.0, 0.003), (5.0, 0.025)))
def test_a_force_against_the_motion_that_carries_nothing_does_not_drive_the_axis_back(pull: float, back: float) -> None:
    """It is told from what carries a load by what becomes of the axis when it has turned."""
    plant = Mass(mass=2.0, viscous=4.0)
    rig = rig_of(plant, velocity_max=0.5, force_max=100.0)
    rig.write(mode=VELOCITY, velocity=-0.4)
    rig.tick(1500)
    plant.pull = pull
    rig.write(mode=VELOCITY | GAINS, velocity=-0.4, k=0.0, kb=-100.0, replace=True)
    rig.tick(12)
    assert rig.field("force") > 10.0
    before = len(rig.history)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(2500)
    went = rig.trace("position")[before:]
    assert (went - np.minimum.accumulate(went)).max() < back
    assert abs(plant.velocity) < 1e-3 and rig.bank.is_idle(rig.axes)


@pytest.mark.parametrize("ends", ("stop", "abandon"))
@pytest.mark.parametrize("law", ({"k": 400.0, "kb": -40.0}, {"k": 2000.0, "kb": -80.0, "ki": 300.0}), ids=str)
@pytest.mark.parametrize("load", (5.0, -5.0))
def test_a_force_that_carries_a_load_holds_it_at_its_stop(load: float, law: dict[str, float], ends: str) -> None:
    plant = Mass(mass=2.0, viscous=4.0, pull=-load)
    rig = rig_of(plant, **law)
    rig.raw = plant(np.array([load]), 1e-9)
    rig.write(mode=FORCE, force=load)
    plant.velocity = plant.position = 0.0
    rig.tick(998)
    place, before = plant.position, len(rig.history)
    end_by(rig, ends)
    rig.tick(2000)
    assert abs(plant.position - place) < 2e-4
    assert np.abs(rig.trace("force")[before:]).max() <= 5.0 + 0.05
    assert rig.bank.is_idle(rig.axes)


def test_a_force_against_a_wall_presses_no_harder_at_its_end_nor_beyond_a_soft_limit() -> None:
    for limit in (3.0, 0.301):
        plant = Mass(viscous=10.0, wall=0.3)
        rig = rig_of(plant, position_max=limit)
        rig.write(mode=FORCE, force=4.0)
        rig.tick(4000)
        assert plant.position == 0.3
        rig.bank.stop(rig.axes, rig.now_ns)
        rig.tick(1000)
        assert rig.trace("force")[-1000:].max() <= 4.0 + 1e-9
        assert rig.field("commanded_position") <= limit


def test_a_force_too_great_to_be_held_by_a_soft_law_is_no_following_error() -> None:
    plant = Mass(viscous=10.0, wall=0.3)
    rig = rig_of(plant, k=100.0, following_error_max=0.02)
    rig.write(mode=FORCE, force=4.0)
    rig.tick(4000)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1000)
    assert not int(rig.field("status")) & AxisStatus.FAULT


@pytest.mark.parametrize("stop", ("stop", "emergency_stop", "abandon"))
@pytest.mark.parametrize(("fields", "pull"), [({"kb": -5.0}, 0.0), ({"kb": 10.0}, 2.0), ({"most": 2.0}, -5.0)], ids=str)
def test_a_force_with_gains_of_a_command_is_stopped_by_its_ramp(
    fields: dict[str, float], pull: float, stop: str
) -> None:
    """The damping that is configured came into force at once: 20 N, and 20 m/s^2, where 1 m/s^2 was configured."""
    plant = Mass(viscous=0.0)
    rig = rig_of(plant, acceleration_max=1.0, force_max=50.0, watch=Watch(uncommanded=False))
    plant.pull = pull
    if "most" in fields:  # its load drives it back
        rig.write(mode=FORCE | MAX_FORCE, force=3.0, max_force=fields["most"])
    else:
        rig.write(mode=FORCE | GAINS, force=3.0, k=400.0, **fields)
    while abs(plant.velocity) < 0.4:
        rig.tick()
    place, speed = plant.position, plant.velocity
    end_by(rig, stop)
    speeds = [speed]
    for _ in range(2000):
        rig.tick()
        speeds.append(plant.velocity)
    changes = np.diff(speeds) / 1e-3 * np.sign(speed)
    assert changes.min() > -1.2
    if stop != "emergency_stop":  # which lets go, and leaves the axis to its load
        assert np.abs(speeds).max() < abs(speed) * 1.15
        assert abs(plant.position - place) < speed**2 / 2.0 + 0.1 * abs(speed) + abs(pull) / 400.0 + 0.01
        assert abs(plant.velocity) < 1e-3


@pytest.mark.parametrize("stop", ("stop", "emergency_stop", "abandon"))
def test_a_stop_puts_no_axis_in_fault(stop: str) -> None:
    """What its gains had put out in that tick, 16 N, would have needed a set-point farther behind than an axis may be:
    a fault, which let it go.
    """
    plant = Mass(viscous=0.0)
    rig = rig_of(plant, k=100.0, kb=-20.0, force_max=30.0, following_error_max=0.1)
    rig.write(mode=VELOCITY, velocity=0.3)
    rig.tick(300)
    rig.write(mode=VELOCITY | GAINS, velocity=0.3, k=100.0, kb=-100.0, replace=True)
    rig.tick(2)
    place, speed = plant.position, plant.velocity
    assert abs(rig.field("force")) > 0.1 * 100.0
    end_by(rig, stop)
    rig.tick(2000)
    assert not int(rig.field("status")) & AxisStatus.FAULT
    assert abs(plant.velocity) < 1e-3
    assert abs(plant.position - place) < speed**2 / 10 + 0.2 * abs(speed)
