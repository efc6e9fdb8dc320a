"""Maps between the joints that a device drives and the coordinates that it shows.

No process, no clock, no I/O.  SI units.  A map is a small immutable object with the three calls of `Transform`; those
of the planar hand are in `sioms.hand.kinematics`.
"""

from .reach import Joint, Reach
from .transform import Transform, forces

__all__ = ["Joint", "Reach", "Transform", "forces"]
