"""A simulated tactile finger: elements under an elastic skin on a rigid core, with the faults of real ones.

The mechanics are those of `sioms.plant.rubber`, tabulated for each indenter over the load; the rest is what a
real finger adds, each switched off by its default: scatter of gain, depth and place, the electronics' quadratic,
noise, a mains line, the converter's steps, drift, creep, the pull of a conductor, copper strips, partial adhesion.

Conventions: strain positive in tension; the output of an element is compression in per cent of the untouched output.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sioms.plant.rubber import POINTS, Layer, rubber

Array = NDArray[np.float64]

_MOST, _LEAST, _STEPS = 1000.0, 0.02, 20  # the tables' loads: _MOST (least .. 1)^2 N/m
_STEP = (1.0 - _LEAST) / _STEPS
_LOADS = _MOST * np.linspace(_LEAST, 1.0, _STEPS + 1) ** 2
_CLEARANCE_M = 4e-3  # over which a conductor's pull falls to 1/e as it comes near


@dataclass(frozen=True, slots=True)
class FingerShape:
    """Geometry, material and faults; the default is a perfect finger.

    Args:
        radius_m: outer radius rb.
        core_m: ra.
        depth_m: of the elements below the surface.
        length_m: contact length along the finger: force over load per length.
        shear_modulus_pa: mu.
        poisson_ratio: nu, 0 to 0.495.
        angles_rad: of the elements.
        gain: strain per output of every element.
        adhesion: share of the tangential traction of full adhesion.
        gain_scatter: standard deviation of the elements' gains, relative.
        depth_scatter_m, angle_scatter_rad: largest departures of the elements.
        quadratic: d = l + quadratic l^2 [1/%].
        mains: amplitude of a line [%] at mains_hz.
        drift: amplitude of a slow wave of all elements [%], of period drift_s.
        creep: share of the response that comes late, with time constant creep_s.
        proximity: output that a conductor draws at its own place [%], falling to 1/e over proximity_range_rad.
        strip_gain: how much more an element feels of a contact right over its copper strip, within strip_width_rad.
        seed: of the scatter.
    """

    radius_m: float = 12.7e-3
    core_m: float = 9.6e-3
    depth_m: float = 2.4e-3
    length_m: float = 20e-3
    shear_modulus_pa: float = 8.3e4
    poisson_ratio: float = 0.46
    angles_rad: tuple[float, ...] = tuple(math.radians(143 - 9.22 * i) for i in range(16))
    gain: float = 1.0
    adhesion: float = 0.0
    gain_scatter: float = 0.0
    depth_scatter_m: float = 0.0
    angle_scatter_rad: float = 0.0
    quadratic: float = 0.0
    mains: float = 0.0
    mains_hz: float = 120.0
    drift: float = 0.0
    drift_s: float = 600.0
    creep: float = 0.0
    creep_s: float = 0.25
    proximity: float = 0.0
    proximity_range_rad: float = 0.23
    strip_gain: float = 0.0
    strip_width_rad: float = 0.07
    seed: int = 0

    def __post_init__(self) -> None:
        for field_ in fields(self):
            value = getattr(self, field_.name)
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"build finger: {field_.name} = {value}; want a finite number")
        if not (len(self.angles_rad) > 0 and np.all(np.isfinite(self.angles_rad))):
            raise ValueError(f"build finger: {len(self.angles_rad)} angles_rad; want one or more, all finite")
        for name in (
            "length_m",
            "gain",
            "mains_hz",
            "drift_s",
            "creep_s",
            "proximity_range_rad",
            "strip_width_rad",
        ):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"build finger: {name} = {value}; want a positive, finite number")
        for name in ("gain_scatter", "adhesion", "creep"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"build finger: {name} = {getattr(self, name)}; want 0 to 1")


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Hold what the scatter made of each element; immutable, each of shape (ns,)."""

    angles_rad: Array
    radii_m: Array
    gains: Array


def scattered(shape: FingerShape) -> Truth:
    """Draw the elements of a finger."""
    random, n = np.random.default_rng(shape.seed), len(shape.angles_rad)
    angle, depth, gain = random.uniform(-1, 1, n), random.uniform(-1, 1, n), random.normal(size=n)
    return Truth(
        np.array(shape.angles_rad) + shape.angle_scatter_rad * angle,
        shape.radius_m - shape.depth_m + shape.depth_scatter_m * depth,
        shape.gain * np.exp(shape.gain_scatter * gain),
    )


class TactileArray:
    """Elements of a finger with their gains, offsets, noise and converter.

    One caller at a time.

    Args:
        shape: the finger.
        gain: further factor on the output; a number or one for each element.
        offset: output without load [%].
        noise: standard deviation [%].
        resolution: step of the output [%]; 0 for none.
        seed: of noise.

    Raises:
        ValueError: a body or elements that cannot be.
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
        self.shape, self.truth = shape, scattered(shape)
        body = Layer(shape.core_m, shape.radius_m, shape.poisson_ratio, shape.shear_modulus_pa)
        radii_m, self._rows = np.unique(self.truth.radii_m, return_inverse=True)  # equally deep ones share a pattern
        self._rubber = rubber(body, tuple(radii_m.tolist()))
        self._factor, self.offset = (np.broadcast_to(np.asarray(v, dtype=np.float64), n).copy() for v in (gain, offset))
        self._noise, self._step = noise, resolution
        self._random = np.random.default_rng(seed)
        self._late = np.zeros(n)
        self._all = False
        self._time_s: float | None = None

    def mount(self, indenter_radius_m: float) -> None:
        """Tabulate an indenter, so that the first touch with it need not; takes a few tenths of a second.

        Raises:
            ValueError: the radius is negative or not a number.
        """
        if not indenter_radius_m >= 0.0:
            raise ValueError(f"mount indenter: radius {indenter_radius_m} m; want 0 (an edge) or more")
        self._rubber.pattern(_LOADS, indenter_radius_m, self.shape.adhesion)

    def mount_all(self) -> None:
        """Let round objects of all sizes come; tabulates the flat, and takes an object for the flat that touches as
        wide: a contact's strains per load depend on its width alone, up to the difference of arcs from their parabolas.
        """
        self._all = True
        self.mount(math.inf)

    def strain(self, load: float, angle_rad: float, indenter_radius_m: float) -> Array:
        """Return the radial strain at the elements, shape (ns,); zero without load.

        Args:
            load: P [N/m]; at most 0 is no contact; above 1000 the pattern keeps its shape.
            angle_rad: middle of contact.
            indenter_radius_m: rc; 0 for an edge, infinite for a flat.
        """
        if load <= 0.0:
            return np.zeros(self._rows.size)
        if self._all and math.isfinite(indenter_radius_m):
            share = indenter_radius_m / (indenter_radius_m + self.shape.radius_m)
            widened: Array = self.strain(load * share, angle_rad, math.inf) / share
            return widened
        table = self._rubber.pattern(_LOADS, indenter_radius_m, self.shape.adhesion)
        # even steps in the root of the load, along which the pattern changes evenly
        place = min(max((math.sqrt(load / _MOST) - _LEAST) / _STEP, 0.0), _STEPS - 1e-9)
        row = int(place)
        turn = np.remainder((self.truth.angles_rad - angle_rad) * (POINTS / math.tau), POINTS)
        column = turn.astype(np.intp) % POINTS
        after, s, u = (column + 1) % POINTS, turn - np.floor(turn), place - row
        low = (1 - s) * table[row, column, self._rows] + s * table[row, after, self._rows]
        high = (1 - s) * table[row + 1, column, self._rows] + s * table[row + 1, after, self._rows]
        strain: Array = load * ((1 - u) * low + u * high)
        if self.shape.strip_gain:
            away = np.remainder(self.truth.angles_rad - angle_rad + math.pi, math.tau) - math.pi
            strain *= 1.0 + self.shape.strip_gain * np.exp(-((away / self.shape.strip_width_rad) ** 2))
        return strain

    def read(
        self, force: float, angle_rad: float, indenter_radius_m: float, out: Array, time_s: float = 0.0,
        clearance_m: float = math.inf,
    ) -> Array:  # fmt: skip
        """Fill out, shape of the elements, with the outputs [%] under a contact force [N].

        Args:
            force: at most 0 is no contact.
            angle_rad, indenter_radius_m: of the contact.
            out: shape (ns,).
            time_s: of this reading, for creep, drift and the mains.
            clearance_m: of an indenter that does not touch, for the pull of a conductor.
        """
        shape = self.shape
        linear = self.strain(force / shape.length_m, angle_rad, indenter_radius_m) * (-100.0 / self.truth.gains)
        if shape.creep:
            linear = self._crept(linear, time_s)
        np.multiply(linear, self._factor * (1.0 + shape.quadratic * linear), out=out)
        out += self.offset
        clear = 0.0 if force > 0.0 else clearance_m
        if shape.proximity and clear < 10 * _CLEARANCE_M:
            away = np.abs(np.remainder(self.truth.angles_rad - angle_rad + math.pi, math.tau) - math.pi)
            out += shape.proximity * math.exp(-clear / _CLEARANCE_M) * np.exp(-away / shape.proximity_range_rad)
        if shape.drift:
            out += shape.drift * math.sin(math.tau * time_s / shape.drift_s)
        if shape.mains:
            out += shape.mains * math.sin(math.tau * shape.mains_hz * time_s)
        if self._noise:
            out += self._noise * self._random.standard_normal(out.size)
        if self._step:
            np.multiply(np.round(out / self._step), self._step, out=out)
        return out

    def _crept(self, linear: Array, time_s: float) -> Array:
        elapsed_s = 0.0 if self._time_s is None else max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        self._late += -math.expm1(-elapsed_s / self.shape.creep_s) * (linear - self._late)
        return (1.0 - self.shape.creep) * linear + self.shape.creep * self._late
