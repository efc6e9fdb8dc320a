"""Answer an elastic half plane to a line of pressure: the model of a flat finger, for comparison with the
cylinder.

Plane strain, surface coordinate s = rb t [m], depth d [m]; compression gives negative strain under the load.
Source: Flamant's solution (Johnson, Contact Mechanics, 2.2), dissertation 2.16 and 2.17.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def normal_strain(distance_m: ArrayLike, depth_m: float, load: float, poisson: float, shear_pa: float) -> Floats:
    """Return the strain normal to the surface at `depth_m` under a line load [N/m, compression positive].

    Args:
        distance_m: distance along the surface from the line [m].
        depth_m: depth d > 0 [m].
        load: P [N/m].
        poisson: nu, 0 to 1/2.
        shear_pa: mu [Pa].
    """
    x = np.asarray(distance_m, dtype=np.float64)
    square = x**2 + depth_m**2
    normal = -2.0 * load / np.pi * depth_m**3 / square**2
    lateral = -2.0 * load / np.pi * depth_m * x**2 / square**2
    strain: Floats = ((1.0 - poisson) * normal - poisson * lateral) / (2.0 * shear_pa)
    return strain


def transfer(frequency: ArrayLike, depth_m: float, poisson: float, shear_pa: float) -> Floats:
    """Return |strain/pressure| [1/Pa] at depth under cos(w s), w in rad/m: e^(-wd) [(1 - 2 nu) + w d]/(2 mu)."""
    wd = np.asarray(frequency, dtype=np.float64) * depth_m
    ratio: Floats = np.exp(-wd) * ((1.0 - 2.0 * poisson) + wd) / (2.0 * shear_pa)
    return ratio
