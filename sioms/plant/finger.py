"""A simulated tactile finger: the radial strain under a cylindrical or flat indenter, by closed form.

The finger is taken as an elastic half plane in plane strain below the arc of contact, the pressure
as Hertz's ellipse; the elements lie at a depth below the surface. It is a plausible device to be
measured, not the exact core-and-skin model.

Conventions: stress and strain positive in tension; the output of an element is compression in per cent.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class FingerShape:
    """Geometry and material.

    Args:
        radius_m: outer radius rb.
        depth_m: of the elements below the surface.
        length_m: contact length along the finger: force over load per length.
        shear_modulus_pa: mu.
        poisson_ratio: nu, 0 to 0.5.
        angles_rad: of the elements.
    """

    radius_m: float = 12.7e-3
    depth_m: float = 2.4e-3
    length_m: float = 20e-3
    shear_modulus_pa: float = 8.3e4
    poisson_ratio: float = 0.46
    angles_rad: tuple[float, ...] = tuple(math.radians(143 - 9.22 * i) for i in range(16))


def half_width(shape: FingerShape, load: float, indenter_radius_m: float) -> float:
    """Return Hertz's half-width a [m]: a^2 = 2 P R (1 - nu)/(pi mu), 1/R = 1/rb + 1/rc.

    Args:
        load: P [N/m], at least 0.
        indenter_radius_m: rc, infinite for a flat.
    """
    relative = 1 / (1 / shape.radius_m + 1 / indenter_radius_m)
    return math.sqrt(2 * load * relative * (1 - shape.poisson_ratio) / (math.pi * shape.shear_modulus_pa))


def hertz_stress(x: Array, depth: float, load: float, a: float) -> tuple[Array, Array]:
    """Return (sigma_xx, sigma_zz) [Pa] below Hertz's pressure (Johnson, Contact Mechanics, eq. 4.49).

    Args:
        x: distance along the surface from the middle of contact [m].
        depth: z below the surface [m], positive.
        load: P [N/m].
        a: half-width [m], positive.
    """
    p0 = 2 * load / (math.pi * a)
    z2 = depth * depth
    d = a * a - x * x + z2
    root = np.hypot(d, 2 * x * depth)
    m = np.sqrt((root + d) / 2)
    # n^2 = (root - d)/2 would cancel below the middle; m n = x z holds exactly, up to sign.
    n2 = (x * depth / m) ** 2
    share = (z2 + n2) / (m * m + n2)
    return -p0 / a * (m * (1 + share) - 2 * depth), -p0 / a * m * (1 - share)


def radial_strain(shape: FingerShape, angle_rad: float, load: float, indenter_radius_m: float) -> Array:
    """Return the radial strain at the elements, shape of angles_rad; zero without load.

    Args:
        angle_rad: middle of contact.
        load: P [N/m]; at most 0 is no contact.
        indenter_radius_m: rc, infinite for a flat.
    """
    angles = np.array(shape.angles_rad)
    if load <= 0:
        return np.zeros_like(angles)
    arc = shape.radius_m * np.remainder(angles - angle_rad + math.pi, math.tau) - shape.radius_m * math.pi
    a = half_width(shape, load, indenter_radius_m)
    along, down = hertz_stress(arc, shape.depth_m, load, a)
    nu = shape.poisson_ratio
    return ((1 - nu) * down - nu * along) / (2 * shape.shear_modulus_pa)


class TactileArray:
    """Elements of a finger with their gains, offsets, noise and converter.

    Args:
        shape: the finger.
        gain: output in per cent for 1 % of compression; a number or one for each element.
        offset: output without load [%].
        noise: standard deviation [%].
        resolution: step of the output [%]; 0 for none.
        seed: of noise.
    """

    def __init__(
        self,
        shape: FingerShape,
        gain: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
        noise: float = 0.0,
        resolution: float = 0.0,
        seed: int = 0,
    ) -> None:
        n = len(shape.angles_rad)
        self.shape = shape
        self._gain, self.offset = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), n).copy() for v in (gain, offset)
        )
        self._noise, self._step = noise, resolution
        self._random = np.random.default_rng(seed)
        self._work = np.zeros(n)

    def read(self, force: float, angle_rad: float, indenter_radius_m: float, out: Array) -> Array:
        """Fill out, shape of the elements, with the outputs [%] under a contact force [N]."""
        strain = radial_strain(self.shape, angle_rad, force / self.shape.length_m, indenter_radius_m)
        np.multiply(strain, -100.0, out=out)
        np.multiply(out, self._gain, out=out)
        np.add(out, self.offset, out=out)
        if self._noise:
            self._random.standard_normal(out=self._work)
            np.multiply(self._work, self._noise, out=self._work)
            np.add(out, self._work, out=out)
        if self._step:
            np.divide(out, self._step, out=out)
            np.round(out, out=out)
            np.multiply(out, self._step, out=out)
        return out
