"""Recorded known loads and readings of a force/torque sensor; what cannot be used is refused before anything is
fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.force.belief import Floats, Loads, readings
from sioms.reconcile.mistakes import in_another_unit
from sioms.reconcile.sensors.effect import SensorModel

LEAST_ROWS = 40
FACTOR = 2.0  # a component off by more is in another unit: lbf for N make 4.4
LEAST_RANGE, MOST_RANGE = 0.01, 5.0  # shares of full range between which the largest load lies
LEAST_WHOLE = 0.8  # share of the rows that must hold numbers
LONG_REST, REST_S = (
    200.0,
    3600.0,
)  # steps of time, and seconds, after which a sensor is as after another power-on
WELL_LIKE, EXCHANGED = (
    0.9,
    0.98,
)  # below the first with its own load and above the second with another's: columns are exchanged
LEAST_LIKE = 0.3  # correlation of readings and loads below which it is another sensor
LOADED = 0.05  # of full range, root mean square about the mean: a reading that follows no such load is broken


@dataclass(frozen=True, slots=True, eq=False)
class ForceRecords:
    """Recorded known loads and readings [N, N m], shape (n, components), in the order of time.

    Attributes:
        time: [s]; temperature: [deg C], nan without; record: number of the file of each row; shape (n,).
    """

    names: tuple[str, ...]
    load: Floats
    reading: Floats
    time: Floats
    temperature: Floats
    record: NDArray[np.int64]


def unit_of(name: str) -> str:
    """Return N m for torques (names that begin with t or m), else N."""
    return "N m" if name[:1].lower() in ("t", "m") else "N"


def whole_rows(r: ForceRecords) -> tuple[ForceRecords, list[str]]:
    """Leave out rows with a value that is not a number, and number the rows where no time was recorded.

    Returns:
        The records, as they are where too many rows would go, and notes.
    """
    notes = []
    if len(r.time) and np.isnan(r.time).all():
        r = replace(r, time=np.arange(len(r.time), dtype=np.float64))
        notes.append("no time was recorded: rows are taken for seconds, and what is per second is per row")
    good = np.isfinite(r.load).all(1) & np.isfinite(r.reading).all(1) & np.isfinite(r.time)
    if LEAST_WHOLE <= good.mean() < 1.0:
        notes.append(f"{int(np.sum(~good))} of {len(good)} rows hold values that are no numbers and are left out")
        r = ForceRecords(r.names, r.load[good], r.reading[good], r.time[good], r.temperature[good], r.record[good])
    return r, notes


def check(r: ForceRecords, model: SensorModel) -> list[str]:
    """Check the records by themselves and against the model.

    Raises:
        BadInputError: with what is wrong and what would be right.
    """
    if len(r.load) < LEAST_ROWS:
        raise BadInputError(f"read loads: {len(r.load)} rows are too few; record {LEAST_ROWS} or more")
    for what, values in (("load", r.load), ("reading", r.reading), ("time", r.time[:, None])):
        bad = ~np.isfinite(values)
        if bad.any():
            column = int(np.flatnonzero(bad.any(0))[0])
            name = what if what == "time" else f"{what} {r.names[column]}"
            raise BadInputError(
                f"read loads: {name} has {int(bad[:, column].sum())} of {len(bad)} values that are no numbers; needs "
                f"numbers in {100 * LEAST_WHOLE:.0f} % of the rows"
            )
    steps = np.diff(r.time)[np.diff(r.record) == 0]
    if np.any(steps < 0.0) or not np.any(steps > 0.0):
        raise BadInputError("read loads: time does not rise; needs seconds in the order of recording")
    notes: list[str] = []
    step = np.where(np.diff(r.record) == 0, np.diff(r.time), 0.0)
    if step.max() > max(LONG_REST * float(np.median(step)), REST_S):
        notes.append(
            f"time jumps by {step.max():.4g} s after row {int(step.argmax()) + 1}: what follows a long rest may have "
            "another zero; give it as a file of its own"
        )
    moved = np.ptp(r.load, axis=0) > 1e-3 * model.base.full
    if not moved.any():
        raise BadInputError("read loads: no load changes by a thousandth of full range; apply known loads")
    share = np.max(np.abs(r.load) / model.base.full, axis=0)
    if not LEAST_RANGE < share.max() < MOST_RANGE:
        i = int(share.argmax())
        raise BadInputError(
            f"compare loads with the full range: {r.names[i]} is loaded up to {np.max(np.abs(r.load[:, i])):.4g}, "
            f"{share[i]:.3g} times its full_range of {model.base.full[i]:.4g} {unit_of(r.names[i])}; needs "
            f"{LEAST_RANGE:g} to {MOST_RANGE:g} times, in one unit"
        )
    for n, here in zip(r.names, moved, strict=True):
        if not here:
            notes.append(f"{n} was never loaded: its gain and what it gives to others are not judged")
    for i, n in enumerate(r.names):
        if np.ptp(r.reading[:, i]) == 0.0:
            raise BadInputError(
                f"read loads: reading {n} is constant at {r.reading[0, i]:g} {unit_of(n)}; the component is dead or "
                "the wrong column was named"
            )
    _check_match(r, model, moved)
    return notes


def _check_match(r: ForceRecords, model: SensorModel, moved: NDArray[np.bool_]) -> None:
    loads = Loads(r.load / model.base.full, r.time - r.time[0], np.zeros(len(r.time)), r.record)
    said = readings(model.belief(), loads) * model.base.full
    said, got = said - said.mean(0), r.reading - r.reading.mean(0)
    like, broken = [], list[str]()
    for i in np.flatnonzero(moved):
        n, s, g = r.names[i], said[:, i], got[:, i]
        correlation = float(s @ g / np.sqrt((s @ s) * (g @ g) + 1e-300))
        like.append(abs(correlation))
        if abs(correlation) < WELL_LIKE:
            _raise_exchanged(r, int(i), got[:, i])
        if abs(correlation) < LEAST_LIKE:
            broken += [n] if float(np.std(s)) > LOADED * model.base.full[i] else []
            continue
        scale = float(s @ g / (s @ s))
        if scale < 0.0:
            raise BadInputError(
                f"compare readings with loads: {n} falls when its load rises; the sign of one of them is turned round"
            )
        if not 1.0 / FACTOR < scale < FACTOR:
            raise BadInputError(
                f"compare readings with loads: {n} reads {scale:.4g} times its load; {in_another_unit(scale)} needs "
                "both in one, and no sensor is off by so much: a scale that is not known stands in columns.toml"
            )
    if np.median(like) < LEAST_LIKE:
        raise BadInputError(
            f"compare readings with loads: they agree to {100 * float(np.median(like)):.0f} % (correlation); it is "
            "another sensor, or columns are exchanged"
        )
    if broken:
        raise BadInputError(
            f"compare readings with loads: {' and '.join(broken)} of the readings do not follow the own load "
            f"(correlation below {LEAST_LIKE:g}), the others do; is a channel broken, or of another run?"
        )


def _raise_exchanged(r: ForceRecords, i: int, got: Floats) -> None:
    """Refuse a reading that goes with the load of another component instead of its own."""
    for j, name in enumerate(r.names):
        other = r.load[:, j] - r.load[:, j].mean()
        if j != i and abs(got @ other) > EXCHANGED * np.sqrt((got @ got) * (other @ other)) > 0.0:
            raise BadInputError(
                f"compare readings with loads: {r.names[i]} does not go with its own load but with that of {name}; "
                "the columns are exchanged"
            )
