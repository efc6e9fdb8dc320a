"""A finger rolls along a side of a held rectangle on to its corner: place of contact, radius, and what it rolls on."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field

import numpy as np

from sioms.hand.contacts import FINGER_M
from sioms.hand.edges import Edge, EdgeDetector
from sioms.hand.plane import PlaneHand, Rig
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.skills import Skills
from sioms.hand.touch import Manner, Reading, Setpoint, State
from sioms.plant.outline import rectangle
from sioms.plant.planar import Body, Mount

SPEED = math.radians(5.0)
PITCH = math.radians(9.22)
"""Between the elements of the array."""
_PERIODS = 3.0  # that a roll must cover before a period is told


@dataclass(frozen=True, slots=True)
class Row:
    """A frame of it; immutable.

    Args:
        time_s: since the roll began.
        link: turn of the rolling link [rad].
        place: phi_c as felt, nan without a usable frame [rad].
        true_place: phi_c of the plane [rad].
        radius_m: R of the contact as felt; nan without.
        at_corner: whether the corner is the point of the outline that is nearest to the finger's centre.
        edge: what the detector says.
        half_width: of the contact [rad].
    """

    time_s: float
    link: float
    place: float
    true_place: float
    radius_m: float
    at_corner: bool
    edge: Edge
    half_width: float


@dataclass(slots=True)
class Rounded:
    """A roll round a corner.

    Attributes:
        rows: its frames.
        fault: why it ended before its time, if it did.
    """

    rows: list[Row] = field(default_factory=list)
    fault: str = ""

    @property
    def drop_outs(self) -> int:
        """Return how many frames had no usable estimate."""
        return sum(not math.isfinite(row.place + row.radius_m) for row in self.rows)

    @property
    def late(self) -> float:
        """Return by what turn of the link [rad] the vertex is told after the contact's middle has come to the corner;
        nan if it never is.
        """
        arrived = next((row.link for row in self.rows if row.at_corner), math.nan)
        told = next((row.link for row in self.rows if row.at_corner and row.edge is Edge.VERTEX), math.nan)
        return abs(told - arrived)

    @property
    def early(self) -> int:
        """Return how many frames were told a vertex more than a contact's width before the corner."""
        arrived = next((row.link for row in self.rows if row.at_corner), math.inf)
        return sum(
            row.edge is Edge.VERTEX and abs(row.link - arrived) > 2.0 * row.half_width
            for row in self.rows
            if not row.at_corner
        )

    @property
    def width(self) -> float:
        """Return the width of the contact on the side [rad]."""
        return 2.0 * float(np.median([row.half_width for row in self.rows if not row.at_corner]))


class OneFinger(Skills):
    """Rolls finger 1 alone."""

    def round_the_corner(self, rate: float, time_s: float) -> Generator[Setpoint, Reading, None]:
        """Turn phi1 at a rate [rad/s] for a time [s], under the damper law."""
        self.state = State.ROLL
        end = self.now.time_s + time_s
        while self.now.time_s < end:
            yield from self._tick((rate, 0.0))


def round_corner(
    width_m: float = 0.03, before_m: float = 3e-3, turn: float = math.radians(45.0), rig: Rig | None = None,
    seed: int = 0,
) -> Rounded:  # fmt: skip
    """Hold a rectangle near a corner and roll one finger on to it; raises as a grasp does.

    Args:
        width_m: between the sides that are held.
        before_m: from the corner to the contacts at the start.
        turn: of the link.
        rig: of the hand.
        seed: of the noise.
    """
    long = 2.0 * width_m
    outline = rectangle(width_m, long)
    first = (0.0, 0.0, 0.0, width_m + 2.0 * FINGER_M + 10e-3, NEUTRAL, NEUTRAL)
    plane = PlaneHand(Body(outline), (0.0, before_m - 0.5 * long, 0.0), rig or Rig(), Mount(friction=2.0), seed, first)
    skills = OneFinger(plane.hand, plane.reading, Manner())
    plane.run(skills.grasp())
    detector, found = EdgeDetector(), Rounded()
    begin_s, begin_th = plane.world.time_s, plane.reading.joints[2]

    def look(hand: PlaneHand, _: Setpoint) -> None:
        finger, felt = hand.world.fingers[0], hand.reading.fingers[0]
        link = hand.reading.joints[2] - begin_th
        edge = detector.edge
        if felt.touched and math.isfinite(felt.phi):
            edge = detector.see(link, felt.phi, felt.radius_m)
        width = hand.world.skin.press(max(-finger.gap_m, 0.0), _relative(finger.radius_m))[1] / FINGER_M
        at_corner = _at_corner(outline.points, hand.world.pose, finger.centre)
        found.rows.append(
            Row(hand.world.time_s - begin_s, link, felt.phi, finger.phi, felt.radius_m, at_corner, edge, width)
        )

    plane.seen = look
    # phi1 grows: the link turns clockwise and the contact goes up the side, to the corner
    plane.run(skills.round_the_corner(SPEED, turn / SPEED))
    return found


def _relative(radius_m: float) -> float:
    return 1.0 / (1.0 / FINGER_M + (0.0 if math.isinf(radius_m) else 1.0 / max(radius_m, 1e-5)))


def _at_corner(points: np.ndarray, pose: Sequence[float], centre: tuple[float, float]) -> bool:
    """Return whether a corner of the outline is its point nearest to a centre."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = points @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
    side = np.roll(turned, -1, axis=0) - turned
    share = np.sum((np.array(centre) - turned) * side, axis=1) / np.sum(side * side, axis=1)
    foot = turned + np.clip(share, 0.0, 1.0)[:, None] * side
    nearest = int(np.argmin(np.sum((foot - np.array(centre)) ** 2, axis=1)))
    return not 0.0 < share[nearest] < 1.0


def period(rows: Sequence[Row]) -> float:
    """Return the period of R's residual over the place of contact on the side [rad], its strongest line between 4 and
    20 degrees; nan where the roll is shorter than three elements.
    """
    places = np.array([row.place for row in rows if not row.at_corner])
    bends = np.array([1.0 / row.radius_m for row in rows if not row.at_corner])
    good = np.isfinite(places + bends)
    places, bends = places[good], bends[good]
    if len(places) < 50 or np.ptp(places) < _PERIODS * PITCH:
        return math.nan
    base = np.vander(places - places.mean(), 3)
    rest = bends - base @ np.linalg.lstsq(base, bends, rcond=None)[0]
    periods = np.radians(np.linspace(4.0, 20.0, 161))
    power = [abs(np.exp(2j * np.pi * places / one) @ rest) for one in periods]
    return float(periods[int(np.argmax(power))])
