"""Motion that another machine imposes: rigs for friction and dampers, whose force is what the motion takes.

There is no inertia to speak of, and without one no force moves anything. So the axis is given an inertia, and its force
what that takes besides, by the measured acceleration: an axis that moves as the rig did just where its friction is the
rig's. The inertia is as large as makes both parts of the force as large as each other; it decides only how an error of
force shows as one of position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.screen import low_passed

#: The acceleration is that of the measured motion up to so many Hz, or up to this share of the rate of the rows.
UP_TO_HZ, OF_RATE = 25.0, 0.1


def carried(session: Session, nominal: AxisModel) -> tuple[Session, AxisModel]:
    """Give a rig an inertia, and its records the force of that; the force is known at the rows.

    Raises:
        BadInputError: nothing accelerates, or nothing takes a force.
    """
    dt, every = nominal.sample_time_s, (*session.records, *session.final)
    pushed, moved = _size([r.force for r in every]), _size([_acceleration(r, dt) for r in every])
    if not (pushed > 0.0 and moved > 0.0):
        what = "speed" if pushed > 0.0 else "force"
        raise BadInputError(f"read records: the {what} never changes; needs motion to and fro, and the force it takes")
    return _laid(session, pushed / moved, dt), replace(nominal, inertia=nominal.inertia + pushed / moved)


def _laid(session: Session, inertia: float, dt: float) -> Session:
    def lay(records: Sequence[Record]) -> tuple[Record, ...]:
        return tuple(replace(r, force=r.force + inertia * _acceleration(r, dt)) for r in records)

    halves = tuple(_laid(half, inertia, dt) for half in session.halves)
    return replace(session, records=lay(session.records), final=lay(session.final), halves=halves, loop_time_s=0.0)


def _acceleration(record: Record, dt: float) -> Array:
    """Return the acceleration at every row, without phase, shape (n,)."""
    x = low_passed(record.position, min(UP_TO_HZ, OF_RATE / dt), dt)
    a = np.diff(x, 2) / dt**2
    return np.concatenate([a[:1], a, a[-1:]])


def _size(parts: Sequence[Array]) -> float:
    return float(np.std(np.concatenate([p - np.mean(p) for p in parts])))
