"""Records that contradict themselves, or the model they come with, are refused before anything is searched.

Every column has a second witness: the controller makes the force from command and position, the motion needs the
force, neighbours in time are alike, records of one axis show one inertia. Where the witnesses disagree, whatever a
search found would be an account of the damage.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sioms.reconcile.checks import check_record
from sioms.reconcile.controlled import FOREIGN, beyond_feedback
from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import JUMP_COUNTS, JUMP_TIMES, LAWLESS, NOISY, SMOOTHER, TWICE

#: Samples (one row late is a way of logging, ``sampling``) that a column is looked for ahead or behind of the others.
SHIFTS = (*range(2, 31), 40, 50, 60, 80, 100)
#: A law that holds only otherwise leaves at most this share of what it leaves as the columns are named.
BETTER = 0.2
#: Rows at least in which a position is new, for their distances to tell anything.
LEAST_NEW = 20
#: How a note begins of a record that is left out.
LEFT_OUT = "left out, the others are used"
#: Of the samples so many are in records that can be used; else none is.
ENOUGH = 0.5


def usable(session: Session, seen: Session, model: AxisModel) -> tuple[Session, list[str]]:
    """Check every record by itself, and leave out those that cannot be used where most can.

    Args:
        seen: the same records, of which only what may take part in a choice is there.

    Returns:
        The session of what can be used, and what is to be said of the rest.

    Raises:
        BadInputError: too little can be used, or a final record cannot: with the record, what contradicts what, and
            what would be right.
    """
    for r in session.final:
        check_one(r, r, model)
    checked, refused = [], []
    for r, part in zip(session.records, seen.records, strict=True):
        try:
            check_one(r, part, model)
            checked.append((r, part))
        except BadInputError as e:
            refused.append(e)
    odd = _of_another_loop([part for _, part in checked], model)
    kept = [r for (r, _), error in zip(checked, odd, strict=True) if error is None]
    refused += [error for error in odd if error is not None]
    if not refused:
        return session, []
    if sum(map(len, kept)) < ENOUGH * session.samples:
        raise refused[0]
    notes = [f"{LEFT_OUT}: {e}" for e in refused]
    return replace(session, records=tuple(kept), continuous=False), notes


def _of_another_loop(records: list[Record], model: AxisModel) -> list[BadInputError | None]:
    """Say of records why the controller does not make their forces, where it makes those of others: it is one loop.

    A limit below the stated one is the axis's own.
    """
    if model.controller is None:
        return [None] * len(records)
    offs = []
    for r in records:
        limit = min(model.controller.limit, float(np.max(np.abs(r.force), initial=0.0)))
        offs.append(beyond_feedback(r, replace(model, controller=replace(model.controller, limit=limit))))
    holds = [r.name for r, off in zip(records, offs, strict=True) if r.command is not None and off <= 0.1 * FOREIGN]
    return [
        BadInputError(
            f"read record {r.name}: the controller of the model does not make its force from command and position (off "
            f"by {100 * off:.0f} % of the force), as it does in {holds[0]}; is it of another run, in another order, or "
            "with something added to the force? what was added is its feedforward"
        )
        if holds and off > FOREIGN
        else None
        for r, off in zip(records, offs, strict=True)
    ]


def check_one(record: Record, r: Record, model: AxisModel) -> None:
    """Check a record by itself.

    Args:
        record: as a whole, for its form.
        r: what may be looked at of it.

    Raises:
        BadInputError: it cannot be used.
    """
    check_record(record, model)
    where = f"read record {record.name}"
    _check_rows(r, where)
    _check_held(r, where)
    _check_smooth(r, model, where)
    _check_order(r, model, where)
    _check_jumps(r, model, where)
    _check_law(r, model, where)


def _check_rows(r: Record, where: str) -> None:
    """Find rows that come twice; a time column would have shown them."""
    twice = (np.diff(r.position) == 0.0) & (np.diff(r.force) == 0.0)
    moved = np.diff(r.position) != 0.0
    for first in (0, 1):
        pairs, between = twice[first::2], moved[1 - first :: 2]
        if len(pairs) and np.mean(pairs) > TWICE and np.mean(between) > 1.0 - np.mean(pairs) + 0.1:
            raise BadInputError(
                f"{where}: {100 * np.mean(pairs):.0f} % of the rows come twice, and there is no time that would tell "
                "them apart; needs every sample once, or a time column"
            )


def _check_held(r: Record, where: str) -> None:
    """Find a position that is new at every so many rows only: its sensor, or what reads it, is slower than the log."""
    new = np.flatnonzero(np.diff(r.position))
    if len(new) >= LEAST_NEW and (every := int(np.gcd.reduce(np.diff(new)))) > 1:
        raise BadInputError(
            f"{where}: the position is new in every row of {every} only, and repeated in between; needs the rows in "
            "which it is new, with their sample time in the model"
        )


def _check_smooth(r: Record, model: AxisModel, where: str) -> None:
    """Find a position that is noise, or whose rows are in no order: neighbours in time must be alike."""
    for name, a in (("position", r.position), ("command", r.command)):
        if a is None or np.ptp(a) < 8.0 * model.resolution:
            continue
        noise = _roughness(a)
        if noise > NOISY * float(np.std(a)):
            raise BadInputError(
                f"{where}: {name} changes from row to row as much as it does altogether "
                f"({100 * noise / float(np.std(a)):.0f} %); "
                "it is noise, or the rows are in no order of time"
            )


def _check_order(r: Record, model: AxisModel, where: str) -> None:
    """Find neighbours that have changed places: a motion is rougher with them exchanged, not smoother; so is what is
    commanded, also where an encoder hardly counts.
    """
    for name, a in (("position", r.position), ("command", r.command)):
        if a is None or np.ptp(a) < 8.0 * model.resolution:
            continue
        if min(_roughness(_exchanged(a, first)) for first in (0, 1)) < SMOOTHER * _roughness(a):
            raise BadInputError(
                f"{where}: the {name} is smoother with every two neighbouring rows exchanged; the rows are in no "
                "order of time"
            )


def _roughness(a: Array) -> float:
    """Return the size of the third differences, of which noise and a wrong order make much and a motion little."""
    return float(np.sqrt(np.mean(np.diff(a, 3) ** 2) / 20.0))


def _exchanged(a: Array, first: int) -> Array:
    """Exchange the rows of every pair, beginning with a row."""
    out = a.copy()
    n = (len(a) - first) // 2 * 2
    out[first : first + n] = a[first : first + n].reshape(-1, 2)[:, ::-1].ravel()
    return out


def _check_jumps(r: Record, model: AxisModel, where: str) -> None:
    """Find places where the position leaps as no machine moves: a wrapped angle, lost counts, a flipped bit."""
    bend = np.abs(np.diff(r.position, 2))
    usual = float(np.quantile(bend, 0.98)) + JUMP_COUNTS * model.resolution
    odd = np.flatnonzero(bend > JUMP_TIMES * usual)
    if len(odd):
        i = int(odd[0]) + 1
        size = max(abs(r.position[i + 1] - r.position[i]), abs(r.position[i] - r.position[i - 1]))
        raise BadInputError(
            f"{where}: position leaps by {size:.4g} {model.position_unit} at sample {i} ({len(odd)} such places), "
            f"{bend[i - 1] / usual:.0f} times as far as its motion goes elsewhere: a wrapped angle, lost counts, a "
            "spike, or a log that stood still meanwhile; unwrap it, or cut the record there"
        )


def _check_law(r: Record, model: AxisModel, where: str) -> None:
    """Where the controller does not make the force, see whether it would if the columns were others.

    A column that is another one, or stands some rows ahead of the others, shows so; a controller that is none of the
    model's does not.
    """
    if model.controller is None or r.command is None or (given := beyond_feedback(r, model)) <= 0.1 * FOREIGN:
        return
    found = ((beyond_feedback(other, model), text) for text, other in _otherwise(r, r.command))
    left, text = min(found, key=lambda f: f[0])
    if left < min(BETTER * given, FOREIGN):
        raise BadInputError(
            f"{where}: the controller of the model makes the recorded force from command and position only if {text} "
            f"(off by {100 * left:.2g} % of the force then, {100 * given:.3g} % as the columns are named)"
        )


def check_law(session: Session, model: AxisModel) -> None:
    """Check that the controller has anything to do with the force, where the rows are those of its loop.

    Raises:
        BadInputError: it has not.
    """
    for r in session.records:
        if model.controller is not None and (off := beyond_feedback(r, model)) > LAWLESS:
            raise BadInputError(
                f"read record {r.name}: the controller of the model does not make the recorded force from command and "
                f"position (off by {100 * off:.0f} % of the force): it is that of another axis, the columns are of "
                "different runs, or rows are missing; where only the controller is not known, or something is added to "
                "its force, leave out [controller]"
            )


def _otherwise(r: Record, command: Array) -> Iterable[tuple[str, Record]]:
    added = None if r.feedforward is None else -r.feedforward
    yield "the sign of the force is turned round", replace(r, force=-r.force, feedforward=added)
    yield "command and position are exchanged", replace(r, command=r.position, position=command)
    if r.force_measured is not None:
        yield "force and force_measured are exchanged", replace(r, force=r.force_measured)
    yield "the command is turned round", replace(r, command=-command)
    yield "the rows are taken in reverse order", r.only(slice(None, None, -1))
    for n in SHIFTS:
        for k in (n, -n):
            part = slice(max(k, 0), len(r) + min(k, 0))
            shifted = slice(max(-k, 0), len(r) + min(-k, 0))
            moved = replace(r.only(part), force=r.force[shifted], feedforward=_cut(r.feedforward, shifted))
            when = f"{n} rows {'earlier' if k > 0 else 'later'}"
            yield f"the force is taken {when}", moved
            yield f"the command is taken {when}", replace(r.only(part), command=command[shifted])
            yield f"the position is taken {when}", replace(r.only(part), position=r.position[shifted])


def _cut(a: Array | None, part: slice) -> Array | None:
    return None if a is None else a[part]
