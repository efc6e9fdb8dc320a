"""Laws of motion from elsewhere: what a bank of motors takes beyond the effects of its own catalogue.

Whoever has a law as an object that adds a force (a library of effects, a user's file) hands it in here; the bank
treats it like its own. What turns a model file into such laws, or into a sensor, is found by an entry point, so that a
simulated device loads it only where a file is given, and knows nothing of who wrote it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from .drive import DriveEffect
from .effects import Effect
from .forces import Force
from .parameters import Motor

GROUP = "sioms.twins"
Floats = NDArray[np.float64]


class Laws(Struct, frozen=True):
    """Further laws of a bank.

    Args:
        drive: change the force of the drive once a tick, after the effects of the drive.
        motor: add a force on the motor, in every substep.
        resistance: add a level of dry friction, at least 0, in every substep; it varies as all dry friction of the bank
            does.
    """

    drive: tuple[DriveEffect, ...] = ()
    motor: tuple[Force, ...] = ()
    resistance: tuple[Force, ...] = ()


class TwinAxes(Protocol):
    """The entry point ``axes``: models of some axes of a bank to what the plant is built of."""

    def __call__(
        self,
        files: Mapping[int, tuple[str, str]],
        motors: Sequence[Motor],
        axes: Sequence[tuple[str, str]],
        tick_s: float,
    ) -> tuple[Sequence[Motor], tuple[Effect, ...], Laws]:
        """Build the twins.

        Args:
            files: path and text of each model, by the number of the motor.
            motors: as configured; stops, switches, wall, start and the limit of the drive stay theirs.
            axes: name and unit of position, "m" or "rad", of each motor.

        Raises:
            ValueError: a file makes no sense, is of the other kind of axis, or no plant can carry it out.
        """
        ...


class TwinForce(Protocol):
    """A force/torque sensor as a model has it; the entry point ``force`` makes it of (table, path, components)."""

    def read(self, load: Floats, time_s: float) -> Floats:
        """Return the readings [N, N m] under a load [N, N m], shape (components,), at a time [s]; times rise."""
        ...


class TwinFinger(Protocol):
    """A finger as a model has it; the entry point ``finger`` makes it of (table, path, length_m, noise, resolution,
    seed).
    """

    @property
    def count(self) -> int:
        """Number of elements."""
        ...

    def mount(self, indenter_radius_m: float) -> None:
        """Tabulate an indenter, so that the first touch with it need not."""
        ...

    def read(
        self, force: float, angle_rad: float, indenter_radius_m: float, out: Floats, time_s: float = 0.0
    ) -> Floats:
        """Fill out with the outputs [%] under a contact force [N] at a place [rad] and a time [s]."""
        ...


def twin(kind: str) -> Any:
    """Return what makes twins of a kind from model files: of ``axes``, a ``finger`` or a sensor of ``force``.

    Raises:
        ValueError: no package that is installed does.
    """
    from importlib.metadata import entry_points  # takes as long as all of the plant; most devices have no such file

    for point in entry_points(group=GROUP, name=kind):
        return point.load()
    raise ValueError(f"model_file: no installed package makes a twin ({kind}); its entry point goes to [{GROUP}]")
