"""A finger touched in numbers: exact contacts on scattered elements, for the tests of estimation and calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.tactile import contact, emap, sensing
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, nominal_finger
from sioms.tactile.indenter import Round, Wedge
from sioms.tactile.touches import Touches

Floats = NDArray[np.float64]
ANGLES = np.radians(143.0 - 9.22 * np.arange(16))
Strains = Callable[[float, float, float], Floats]


@pytest.fixture(scope="session")
def nominal() -> Finger:
    """Return the published finger: 16 elements, 0.1 % strain noise."""
    return nominal_finger(FINGER_B, ANGLES, 10.3e-3, 1.0, 1e-3)


def exact_strains(angles: Floats, radii: Floats | float, extent: float = 0.0) -> Strains:
    """Return a function (place [rad], load [N/m], rc [m]; 0 an edge) -> strains by the bounded contact, 100 wave
    numbers.

    Means over elements of a half angle `extent`, by Gauss's rule.
    """
    points, weights = np.polynomial.legendre.leggauss(6 if extent else 1)
    maps = [emap.e_map(FINGER_B, angles + extent * x, radii, 100) for x in points]
    matrix = np.tensordot(weights / 2.0, maps, axes=1)
    solved: dict[tuple[float, float], contact.Contact] = {}

    def strains(place: float, load: float, rc: float) -> Floats:
        if (load, rc) not in solved:
            indenter = Wedge(np.pi / 4) if rc == 0.0 else Round(rc)
            solved[load, rc] = contact.width_for_load(FINGER_B, indenter, load)
        total: Floats = matrix @ solved[load, rc].series(place, 100)
        return total

    return strains


@pytest.fixture(scope="session")
def touch() -> Strains:
    """Return the strains of the published finger under a touch."""
    return exact_strains(ANGLES, 10.3e-3)


class Made:
    """A moulded finger whose truth is known: scattered places, depths and gains, one quadratic, noise."""

    def __init__(self, seed: int = 3) -> None:
        random = np.random.default_rng(seed)
        self.angles = ANGLES + np.radians(random.normal(0.0, 0.4, 16))
        self.radii = 10.3e-3 + 1e-4 * random.uniform(-2.0, 2.0, 16)
        self.gain = random.uniform(2.5, 3.5, 16)
        self.quadratic = 4.0  # per unit of output
        self.noise = 5e-4
        self._random = random
        self.extent = 0.05
        self._strains = exact_strains(self.angles, self.radii, self.extent)

    def output(self, place: float, load: float, rc: float, frames: int = 20) -> Floats:
        """Return the averaged output of one touch."""
        linear = -self._strains(place, load, rc) / self.gain
        noise = self.noise * np.sqrt(2.0 / frames) * self._random.normal(size=16)
        total: Floats = linear + self.quadratic * linear**2 + noise
        return total

    def touches(self) -> Touches:
        """Return 200 N/m edges every second degree, some flats and rounds, and four load series."""
        plan = [(np.radians(d), 200.0, 0.0) for d in range(0, 151, 2)]
        plan += [(np.radians(d), 200.0, rc) for rc in (6e-3, np.inf) for d in range(15, 136, 5)]
        plan += [(np.radians(d), p, 1.6e-3) for d in range(10, 141, 10) for p in (50.0, 100.0, 150.0, 250.0)]
        angle, load, radius = (np.array(column) for column in zip(*plan, strict=True))
        output = np.array([self.output(*place) for place in plan])
        return Touches(output, angle, load, radius, load.copy(), np.full(16, self.noise))


@pytest.fixture(scope="session")
def made() -> Made:
    """Return a moulded finger."""
    return Made()


@pytest.fixture(scope="module")
def one_estimator() -> Iterator[None]:
    """Build the estimator of each finger once for all cases: it holds no state from frame to frame."""
    with pytest.MonkeyPatch.context() as patch:
        built: dict[bytes, Estimator] = {}

        def estimator(finger: Finger, **options: Any) -> Estimator:
            key = msgspec.json.encode((finger, options))
            if key not in built:
                built[key] = Estimator(finger, **options)
            return built[key]

        patch.setattr(sensing, "Estimator", estimator)
        yield
