"""What the motion core and its host say to each other: errors, events, and the seams of markers and kept positions."""

from enum import Enum
from typing import Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray


class CommandError(Exception):
    """A command is refused; nothing of the written array was taken.

    Args:
        errno_: POSIX errno that a client sees (EINVAL, ERANGE, EAGAIN, EPERM, EBUSY, EIO).
        text: sentence that names axis, field, value and unit, and what would be accepted.
    """

    def __init__(self, errno_: int, text: str) -> None:
        super().__init__(text)
        self.errno = errno_


class RecordError(CommandError):
    """A record of a written array is bad.

    Args:
        errno_: POSIX errno.
        axis: bank axis and name, for the sentence; empty when the record names none.
        record: its index in the written array.
        what: what is wrong with it, and what would be accepted.
    """

    def __init__(self, errno_: int, axis: str, record: int, what: str) -> None:
        super().__init__(errno_, f"write{' axis ' + axis if axis else ''}, record {record}: {what}")
        self._parts = (axis, record, what)

    def later(self, records: int) -> "RecordError":
        """Return the same of a record so many further on: the array was looked at in pieces."""
        axis, record, what = self._parts
        return RecordError(self.errno, axis, record + records, what)


class MarkerPort(Protocol):
    """The marker table as the motion core needs it; the kit binds it to shared memory."""

    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        """Return (number, generation) of a marker named in a record.

        Args:
            token_or_number: token, or for waiting also the bare number.
            signal: True when the record wants to signal it, which needs the key.

        Raises:
            CommandError: EINVAL when the marker is not reserved, EPERM when the key is wrong.
        """

    def state(self, number: int, generation: int) -> bool | None:
        """Tell whether this generation was signalled; None when it was freed."""

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        """Signal this generation once."""


class EventKind(Enum):
    """What happened to axes in a tick or a verb."""

    STARTED = "started"
    ENDED = "ended"
    IDLE = "idle"
    DROPPED = "dropped"
    """The buffer was emptied without being asked for by its writer; errno and text say why."""
    FAULT = "fault"
    HOMED = "homed"


class Event(Struct, frozen=True):
    """One thing that happened at once to one or many axes.

    Args:
        kind: what happened.
        axes: bank axes it happened to.
        stamp_ns: instant [ns]; for STARTED, ENDED and IDLE the tick that saw it.
        errno: for DROPPED and FAULT the errno that waiters receive, else 0.
        text: for DROPPED and FAULT the reason.
    """

    kind: EventKind
    axes: tuple[int, ...]
    stamp_ns: int
    errno: int = 0
    text: str = ""


class Keeper(Protocol):
    """Where positions outlive the process; the kit binds it to a file (docs/decisions/0070)."""

    def restored(self, raw: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the offset from raw to position of each axis (n,), 0 where none is restored, and which are homed.

        Args:
            raw: the first measurement (n,).
        """

    def note(
        self,
        at_rest: NDArray[np.bool_],
        homed: NDArray[np.bool_],
        raw: NDArray[np.float64],
        position: NDArray[np.float64],
        now_ns: int,
    ) -> None:
        """Keep the present state of all axes (n,); called before anything moves an axis that has been told to rest."""
