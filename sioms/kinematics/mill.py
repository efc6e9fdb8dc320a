"""A mill of five axes: a spindle that x, y and z carry, above a table that turns on a cradle that tilts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Three = tuple[float, float, float]
Five = tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Mill:
    """Joints (x, y, z [m], tilt, turn [rad]).  Coordinates: the same, of the tool in the workpiece.

    The cradle tilts about an axis parallel to x, the table on it turns about its own normal, z at no tilt; both angles
    are right-handed rotations of the workpiece. x, y and z of the coordinates are of the tool's tip in the frame that
    turns with the table, its origin on the table's axis; so a command of an angle alone leaves the tip at its place on
    the workpiece, and x, y and z follow. Both angles being coordinates, no posture is singular: a tool along the
    table's axis could be turned at will, and here it is told how.

    Args:
        pivot_m: a point of the cradle's axis, in the machine's frame, whose x counts as the table's.
        table_m: from the cradle's axis to the origin of the workpiece's frame at no tilt, along y and z.
        tool_m: from where z counts down to the tool's tip, >= 0.
        tilt_max: largest |tilt| [rad], above 0 and at most pi; beyond it table and spindle would meet.
    """

    pivot_m: Three = (0.0, 0.0, 0.0)
    table_m: tuple[float, float] = (0.0, 0.0)
    tool_m: float = 0.0
    tilt_max: float = 0.5 * math.pi

    def __post_init__(self) -> None:
        for name, count in (("pivot_m", 3), ("table_m", 2)):
            value = getattr(self, name)
            if len(value) != count or not all(abs(number) <= 1e3 for number in value):
                raise ValueError(f"describe mill: {name} {list(value)}; want {count} numbers within 1000")
        if not 0.0 <= self.tool_m <= 1e3:
            raise ValueError(f"describe mill: tool_m {self.tool_m:g}; want 0 to 1000")
        if not 1e-9 <= self.tilt_max <= math.pi:
            raise ValueError(f"describe mill: tilt_max {self.tilt_max:g} rad; want 1e-9 or more and at most pi")

    def forward(self, joints: Sequence[float]) -> Five:
        """Return (x, y, z, tilt, turn) of joints; a table that is tilted too far still has a place."""
        x, y, z, tilt, turn = joints
        px, py, pz = self.pivot_m
        c, s = math.cos(tilt), math.sin(tilt)
        across, up = y - py, z - self.tool_m - pz
        u, v, w = x - px, c * across + s * up - self.table_m[0], c * up - s * across - self.table_m[1]
        c, s = math.cos(turn), math.sin(turn)
        return c * u + s * v, c * v - s * u, w, tilt, turn

    def inverse(self, coordinates: Sequence[float]) -> Five:
        """Return the joints of (x, y, z, tilt, turn).

        Raises:
            ValueError: the tilt is beyond `tilt_max`.

        Example:
            >>> x, y, z, *_ = Mill(tool_m=0.1).inverse((0.02, 0.0, 0.01, 0.0, 0.5 * math.pi))
            >>> round(x, 9), round(y, 9), round(z, 9)
            (0.0, 0.02, 0.11)
        """
        tilt = coordinates[3]
        if not abs(tilt) <= self.tilt_max:
            raise ValueError(
                f"a tilt of {tilt:g} rad would bring table and spindle together; want at most {self.tilt_max:g} rad"
            )
        u, v, w = self._on_cradle(coordinates)
        px, py, pz = self.pivot_m
        c, s = math.cos(tilt), math.sin(tilt)
        return px + u, py + c * v - s * w, pz + self.tool_m + s * v + c * w, tilt, coordinates[4]

    def joint_rates(self, coordinates: Sequence[float], rates: Sequence[float]) -> Five:
        """Return the joints' velocities."""
        vx, vy, vz, tilting, turning = rates
        u, v, w = self._on_cradle(coordinates)
        c, s = math.cos(coordinates[4]), math.sin(coordinates[4])
        du = c * vx - s * vy - turning * (v - self.table_m[0])
        dv = s * vx + c * vy + turning * u
        dw = vz
        c, s = math.cos(coordinates[3]), math.sin(coordinates[3])
        across, up = dv - tilting * w, dw + tilting * v
        return du, c * across - s * up, s * across + c * up, tilting, turning

    def _on_cradle(self, coordinates: Sequence[float]) -> Three:
        """Return where the tip is from the cradle's axis, in the frame that tilts with it [m]."""
        x, y, z, _, turn = coordinates
        c, s = math.cos(turn), math.sin(turn)
        return c * x - s * y, s * x + c * y + self.table_m[0], z + self.table_m[1]
