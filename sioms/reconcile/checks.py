"""Refuse data that cannot be used, before anything is fitted, and say why."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

from sioms.reconcile.controlled import FOREIGN, beyond_feedback
from sioms.reconcile.effect import Array
from sioms.reconcile.mistakes import in_another_unit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.timing import LEAST_SAMPLES, MOST
from sioms.reconcile.verdict import BadInputError

LEAST_COUNTS = 20
LEAST_TOTAL_S = 2.0
#: A channel that is so many times another one that should be like it is in another unit.
OTHER_UNIT = 30.0
#: Measured may be so many times the commanded force; samples it is judged on, their share of the largest force, and
#: seconds of a mean.
FORCE_SCALE, LEAST_SLOW, SLOW_SHARE, SLOW_S = 1.33, 200, 0.8, 0.05
#: A log in which more of the steps than this are off by half was polled: there is no place to cut it at.
POLLED = 0.05
#: Share of samples at the controller's limit above which nothing is left to learn, and above which it is said.
SATURATED, OFTEN = 0.9, 0.5


def check(session: Session, model: AxisModel) -> tuple[str, ...]:
    """Check the records by themselves.

    Returns:
        Notes on what is missing and narrows what can be named.

    Raises:
        BadInputError: with the record, what is wrong and what would be right.
    """
    if not session.records:
        raise BadInputError("read records: there are none; give at least one recording of the axis")
    for r in session.records + session.final:
        check_record(r, model)
    seconds = session.samples * model.sample_time_s
    if seconds < LEAST_TOTAL_S:
        raise BadInputError(
            f"read records: {seconds:.2f} s altogether is too short; record {LEAST_TOTAL_S:g} s or more"
        )
    travel = max(float(np.ptp(r.position)) for r in session.records)
    if travel < LEAST_COUNTS * model.resolution:
        raise BadInputError(
            f"read records: no motion, position stays within {travel:.3g} {model.position_unit} "
            f"({travel / model.resolution:.0f} counts); record moves of {LEAST_COUNTS} counts and far more"
        )
    _check_measured(session, model)
    return tuple(_notes(session, model))


def check_record(r: Record, model: AxisModel) -> None:
    """Check one record by itself.

    Raises:
        BadInputError: with what is wrong and what would be right.
    """
    where = f"read record {r.name}"
    if len(r) < LEAST_SAMPLES:
        raise BadInputError(f"{where}: {len(r)} samples are too few; needs {LEAST_SAMPLES}")
    for name, a in (
        ("position", r.position),
        ("force", r.force),
        ("command", r.command),
        ("force_measured", r.force_measured),
        ("feedforward", r.feedforward),
        ("external", r.external),
    ):
        if a is None:
            continue
        if len(a) != len(r):
            raise BadInputError(f"{where}: {name} has {len(a)} samples, position {len(r)}; needs the same number")
        if not np.all(np.isfinite(a)):
            raise BadInputError(
                f"{where}: {name} has {int(np.sum(~np.isfinite(a)))} of {len(a)} values that are no numbers; needs a "
                f"number in {100 * (1 - MOST):.0f} % of the rows (gaps are then interpolated), or no such column"
            )
    for name, a, what in (
        ("force", r.force, "the force that moved the axis"),
        ("force_measured", r.force_measured, "the drive's current"),
        ("command", r.command, "the command that was followed"),
    ):
        if a is None or np.ptp(a) != 0.0 or (name == "force" and not model.driven):
            continue
        if name == "force" or np.ptp(r.position) >= LEAST_COUNTS * model.resolution:
            instead = (
                "driven = false in [axis] of the model where nothing drives it" if name == "force" else "no such column"
            )
            raise BadInputError(f"{where}: {name} is constant at {a[0]:.6g}; needs {what}, or {instead}")
    if r.time_s is not None:
        _check_time(r, r.time_s, model.sample_time_s)
    top = float(np.max(np.abs(r.force)))
    limit = model.controller.limit if model.controller is not None else top
    if top > OTHER_UNIT * limit:
        raise BadInputError(
            f"{where}: force reaches {top:.4g}, the controller's limit is {limit:.4g} {model.force_unit}; "
            f"{in_another_unit(top / limit)}"
        )
    share = at_limit(r, model)
    if share > SATURATED:
        raise BadInputError(
            f"{where}: force is at its limit of {limit:.4g} {model.force_unit} in {100 * share:.0f} % of the "
            "samples; record gentler moves"
        )
    if r.command is not None:
        _check_command(r, r.command, model)


def at_limit(r: Record, model: AxisModel) -> float:
    """Return the share of the samples at the limit of the controller; 0 where none is known."""
    return 0.0 if model.controller is None else float(np.mean(np.abs(r.force) >= 0.999 * model.controller.limit))


def _check_time(r: Record, time: Array, dt: float) -> None:
    steps = np.diff(time)
    typical = float(np.median(steps))
    if typical <= 0.0:
        raise BadInputError(f"read record {r.name}: time does not increase; needs seconds, rising")
    factor = typical / dt
    if not 0.98 < factor < 1.02:
        hint = f" (a factor of {factor:.4g}: is it in another unit?)" if factor > 30 or factor < 1 / 30 else ""
        raise BadInputError(f"read record {r.name}: time steps are {typical:.6g} s, the model says {dt:.6g} s{hint}")
    odd = np.flatnonzero(np.abs(steps - typical) > 0.5 * typical)
    if len(odd):
        if len(odd) > POLLED * len(steps):
            raise BadInputError(
                f"read record {r.name}: it was polled at no fixed rate, in steps of {steps.min():.4g} to "
                f"{steps.max():.4g} s ({100 * len(odd) / len(steps):.0f} % of them are off by more than half of "
                f"{typical:.4g} s); needs what the drive, or its driver, samples at a fixed rate"
            )
        i = int(odd[0])
        raise BadInputError(
            f"read record {r.name}: time jumps by {steps[i]:.6g} s after sample {i} ({len(odd)} jumps); "
            f"needs steps of {typical:.6g} s, or cut the record there"
        )


def _check_command(r: Record, command: Array, model: AxisModel) -> None:
    y, c = r.position - r.position.mean(), command - command.mean()
    if min(np.ptp(command), np.ptp(r.position)) < LEAST_COUNTS * model.resolution:
        return
    ratio = float(np.sqrt(np.mean(y**2) / max(np.mean(c**2), 1e-300)))
    if not 1.0 / OTHER_UNIT < ratio < OTHER_UNIT:
        raise BadInputError(
            f"read record {r.name}: position is {ratio:.4g} times the command; {in_another_unit(ratio)} "
            f"needs both in {model.position_unit}"
        )


def _check_measured(session: Session, model: AxisModel) -> None:
    """Compare measured with commanded force where both are slow and far from a limit, so that no drive effect passes
    for a scale.

    Raises:
        BadInputError: the measured force is of another scale or sign; its noise and its limit would be misread.
    """
    pairs = [(r.force, r.force_measured) for r in session.records if r.force_measured is not None]
    if not pairs:
        return
    size = [float(np.sqrt(np.mean(np.concatenate(a) ** 2))) for a in zip(*pairs, strict=True)]
    ratio = size[1] / size[0]
    if 1.0 / OTHER_UNIT < ratio < OTHER_UNIT:
        top = SLOW_SHARE * max(float(np.max(np.abs(m))) for _, m in pairs)
        span = max(round(SLOW_S / model.sample_time_s), 1)
        calm = [maximum_filter1d(np.abs(u), 2 * span) < top for u, _ in pairs]
        u, m = (
            np.concatenate([uniform_filter1d(p[i], span)[k] for p, k in zip(pairs, calm, strict=True)]) for i in (0, 1)
        )
        if len(u) < LEAST_SLOW or np.ptp(u) == 0.0 or abs(np.corrcoef(u, m)[0, 1]) < 0.9:
            return
        ratio = float(np.polyfit(u, m, 1)[0])
    if not 1.0 / FORCE_SCALE < ratio < FORCE_SCALE:
        raise BadInputError(
            f"compare force_measured with force: it is {ratio:.4g} times the commanded force"
            + (
                f"; {in_another_unit(ratio)}"
                if not 1.0 / OTHER_UNIT < ratio < OTHER_UNIT
                else ", also where nothing limits it; needs the same sign and scale (a scale in columns.toml), or no "
                "such column"
            )
        )


def _notes(session: Session, model: AxisModel) -> list[str]:
    out: list[str] = []
    if model.imposed:
        return out
    if all(r.force_measured is None for r in session.records):
        out.append("no force was measured: drive delay, lag and saturation are judged by their effect on motion only")
    if all(r.index is None for r in session.records):
        out.append("no index marks: encoder scale and payload cannot be told apart")
    if model.controller is None:
        out.append("no controller in the model: the closed loop is not simulated, gaps are given in force only")
    if model.controller is not None and any(r.command is None for r in session.records):
        out.append("no command recorded: the closed loop is not simulated, gaps are given in force only")
    if often := [f"{r.name} {100 * at_limit(r, model):.0f} %" for r in session.records if at_limit(r, model) > OFTEN]:
        out.append(f"the force is at the controller's limit most of the time ({', '.join(often)}): little shows there")
    if model.controller is not None:
        shares = [(r.name, beyond_feedback(r, model)) for r in session.records + session.final]
        if odd := [f"{name} {100 * share:.0f} %" for name, share in shares if share > FOREIGN]:
            out.append(
                "the controller of the model does not make the recorded force from command and position (off by, "
                f"share of the force: {', '.join(odd)}), and the closed loop suffers; if a feed-forward or a test "
                "signal was added, name its column feedforward"
            )
    return out
