"""The source's regrasps of a disk and of a rectangle in one step, and the classifier that tells them apart."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from sioms.hand.contacts import Likeness
from sioms.hand.experiments.starts import Start
from sioms.hand.kinematics import Six
from sioms.hand.plane import Rig
from sioms.hand.regrasp import disk_radii, regrasp_disk, regrasp_rectangle
from sioms.hand.skills import Skills
from sioms.hand.touch import Sensed
from sioms.plant.planar import Mount


class By(Enum):
    """What a regrasp takes the radius of a disk from."""

    POSITION = "position"
    CURVATURE = "curvature"


class SourceSkills(Skills):
    """Regrasps as the source does: disk or rectangle, by one grasp alone.

    Attributes:
        likeness: what the object is taken for.
        by: what the radius is taken from.
    """

    likeness, by = Likeness.DISK, By.POSITION

    def plan(self, found: Sensed) -> Six:
        """Return where the hand goes (4.4 to 4.8)."""
        if self.likeness is Likeness.RECTANGLE:
            return regrasp_rectangle(found.grasp)
        return regrasp_disk(found.grasp, radius_of(found, self.by))


def radius_of(found: Sensed, by: By) -> float:
    """Return rc [m] of a grasp of a disk, the mean over both fingers."""
    if by is By.POSITION:
        return 0.5 * sum(disk_radii(found.grasp))
    return 0.5 * sum(1.0 / max(bend, 1.0) for bend in found.curvatures)


@dataclass(frozen=True, slots=True)
class Regrasped:
    """What regrasps of an object came to; immutable.

    Args:
        start: of it.
        told: what the first grasp was classified as.
        radius_m: rc by the first grasp; nan for a rectangle.
        etas: true max |eta| of the first grasp and after each regrasp [rad].
        deviation: stated standard deviation of the friction angles of the first grasp [rad].
    """

    start: Start
    told: Likeness
    radius_m: float
    etas: tuple[float, ...]
    deviation: float


def regrasp(start: Start, by: By, steps: int, rig: Rig, seed: int = 0, friction: float | None = 2.0) -> Regrasped:
    """Grasp an object in the plane and regrasp it `steps` times; raises as the skills do."""
    plane = start.plane(rig, Mount(friction=friction), seed)
    skills = SourceSkills(plane.hand, plane.reading)
    skills.likeness, skills.by = start.likeness, by
    first = found = plane.run(skills.grasp())
    etas = [plane.truth().quality]
    for _ in range(steps):
        found = plane.run(skills.regrasp(found))
        etas.append(plane.truth().quality)
    radius = radius_of(first, by) if start.likeness is Likeness.DISK else float("nan")
    return Regrasped(start, first.likeness, radius, tuple(etas), first.deviation)
