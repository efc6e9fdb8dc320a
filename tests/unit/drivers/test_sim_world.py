"""The simulated plane as a device: axes press on an object in it, and everybody feels the same contact."""

import math

import msgspec
import numpy as np
import pytest

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.tactile import SimTactile
from sioms.drivers.sim.world import SimWorld
from sioms.plant.finger import FingerShape, TactileArray
from sioms.protocol.flags import AnalogStatus, ControlMode
from sioms.sdk.exchange import LinkError

RB = 12.7e-3
MOUNT = {"link_m": 0.0, "stiffness": 1e5, "turn_stiffness": 5.0, "mass": 0.3, "inertia": 2e-4}


def module(loads=True):
    """Three axes that bear what the world says."""
    axes = []
    for name, unit in (("x", "m"), ("y", "m"), ("th", "rad")):
        axis = {
            "name": name, "unit": unit, "velocity_max": 0.2, "acceleration_max": 2.0, "force_max": 50.0,
            "bandwidth_hz": 15.0, "motor": {"mass": 2.0 if unit == "m" else 0.01, "encoder_step": 1e-6},
        }  # fmt: skip
        axes.append(axis | {"load_node": f"world.left.{name}_load"} if loads else axis)
    return {"axis": axes}


def world(**of_object):
    thing = {"shape": "disk", "radius_m": 0.02, "pose": [0.035, 0.0, 0.0], "mass": 5.0, "platen_friction": 1.0}
    axes = [f"mod0.plant.{name}_position" for name in ("x", "y", "th")]
    return {"object": thing | of_object, "finger": [{"name": "left", "axes": axes, "mount": MOUNT}]}


def felt(driver, channel):
    block = driver.blocks[1]
    return float(block.data[[info.name for info in block.spec.channels].index(channel)])


@pytest.fixture
def cell(bench):
    """Return an axis module, a world, a force sensor and a finger, the axis's command still to come."""
    contact = [
        {"node": "world.left.fx", "direction": [1, 0, 0]},
        {"node": "world.left.fy", "direction": [0, 1, 0]},
    ]
    plane = bench.make(SimWorld, "world", world())
    arm = bench.make(SimAxes, "mod0", module())
    quiet = {"noise": [0.0] * 6, "resolution": [0.0] * 6}
    sensor = bench.make(SimForce, "force0", {"contact": contact} | quiet)
    nodes = {
        "force_node": "world.left.normal",
        "angle_node": "world.left.angle",
        "curvature_node": "world.left.curvature",
    }
    still = {"angle_rad": 0.0, "angle_per_position": 1.0, "noise": 0.0, "resolution": 0.0}
    finger = bench.make(SimTactile, "tactile0", nodes | still)
    bench.run(0.02)
    return plane, arm, sensor, finger


def test_a_contact_is_the_same_for_the_axis_the_force_sensor_and_the_finger(bench, cell):
    plane, arm, sensor, finger = cell
    assert felt(plane, "clearance") == pytest.approx(0.035 - 0.02 - RB, abs=1e-6) and felt(plane, "normal") == 0.0
    bench.write(arm, axis=0, control_mode=ControlMode.POSITION, position=0.003)
    bench.run(1.0)
    force = felt(plane, "normal")
    assert 1.0 < force < 9.0
    assert felt(plane, "x_load") == pytest.approx(-force, rel=5e-3) and felt(plane, "fx") == pytest.approx(
        -force, rel=5e-3
    )
    assert sensor.blocks[0].data[0] == pytest.approx(-force, rel=5e-3)
    assert 1 / felt(plane, "curvature") == pytest.approx(0.02, rel=0.05)
    # the servo's stiffness, m w^2, bears it: its error is the force over it
    error = 0.003 - arm.blocks[1].data[0]
    assert error == pytest.approx(force / (2.0 * (2 * math.pi * 15) ** 2), rel=0.02)
    # the finger shows the pattern of such a cylinder there
    array, expected = TactileArray(FingerShape()), np.zeros(16)
    array.mount(0.02)
    array.read(force, felt(plane, "angle"), 0.02, expected)
    assert finger.blocks[0].data == pytest.approx(expected, abs=0.03 * np.abs(expected).max())
    assert np.all(finger.blocks[0].flags == 0)


def test_an_object_is_pushed_along_when_the_platen_lets_it(bench):
    plane = bench.make(SimWorld, "world", world(mass=0.1, platen_friction=0.2))
    arm = bench.make(SimAxes, "mod0", module())
    bench.run(0.02)
    bench.write(arm, axis=0, control_mode=ControlMode.POSITION, position=0.05)
    bench.run(1.0)
    x, y, _, *speed = plane.blocks[0].data
    assert 0.05 + RB + 0.02 - 1e-4 < x < 0.095 and abs(y) < 1e-4  # and on, for as long as it slides
    assert speed == pytest.approx([0, 0, 0], abs=1e-6)


def test_axes_whose_world_is_gone_are_lost_and_sensors_invalid(bench, cell):
    _, arm, sensor, finger = cell
    for node in bench.inputs.values():
        if node.name.startswith("world."):
            node.detach()
    now = bench.clock_ns + 1_000_000
    with pytest.raises(LinkError, match=r"world\.left\.x_load"):
        arm.tick(now)
    with pytest.raises(LinkError, match="simulated world"):
        arm.open()
    for driver in (sensor, finger):
        driver.tick(now)
        assert np.all(driver.blocks[0].flags & int(AnalogStatus.INVALID))


def test_a_world_without_its_axes_stands_still_and_says_so(bench, cell):
    plane, arm, _, _ = cell
    bench.write(arm, axis=0, control_mode=ControlMode.POSITION, position=0.003)
    bench.run(0.5)
    before = plane.blocks[0].data.copy()
    bench.inputs["mod0.plant.th_position"].detach()
    for tick in range(5):
        plane.tick(bench.clock_ns + 1_000_000 * (tick + 1))
    assert np.all(plane.blocks[0].flags & int(AnalogStatus.INVALID))
    assert plane.blocks[0].data == pytest.approx(before, abs=1e-9)


def test_a_finger_that_takes_all_round_objects_shows_each_as_its_own_table_would():
    every = TactileArray(FingerShape())
    every.mount_all()
    for radius, within in ((0.1, 0.01), (0.02, 0.015), (0.006, 0.03), (0.002, 0.06)):
        own = TactileArray(FingerShape())
        own.mount(radius)
        expected = own.strain(100.0, 1.2, radius)
        assert every.strain(100.0, 1.2, radius) == pytest.approx(expected, abs=within * np.abs(expected).max())


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        ({"shape": "disk", "radius_m": 0.0}, "half_x_m"),
        ({"shape": "polygon", "points_m": [[0, 0], [0, 0.01], [0.01, 0]]}, "anti-clockwise"),
        ({"shape": "rectangle", "size_m": [0.02, 0.03], "corner_m": 0.02}, "nothing of a side"),
        ({"mass": 0.0}, "mass"),
    ],
)
def test_objects_that_cannot_be_are_refused(change, wrong):
    table = world(**change)
    with pytest.raises(ValueError, match=wrong):
        SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))


def test_names_of_fingers_are_one_each_and_steppers_bear_no_loads():
    table = world()
    table["finger"] *= 2
    with pytest.raises(ValueError, match="is taken"):
        SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))
    stepper = {"name": "x", "velocity_max": 0.1, "acceleration_max": 1.0, "load_node": "world.left.x_load"}
    stepper["stepper"] = {"mass": 0.4, "step": 2e-4, "hold_force": 60.0}
    with pytest.raises(ValueError, match="steppers bear no load"):
        SimAxes.describe("mod0", msgspec.convert({"axis": [stepper]}, SimAxes.Settings))


def test_axes_that_lose_their_world_do_not_go_on_when_it_comes_back(bench, cell):
    _, arm, *_ = cell
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=0.1)
    bench.run(0.3)
    assert arm._servos.velocity[1] == pytest.approx(0.1, abs=0.01)
    for node in bench.inputs.values():
        if node.name.startswith("world."):
            node.detach()
    with pytest.raises(LinkError):
        arm.tick(bench.clock_ns + 1_000_000)
    assert not np.any(arm._servos.velocity)
