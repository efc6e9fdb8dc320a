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

from sioms.reconcile.checks import check_record
from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.screen import low_passed
from sioms.reconcile.timing import LEAST_SAMPLES

#: The acceleration is that of the measured motion up to so many Hz, or up to this share of the rate of the rows; up to
#: twice, four times, ... as many, and to the second share, where noise of the position makes less than the last of it.
UP_TO_HZ, OF_RATE, FASTEST, CLEAN = 25.0, 0.1, 0.25, 0.05
#: Periods of that frequency at either end of a record that are left out.
EDGE = 2.0
#: Noise of the position makes less than this share of it.
OF_NOISE = 0.5
#: The speed changes by this share of the largest, or it does not.
STEADY = 0.01
#: Motion is to and fro where its mean speed is less than this share of the root mean square, and driven where this
#: share of the force goes with the speed.
TO_AND_FRO, DRIVES = 0.5, 0.3


def carried(session: Session, nominal: AxisModel) -> tuple[Session, AxisModel]:
    """Give a rig an inertia, and its records the force of that; the force is known at the rows.

    Raises:
        BadInputError: a record is none, nothing accelerates, nothing takes a force, or the force drives the motion.
    """
    dt, every = nominal.sample_time_s, (*session.records, *session.final)
    if not session.records:
        raise BadInputError("read records: there are none; give at least one recording of the rig")
    for r in every:
        sound = len(r) >= LEAST_SAMPLES and len(r.force) == len(r) and np.all(np.isfinite(r.position + r.force))
        if not sound:
            check_record(r, nominal)
    pushed = _size([r.force for r in every])
    hz = min(UP_TO_HZ, OF_RATE / dt)
    speeds = [np.diff(low_passed(r.position, hz, dt)) for r in every]
    if not pushed > 0.0 or not _size(speeds) > STEADY * max(float(np.max(np.abs(v))) for v in speeds):
        what = "speed" if pushed > 0.0 else "force"
        raise BadInputError(f"read records: the {what} never changes; needs motion to and fro, and the force it takes")
    _check_resolved(every, hz, dt)
    _check_sign(every, hz, dt)
    hz = _as_fast_as_told(every, hz, nominal)
    inertia = pushed / _size([_acceleration(r, hz, dt) for r in every])
    return _laid(session, inertia, hz, dt), replace(nominal, inertia=nominal.inertia + inertia)


def _check_resolved(records: Sequence[Record], hz: float, dt: float) -> None:
    """Check that the acceleration is more than noise.

    Raises:
        BadInputError: it is not; friction at low speed would be read into the steps of an encoder.
    """
    noise = _size([r.position - low_passed(r.position, hz, dt) for r in records])
    share = _made(noise, hz, dt) / _size([_acceleration(r, hz, dt) for r in records])
    if share > OF_NOISE:
        raise BadInputError(
            f"read records: noise or steps of the position, {noise:.2g} root mean square, make {100 * share:.0f} % of "
            f"the acceleration up to {hz:.3g} Hz; needs {100 * OF_NOISE:.0f} % or less: a finer sensor of position, or "
            "faster motion"
        )


def _made(noise: float, hz: float, dt: float) -> float:
    """Return the acceleration that white noise of the position makes, up to a frequency, root mean square."""
    return float(noise * np.sqrt(2.0 * hz * dt / 5.0) * (2.0 * np.pi * hz) ** 2)


def _as_fast_as_told(records: Sequence[Record], hz: float, nominal: AxisModel) -> float:
    """Return the highest frequency up to which the acceleration is hardly noise: a turn may be over in a few rows."""
    dt = nominal.sample_time_s
    third = np.abs(np.concatenate([np.diff(r.position, 3) for r in records]))
    noise = max(1.4826 * float(np.median(third)) / np.sqrt(20.0), nominal.resolution / np.sqrt(12.0))
    while 2.0 * hz * dt <= FASTEST:
        if _made(noise, 2.0 * hz, dt) > CLEAN * _size([_acceleration(r, 2.0 * hz, dt) for r in records]):
            break
        hz *= 2.0
    return hz


def _check_sign(records: Sequence[Record], hz: float, dt: float) -> None:
    """Check that motion to and fro takes power, whatever spring, mass or weight there is.

    Raises:
        BadInputError: it gives power.
    """
    x = np.concatenate([r.position for r in records])
    v = np.concatenate([np.gradient(low_passed(r.position, hz, dt), dt) for r in records])
    a = np.concatenate([_acceleration(r, hz, dt) for r in records])
    force = np.concatenate([r.force for r in records])
    columns = np.column_stack([v, x - np.mean(x), a, np.ones_like(v)])
    columns /= np.linalg.norm(columns, axis=0)
    along = float(np.linalg.lstsq(columns, force, rcond=1e-6)[0][0])
    if abs(np.mean(v)) < TO_AND_FRO * np.sqrt(np.mean(v**2)) and along < -DRIVES * np.std(force) * np.sqrt(len(force)):
        raise BadInputError(
            "read records: the force drives the motion, which should take it; its sign, or that of the position, is "
            "turned round (a negative scale in columns.toml)"
        )


def _laid(session: Session, inertia: float, hz: float, dt: float) -> Session:
    edge = round(EDGE / (hz * dt))  # where the filter knows one side only

    def lay(records: Sequence[Record]) -> tuple[Record, ...]:
        laid = (replace(r, force=r.force + inertia * _acceleration(r, hz, dt)) for r in records)
        return tuple(r.cut(edge, len(r) - edge) for r in laid)

    halves = tuple(_laid(half, inertia, hz, dt) for half in session.halves)
    return replace(session, records=lay(session.records), final=lay(session.final), halves=halves, loop_time_s=0.0)


def _acceleration(record: Record, hz: float, dt: float) -> Array:
    """Return the acceleration at every row up to a frequency, without phase, shape (n,)."""
    a = np.diff(low_passed(record.position, hz, dt), 2) / dt**2
    return np.concatenate([a[:1], a, a[-1:]])


def _size(parts: Sequence[Array]) -> float:
    return float(np.std(np.concatenate([p - np.mean(p) for p in parts])))
