"""Rigid fingers that roll on a rigid object without slip: rates, laws, and an integrator for any convex outline.

The integrator knows the four no-slip equations only; the closed forms of disk and rectangle are there to be compared
with it, and both with the simulated world, whose rubber gives way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sioms.hand.contacts import FINGER_M, Grasp, Likeness, grasp_of
from sioms.hand.kinematics import Hand
from sioms.plant.outline import Outline

_DAMPING = 0.15**2


def normal_rate(link_rate: float, spin: float, radius_m: float, finger_m: float = FINGER_M) -> float:
    """Return a' [rad/s]: how fast the normal turns where a finger rolls.

    Args:
        link_rate: th' [rad/s].
        spin: w of the object [rad/s].
        radius_m: rho of the object at the contact; 0 for a vertex, infinite for a side.
        finger_m: rb.
    """
    if math.isinf(radius_m):
        return spin
    return (finger_m * link_rate + radius_m * spin) / (finger_m + radius_m)


def place_rate(link_rate: float, spin: float, radius_m: float, finger_m: float = FINGER_M) -> float:
    """Return phi_c' [rad/s]: how fast the place of contact moves in the finger's angle; as `normal_rate`."""
    return normal_rate(link_rate, spin, radius_m, finger_m) - link_rate


def rolling_law(likeness: Likeness, eta1: float, eta2: float, speed: float) -> tuple[float, float]:
    """Return (phi1', phi2') [rad/s] that roll towards a parallel grasp: a disk is translated, a rectangle turned.

    Zero for a grasp that is parallel as far as is known.
    """
    sign = {Likeness.DISK: -speed, Likeness.RECTANGLE: speed, Likeness.PARALLEL: 0.0}[likeness]
    return math.copysign(sign, sign * eta1), math.copysign(sign, sign * eta2)


def correcting_law(eta1: float, eta2: float, gain: float, most: float) -> tuple[float, float]:
    """Return (phi1', phi2') [rad/s] that roll a convex object towards a parallel grasp: gain times the OTHER's eta.

    The part of the friction angles that is opposite translates as a disk asks for, the part that is equal turns as a
    rectangle does: so no class is needed.

    Args:
        eta1, eta2: friction angles [rad].
        gain: [1/s].
        most: largest rate [rad/s]; both are reduced alike.
    """
    rate1, rate2 = gain * eta2, gain * eta1
    share = min(1.0, most / max(abs(rate1), abs(rate2), 1e-300))
    return share * rate1, share * rate2


def friction_angle_rates(
    apart_m: float, curvatures: Sequence[float], finger_m: float = FINGER_M
) -> tuple[float, float, float, float]:
    """Return d eta_i/d phi_j, by rows, of a nearly parallel grasp whose x, y and psi are held.

    From the no-slip equations: w = rb (phi1' + phi2')/L, a_i' = (w - kappa_i rb phi_i')/(1 + kappa_i rb),
    eta_i' = -rb (a_1' + a_2')/L - a_i'. Its first part, of equal rates, changes sign where the radii at the contacts
    add up to L: there the smallest diameter becomes the largest.

    Args:
        apart_m: L, distance of the contacts.
        curvatures: kappa, 1/rc of the object at the contacts [1/m], >= 0.
        finger_m: rb.
    """
    across = finger_m / apart_m
    share1, share2 = (1.0 / (1.0 + max(bend, 0.0) * finger_m) for bend in curvatures)
    own1, own2 = 1.0 - share1, 1.0 - share2  # of a finger's own turn in that of its normal
    a11, a12, a21, a22 = share1 * across - own1, share1 * across, share2 * across, share2 * across - own2
    first, second = across * (a11 + a21), across * (a12 + a22)
    return -first - a11, -second - a12, -first - a21, -second - a22


def nearest_law(
    eta: Sequence[float], apart_m: float, curvatures: Sequence[float], gain: float, most: float
) -> tuple[float, float]:
    """Return (phi1', phi2') [rad/s] that roll a convex object towards the nearest parallel grasp, smallest or largest.

    The damped inverse of `friction_angle_rates`: what rolling cannot change, as the wedge of two sides, it leaves.

    Args:
        eta: both friction angles [rad].
        apart_m, curvatures: as there.
        gain: [1/s].
        most: largest rate [rad/s]; both are reduced alike.
    """
    a, b, c, d = friction_angle_rates(apart_m, curvatures)
    u, v = -gain * (a * eta[0] + c * eta[1]), -gain * (b * eta[0] + d * eta[1])
    p, q, r = a * a + c * c + _DAMPING, a * b + c * d, b * b + d * d + _DAMPING
    det = p * r - q * q
    rate1, rate2 = (r * u - q * v) / det, (p * v - q * u) / det
    share = min(1.0, most / max(abs(rate1), abs(rate2), 1e-300))
    return share * rate1, share * rate2


def disk_time(eta: float, radius_m: float, speed: float, finger_m: float = FINGER_M) -> float:
    """Return how long [s] the law takes to bring a disk's friction angle [rad] to 0 at |phi'| = speed [rad/s]."""
    return abs(eta) * (finger_m + radius_m) / (finger_m * speed)


def rectangle_time(tilt: float, width_m: float, speed: float, finger_m: float = FINGER_M) -> float:
    """Return how long [s] the law takes to bring a rectangle's tilt [rad] to 0 at |phi'| = speed [rad/s].

    The integral of 1/`rectangle_spin` over the tilt.

    Args:
        tilt: direction of the side's normal less psi [rad].
        width_m: between the two sides.
        speed: [rad/s].
        finger_m: rb.
    """
    lean = abs(tilt)
    return ((width_m + 2.0 * finger_m) * math.tan(lean) - 2.0 * finger_m * lean) / (2.0 * finger_m * speed)


def rectangle_spin(tilt: float, width_m: float, rate: float, finger_m: float = FINGER_M) -> float:
    """Return the spin [rad/s] of a rectangle under the rotation phi1' = phi2' = rate.

    Args:
        tilt: direction of the side's normal less psi [rad].
        width_m: between the two sides.
        rate: [rad/s].
        finger_m: rb.
    """
    return 2.0 * finger_m * rate / ((width_m + 2.0 * finger_m) / math.cos(tilt) ** 2 - 2.0 * finger_m)


@dataclass(slots=True)
class RigidGrasp:
    """An object between two rolling fingers; d follows from the object.

    Args:
        outline: of the object.
        hand: the modules.
        coordinates: x, y, psi, d, phi1, phi2 of the start, with both fingers touching.
        pose: x [m], y [m], angle [rad] of the object.
        finger_m: rb.

    Concurrency: one caller at a time.
    """

    outline: Outline
    hand: Hand
    coordinates: list[float]
    pose: list[float]
    finger_m: float = FINGER_M

    def roll(self, rates: Sequence[float], time_s: float, steps: int = 50) -> None:
        """Move x, y, psi, phi1, phi2 at `rates` (m/s, rad/s) for a time [s]; object and d follow, by Runge-Kutta."""
        h = time_s / steps
        state = np.array([*self.pose, *self.coordinates])
        for _ in range(steps):  # of the fourth order
            k1 = self._slopes(state, rates)
            k2 = self._slopes(state + 0.5 * h * k1, rates)
            k3 = self._slopes(state + 0.5 * h * k2, rates)
            k4 = self._slopes(state + h * k3, rates)
            state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self.pose, self.coordinates = state[:3].tolist(), state[3:].tolist()

    def roll_until_parallel(self, rates: Sequence[float], most_s: float, tolerance_s: float = 1e-6) -> float:
        """Roll until the first friction angle changes sign; return the time it took [s].

        Raises:
            ValueError: it does not within `most_s`.
        """
        step, gone = most_s / 100, 0.0
        sign = self.grasp().eta1
        while gone < most_s:
            pose, coordinates = list(self.pose), list(self.coordinates)
            self.roll(rates, step, 1)
            if self.grasp().eta1 * sign > 0.0:
                gone += step
                continue
            self.pose, self.coordinates = pose, coordinates
            if step < tolerance_s:
                return gone
            step *= 0.25
        raise ValueError(f"roll until parallel: not within {most_s} s; want the rates of the rolling law")

    def grasp(self) -> Grasp:
        """Return the present grasp."""
        fingers, contacts = self._contacts(self.coordinates, self.pose)
        normals = [math.atan2(c[1] - f[1], c[0] - f[0]) for f, c in zip(fingers, contacts, strict=True)]
        return grasp_of(fingers[0], fingers[1], normals[0], normals[1], self.finger_m)

    def _contacts(
        self, coordinates: Sequence[float], pose: Sequence[float]
    ) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
        x, y, psi, d = coordinates[:4]
        hx, hy = 0.5 * d * math.cos(psi), 0.5 * d * math.sin(psi)
        fingers = [(x - hx, y - hy), (x + hx, y + hy)]
        return fingers, [self.outline.nearest(pose, *finger) for finger in fingers]

    def _slopes(self, state: np.ndarray, rates: Sequence[float]) -> np.ndarray:
        pose, coordinates = state[:3].tolist(), state[3:].tolist()
        fingers, contacts = self._contacts(coordinates, pose)
        vx, vy, turn, _, roll1, roll2 = rates
        _, _, psi, d, _, _ = coordinates
        along = (math.cos(psi), math.sin(psi))
        matrix, right = np.zeros((4, 4)), np.zeros(4)
        for row, (finger, contact, roll, side) in enumerate(
            zip(fingers, contacts, (roll1, roll2), (-0.5, 0.5), strict=True)
        ):
            rx, ry = contact[0] - finger[0], contact[1] - finger[1]
            link = turn - roll
            # the finger's surface there, apart from d', and that of the object: (V, w, d') unknown
            right[2 * row] = vx - side * d * along[1] * turn - link * ry
            right[2 * row + 1] = vy + side * d * along[0] * turn + link * rx
            matrix[2 * row] = 1.0, 0.0, -(contact[1] - pose[1]), -side * along[0]
            matrix[2 * row + 1] = 0.0, 1.0, contact[0] - pose[0], -side * along[1]
        ox, oy, spin, opening = np.linalg.solve(matrix, right)
        return np.array([ox, oy, spin, vx, vy, turn, opening, roll1, roll2])
