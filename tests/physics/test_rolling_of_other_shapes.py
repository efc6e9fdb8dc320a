"""Rolling without slip of shapes and sizes that no table of known answers has, by an integrator of the test's own.

An outline is given by its support function h of the outward normal's angle A in its own frame: the finger's centre is
at Q(A) = (h + rb) n + h' t, and Q' = (h + h'' + rb) t. The line through both centres has a fixed direction, which tells
the object's turn from both angles alone; without slip A_i' = rb (th_i' - turn')/(rb + rho_i). No places of contact are
sought, and no velocities of points: nothing is shared with what is tested.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from sioms.hand.kinematics import Hand
from sioms.hand.rolling import RigidGrasp
from sioms.plant.outline import Outline
from sioms.plant.planar import Body, Mount, World

RB = 12.7e-3
Support = Callable[[float], tuple[float, float, float]]


def harmonics(mean: float, **parts: float) -> Support:
    """Return h, h', h'' of a mean radius and parts c2, s3, ... [m] of cos 2 A, sin 3 A."""

    def support(angle: float) -> tuple[float, float, float]:
        h, slope, bend = mean, 0.0, 0.0
        for name, size in parts.items():
            k = int(name[1:])
            c, s = math.cos(k * angle), math.sin(k * angle)
            value, turned = (c, -s) if name[0] == "c" else (s, c)
            h, slope, bend = h + size * value, slope + k * size * turned, bend - k * k * size * value
        return h, slope, bend

    return support


def oval(a: float, b: float) -> Support:
    """Return h, h', h'' of an ellipse."""

    def support(angle: float) -> tuple[float, float, float]:
        c, s = math.cos(angle), math.sin(angle)
        h = math.hypot(a * c, b * s)
        return h, (b * b - a * a) * s * c / h, a * a * b * b / h**3 - h

    return support


SHAPES = {
    "flat oval": oval(0.047, 0.013),
    "small oval": oval(0.009, 0.006),
    "egg": harmonics(0.021, c2=0.0021, c3=0.0009),
    "rounded triangle": harmonics(0.030, c3=0.0030, s2=0.0006),
    "rounded square": harmonics(0.018, s4=0.0009),
}


def centre(support: Support, angle: float) -> np.ndarray:
    h, slope, _ = support(angle)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([(h + RB) * c - slope * s, (h + RB) * s + slope * c])


def outline(support: Support) -> tuple[Outline, np.ndarray]:
    """Return the outline, and where its frame's origin lies from its centroid."""
    angles = math.tau * np.arange(3000) / 3000
    points = np.array([centre(support, a) - RB * np.array([math.cos(a), math.sin(a)]) for a in angles])
    made = Outline(points)
    return made, made.points[0] - points[0]


def rates(support: Support, angles: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return the rates of both angles while the links turn; the line of centres keeps its direction."""
    way = centre(support, angles[1]) - centre(support, angles[0])
    square = way @ way
    own, line = np.zeros(2), np.zeros(2)
    for i, sign in ((0, -1.0), (1, 1.0)):
        h, _, bend = support(angles[i])
        rho = h + bend
        tangent = np.array([-math.sin(angles[i]), math.cos(angles[i])])
        own[i] = RB / (RB + rho)
        line[i] = sign * (way[0] * tangent[1] - way[1] * tangent[0]) * (rho + RB) / square
    # turn' = -sum line_i A_i', A_i' = own_i (th_i' - turn')
    turn = -np.sum(line * own * links) / (1.0 - np.sum(line * own))
    found: np.ndarray = own * (links - turn)
    return found


def rolled(support: Support, angles: np.ndarray, links: np.ndarray, time_s: float) -> np.ndarray:
    """Return both angles after a time, by Runge and Kutta."""
    steps = 400
    h = time_s / steps
    for _ in range(steps):
        k1 = rates(support, angles, links)
        k2 = rates(support, angles + 0.5 * h * k1, links)
        k3 = rates(support, angles + 0.5 * h * k2, links)
        k4 = rates(support, angles + h * k3, links)
        angles = angles + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return angles


def state(support: Support, angles: np.ndarray, psi: float) -> tuple[float, float, list[float]]:
    """Return d, the object's turn and both friction angles, the hand's line having the direction psi."""
    one, two = (centre(support, a) for a in angles)
    way = two - one
    turn = psi - math.atan2(way[1], way[0])
    normals = [np.array([math.cos(a), math.sin(a)]) for a in angles]
    touch1, touch2 = one - RB * normals[0], two - RB * normals[1]
    line = math.atan2(*(touch2 - touch1)[::-1])
    eta1 = math.remainder(line - angles[0] - math.pi, math.tau)
    eta2 = math.remainder(line + math.pi - angles[1] - math.pi, math.tau)
    return float(np.hypot(*way)), turn, [eta1, eta2]


@pytest.mark.parametrize("roll", [(0.5, 0.5), (0.6, -0.4), (-0.3, 0.0)])
@pytest.mark.parametrize("shape", SHAPES)
def test_any_shape_rolls_as_its_support_function_says(shape: str, roll: tuple[float, float]) -> None:
    support, psi = SHAPES[shape], 0.7
    made, shift = outline(support)
    angles = np.array([math.pi + 0.35, 0.15])
    d, turn, eta = state(support, angles, psi)
    c, s = math.cos(turn), math.sin(turn)
    first = -0.5 * d * np.array([math.cos(psi), math.sin(psi)])
    at = centre(support, angles[0]) + shift
    pose = [first[0] - c * at[0] + s * at[1], first[1] - s * at[0] - c * at[1], turn]
    rigid = RigidGrasp(made, Hand(), [0.0, 0.0, psi, d, 1.5, 1.4], list(pose))
    assert [rigid.grasp().eta1, rigid.grasp().eta2] == pytest.approx(eta, abs=2e-3)
    rigid.roll((0.0, 0.0, 0.0, 0.0, *roll), 1.0, 80)
    after = rolled(support, angles, -np.array(roll), 1.0)  # th' = psi' - phi'
    d, turn, eta = state(support, after, psi)
    assert rigid.coordinates[3] == pytest.approx(d, rel=5e-4)
    assert math.remainder(rigid.pose[2] - turn, math.tau) == pytest.approx(0.0, abs=3e-3)
    assert [rigid.grasp().eta1, rigid.grasp().eta2] == pytest.approx(eta, abs=5e-3)


@pytest.mark.parametrize("mass", [5e-3, 10e-3, 0.1, 300.0])
@pytest.mark.parametrize("half_m", [(0.04, 0.6e-3), (0.02, 0.02)])
@pytest.mark.parametrize("coefficient", [0.0, 3.4])
def test_what_is_thrown_between_two_fingers_never_gains_energy(
    mass: float, half_m: tuple[float, float], coefficient: float
) -> None:
    """Tiny and huge masses, a lath of 1.2 mm, no friction at all and much: 2 m/s, spinning."""
    x, y = half_m
    made = Outline(np.array([(-x, -y), (x, -y), (x, y), (-x, y)]))
    mount = Mount(friction=coefficient)
    joints = [[-x - RB - 1e-3, -0.14, 0.5 * math.pi], [x + RB + 1e-3, 0.14, -0.5 * math.pi]]
    world = World(Body(made, mass=mass, platen_friction=0.0), [mount, mount], joints, (0.0, 0.0, 0.2))
    world.speed = [2.0, 0.3, 40.0]
    begun = most = world.energy
    touched = 0
    for _ in range(600):
        world.advance(0.25e-3, 1)
        touched += any(finger.normal > 0.0 for finger in world.fingers)
        assert math.isfinite(world.energy)
        most = max(most, world.energy)
        assert all(abs(finger.tangential) <= coefficient * finger.normal + 1e-12 for finger in world.fingers)
    assert touched > 5 and most < 1.03 * begun


def test_two_fingers_at_one_corner_push_it_along_the_middle_of_both() -> None:
    """Mirror images about the corner's bisector: the object goes along that, and does not turn."""
    half = math.radians(35.0)
    back = 0.06
    x, y = back * math.cos(half), back * math.sin(half)
    made = Outline(np.array([(0.0, 0.0), (x, -y), (x, y)]))
    shift = made.points[np.argmin(made.points[:, 0])]  # of the tip from the centroid
    mount = Mount(link_m=0.0)
    slant = math.radians(65.0)  # of each finger from the bisector, on the corner itself
    place = [(-RB * math.cos(a) + 1e-3, -RB * math.sin(a), 0.0) for a in (slant, -slant)]
    world = World(Body(made, mass=0.05, platen_friction=0.0), [mount, mount], place, (-shift[0], -shift[1], 0.0))
    world.advance(0.05, 200)
    assert world.speed[0] > 1e-3
    assert abs(world.speed[1]) < 1e-6 * world.speed[0] and abs(world.speed[2]) < 1e-3 * world.speed[0]
    one, two = world.fingers
    assert one.normal == pytest.approx(two.normal, rel=1e-9, abs=1e-12)
