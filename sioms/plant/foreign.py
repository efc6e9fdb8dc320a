"""Laws of motion from elsewhere: what a bank of motors takes beyond the effects of its own catalogue.

Whoever has a law as an object that adds a force (a library of effects, a user's file) hands it in here; the bank
treats it like its own.
"""

from dataclasses import dataclass

from .drive import DriveEffect
from .forces import Force


@dataclass(frozen=True, slots=True)
class Laws:
    """Further laws of a bank.

    Args:
        drive: change the force of the drive once a tick, after the effects of the drive.
        motor: add a force on the motor, in every substep.
        resistance: add a level of dry friction, at least 0, in every substep; it varies as all dry friction of the bank does.
    """

    drive: tuple[DriveEffect, ...] = ()
    motor: tuple[Force, ...] = ()
    resistance: tuple[Force, ...] = ()
