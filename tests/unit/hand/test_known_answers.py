"""Known answers of the rigid hand, computed elsewhere by an independent integrator; mm and degrees."""

from __future__ import annotations

import math

import pytest

from sioms.hand.contacts import Likeness, classify, grasp_of
from sioms.hand.kinematics import Hand
from sioms.hand.regrasp import disk_radii, regrasp_disk, regrasp_rectangle
from sioms.hand.rolling import RigidGrasp, disk_time, rectangle_spin, rolling_law
from sioms.plant.outline import Outline, disk, ellipse, rectangle

DEG, MM, RB = math.pi / 180, 1e-3, 12.7e-3
HAND = Hand()
SPEED = 5 * DEG
JOINTS = (100 * MM, 20 * MM, 70 * DEG, 240 * MM, 35 * MM, 110 * DEG)


def held(outline: Outline, pose: list[float], d_m: float) -> RigidGrasp:
    """Return the object at `pose` between fingers on the x axis."""
    return RigidGrasp(outline, HAND, [0.0, 0.0, 0.0, d_m, math.pi / 2, math.pi / 2], pose)


def disk_20() -> RigidGrasp:
    """A disk of radius 20 mm whose chord through the contacts misses the centre: friction angle 20 degrees."""
    reach = 20 * MM + RB
    return held(disk(20 * MM, 1e-8), [0.0, reach * math.sin(20 * DEG), 0.0], 2 * reach * math.cos(20 * DEG))


def rectangle_30() -> RigidGrasp:
    """A rectangle 30 mm wide, touched 6 mm off the middle of each side, in opposite directions."""
    half, off = 15 * MM + RB, 6 * MM
    return held(rectangle(30 * MM, 80 * MM), [0.0, 0.0, -math.atan2(off, half)], 2 * math.hypot(half, off))


def ellipse_30_20() -> RigidGrasp:
    """An ellipse whose centre lies on the line of the fingers, 15 degrees from its minor axis."""
    outline = ellipse(30 * MM, 20 * MM, 1e-8)
    pose = [0.0, 0.0, 90 * DEG + 15 * DEG]
    low, high = 30 * MM, 60 * MM
    for _ in range(60):  # where the finger's centre is one radius from the outline
        middle = 0.5 * (low + high)
        x, y = outline.nearest(pose, -middle, 0.0)
        low, high = (middle, high) if math.hypot(x + middle, y) < RB else (low, middle)
    return held(outline, pose, 2 * low)


def test_joints_to_hand_coordinates() -> None:
    found = HAND.forward(JOINTS)
    shown = [found[0] / MM, found[1] / MM, found[3] / MM, *(found[i] / DEG for i in (2, 4, 5))]
    assert shown == pytest.approx([170, 159.057, 46.7084, 18.7319, -51.2681, 88.7319], rel=5e-6)


def test_hand_velocities_to_joint_velocities() -> None:
    found = HAND.joint_rates(HAND.forward(JOINTS), (5 * MM, -3 * MM, 0.1, 2 * MM, -0.2, 0.3))
    shown = [v if i in (2, 5) else v / MM for i, v in enumerate(found)]
    assert shown == pytest.approx([44.2701, -19.8977, 0.3, -21.1144, -10.0437, -0.2], rel=1e-5)


def test_disk_at_its_start() -> None:
    grasp = disk_20().grasp()
    assert [abs(grasp.eta1) / DEG, abs(grasp.eta2) / DEG] == pytest.approx([20, 20], abs=0.02)
    assert grasp.eta1 * grasp.eta2 < 0 and classify(grasp.eta1, grasp.eta2, 0.1 * DEG) is Likeness.DISK
    assert [disk_20().coordinates[3] / MM, grasp.apart_m / MM] == pytest.approx([61.4559, 37.5877], rel=2e-4)


def test_disk_rolled_until_parallel() -> None:
    system = disk_20()
    before = system.grasp()
    rates = rolling_law(Likeness.DISK, before.eta1, before.eta2, SPEED)
    time_s = system.roll_until_parallel((0, 0, 0, 0, *rates), 60.0)
    after = system.grasp()
    travel = math.hypot(system.pose[0], system.pose[1] - 32.7 * MM * math.sin(20 * DEG)) / MM
    place = (after.normal1 - before.normal1) / DEG + rates[0] * time_s / DEG  # phi_c = a - th, th' = -phi'
    assert SPEED * time_s / DEG == pytest.approx(51.4961, rel=2e-3)
    assert travel == pytest.approx(11.1841, rel=2e-3)
    assert abs(place) == pytest.approx(31.4961, rel=2e-3)
    assert place * rates[0] > 0  # against the turn of the link
    assert time_s == pytest.approx(disk_time(20 * DEG, 20 * MM, SPEED), rel=2e-3)
    assert system.pose[2] == pytest.approx(0.0, abs=1e-5)


def test_disk_rolled_half_the_way() -> None:
    system = disk_20()
    before = system.grasp()
    rates = rolling_law(Likeness.DISK, before.eta1, before.eta2, SPEED)
    system.roll((0, 0, 0, 0, *rates), 51.4961 / 5 / 2)
    assert abs(system.grasp().eta1) / DEG == pytest.approx(10.0, abs=0.05)


def test_one_regrasp_of_a_disk_taken_for_smaller() -> None:
    system = disk_20()
    grasp = system.grasp()
    assert disk_radii(grasp) == pytest.approx((20 * MM, 20 * MM), rel=5e-4)
    x, y, psi, _, _, _ = regrasp_disk(grasp, 0.8 * 20 * MM)
    # the fingers close along their new line until they touch the disk, which has not moved
    off = (system.pose[1] - y) * math.cos(psi) - (system.pose[0] - x) * math.sin(psi)
    assert abs(math.degrees(math.asin(off / (20 * MM + RB)))) == pytest.approx(2.398, abs=0.01)
    x, y, psi, d, _, _ = regrasp_disk(grasp, disk_radii(grasp)[0])
    assert [x, y, psi] == pytest.approx([system.pose[0], system.pose[1], 0.0], abs=3e-4)
    assert d == pytest.approx(2 * (20 * MM + RB), rel=5e-4)


def test_rectangle_at_its_start() -> None:
    system = rectangle_30()
    grasp = system.grasp()
    assert [abs(grasp.eta1) / DEG, system.coordinates[3] / MM] == pytest.approx([21.8014, 56.6847], rel=1e-5)
    assert abs(system.pose[2]) / DEG == pytest.approx(12.2218, rel=1e-5)
    assert grasp.eta1 == pytest.approx(grasp.eta2, rel=1e-9)
    assert classify(grasp.eta1, grasp.eta2, 0.1 * DEG) is Likeness.RECTANGLE


def test_one_regrasp_of_a_rectangle_is_parallel() -> None:
    system = rectangle_30()
    x, y, psi, d, _, _ = regrasp_rectangle(system.grasp())
    assert [x, y, psi] == pytest.approx([0.0, 0.0, system.pose[2]], abs=1e-9)
    assert d == pytest.approx(30 * MM + 2 * RB, rel=1e-9)


def test_rectangle_rolled_until_parallel() -> None:
    system = rectangle_30()
    before = system.grasp()
    rates = rolling_law(Likeness.RECTANGLE, before.eta1, before.eta2, SPEED)
    time_s = system.roll_until_parallel((0, 0, 0, 0, *rates), 30.0)
    turn = abs(system.pose[2] + math.atan2(6, 27.7)) / DEG
    assert [SPEED * time_s / DEG, turn, system.coordinates[3] / MM] == pytest.approx([14.847, 12.2218, 55.4], rel=1e-4)


def test_ellipse_at_its_start() -> None:
    system = ellipse_30_20()
    grasp = system.grasp()
    assert [abs(grasp.eta1) / DEG, abs(grasp.eta2) / DEG] == pytest.approx([10.2504, 10.2504], abs=0.01)
    assert grasp.eta1 * grasp.eta2 > 0
    assert [system.coordinates[3] / MM, grasp.apart_m / MM] == pytest.approx([66.3687, 41.22], rel=1e-4)


def test_ellipse_rolled_until_parallel() -> None:
    system = ellipse_30_20()
    before = system.grasp()
    rates = rolling_law(Likeness.RECTANGLE, before.eta1, before.eta2, SPEED)
    time_s = system.roll_until_parallel((0, 0, 0, 0, *rates), 30.0)
    turn = abs(system.pose[2] - 105 * DEG) / DEG
    shown = [SPEED * time_s / DEG, turn, system.grasp().apart_m / MM]
    assert shown == pytest.approx([23.95, 15.0, 40.0], rel=4e-3)


def test_one_link_alone_turns_the_rectangle() -> None:
    system = rectangle_30()
    start = list(system.pose)
    system.roll((0, 0, 0, 0, -17.1887 * DEG, 0), 1.0)
    moved = [(system.pose[0] - start[0]) / MM, (system.pose[1] - start[1]) / MM, (system.pose[2] - start[2]) / DEG]
    grasp = system.grasp()
    assert [abs(v) for v in moved] == pytest.approx([0.6073, 1.8056, 6.3677], rel=2e-3)
    assert system.coordinates[3] / MM == pytest.approx(58.4495, rel=1e-3)
    assert [abs(grasp.eta1) / DEG, abs(grasp.eta2) / DEG] == pytest.approx([31.8443, 31.8443], abs=0.02)


@pytest.mark.parametrize(("radius", "eta"), [(10, -40), (25, -10), (25, 40), (60, 25)])
def test_the_laws_of_disks_converge_and_the_other_sign_diverges(radius: float, eta: float) -> None:
    reach = radius * MM + RB
    for sense, better in ((1, True), (-1, False)):
        system = held(disk(radius * MM, 1e-8), [0.0, reach * math.sin(eta * DEG), 0.0], 2 * reach * math.cos(eta * DEG))
        grasp = system.grasp()
        rates = [sense * rate for rate in rolling_law(Likeness.DISK, grasp.eta1, grasp.eta2, SPEED)]
        if better:
            time_s = system.roll_until_parallel((0, 0, 0, 0, *rates), 120.0, 1e-2)
            assert time_s == pytest.approx(disk_time(eta * DEG, radius * MM, SPEED), rel=1e-2)
        else:
            system.roll((0, 0, 0, 0, *rates), 0.2, 4)
            assert system.grasp().quality > grasp.quality


def test_spin_of_a_rectangle_is_the_closed_form() -> None:
    system = rectangle_30()
    turned, rate = system.pose[2], -5 * DEG
    system.roll((0, 0, 0, 0, rate, rate), 1e-3, 1)
    assert (system.pose[2] - turned) / 1e-3 == pytest.approx(rectangle_spin(turned, 30 * MM, rate), rel=1e-3)
    assert rectangle_spin(0.0, 30 * MM, rate) / DEG == pytest.approx(-4.23, abs=0.005)


def test_friction_angles_of_contacts_counted_the_other_way_round_differ_by_half_a_turn() -> None:
    grasp = grasp_of((-40 * MM, 0), (40 * MM, 0), 10 * DEG, 170 * DEG)
    assert grasp.eta1 == pytest.approx(-10 * DEG) and grasp.eta2 == pytest.approx(10 * DEG)
    assert grasp.holds(math.tan(10.1 * DEG)) and not grasp.holds(math.tan(9.9 * DEG))
