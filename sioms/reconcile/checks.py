"""Refuse data that cannot be used, before anything is fitted, and say why."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from sioms.reconcile.effect import Array
from sioms.reconcile.fit import Problem
from sioms.reconcile.kernel import (
    CTL_ALPHA,
    CTL_K,
    CTL_KB,
    CTL_KP,
    CTL_KZ,
    CTL_MAX,
    CTL_MEAN,
    CTL_OFFSET,
)
from sioms.reconcile.model import AxisModel, controller_row
from sioms.reconcile.records import Record, Session
from sioms.reconcile.screen import dead_band, direction, smoothed_motion
from sioms.reconcile.timing import LEAST_SAMPLES
from sioms.reconcile.verdict import BadInputError

LEAST_COUNTS = 20
LEAST_TOTAL_S = 2.0
#: The inertia the data show may differ from the nominal one by a payload, hardly by this factor.
UNIT_FACTOR = 60.0
#: Share of samples at the controller's limit above which nothing is left to learn.
SATURATED = 0.5
#: Share of the force above which what feedback does not explain is told, and samples until a filter of speed has settled.
FOREIGN, SETTLED = 0.05, 100


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
        _check_record(r, model)
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
    return tuple(_notes(session, model))


def _check_record(r: Record, model: AxisModel) -> None:
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
            raise BadInputError(
                f"{where}: {name} has {len(a)} samples, position {len(r)}; needs the same number"
            )
        if not np.all(np.isfinite(a)):
            raise BadInputError(
                f"{where}: {name} has {int(np.sum(~np.isfinite(a)))} values that are no numbers"
            )
    for name, a, what in (
        ("force", r.force, "the force that moved the axis"),
        ("force_measured", r.force_measured, "the drive's current"),
        ("command", r.command, "the command that was followed"),
    ):
        if (
            a is not None
            and np.ptp(a) == 0.0
            and (name == "force" or np.ptp(r.position) >= LEAST_COUNTS * model.resolution)
        ):
            raise BadInputError(f"{where}: {name} is constant at {a[0]:.6g}; needs {what}, or no such column")
    if r.time_s is not None:
        _check_time(r, r.time_s, model.sample_time_s)
    limit = model.controller.limit if model.controller is not None else float(np.max(np.abs(r.force)))
    share = float(np.mean(np.abs(r.force) >= 0.999 * limit))
    if share > SATURATED:
        raise BadInputError(
            f"{where}: force is at its limit of {limit:.4g} {model.force_unit} in {100 * share:.0f} % of the "
            "samples; record gentler moves"
        )
    if r.command is not None:
        _check_command(r, r.command, model)


def _check_time(r: Record, time: Array, dt: float) -> None:
    steps = np.diff(time)
    typical = float(np.median(steps))
    if typical <= 0.0:
        raise BadInputError(f"read record {r.name}: time does not increase; needs seconds, rising")
    factor = typical / dt
    if not 0.98 < factor < 1.02:
        hint = (
            f" (a factor of {factor:.4g}: is it in another unit?)" if factor > 30 or factor < 1 / 30 else ""
        )
        raise BadInputError(
            f"read record {r.name}: time steps are {typical:.6g} s, the model says {dt:.6g} s{hint}"
        )
    odd = np.flatnonzero(np.abs(steps - typical) > 0.5 * typical)
    if len(odd):
        i = int(odd[0])
        raise BadInputError(
            f"read record {r.name}: time jumps by {steps[i]:.6g} s after sample {i} ({len(odd)} jumps); "
            f"needs steps of {typical:.6g} s, or cut the record there"
        )


def _check_command(r: Record, command: Array, model: AxisModel) -> None:
    y, c = r.position - r.position.mean(), command - command.mean()
    if np.ptp(command) < LEAST_COUNTS * model.resolution:
        return
    ratio = float(np.sqrt(np.mean(y**2) / max(np.mean(c**2), 1e-300)))
    if ratio > 30.0 or ratio < 1.0 / 30.0:
        raise BadInputError(
            f"read record {r.name}: position is {ratio:.4g} times the command; is one of them in another unit "
            f"(a factor of {10.0 ** round(np.log10(ratio)):g})? needs both in {model.position_unit}"
        )


def _notes(session: Session, model: AxisModel) -> list[str]:
    out = []
    if all(r.force_measured is None for r in session.records):
        out.append(
            "no force was measured: drive delay, lag and saturation are judged by their effect on motion only"
        )
    if all(r.index is None for r in session.records):
        out.append("no index marks: encoder scale and payload cannot be told apart")
    if model.controller is None:
        out.append(
            "no controller in the model: the closed loop is not simulated, gaps are given in force only"
        )
    if model.controller is not None and any(r.command is None for r in session.records):
        out.append("no command recorded: the closed loop is not simulated, gaps are given in force only")
    if model.controller is not None:
        shares = [(r.name, _beyond_feedback(r, model)) for r in session.records + session.final]
        if odd := [f"{name} {100 * share:.0f} %" for name, share in shares if share > FOREIGN]:
            out.append(
                "the controller of the model does not make the recorded force from command and position (off by, share of the "
                f"force: {', '.join(odd)}), and the closed loop suffers; if a feed-forward or a test signal was added, "
                "name its column feedforward"
            )
    return out


def _beyond_feedback(r: Record, model: AxisModel) -> float:
    """Size of the recorded force that the controller does not explain, over the size of the force; 0 without a command.

    The size is the 98th percentile, so that some interpolated samples do not count.
    """
    if r.command is None or len(r) < LEAST_SAMPLES:
        return 0.0
    c, y = controller_row(model), r.position
    e, own = r.command - y, r.force - (0.0 if r.feedforward is None else r.feedforward)
    if c[CTL_MEAN] > 0.0:
        v = 0.5 * (y - np.concatenate([y[:1], y[:1], y[:-2]])) / model.sample_time_s
    else:
        steps = np.diff(y, prepend=y[0]) / model.sample_time_s
        v = lfilter([c[CTL_ALPHA]], [1.0, c[CTL_ALPHA] - 1.0], steps)
    u = c[CTL_K] * (e[1:] + c[CTL_KZ] * e[:-1]) - c[CTL_KP] * own[:-1] + c[CTL_KB] * v[1:] + c[CTL_OFFSET]
    off = np.abs(own[1:] - np.clip(u, -c[CTL_MAX], c[CTL_MAX]))[SETTLED:]
    return float(np.quantile(off, 0.98) / max(float(np.quantile(np.abs(own), 0.98)), 1e-300))


def check_scale(problem: Problem, model: AxisModel) -> None:
    """Compare the force with what the nominal inertia needs, whatever friction and position forces there are.

    Raises:
        BadInputError: they differ by a factor that no payload makes: units, or another axis.
    """
    motions = smoothed_motion(problem, model)
    dead = dead_band(problem, model)
    turn = 1.0 if model.rotary else 2.0 * np.pi / model.pitch  # gravity, or cogging
    columns = [
        np.stack(
            [
                model.inertia * m.a,
                m.v,
                direction(m.v, dead),
                m.x,
                np.ones_like(m.x),
                np.sin(turn * m.x),
                np.cos(turn * m.x),
            ],
            axis=1,
        )
        for m in motions
    ]
    a, u = problem.join(columns), problem.join([m.u + m.outer for m in motions])
    size = np.linalg.norm(a, axis=0)
    size[size == 0.0] = 1.0
    c = np.linalg.lstsq(a / size, u, rcond=1e-10)[0] / size
    share = 1.0 - float(np.sum((u - a @ c) ** 2) / np.sum(u**2))
    inertial = float(np.linalg.norm(a[:, 0] * c[0]) / np.linalg.norm(u))
    if inertial < 0.02 or share < 0.2:
        return
    if c[0] < -0.05:
        raise BadInputError(
            f"compare force with motion: force is {c[0]:.3g} times what the nominal inertia needs; the sign "
            "of force or position is turned round"
        )
    if c[0] > UNIT_FACTOR or c[0] < 1.0 / UNIT_FACTOR:
        near = 10.0 ** round(np.log10(c[0]))
        raise BadInputError(
            f"compare force with motion: force is {c[0]:.4g} times what the nominal inertia of "
            f"{model.inertia:.4g} needs (about {near:g}); check the units of force, position and inertia "
            f"(m against mm, N against mN), or the model is of another axis"
        )
