"""The simulated plane: facts that its program does not use."""

from __future__ import annotations

import math
import random
from copy import deepcopy

import numpy as np
import pytest
from hand_rig import RB, HandRig
from scipy.integrate import solve_ivp

from sioms.plant.outline import Outline, disk, ellipse, polygon, rectangle
from sioms.plant.planar import GRAVITY, Body, Mount, World
from sioms.plant.rubber import Layer, rubber
from sioms.plant.skin import friction, skin
from sioms.tactile.contact import frictionless
from sioms.tactile.cylinder import FINGER_B, respond
from sioms.tactile.indenter import FLAT

MM, DEG = 1e-3, math.pi / 180
FREE = Mount(
    link_m=0.0, stiffness=1e-9, turn_stiffness=1e-9, damping_ratio=0.0, loss_s=0.0, shear_loss_s=0.0, creep=False
)
"""A finger that flies on its own."""
LOSSLESS = Mount(link_m=0.0, stiffness=2e3, damping_ratio=0.0, loss_s=0.0, shear_loss_s=0.0, creep=False)


@pytest.mark.parametrize(("half_width", "within"), [(0.05, 0.002), (0.1, 0.003), (0.2, 0.01)])
def test_the_normal_law_is_that_of_the_other_theory_of_the_finger(half_width: float, within: float) -> None:
    contact = frictionless(FINGER_B, FLAT, half_width)
    t, k = np.linspace(-half_width, half_width, 1501), np.arange(1000)
    pressure = contact.pressure(t)
    cosine = np.array([-np.trapezoid(pressure * np.cos(n * t), t) / math.pi for n in k])
    cosine[0] /= 2
    approach = -float(np.sum(respond(FINGER_B, k, FINGER_B.outer_m).u_r[:, 0, 0] * cosine))
    assert skin().press(approach, RB)[0] == pytest.approx(contact.load, rel=within)


@pytest.mark.parametrize(
    ("load", "radius", "within"), [(50.0, 30 * MM, 0.005), (200.0, 12.7 * MM, 0.015), (50.0, 3 * MM, 0.01)]
)
def test_one_curve_serves_round_objects_of_all_sizes(load: float, radius: float, within: float) -> None:
    pressed = rubber(Layer(), (10.3e-3,)).press(load, radius)
    assert skin().press(pressed.approach, 1 / (1 / RB + 1 / radius))[0] == pytest.approx(load, rel=within)


def test_friction_is_that_of_the_table() -> None:
    assert [friction(r) for r in (math.inf, 12.7e-3, 2.5e-3, 0.3e-3, 1e-5)] == pytest.approx([3.4, 2.0, 2.0, 1.4, 1.4])
    assert 1.4 < friction(1e-3) < 2.0 and 2.0 < friction(0.1) < 3.4


@pytest.mark.parametrize(
    "outline",
    [disk(20 * MM), rectangle(30 * MM, 80 * MM), rectangle(30 * MM, 20 * MM, 3 * MM), ellipse(30 * MM, 12 * MM)],
)
def test_clearance_is_the_distance_to_the_outline_from_wherever_it_was_last(outline: Outline) -> None:
    draw = random.Random(3).uniform
    world = World(Body(outline), [FREE], [(0.2, 0.0, 0.0)])
    for _ in range(300):
        angle, away = draw(-4, 4), outline.reach_m + RB + draw(0, 0.02)
        world.pose = [draw(-0.1, 0.1), draw(-0.1, 0.1), draw(-4, 4)]
        finger = world.fingers[0]
        finger.place = [world.pose[0] + away * math.cos(angle), world.pose[1] + away * math.sin(angle), 0.3]
        world.advance(1e-9, 1)
        x, y = outline.nearest(world.pose, *finger.centre)
        apart = math.hypot(x - finger.centre[0], y - finger.centre[1])
        assert finger.gap_m == pytest.approx(apart - RB, abs=1e-9)
        seen = math.atan2(y - finger.centre[1], x - finger.centre[0])
        assert math.remainder(finger.phi + 0.3 - seen, math.tau) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("outline", "radius"), [(disk(20 * MM, 1e-8), 20 * MM), (rectangle(60 * MM, 60 * MM), math.inf)]
)
def test_a_contact_feels_the_radius_and_the_approach_of_its_object(outline: Outline, radius: float) -> None:
    reach = 20 * MM if math.isfinite(radius) else 30 * MM
    world = World(Body(outline, 1e9), [FREE], [(-(reach + RB - 0.3 * MM), 0.0, 0.0)])
    finger = world.fingers[0]
    assert -finger.gap_m == pytest.approx(0.3 * MM, rel=0.01)
    assert finger.radius_m == pytest.approx(radius, rel=0.02) if math.isfinite(radius) else finger.radius_m > 0.3
    assert finger.normal == pytest.approx(0.02 * skin().press(0.3 * MM, 1 / (1 / RB + 1 / radius))[0], rel=0.02)


def test_a_finger_that_rolls_on_to_a_corner_feels_it_gradually() -> None:
    world = World(Body(rectangle(40 * MM, 40 * MM), 1e9), [FREE], [(0.0, 20 * MM + RB - 0.3 * MM, 0.0)])
    felt = []
    for x in np.linspace(10 * MM, 20 * MM, 41):
        world.fingers[0].place[0] = float(x)
        world.advance(1e-12, 1)
        felt.append(world.fingers[0].normal)
    assert felt[-1] < 0.6 * felt[0]
    assert np.max(np.abs(np.diff(felt))) < 0.12 * felt[0]  # of 41 places, over a contact 5 mm wide


def test_momentum_is_kept_in_a_collision() -> None:
    mount = Mount(**{**{name: getattr(FREE, name) for name in FREE.__slots__}, "mass": 0.2})
    world = World(Body(ellipse(30 * MM, 20 * MM), 0.1, 0.0), [mount], [(-60 * MM, 8 * MM, 0.0)])
    finger = world.fingers[0]
    finger.speed[0] = 0.2

    def momenta() -> tuple[float, float, float]:
        (vx, vy, w), (fx, fy, turn) = world.speed, finger.speed
        m, inertia = 0.1, 0.1 * world.body.outline.gyration_m**2
        spin = m * (world.pose[0] * vy - world.pose[1] * vx) + inertia * w + mount.inertia * turn
        return 0.2 * fx + m * vx, 0.2 * fy + m * vy, spin + 0.2 * (finger.place[0] * fy - finger.place[1] * fx)

    before = momenta()
    world.advance(0.3, 3000)
    assert world.speed[0] > 0.05 and abs(world.speed[2]) > 0.1  # it was hit, off its centre
    assert momenta() == pytest.approx(before, abs=1e-10)


def _energy_error(coefficient: float, steps: int) -> float:
    mount = Mount(
        link_m=0.0, stiffness=2e3, damping_ratio=0.0, loss_s=0.0, shear_loss_s=0.0, creep=False, friction=coefficient
    )
    world = World(Body(disk(20 * MM, 1e-9), 0.1, 0.0), [mount] * 2, [(-32.5 * MM, 0, 0), (32.5 * MM, 0, 0)])
    world.speed = [0.01, 0.003, 0.2]
    before, worst = world.energy, 0.0
    for _ in range(20):
        world.advance(5e-3, steps)
        worst = max(worst, abs(world.energy / before - 1.0))
    return worst


def test_energy_without_losses_is_kept() -> None:
    assert _energy_error(0.0, 10) < 0.01
    assert _energy_error(0.0, 40) < 1e-3
    assert _energy_error(9.0, 40) < 3e-3  # a stretched contact whose load changes changes its stiffness


def test_a_squeezed_disk_moves_as_an_independent_solver_says() -> None:
    """Two fingers on springs, one disk, along one line: by scipy with the area of a lens."""
    rubber_, stiff, mass, radius = skin(), 2e3, 1.0, 20 * MM

    def push(apart: float) -> float:
        if apart >= RB + radius:
            return 0.0
        chord_at = (apart**2 + RB**2 - radius**2) / (2 * apart)
        half = math.sqrt(RB**2 - chord_at**2)
        lens = RB**2 * math.acos(chord_at / RB) + radius**2 * math.acos((apart - chord_at) / radius) - apart * half
        depth = 0.75 * lens / half
        return 0.02 * rubber_.press(depth, half**2 / (2 * depth))[0]

    def slopes(_: float, state: np.ndarray) -> list[float]:
        left, right, x, vl, vr, v = state
        a, b = push(x - left), push(right - x)
        return [
            vl,
            vr,
            v,
            (stiff * (-32.5 * MM - left) - a) / mass,
            (stiff * (32.5 * MM - right) + b) / mass,
            (a - b) / 0.1,
        ]

    exact = solve_ivp(slopes, (0, 0.05), [-32.5 * MM, 32.5 * MM, 0, 0, 0, 0.01], rtol=1e-9, atol=1e-12).y[:, -1]
    errors = []
    for steps in (100, 400):
        world = World(Body(disk(radius, 1e-9), 0.1, 0.0), [LOSSLESS] * 2, [(-32.5 * MM, 0, 0), (32.5 * MM, 0, 0)])
        world.speed[0] = 0.01
        world.advance(0.05, steps)
        errors.append(abs(world.pose[0] - exact[2]))
    assert errors[1] < 3e-7 and errors[1] < 0.2 * errors[0] + 1e-7, errors


@pytest.mark.parametrize("coefficient", [0.5, 1.4])
def test_a_contact_slides_when_its_force_leaves_the_cone(coefficient: float) -> None:
    mount = Mount(link_m=0.0, friction=coefficient, turn_stiffness=1e3)
    world = World(Body(rectangle(60 * MM, 60 * MM), 1e6), [mount], [(0.0, 30 * MM + RB - 0.2 * MM, 0.0)])
    finger, steepest = world.fingers[0], 0.0
    for step in range(400):
        world.command([(step * 0.01 * MM, 30 * MM + RB - 0.2 * MM, 0.0)], 1e-3)
        world.advance(1e-3, 4)
        if finger.slides:
            break
        steepest = max(steepest, abs(finger.tangential) / finger.normal)
    assert finger.slides
    assert math.degrees(math.atan(steepest)) == pytest.approx(math.degrees(math.atan(coefficient)), abs=1.0)
    world.command([(20 * MM, 30 * MM + RB - 0.2 * MM, 0.0)], 0.1)
    world.advance(0.08, 320)
    assert finger.slides and abs(finger.tangential) == pytest.approx(coefficient * finger.normal, rel=1e-9)


def test_an_object_on_the_platen_stops_where_friction_says_and_then_stays() -> None:
    world = World(Body(disk(20 * MM), 0.1, 0.2), [FREE], [(1.0, 0.0, 0.0)])
    world.speed[0] = 0.3
    world.advance(0.3, 1200)
    assert world.pose[0] == pytest.approx(0.3**2 / (2 * 0.2 * GRAVITY), rel=0.005)
    assert world.speed == [0.0, 0.0, 0.0]
    world.pose, world.speed[2] = [0.0, 0.0, 0.0], 3.0  # spinning: the moment of a disk's friction is 2/3 mu m g r
    world.advance(1.0, 4000)
    slowing = 2 / 3 * 0.2 * GRAVITY * 20 * MM / (0.5 * (20 * MM) ** 2)
    assert world.pose[2] == pytest.approx(3.0**2 / (2 * slowing), rel=0.01)


def test_a_push_below_the_platen_friction_moves_nothing() -> None:
    mount = Mount(link_m=0.0, stiffness=100.0, mass=0.02)
    world = World(Body(disk(20 * MM), 0.1, 0.2), [mount], [(-40 * MM, 0.0, 0.0)])
    reach = 0.9 * 0.2 * 0.1 * GRAVITY / 100.0 + 40 * MM - 20 * MM - RB
    world.command([(-40 * MM + reach, 0.0, 0.0)], 0.5)
    world.advance(0.5, 2000)
    world.command([(-40 * MM + reach, 0.0, 0.0)], 1.0)
    world.advance(0.5, 2000)
    pose = list(world.pose)
    world.command([(-40 * MM + reach, 0.0, 0.0)], 1.0)
    world.advance(0.5, 2000)
    assert 0.7 < world.fingers[0].normal / (0.2 * 0.1 * GRAVITY) < 1.0
    assert world.pose == pose and abs(pose[0]) < 5e-6  # but for the first bump


def test_a_held_object_is_in_equilibrium() -> None:
    rig = HandRig(ellipse(30 * MM, 20 * MM), [0, 0, 105 * DEG], 66.4 * MM, 1.0)
    rig.run(2.5)
    total = np.zeros(2)
    for finger in rig.world.fingers:
        a = finger.phi + finger.place[2]
        total += finger.normal * np.array([math.cos(a), math.sin(a)]) + finger.tangential * np.array(
            [-math.sin(a), math.cos(a)]
        )
    assert rig.force == pytest.approx(1.0, rel=0.03)
    assert float(np.hypot(*total)) < 0.2 * 0.1 * GRAVITY  # the platen may bear the rest
    grasp = rig.grasp()
    for eta, finger in zip((grasp.eta1, grasp.eta2), rig.world.fingers, strict=True):
        assert math.atan2(finger.tangential, finger.normal) == pytest.approx(eta, abs=12 * DEG)


def _roll(rig: HandRig, sense: int) -> tuple[float, float, float, float]:
    """Roll at 20 deg/s until parallel; return turn of the links' mean, travel, turn of the object and first angle."""
    rig.run(1.5)
    before, pose = rig.grasp(), list(rig.world.pose)
    links = [finger.place[2] for finger in rig.world.fingers]
    rates = [math.copysign(sense * 20 * DEG, sense * eta) for eta in (before.eta1, before.eta2)]
    same = math.copysign(1.0, before.eta1 * before.eta2)
    for _ in range(600):
        rig.run(0.01, (0, 0, 0, 0, *rates), 8)
        now = rig.grasp()
        if (now.eta1 + same * now.eta2) * before.eta1 <= 0.0:
            break
    turned = sum(abs(f.place[2] - start) for f, start in zip(rig.world.fingers, links, strict=True)) / 2
    travel = math.hypot(rig.world.pose[0] - pose[0], rig.world.pose[1] - pose[1])
    mean = 0.5 * (abs(before.eta1) + abs(before.eta2))
    return turned / DEG, travel / MM, abs(rig.world.pose[2] - pose[2]) / DEG, mean / DEG


def _light(outline: Outline) -> Body:
    """Return an object whose friction on the platen is small against the grasp."""
    return Body(outline, 0.05, 0.05)


STIFF = Mount(turn_stiffness=3.0, damping_ratio=1.0)
"""A link stiff enough that closing does not turn the object before it rolls."""


def test_a_disk_rolls_as_the_rigid_one() -> None:
    reach = 20 * MM + RB
    pose, d = [0.0, reach * math.sin(20 * DEG), 0.0], 2 * reach * math.cos(20 * DEG)
    turned, travel, _, eta = _roll(HandRig(disk(20 * MM), pose, d, 0.5, STIFF), -1)
    assert eta == pytest.approx(20, abs=2.0)
    assert turned == pytest.approx(eta * 32.7 / 12.7, rel=0.05)
    assert travel == pytest.approx(32.7 * math.sin(eta * DEG), rel=0.05)


def test_an_ellipse_and_a_rectangle_turn_as_the_rigid_ones() -> None:
    turned, _, spun, eta = _roll(
        HandRig(_light(ellipse(30 * MM, 20 * MM)), [0, 0, 105 * DEG], 66.3687 * MM, 0.5, STIFF), 1
    )
    assert turned / spun == pytest.approx(23.95 / 15, rel=0.05)
    half, off = 15 * MM + RB, 6 * MM
    turned, _, spun, eta = _roll(
        HandRig(
            _light(rectangle(30 * MM, 80 * MM)), [0, 0, -math.atan2(off, half)], 2 * math.hypot(half, off), 0.5, STIFF
        ),
        1,
    )
    assert eta == pytest.approx(21.8, abs=2.5)
    assert turned / spun == pytest.approx(14.847 / 12.2218, rel=0.05)


def test_without_friction_an_ellipse_squeezed_on_one_half_is_lost_and_on_two_ends_at_its_smallest_diameter() -> None:
    slick = Mount(link_m=0.0, friction=0.0, turn_stiffness=1e3)

    def squeeze(y_m: float, angle: float, to_m: float) -> World:
        world = World(
            Body(ellipse(30 * MM, 20 * MM), 0.1, 0.02),
            [slick] * 2,
            [(-48 * MM, 0, 0), (48 * MM, 0, 0)],
            (0, y_m, angle),
        )
        world.command([(-to_m, 0, 0), (to_m, 0, 0)], 1.5)
        world.advance(1.5, 6000)
        return world

    lost = squeeze(12 * MM, 0.0, 18 * MM)
    assert lost.pose[1] > 20 * MM and max(finger.normal for finger in lost.fingers) < 0.1
    kept = squeeze(0.0, 60 * DEG, 31 * MM)
    assert abs(abs(kept.pose[2]) - 90 * DEG) < 4 * DEG and min(finger.normal for finger in kept.fingers) > 3.0


@pytest.mark.parametrize(
    ("call", "wrong"),
    [
        (lambda: Body(disk(0.02), 0.0), "mass"),
        (lambda: Body(disk(0.02), 0.1, -0.1), "platen_friction"),
        (lambda: Mount(stiffness=math.nan), "stiffness"),
        (lambda: Mount(friction=-1.0), "friction"),
        (lambda: World(Body(disk(0.02)), [Mount()], [(0, 0)]), "want x, y, th"),
        (lambda: World(Body(polygon([(0, 0), (0.1, 0), (0, 0.1)])), [Mount()], []), "want x, y, th"),
    ],
)
def test_what_cannot_be_is_refused(call: object, wrong: str) -> None:
    with pytest.raises(ValueError, match=wrong):
        call()  # type: ignore[operator]


def test_a_corner_is_met_by_a_finger_that_sees_one_of_its_sides_from_behind() -> None:
    """Round sharp corners the nearest side was sought past the corner: a finger went through it."""
    draw = random.Random(5).uniform
    for _ in range(60):
        points = [(draw(-0.03, 0.03), draw(-0.02, 0.02)) for _ in range(3)]
        (ax, ay), (bx, by), (cx, cy) = points
        twice = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if abs(twice) < 2e-4:
            continue
        world = World(Body(polygon(points if twice > 0.0 else points[::-1])), [FREE], [(0.2, 0.0, 0.0)])
        finger = world.fingers[0]
        for _ in range(60):
            angle, away = draw(-4.0, 4.0), draw(0.005, 0.06)
            finger.place = [away * math.cos(angle), away * math.sin(angle), 0.3]
            apart = world.clearances()[0]
            if apart < -0.5e-3:
                continue
            world._look()
            assert finger.gap_m == pytest.approx(apart, abs=1e-9) if apart > 0.0 else finger.normal > 0.0


def test_a_copy_is_a_world_of_its_own() -> None:
    world = World(Body(disk(20 * MM)), [LOSSLESS], [(-0.17, 0.0, 0.0)])
    copy = deepcopy(world)
    for one, to in ((world, -0.168), (copy, -0.17)):
        one.command([(to, 0.0, 0.0)], 0.1)
        one.advance(0.1, 400)
    assert copy.fingers[0].place == [-0.17, 0.0, 0.0] and world.fingers[0].place[0] > -0.169
    again = deepcopy(copy)
    again.command([(-0.168, 0.0, 0.0)], 0.1)
    again.advance(0.1, 400)
    assert (again.pose, again.fingers[0].place) == (world.pose, world.fingers[0].place)
