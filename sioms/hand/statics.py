"""Forces of a planar grasp, and the sampled loop that controls the internal one.

At rest with two contacts the forces are equal and opposite along the line through the contacts: the null space of the
grasp matrix.  f > 0 squeezes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def damper_limit(stiffness: float, sample_s: float, late: int = 0) -> float:
    """Return the gain K_v [m/(s N)] at which the sampled loop d' = -K_v (f_d - f_a) becomes unstable.

    Args:
        stiffness: of everything in series between the commanded d and the force [N/m].
        sample_s: T.
        late: samples by which the force is late: 1 halves the limit, see `damper_factor`.
    """
    return 2.0 * math.sin(0.5 * math.pi / (2 * late + 1)) / (stiffness * sample_s)


def damped_limit(stiffness: float, damping: float, sample_s: float) -> float:
    """Return the gain K_v [m/(s N)] at which the loop becomes unstable where force also goes with speed, 2/(k T + 2 c).

    A servo's damping answers a closing speed at once, before any way is gone; at high rates it is what limits K_v.

    Args:
        stiffness: k, of everything in series [N/m].
        damping: c, of everything in series [N s/m].
        sample_s: T.
    """
    return 2.0 / (stiffness * sample_s + 2.0 * damping)


RINGING_KG = 0.06
"""Least (filter_s + sample_s) / K_v: at less a link of Table 4.1 rings on the rubber. Measured on the plane with 20 and
50 ms at 400 Hz and with none at 20 Hz (`sioms bench hand`, row 5): it began at 0.037 to 0.056."""


def filtered_limit(filter_s: float, sample_s: float) -> float:
    """Return the largest gain K_v [m/(s N)] at which links do not ring on the rubber, for a low-pass of the force.

    Args:
        filter_s: time constant of the low-pass [s], 0 for none.
        sample_s: T.
    """
    return (filter_s + sample_s) / RINGING_KG


def damper_factor(gain: float, stiffness: float, sample_s: float, late: int = 0) -> float:
    """Return the largest |z| of the loop z^(n+1) - z^n + K_v k T = 0: below 1 it is stable.

    With nothing late z = 1 - K_v k T: no overshoot up to K_v k T = 1, stable below 2.
    """
    polynomial = [1.0, -1.0, *([0.0] * late)]
    polynomial[-1] += gain * stiffness * sample_s
    return float(np.abs(np.roots(polynomial)).max())
