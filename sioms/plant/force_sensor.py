"""A six-component force/torque sensor that feels the contacts of other axes.

Components in order: fx, fy, fz [N], tx, ty, tz [N m], about the sensor's origin.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True, slots=True)
class Contact:
    """Where and along what a contact force acts on the sensor.

    Args:
        direction: of the force for a positive contact force; normalised.
        point: of its application [m].
    """

    direction: tuple[float, float, float]
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)


class ForceSensor:
    """Turns contact forces into six readings.

    Args:
        contacts: the forces it feels.
        noise: standard deviation of each component [N, N m], shape (6,) or a number.
        resolution: step of the readings [N, N m]; 0 for none.
        bias: readings without load.
        limit: readings saturate at this magnitude.
        cross_talk: shape (6, 6), applied to the true components; the identity when None.
        seed: of the noise.
    """

    def __init__(
        self,
        contacts: Sequence[Contact],
        noise: float | Sequence[float] = 0.0,
        resolution: float | Sequence[float] = 0.0,
        bias: float | Sequence[float] = 0.0,
        limit: float | Sequence[float] = np.inf,
        cross_talk: Array | None = None,
        seed: int = 0,
    ) -> None:
        wrenches = np.array([_wrench(contact) for contact in contacts]).reshape(-1, 6).T
        self._wrenches = wrenches if cross_talk is None else cross_talk @ wrenches
        self._noise, self._step, self.bias, self._limit = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), 6).copy()
            for v in (noise, resolution, bias, limit)
        )
        self._has_step = bool(np.all(self._step > 0))
        if not self._has_step and np.any(self._step != 0):
            raise ValueError(f"build force sensor: resolution {self._step}; want all positive or all 0")
        self._random = np.random.default_rng(seed)
        self._work = np.zeros(6)

    def read(self, forces: Array, out: Array) -> Array:
        """Fill out, shape (6,), from the contact forces [N], one for each contact."""
        np.matmul(self._wrenches, forces, out=out)
        np.add(out, self.bias, out=out)
        self._random.standard_normal(out=self._work)
        np.multiply(self._work, self._noise, out=self._work)
        np.add(out, self._work, out=out)
        np.minimum(out, self._limit, out=out)
        np.maximum(out, -self._limit, out=out)
        if self._has_step:
            np.divide(out, self._step, out=out)
            np.round(out, out=out)
            np.multiply(out, self._step, out=out)
        return out


def _wrench(contact: Contact) -> Array:
    """Return force and torque of a unit contact force, shape (6,)."""
    direction = np.array(contact.direction, dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if not 0 < length < np.inf:
        raise ValueError(f"build force sensor: direction {contact.direction}; must not vanish")
    direction /= length
    return np.concatenate([direction, np.cross(contact.point, direction)])
