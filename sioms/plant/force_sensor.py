"""A six-component force/torque sensor that feels the contacts of other axes.

Components in order: fx, fy, fz [N], tx, ty, tz [N m], about the sensor's origin.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

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


Six = tuple[float, float, float, float, float, float]
_NONE: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_SLIDERS = 24


@dataclass(frozen=True, slots=True)
class Flaws:
    """What a sensor does beyond its data sheet, a number for each component.

    Attributes:
        gain: relative errors.
        quadratic: added at the limit, as a share of it, with the square of the load.
        drift: of the zero [N/s, N m/s].
        cross_talk: rows of a matrix applied to the true components and added; None for none.
        loop: half heights of the hysteresis loop, as shares of the limit; reach: share over which it turns round.
    """

    gain: Six = _NONE
    quadratic: Six = _NONE
    drift: Six = _NONE
    cross_talk: tuple[Six, Six, Six, Six, Six, Six] | None = None
    loop: Six = _NONE
    reach: float = 0.1


@dataclass(slots=True)
class _Sliders:
    """Springs on dry friction: each stretches with the load until it slides."""

    flaws: Flaws
    stretch: Array = field(default_factory=lambda: np.zeros((_SLIDERS, 6)))
    last: Array = field(default_factory=lambda: np.zeros(6))

    def move(self, share: Array) -> Array:
        """Return what they hold back, as shares of the limit, at a load as a share of it."""
        slip = self.flaws.reach * (np.arange(_SLIDERS) + 0.5)[:, None] / _SLIDERS
        self.stretch = np.clip(self.stretch + share - self.last, -slip, slip)
        self.last = share.copy()
        held: Array = np.array(self.flaws.loop) * np.mean(self.stretch / slip, axis=0)
        return held


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
        flaws: beyond the data sheet; they need a limit where they are shares of it.
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
        flaws: Flaws | None = None,
    ) -> None:
        self._wrenches = np.array([_wrench(contact) for contact in contacts]).reshape(-1, 6).T
        self._matrix = cross_talk
        self._flaws = flaws
        self._sliders = None if flaws is None else _Sliders(flaws)
        self._began_s: float | None = None
        self._noise, self._step, self.bias, self._limit = (
            np.broadcast_to(np.asarray(v, dtype=np.float64), 6).copy() for v in (noise, resolution, bias, limit)
        )
        self._has_step = bool(np.all(self._step > 0))
        if not self._has_step and np.any(self._step != 0):
            raise ValueError(f"build force sensor: resolution {self._step}; want all positive or all 0")
        for what, values, good, want in (
            ("noise", self._noise, (self._noise >= 0.0) & np.isfinite(self._noise), "0 or more, finite"),
            ("resolution", self._step, np.isfinite(self._step), "finite numbers"),
            ("bias", self.bias, np.isfinite(self.bias), "finite numbers"),
            ("limit", self._limit, self._limit > 0.0, "more than 0"),
            ("what contacts do", self._wrenches, np.isfinite(self._wrenches), "finite directions and points"),
        ):
            if not np.all(good):
                raise ValueError(f"build force sensor: {what} {values.tolist()}; want {want}")
        self._random = np.random.default_rng(seed)
        self._work = np.zeros(6)

    def load(self, forces: Array) -> Array:
        """Return the true components, shape (6,), of the contact forces [N], one for each contact."""
        out: Array = self._wrenches @ forces
        return out

    def read(self, forces: Array, out: Array, time_s: float = 0.0) -> Array:
        """Fill out, shape (6,), from the contact forces [N] at a time [s], which only drift asks for."""
        return self.electronics(self._felt(self.load(forces), time_s), out)

    def _felt(self, load: Array, time_s: float) -> Array:
        felt = load if self._matrix is None else self._matrix @ load
        if self._flaws is None or self._sliders is None:
            return felt
        if self._began_s is None:
            self._began_s = time_s
        flaws, share = self._flaws, load / self._limit
        out: Array = felt + np.array(flaws.gain) * load + np.array(flaws.drift) * (time_s - self._began_s)
        if flaws.cross_talk is not None:
            out += np.array(flaws.cross_talk) @ load
        out += self._limit * (np.array(flaws.quadratic) * share**2 - self._sliders.move(share))
        return out

    def electronics(self, felt: Array, out: Array) -> Array:
        """Fill out, shape (6,), with bias, noise, range and steps about what is felt [N, N m]."""
        np.add(felt, self.bias, out=out)
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
