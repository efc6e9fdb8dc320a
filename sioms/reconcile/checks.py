"""Refuse data that cannot be used, before anything is fitted, and say why."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d
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
from sioms.reconcile.timing import LEAST_SAMPLES, MOST
from sioms.reconcile.verdict import BadInputError

LEAST_COUNTS = 20
LEAST_TOTAL_S = 2.0
#: The inertia the data show may be between these multiples of the nominal one, by a payload; beyond them it is a unit.
LEAST_INERTIA, MOST_INERTIA = 0.125, 21.0
#: Beyond these it is said.
UNLIKELY_INERTIA = 0.25, 4.0
#: A channel that is so many times another one that should be like it is in another unit.
OTHER_UNIT = 30.0
#: Mistakes of units by their factor, which is met within a tenth.
MISTAKES = {
    1000.0: "m against mm, N against mN, A against mA",
    180.0 / np.pi: "degrees against radians",
    2.0 * np.pi: "turns against radians",
    25.4: "inches against millimetres",
    39.37: "inches against metres",
    9.80665: "kgf against N, or ten",
}
#: Measured may be so many times the commanded force; samples it is judged on, their share of the largest force, and
#: seconds of a mean.
FORCE_SCALE, LEAST_SLOW, SLOW_SHARE, SLOW_S = 1.33, 200, 0.8, 0.05
#: Share of samples at the controller's limit above which nothing is left to learn.
SATURATED = 0.5
#: Share of the force above which what feedback does not explain is told, and samples until a filter of speed has
#: settled.
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
    _check_measured(session, model)
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
        if (
            a is not None
            and np.ptp(a) == 0.0
            and (name == "force" or np.ptp(r.position) >= LEAST_COUNTS * model.resolution)
        ):
            raise BadInputError(f"{where}: {name} is constant at {a[0]:.6g}; needs {what}, or no such column")
    if r.time_s is not None:
        _check_time(r, r.time_s, model.sample_time_s)
    top = float(np.max(np.abs(r.force)))
    limit = model.controller.limit if model.controller is not None else top
    if top > OTHER_UNIT * limit:
        raise BadInputError(
            f"{where}: force reaches {top:.4g}, the controller's limit is {limit:.4g} {model.force_unit}; "
            f"{_in_another_unit(top / limit)}"
        )
    share = float(np.mean(np.abs(r.force) >= 0.999 * limit))
    if share > SATURATED:
        raise BadInputError(
            f"{where}: force is at its limit of {limit:.4g} {model.force_unit} in {100 * share:.0f} % of the "
            "samples; record gentler moves"
        )
    if r.command is not None:
        _check_command(r, r.command, model)


def _in_another_unit(factor: float) -> str:
    """Say what a factor between two numbers that should be alike looks like."""
    size = max(abs(factor), 1.0 / abs(factor))
    known = next((f" ({said})" for f, said in MISTAKES.items() if 0.9 < size / f < 1.1), "")
    shown = f"{10.0 ** round(np.log10(size)):g}" if size > 100.0 else f"{size:.3g}"
    return f"is one of them in another unit, by a factor of {shown}{known}?"


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
            f"read record {r.name}: position is {ratio:.4g} times the command; {_in_another_unit(ratio)} "
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
                f"; {_in_another_unit(ratio)}"
                if not 1.0 / OTHER_UNIT < ratio < OTHER_UNIT
                else ", also where nothing limits it; needs the same sign and scale (a scale in columns.toml), or no "
                "such column"
            )
        )


def _notes(session: Session, model: AxisModel) -> list[str]:
    out = []
    if all(r.force_measured is None for r in session.records):
        out.append("no force was measured: drive delay, lag and saturation are judged by their effect on motion only")
    if all(r.index is None for r in session.records):
        out.append("no index marks: encoder scale and payload cannot be told apart")
    if model.controller is None:
        out.append("no controller in the model: the closed loop is not simulated, gaps are given in force only")
    if model.controller is not None and any(r.command is None for r in session.records):
        out.append("no command recorded: the closed loop is not simulated, gaps are given in force only")
    if model.controller is not None:
        shares = [(r.name, _beyond_feedback(r, model)) for r in session.records + session.final]
        if odd := [f"{name} {100 * share:.0f} %" for name, share in shares if share > FOREIGN]:
            out.append(
                "the controller of the model does not make the recorded force from command and position (off by, "
                f"share of the force: {', '.join(odd)}), and the closed loop suffers; if a feed-forward or a test "
                "signal was added, name its column feedforward"
            )
    return out


def runs_the_loop(session: Session, model: AxisModel) -> bool:
    """Say whether the controller of the model makes the recorded forces: then the rows are those of the loop."""
    return (
        model.controller is not None
        and all(r.command is not None for r in session.records)
        and all(_beyond_feedback(r, model) <= FOREIGN for r in session.records)
    )


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


def check_scale(problem: Problem, model: AxisModel) -> list[str]:
    """Compare the force with what the nominal inertia needs, whatever friction and position forces there are.

    Returns:
        What is to be said of a factor that a payload may make, but a unit more likely.

    Raises:
        BadInputError: they differ by a factor that no payload makes: units, or another axis.
    """
    ratio = inertia_seen(problem, model)
    if ratio is None:
        return []
    if ratio < -0.05:
        raise BadInputError(
            f"compare force with motion: force is {ratio:.3g} times what the nominal inertia needs; the sign "
            "of force or position is turned round"
        )
    if not LEAST_INERTIA < ratio < MOST_INERTIA:
        raise BadInputError(
            f"compare force with motion: force is {ratio:.4g} times what the nominal inertia of {model.inertia:.4g} "
            "needs; "
            f"{_in_another_unit(ratio)} check the units of force, position and inertia, or the model is of another axis"
        )
    if UNLIKELY_INERTIA[0] < ratio < UNLIKELY_INERTIA[1]:
        return []
    return [
        f"force is {ratio:.3g} times what the nominal inertia of {model.inertia:.4g} needs: a heavy payload, or a "
        "wrong unit (turns for radians make 6.3)"
    ]


def inertia_seen(problem: Problem, model: AxisModel) -> float | None:
    """Return the inertia that force and motion show, as a multiple of the nominal one; None where too little tells."""
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
    return None if inertial < 0.02 or share < 0.2 else float(c[0])
