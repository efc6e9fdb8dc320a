"""The control-mode flags as plain integers, for code that runs per command: an IntFlag's ``&`` costs
a microsecond, an int's 30 ns. The numbers are those of sioms.protocol.flags.ControlMode."""

from typing import Final

from sioms.protocol.flags import ControlMode

JERK: Final = int(ControlMode.JERK)
ACCELERATION: Final = int(ControlMode.ACCELERATION)
VELOCITY: Final = int(ControlMode.VELOCITY)
POSITION: Final = int(ControlMode.POSITION)
FORCE: Final = int(ControlMode.FORCE)
FORCE_VELOCITY: Final = int(ControlMode.FORCE_VELOCITY)
TIME: Final = int(ControlMode.SPECIFIED_TIME)
SYNCH: Final = int(ControlMode.WAIT_FOR_EXTERNAL_SYNCH)
GAINS: Final = int(ControlMode.SPECIFIED_GAINS)
FORCE_OFFSET: Final = int(ControlMode.SPECIFIED_FORCE_OFFSET)
MAX_VEL_ACC: Final = int(ControlMode.SPECIFIED_MAX_VEL_ACC)
MAX_FORCE: Final = int(ControlMode.SPECIFIED_MAX_FORCE)
WAIT_MARKER: Final = int(ControlMode.SPECIFIED_WAIT_MARKER)
SIGNAL_MARKER: Final = int(ControlMode.SPECIFIED_SIGNAL_MARKER)
RELATIVE: Final = int(ControlMode.RELATIVE)

ANY_FORCE: Final = FORCE | FORCE_VELOCITY
SETTINGS: Final = GAINS | FORCE_OFFSET | MAX_VEL_ACC | MAX_FORCE
"""Flags whose fields stay in force for the axis after the command."""
PASS: Final = POSITION | VELOCITY
