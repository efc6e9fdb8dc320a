"""The simulated plane as a device: axes press on an object in it, and everybody feels the same contact."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.tactile import SimTactile
from sioms.drivers.sim.world import SimWorld
from sioms.plant.finger import FingerShape, TactileArray
from sioms.plant.outline import disk, rectangle
from sioms.plant.planar import Body, Mount, World
from sioms.protocol.flags import AnalogStatus, ControlMode
from sioms.sdk.exchange import LinkError

RB = 12.7e-3
MOUNT = {"link_m": 0.0, "stiffness": 1e5, "turn_stiffness": 5.0, "mass": 0.3, "inertia": 2e-4}

BOX = {"shape": "rectangle", "radius_m": 0.0}
UNBOUNDED = ("friction_by_load", "creep")


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


def test_axes_whose_world_is_gone_are_in_fault_and_sensors_invalid(bench, cell):
    _, arm, sensor, finger = cell
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=0.1)
    bench.run(0.3)
    assert arm._world.servos.velocity[1] == pytest.approx(0.1, abs=0.01)
    let_go_of_the_world(bench)
    bench.halted += [sensor, finger]
    bench.run(0.01)
    assert fault(arm).startswith("world.left.x_load: no load is known") and stands(arm)
    at = arm._world.servos.position.copy()
    bench.run(0.1)
    assert stands(arm) and np.array_equal(arm._world.servos.position, at)
    for driver in (sensor, finger):
        driver.tick(bench.clock_ns + 1_000_000)
        assert np.all(driver.blocks[0].flags & int(AnalogStatus.INVALID))
    with pytest.raises(LinkError, match="simulated world"):
        arm.open()
    arm.bank.reset(np.arange(3))
    bench.run(0.01)
    assert not fault(arm)  # it may stand there without a world
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=0.1)
    bench.run(0.01)
    assert fault(arm) and stands(arm)


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
        ({"radius_m": 5.0}, r"reaches 5 m .* at most 0.72 m"),
        ({"radius_m": 4e-4}, r"m wide .* at least 0.001 m"),
        ({**BOX, "size_m": [0.03, 9e-4]}, "0.0009 m wide"),
        ({**BOX, "size_m": [1.5, 0.03]}, "reaches 0.75 m"),
        ({"shape": "polygon", "points_m": [[0, 0], [0, 0.01], [0.01, 0]], "radius_m": 0.0}, "anti-clockwise"),
        ({**BOX, "size_m": [0.02, 0.03], "corner_m": 0.02}, "nothing of a side"),
        ({"corner_m": 1e-3}, "corner_m is given, which nobody reads of shape disk; want radius_m"),
        ({**BOX, "size_m": [0.02, 0.03], "radius_m": math.nan}, "radius_m is given, .* want size_m and corner_m"),
        ({"mass": 0.0}, "mass is 0; want 1e-06 to 1e.12"),
        ({"mass": 2e-3}, "thrown about by the rubber in steps of 0.25 ms; want at least 0.0047 kg"),
        ({"mass": 1e13}, "mass is 1e.13; want"),
        ({"platen_friction": -0.1}, "platen_friction"),
        ({"platen_friction": 1e6}, "platen_friction"),
        ({"pose": [math.nan, 0.0, 0.0]}, "its pose is"),
        ({"pose": [0.0, 11.0, 0.0]}, "within 10 m"),
        ({"pose": [0.0, 0.0, math.inf]}, "within 100 rad"),
    ],
)
def test_objects_that_cannot_be_are_refused(change, wrong):
    table = world(**change)
    with pytest.raises(ValueError, match=wrong):
        SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Mount) if field.name not in UNBOUNDED])
def test_no_number_of_a_mount_is_without_bounds(name):
    for number in (-1.0, 1e12, math.inf, -math.inf, math.nan):
        table = world()
        table["finger"][0]["mount"] = MOUNT | {name: number}
        with pytest.raises(ValueError, match=rf"{name} is .*; want \S+ to \S+"):
            SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))


def test_what_is_too_light_for_the_steps_is_refused_and_would_be_thrown_about():
    """0.1 g between two fingers in steps of 0.25 ms goes off at 10 m/s and more."""

    def speed(mass, step_s):
        joints = [[-0.0327, 0.14, -0.5 * math.pi], [0.0327, -0.14, 0.5 * math.pi]]
        mounts = [Mount(stiffness=2.5e4, turn_stiffness=3.0, mass=0.2, inertia=2e-4)] * 2
        plane = World(Body(disk(0.02), mass), mounts, joints)
        closed = [[x - math.copysign(2e-3, x), y, th] for x, y, th in joints]
        plane.command(closed, 0.05)
        plane.advance(0.05, round(0.05 / step_s))
        plane.command(closed, 0.05)
        plane.advance(0.05, round(0.05 / step_s))
        return math.hypot(*plane.speed[:2])

    assert speed(1e-4, 0.25e-3) > 10.0 and speed(2e-3, 0.25e-3) < 1e-3 and speed(1e-3, 0.1e-3) < 1e-3
    for mount, wrong in (
        ({"stiffness": 1e8}, "mass 0.3 is thrown about by its springs .* want at least 6"),
        ({"turn_stiffness": 1e5}, "inertia 0.0002 is thrown about"),
    ):
        table = world()
        table["finger"][0]["mount"] = MOUNT | {"damping_ratio": 100.0} | mount
        with pytest.raises(ValueError, match=wrong):
            SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))


@pytest.mark.parametrize(("keys", "wrong"), [
    ({"step_s": 0.0}, "step_s 0; want"), ({"step_s": 1e-12}, "1000 steps a tick"), ({"step_s": math.inf}, "step_s inf"),
])  # fmt: skip
def test_steps_that_no_tick_could_make_are_refused(keys, wrong):
    with pytest.raises(ValueError, match=wrong):
        SimWorld.describe("world", msgspec.convert(world() | keys, SimWorld.Settings))


def test_names_of_fingers_are_one_each_and_steppers_bear_no_loads():
    table = world()
    table["finger"] *= 2
    with pytest.raises(ValueError, match="is taken"):
        SimWorld.describe("world", msgspec.convert(table, SimWorld.Settings))
    stepper = {"name": "x", "velocity_max": 0.1, "acceleration_max": 1.0, "load_node": "world.left.x_load"}
    stepper["stepper"] = {"mass": 0.4, "step": 2e-4, "hold_force": 60.0}
    with pytest.raises(ValueError, match="steppers bear no load"):
        SimAxes.describe("mod0", msgspec.convert({"axis": [stepper]}, SimAxes.Settings))


# --- a module that carries a finger, and its world: who of them stands still -----------------------------

SOFT = MOUNT | {"link_m": 0.14, "stiffness": 2.5e4, "turn_stiffness": 3.0, "mass": 0.2}


def carrying_table(**of_object):
    table = world(**of_object)
    table["finger"][0]["mount"] = SOFT
    return table


@pytest.fixture
def carrying(bench):
    """Return a world and a module that goes on pressing its finger, on a link across that, on a heavy disk."""
    plane = bench.make(SimWorld, "world", carrying_table(pose=[0.14, RB + 0.0205, 0.0]))
    axes = module(loads=False)["axis"]
    axes[2]["motor"] |= {"mass": 3e-4, "viscous": 2e-3}
    axes[2] |= {"bandwidth_hz": 5.06, "force_max": 0.8, "following_error_max": 2.5, "velocity_max": 3.0}
    axes[2] |= {"watch": {"uncommanded": False}}
    arm = bench.make(SimAxes, "mod0", {"axis": axes, "carries": "world.left_joints"})
    bench.run(0.3)
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=0.05)
    bench.run(0.8)
    assert felt(plane, "normal") > 0.5 and not any(fault(arm, axis) for axis in range(3))
    assert abs(plane._world.fingers[0].place[2] - arm._world.servos.position[2]) > 0.01  # the link is bent
    return plane, arm


def let_go_of_the_world(bench):
    for node in bench.inputs.values():
        if node.name.startswith("world."):
            node.detach()


def fault(arm, axis=0):
    return arm.bank.fault_text(axis)


def stands(arm):
    """Tell whether nothing moves, by any measure."""
    rows = arm.bank.rows
    return not any(np.any(x) for x in (arm._world.servos.velocity, rows["velocity"], rows["commanded_velocity"]))


def highest(bench, seconds, *values):
    """Run; return the highest magnitude of each value on the way."""
    most = [0.0] * len(values)
    for _ in range(round(seconds * 1e3)):
        bench.run(1e-3)
        most = [max(old, abs(float(value()))) for old, value in zip(most, values, strict=True)]
    return most


def test_a_module_stands_when_its_world_is_late_and_holds_on_when_that_goes_on(bench, carrying):
    plane, arm = carrying
    before = felt(plane, "normal")
    bench.halted.append(plane)
    bench.run(0.04)
    assert not fault(arm)  # a busy machine
    bench.run(0.02)
    assert "late" in fault(arm) and stands(arm)
    at = arm._world.servos.position.copy()
    bench.run(0.5)
    assert stands(arm) and np.array_equal(arm._world.servos.position, at)
    bench.halted.clear()
    normal, turning = highest(bench, 0.3, lambda: felt(plane, "normal"), lambda: plane._world.fingers[0].speed[2])
    assert normal < 1.3 * before and turning < 1.0
    assert stands(arm) and felt(plane, "normal") == pytest.approx(before, rel=0.3)  # what is let go is braked
    arm.bank.reset(np.arange(3))
    assert highest(bench, 0.3, lambda: felt(plane, "normal"))[0] < 1.3 * before
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=-0.01)
    bench.run(0.1)
    assert not fault(arm) and arm._world.servos.velocity[1] == pytest.approx(-0.01, rel=0.2)


def test_a_module_that_was_stopped_makes_up_for_nothing_and_shakes_nothing(bench, carrying):
    plane, arm = carrying
    before, at = felt(plane, "normal"), arm._world.servos.position.copy()
    bench.halted.append(arm)
    bench.run(1.5)  # beyond the lease: its world has been standing still for half a second
    assert np.all(plane.blocks[0].flags & int(AnalogStatus.INVALID))
    bench.halted.clear()
    speeds = [lambda i=i: arm._world.servos.velocity[i] for i in (0, 1, 2)]
    x, y, th, normal = highest(bench, 0.5, *speeds, lambda: felt(plane, "normal"))
    assert fault(arm) and stands(arm)
    assert x < 0.02 and y < 0.051 and th < 0.5 and normal < 1.3 * before
    assert arm._world.servos.position == pytest.approx(at, abs=1e-3)


def test_a_module_that_was_stopped_for_a_moment_moves_no_further_than_it_brakes(bench, carrying):
    _, arm = carrying
    at = float(arm._world.servos.position[1])
    bench.halted.append(arm)
    bench.run(0.4)  # its world goes on: to it the module stands
    bench.halted.clear()
    assert highest(bench, 0.5, lambda: arm._world.servos.velocity[1])[0] < 0.051
    assert "behind" in fault(arm, 1) and arm._world.servos.position[1] == pytest.approx(at, abs=1e-3)


def test_bent_links_push_no_module_that_is_let_go(bench, carrying):
    _, arm = carrying
    arm.bank.fault(np.arange(3), "for a test")
    bench.run(0.02)
    at = arm._world.servos.position.copy()
    bench.run(0.5)
    assert stands(arm) and np.array_equal(arm._world.servos.position, at)


def test_a_world_that_ticks_seldom_keeps_its_time(bench):
    table = world() | {"tick_hz": 10.0, "step_s": 1e-3}
    table["finger"][0] |= {"axes": ["", "", ""], "mount": MOUNT | {"damping_ratio": 50.0}}
    plane = bench.make(SimWorld, "world", table)
    bench.run(2.0)
    assert plane._world.time_s == pytest.approx(1.9)  # the first tick makes it


# --- no finger is put into the object ---------------------------------------------------------------------


@pytest.fixture
def logged(bench, monkeypatch):
    """Return the sentences that go to the log."""
    found = []
    monkeypatch.setattr(bench, "log", lambda level, text: found.append(text))
    return found


def lies(plane):
    """Return where the object is shown to lie; None while that is flagged invalid."""
    block = plane.blocks[0]
    return None if np.any(block.flags & int(AnalogStatus.INVALID)) else block.data[:3].tolist()


def test_a_world_that_starts_anew_around_a_finger_is_empty_until_that_has_gone(bench, logged, carrying):
    """The world that died had its object pushed away; the next one has it where the finger now is."""
    plane, arm = carrying
    arm.bank.stop(np.arange(3), bench.clock_ns)
    bench.run(0.1)
    bench.halted.append(plane)
    away = carrying_table(pose=[0.14, RB + 0.0195, 0.0])
    again = bench.make(SimWorld, "world", away)
    bench.run(0.05)
    assert lies(again) is None and "left would be put into the object" in logged[-1]
    assert felt(again, "normal") == 0.0 and felt(again, "x_load") == pytest.approx(0.0, abs=1e-6)
    arm.bank.reset(np.arange(3))
    bench.run(0.01)
    assert not any(fault(arm, axis) for axis in range(3))  # it may go away without an object
    bench.write(arm, axis=1, control_mode=ControlMode.VELOCITY, velocity=-0.05)
    most = highest(bench, 0.5, lambda: felt(again, "normal"))[0]
    assert most == 0.0 and lies(again) == pytest.approx([0.14, RB + 0.0195, 0.0])
    assert "it lies there now" in logged[-1]


@pytest.mark.parametrize("into_m", [0.002, 0.02, 0.0328])
def test_a_module_that_comes_back_elsewhere_puts_no_finger_into_the_object(bench, logged, into_m):
    """Its finger was beside the object, and would be at its edge, in its middle, or deep within."""
    plane = bench.make(SimWorld, "world", world())
    arm = bench.make(SimAxes, "mod0", module(loads=False))
    bench.run(0.1)
    bench.halted.append(arm)
    bench.inputs["mod0.plant.x_position"].detach()
    plane.tick(bench.clock_ns + 1_000_000)
    moved = module(loads=False)
    moved["axis"][0]["motor"]["start"] = 0.035 - 0.02 - RB + into_m
    bench.make(SimAxes, "mod0", moved)
    most = highest(bench, 0.1, lambda: felt(plane, "normal"))[0]
    assert most == 0.0 and lies(plane) is None and "left would be put" in logged[-1]


def test_distances_of_fingers_are_right_inside_of_the_object_too():
    body = Body(rectangle(0.04, 0.06))
    for x, clearance in ((0.05, 0.03 - RB), (0.02, -RB), (0.015, -0.005 - RB), (0.0, -0.02 - RB)):
        plane = World(body, [Mount(link_m=0.0)], [[x, 0.0, 0.0]])
        assert plane.clearances() == pytest.approx([clearance])
        turned = plane.clearances((x, 0.0, 0.5 * math.pi))  # the centre of the finger in that of the object
        assert turned == pytest.approx([-0.02 - RB])
