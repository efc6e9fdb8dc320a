"""What a recorded grasp is: one row for each hold of one object under one load, in the order of time.

Angles are in the frames of `sioms.hand`: th of a link against the platen, place of a contact in its finger's own angle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
OTHER, DISK, BAR = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class Grasps:
    """Rows of one hand; immutable.

    Attributes:
        time: [s], shape (n,).
        record: number of the recording: the joints are homed anew in each, shape (n,).
        grasp: number of the grasp that a row belongs to; it rises with the rows, shape (n,).
        kind: DISK, BAR (two parallel sides) or OTHER, of the object, shape (n,).
        thing: number of the object, shape (n,).
        size: radius of a disk, width of a bar [m]; nan where it is not known, shape (n,).
        command: x1, y1, th1, x2, y2, th2 [m, rad] as told to the axes; nan without, shape (n, 6).
        joints: the same as the encoders read them, shape (n, 6).
        place: of the contact on each finger [rad], shape (n, 2).
        load: along the normal, as each finger tells it [N], shape (n, 2).
        wrist: force of the object on each finger [N], along the axes of the platen; nan without, shape (n, 2, 2).
        slip: the finger (1 or 2) that begins to slide in this row, 0 for none, shape (n,).
    """

    time: Floats
    record: Ints
    grasp: Ints
    kind: Ints
    thing: Ints
    size: Floats
    command: Floats
    joints: Floats
    place: Floats
    load: Floats
    wrist: Floats
    slip: Ints

    def __len__(self) -> int:
        return len(self.time)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Rows of objects whose size is known."""
        return np.isfinite(self.size)

    @property
    def weighed(self) -> NDArray[np.bool_]:
        """Rows in which both wrists are read."""
        return np.asarray(np.isfinite(self.wrist).all((1, 2)))

    @property
    def told(self) -> NDArray[np.bool_]:
        """Rows in which the commands of all joints are known."""
        return np.asarray(np.isfinite(self.command).all(1))

    def rows(self, which: NDArray[np.bool_]) -> Grasps:
        """Return some of the rows."""
        return Grasps(**{name: getattr(self, name)[which] for name in self.__slots__})

    def moved(self, name: str, change: Floats) -> Grasps:
        """Return the rows with something added to one of their columns."""
        return replace(self, **{name: getattr(self, name) + change})
