"""Axes that cannot follow their set-points: what stops them, what takes over from what they do, when they are at rest.

The plants are Newton's law and nothing else; what the tests ask for follows from it.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sioms.motion import EventKind
from sioms.motion.settings import SWITCH_PLUS
from sioms.protocol.flags import AxisStatus, ControlMode

from ...motion_rig import Rig, axis

POSITION, VELOCITY = ControlMode.POSITION, ControlMode.VELOCITY
WEAK = {"velocity_max": 0.5, "acceleration_max": 2.0, "jerk_max": None, "force_max": 1.0}
"""What no motor can do that moves 1 kg against 5 N s/m: it goes at most 0.2 m/s."""
STOPS = ("stop", "emergency_stop")


class Mass:
    """A mass on a slide.

    Args:
        mass: [kg].
        viscous: [N s/m].
        wall: beyond this place it does not go [m].
        pull: a force that always acts [N].
    """

    def __init__(self, mass: float = 1.0, viscous: float = 5.0, wall: float = np.inf, pull: float = 0.0) -> None:
        self.mass, self.viscous, self.wall, self.pull = mass, viscous, wall, pull
        self.position = self.velocity = 0.0

    def __call__(self, force: np.ndarray, dt: float) -> np.ndarray:
        for _ in range(4):
            acceleration = (force[0] + self.pull - self.viscous * self.velocity) / self.mass
            self.velocity += acceleration * dt / 4
            self.position += self.velocity * dt / 4
        if self.position >= self.wall:
            self.position, self.velocity = self.wall, min(self.velocity, 0.0)
        return np.array([self.position])


def weak(gains: dict[str, float], plant: Mass, **changes: float) -> Rig:
    return Rig([axis(**{**WEAK, "following_error_max": np.inf, **gains, **changes})], plant=plant)


def tick_to(rig: Rig, plant: Mass, place: float) -> None:
    for _ in range(5000):
        if plant.position >= place:
            return
        rig.tick()
    raise AssertionError(f"the axis has not come to {place}")


GAINS = [
    {"k": 1000.0, "kb": -60.0},
    {"k": 100.0, "kb": -20.0},
    {"k": 1000.0, "kz": -0.9, "kb": -20.0},
    {"k": 400.0, "kp": 0.5, "kb": -60.0},
    {"k": 1000.0, "kb": -60.0, "ki": 2000.0},
]


@pytest.mark.parametrize(("gains", "stop"), list(itertools.product(GAINS, STOPS)))
def test_a_stop_begins_where_the_axis_is(gains: dict[str, float], stop: str) -> None:
    plant = Mass()
    rig = weak(gains, plant)
    rig.write(mode=POSITION, position=1.0)
    tick_to(rig, plant, 0.2)
    place, speed = plant.position, plant.velocity
    assert rig.field("following_error") > 0.05  # the set-point has run ahead
    getattr(rig.bank, stop)(rig.axes, rig.now_ns)
    rig.tick(2000)
    assert rig.bank.is_idle(rig.axes)
    assert plant.position - place <= 1.5 * speed**2 / (2 * 2.0) + 0.002
    assert abs(plant.velocity) < 1e-3


@pytest.mark.parametrize("gains", GAINS)
def test_a_fault_and_a_late_tick_stop_it_there_too(gains: dict[str, float]) -> None:
    for late in (False, True):
        plant = Mass()
        rig = weak(gains, plant)
        rig.write(mode=VELOCITY, velocity=0.5)
        tick_to(rig, plant, 0.2)
        if late:
            rig.now_ns += 60_000_000
        else:
            rig.bank.fault(rig.axes, "a fault", rig.now_ns)
        rig.tick(2000)
        coasts = 1.0 * 0.2 / 5.0  # so far a mass goes on that is let go
        assert plant.position < 0.2 + max(coasts, 1.5 * 0.2**2 / 4 + 0.06 * 0.2) + 1e-3, f"late {late}"


def test_an_axis_is_in_motion_until_it_has_arrived() -> None:
    plant = Mass()
    rig = weak(GAINS[0], plant)
    rig.write(mode=POSITION, position=0.5)
    rig.run()
    assert rig.history[-1]["in_motion"][0] == 0
    assert abs(plant.position - 0.5) <= 0.006
    assert rig.trace("velocity")[-1] <= 0.05
    moved = rig.trace("velocity") > 0.1
    assert np.all(rig.trace("in_motion")[moved] == 1)
    assert rig.kinds().count(EventKind.IDLE) == 1


def test_an_axis_that_is_let_go_is_in_motion_until_it_stands() -> None:
    plant = Mass(viscous=1.0)
    rig = weak({"k": 1000.0, "kb": -60.0}, plant, force_max=50.0)
    rig.write(mode=POSITION, position=1.0)
    tick_to(rig, plant, 0.2)
    rig.bank.fault(rig.axes, "a fault", rig.now_ns)
    rig.tick(300)
    assert plant.velocity > 0.1
    assert rig.field("in_motion") == 1
    assert not rig.bank.is_idle(rig.axes)
    place, speed = plant.position, plant.velocity
    rig.bank.reset(rig.axes)
    rig.tick()
    assert rig.field("in_motion") == 1
    rig.run()
    assert plant.position - place == pytest.approx(speed**2 / 4, rel=0.3, abs=1e-3)


def test_an_axis_that_meets_a_wall_is_at_rest_there_and_a_stop_lets_the_pressure_go() -> None:
    plant = Mass(wall=0.1)
    rig = weak(GAINS[0], plant)
    rig.write(mode=POSITION, position=0.5)
    rig.tick(3000)
    assert rig.bank.is_idle(rig.axes)
    assert int(rig.field("status")) & AxisStatus.SATURATED
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(100)
    assert abs(rig.field("force")) < 0.05
    plant.wall = np.inf
    rig.tick(1000)
    assert plant.position < 0.105


def test_what_replaces_a_motion_begins_where_the_axis_is() -> None:
    plant = Mass()
    rig = weak(GAINS[0], plant)
    rig.write(mode=VELOCITY, velocity=0.5)
    tick_to(rig, plant, 0.3)
    rig.write(mode=POSITION, position=0.0, replace=True)
    rig.run()
    assert max(rig.trace("position")) < 0.3 + 0.2**2 / 4 + 0.02
    assert abs(plant.position) < 0.006


def test_a_planned_command_does_not_hurry_an_axis_off_a_wall() -> None:
    plant = Mass(wall=0.1)
    rig = weak(GAINS[0], plant)
    rig.write(mode=POSITION, position=0.5)
    rig.tick(3000)
    plant.wall = np.inf
    rig.write(mode=POSITION, position=0.0)
    rig.run()
    assert max(rig.trace("position")) < 0.11


def test_an_axis_that_runs_ahead_of_its_set_point_is_braked_with_all_its_force() -> None:
    plant = Mass(viscous=0.0, pull=0.8)
    rig = weak(GAINS[0], plant)
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(1000)
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(100)
    forces = []
    for _ in range(200):
        rig.bank.stop(rig.axes, rig.now_ns)  # said again and again, it takes no force away
        rig.tick()
        forces.append(rig.field("force"))
    assert max(forces) <= -0.99


def test_a_servo_that_follows_stops_as_its_set_point_does() -> None:
    plant = Mass()
    rig = weak({"k": 1000.0, "kb": -60.0}, plant, force_max=100.0)
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(1000)
    before = rig.field("commanded_position")
    rig.bank.stop(rig.axes, rig.now_ns)
    rig.tick(1000)
    assert rig.field("commanded_position") - before == pytest.approx(0.5**2 / 4, abs=1e-3)


def test_an_end_switch_stops_an_axis_on_its_way_to_a_set_point_at_rest() -> None:
    plant = Mass()
    rig = weak(GAINS[0], plant)
    rig.switches = lambda raw: np.where(raw > 0.4, SWITCH_PLUS, 0)
    rig.write(mode=POSITION, position=0.8)
    rig.tick(5000)
    assert plant.position < 0.4 + 0.2**2 / 4 + 0.01


def test_who_may_use_all_the_force_has_to_follow() -> None:
    for most, faulty in ((None, True), (0.5, False), (1.0, True)):
        rig = Rig([axis(**WEAK, k=1000.0, kb=-60.0)], plant=Mass(wall=0.1))
        limited = {} if most is None else {"max_force": most}
        rig.write(mode=POSITION | (0 if most is None else ControlMode.SPECIFIED_MAX_FORCE), position=0.8, **limited)
        rig.tick(2500)
        assert bool(int(rig.field("status")) & AxisStatus.FOLLOWING_ERROR) == faulty, f"with {most} N"
        if faulty:
            assert "following error 0.25" in rig.bank.fault_text(0)
            assert rig.field("force") == 0.0


@pytest.mark.parametrize("others", (0, 7))
@pytest.mark.parametrize("since_ns", (0, 400_000, 900_000))
def test_what_replaces_a_motion_that_could_not_be_followed_is_no_kick(since_ns: int, others: int) -> None:
    """However far behind the axis was, and whenever between two ticks; more axes than a few go a way of their own."""
    plant = Mass(mass=2.0, viscous=4.0)
    idle = [axis(**{**WEAK, "k": 400.0}) for _ in range(others)]
    changes = {
        "k": 20000.0,
        "kz": -0.9,
        "kb": -40.0,
        "force_max": 6.0,
        "acceleration_max": 5.0,
        "following_error_max": np.inf,
    }
    rig = Rig(
        [axis(**{**WEAK, **changes}), *idle], plant=lambda force, dt: np.append(plant(force, dt), np.zeros(others))
    )
    rig.write(mode=VELOCITY, velocity=0.5)
    rig.tick(80)
    assert rig.field("following_error") > 0.003 and rig.field("force") == 6.0
    before, rig.now_ns = len(rig.history), rig.now_ns + since_ns
    rig.write(mode=VELOCITY, velocity=np.append(0.2, np.zeros(others)), axis=np.arange(others + 1), replace=True)
    rig.now_ns -= since_ns
    rig.tick(40)
    assert rig.trace("force")[before:].min() > -1.0
