"""Channels first: what the sensor and the drive say by themselves, before any mechanics is fitted.

The count lattice and the index marks judge the sensor, measured against commanded force the drive. What is
found here is measured directly, so the later fits keep it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import COLOURED, DOUBTED, GOES_WITH, STEADY_ROWS, STRAYS

LATTICE_SHARE = 0.998
#: A scale or a drive effect must be this many standard errors away from nothing ...
SIGNIFICANT = 5.0
#: ... and explain at least this share of what the drive residual holds.
DRIVE_GAIN = 0.05
#: A measured force of which the best delay, lag and limit leave more than this share does not come from the command.
FOREIGN_FORCE = 0.5
#: Longest delay or lag of a drive that is searched for, in samples; one that is found there may be any longer one.
LATEST = 20.0
#: First samples of a record, not compared: what was commanded before them is not known.
UNSETTLED = 20
#: Samples back at which a command may still tell what a drive does.
PAST = (0, 1, 2, 4, 8, 16)
#: Step of a slope over a time, in samples.
STEP = 0.05


@dataclass(frozen=True, slots=True)
class Finding:
    """An effect that a channel shows by itself.

    Attributes:
        values: parameters; errors: their standard errors.
        evidence: one sentence with figures.
        doubted: what its law leaves is no noise: another law may do as well, or better.
    """

    effect: str
    values: Mapping[str, float]
    errors: Mapping[str, float]
    evidence: str
    doubted: bool = False


def with_resolution(model: AxisModel, session: Session) -> AxisModel:
    """Fill in a resolution of zero by the smallest step of the recorded position.

    Raises:
        BadInputError: there is no step.
    """
    if model.resolution > 0.0:
        return model
    steps = np.abs(np.concatenate([np.diff(r.position) for r in session.records]))
    top = float(np.nanmax([np.nanmax(np.abs(r.position)) for r in session.records]))
    moved = steps[steps > 1e-9 * max(top, 1e-12)]
    if not len(moved):
        raise BadInputError("read records: position is constant; needs motion")
    return replace(model, resolution=float(np.min(moved)))


def lattice(session: Session, model: AxisModel) -> Finding | None:
    """Find the largest number of which (nearly) all count differences are multiples."""
    steps = np.concatenate([_count_steps(r, model.resolution) for r in session.records])
    moved = np.abs(steps[steps != 0])
    if len(moved) < 20:
        return None
    sizes, times = np.unique(moved, return_counts=True)
    best = 1
    for factor in range(2, int(min(sizes.max(), 4096)) + 1):
        if times[sizes % factor == 0].sum() >= LATTICE_SHARE * times.sum():
            best = factor
    if best == 1:
        return None
    share = times[sizes % best == 0].sum() / times.sum()
    return Finding(
        "encoder_quantisation",
        {"factor": float(best)},
        {"factor": 0.0},
        f"{100 * share:.1f} % of {len(moved)} position changes are multiples of {best} counts",
    )


def _count_steps(record: Record, resolution: float) -> NDArray[np.int64]:
    """Differences in counts of neighbours that were both measured."""
    counts = np.rint(record.position / resolution).astype(np.int64)
    steps: NDArray[np.int64] = counts[1:] - counts[:-1]
    return steps if record.filled is None else steps[~(record.filled[1:] | record.filled[:-1])]


def index_scale(session: Session, model: AxisModel) -> Finding | None:
    """Fit measured against true position of the index marks; None where they agree or are too few."""
    fit = index_fit(session, model)
    if fit is None:
        return None
    gain, error, marks = fit
    if abs(gain - 1.0) < SIGNIFICANT * error or abs(gain - 1.0) < 3e-4:
        return None
    return Finding(
        "encoder_scale",
        {"gain": gain},
        {"gain": error},
        f"{marks} index marks lie {gain:.5f} +- {error:.5f} of their pitch apart",
    )


def index_fit(session: Session, model: AxisModel) -> tuple[float, float, int] | None:
    """Estimate measured over true displacement from index marks.

    Returns:
        (gain, standard error, number of marks), or None with fewer than two distinct marks.
    """
    where, width, record = [], [], []
    for i, r in enumerate(session.records):
        if r.index is None:
            continue
        at = np.flatnonzero(r.index[:-1])
        where.append(0.5 * (r.position[at] + r.position[at + 1]))
        width.append(np.abs(r.position[at + 1] - r.position[at]) + 2.0 * model.resolution)
        record.append(np.full(len(at), i))
    if not where or sum(map(len, where)) < 4:
        return None
    y, s = np.concatenate(where), np.concatenate(width) / np.sqrt(12.0)
    best: tuple[float, float, float] | None = None
    for trial in np.concatenate([[1.0], np.linspace(0.8, 1.25, 451)]):
        n = np.rint(y / (model.pitch * trial))
        if len(np.unique(n)) < 2:
            continue
        g, e, chi = _line(n * model.pitch, y, s)
        if best is None or chi < best[2] * (1.0 - 1e-6):
            best = (g, e, chi)
    if best is None:
        return None
    gain, error, chi = best
    return gain, error * max(1.0, np.sqrt(chi)), len(y)


def _line(x: Array, y: Array, s: Array) -> tuple[float, float, float]:
    """Weighted straight line: slope, its standard error, reduced chi square."""
    w = 1.0 / s**2
    xm, ym = np.average(x, weights=w), np.average(y, weights=w)
    sxx = float(np.sum(w * (x - xm) ** 2))
    slope = float(np.sum(w * (x - xm) * (y - ym))) / sxx
    rest = y - ym - slope * (x - xm)
    return slope, 1.0 / np.sqrt(sxx), float(np.sum(w * rest**2) / max(len(x) - 2, 1))


def drive_output(force: Array, delay: float, lag: float, limit: float, dt: float) -> Array:
    """Mean force over each sample of a drive with delay, first-order lag and limit (at nominal constant)."""
    k = int(np.floor(delay / dt))
    part = delay / dt - k
    held = np.concatenate([np.zeros(k + 1), force])
    u = (1.0 - part) * held[1 : len(force) + 1] + part * held[: len(force)]
    if lag > 0.0:
        decay = float(np.exp(-dt / lag))
        share = (1.0 - decay) * lag / dt
        state: Array = np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], u))  # at each sample's start
        u = u + (state - u) * share
    limited: Array = np.clip(u, -limit, limit)
    return limited


def drive(session: Session, model: AxisModel) -> tuple[list[Finding], str]:
    """Compare measured with commanded force: delay, lag, saturation, the fewest that explain it.

    Returns:
        What was found, and why nothing can be told of an axis with this drive; empty where that is not so.

    Raises:
        BadInputError: the measured force does not follow the commanded one, or later than is searched for.
    """
    records = [r for r in session.records if r.force_measured is not None]
    if not records:
        return [], ""
    dt = model.sample_time_s
    noise = _white(records)
    limit, at_limit = _plateau(records, noise)
    n = sum(len(r) - UNSETTLED for r in records)
    late = _latest(records, np.inf, dt)
    found = []
    if at_limit:
        limited = _latest(records, limit, dt)
        if limited.left < (1.0 - DRIVE_GAIN) * late.left:  # a drive that only is slow cuts peaks off, too
            late = limited
            found.append(
                Finding(
                    "saturation",
                    {"limit": limit},
                    {"limit": noise * np.sqrt(0.5 * np.pi / at_limit)},
                    f"measured force stays at {limit:.4g} {model.force_unit} in {at_limit} samples "
                    "while the command goes on",
                )
            )
        else:
            limit = np.inf
    _check_follows(records, late, dt)
    if late.value > max(SIGNIFICANT * late.error, 1e-3 * dt) and late.left < (1.0 - DRIVE_GAIN) * late.none:
        other = "lag" if late.name == "delay" else "delay"
        found.append(
            Finding(
                late.name,
                {"delay" if late.name == "delay" else "tau": late.value},
                {"delay" if late.name == "delay" else "tau": late.error},
                f"measured force is late by {1e3 * late.value:.3f} ms; misfit {np.sqrt(late.left / n):.3g}, with "
                f"{other} {np.sqrt(late.other / n):.3g}, with neither {np.sqrt(late.none / n):.3g} {model.force_unit}",
            )
        )
    times = {late.name: late.value} if found and found[-1].effect == late.name else {}
    return _judged(records, found, _left(records, times.get("delay", 0.0), times.get("lag", 0.0), limit, dt), dt)


def _judged(records: list[Record], found: list[Finding], left: list[Array], dt: float) -> tuple[list[Finding], str]:
    """Doubt what was found where what it leaves goes on from row to row, as no noise does; see ``drive``.

    Its zero is no law of the drive, and does not count. Its scale doubts a lag, which it looks like, and no more.
    """
    measured = np.concatenate([r.force_measured[UNSETTLED:] for r in records if r.force_measured is not None])
    ends = np.cumsum([len(e) for e in left])[:-1]
    whole = np.concatenate(left)
    whole -= np.mean(whole)
    odd = _steady(np.split(whole, ends))
    if odd == 0.0:
        return found, ""
    scaled = whole - measured * (measured @ whole) / max(float(measured @ measured), 1e-300)
    share = np.sqrt(_steady(np.split(scaled, ends)) / max(float(measured @ measured), 1e-300))
    strays = ""
    if share > STRAYS and _of_command(records, whole) > GOES_WITH:
        strays = (
            f"the drive does not follow its command by a delay, a lag and a limit alone: {100 * share:.0f} % of the "
            "measured force is something else (a supply that gives less at speed, a limit of its rate of change?); "
            "describe force_measured as force to see the mechanics by what the drive did"
        )
    none = np.concatenate(_left(records, 0.0, 0.0, np.inf, dt))
    doubted = odd > DOUBTED * len(none) * float(np.var(none))
    return [replace(f, doubted=doubted) for f in found], strays


def _of_command(records: list[Record], left: Array) -> float:
    """Return the share of what a drive leaves that goes with its command, present and past; little of any noise."""

    def seen(u: Array) -> Array:
        past = [np.concatenate([np.zeros(k), u])[: len(u)] for k in PAST]
        columns = [f(p) for p in past for f in (np.asarray, np.abs, lambda p: p * np.abs(p))]
        return np.stack(columns, axis=1)[UNSETTLED:]

    columns = np.concatenate([seen(r.force) for r in records if r.force_measured is not None])
    of_it = columns @ np.linalg.lstsq(columns, left, rcond=None)[0]
    return float(of_it @ of_it) / max(float(left @ left), 1e-300)


def _steady(left: list[Array]) -> float:
    """Return the squares of what goes on from row to row; 0 of noise."""
    rows, squares = sum(map(len, left)), max(sum(float(e @ e) for e in left), 1e-300)
    steps = sum(float(np.sum(np.diff(e) ** 2)) for e in left) / squares  # 2 of white noise, by 2 over the root of rows
    return 0.0 if steps > 2.0 - max(STEADY_ROWS, COLOURED / np.sqrt(rows)) else squares * (1.0 - 0.5 * steps)


def _left(records: list[Record], delay: float, lag: float, limit: float, dt: float) -> list[Array]:
    """Return what a drive leaves of each measured force."""
    return [
        ((r.force if r.force_measured is None else r.force_measured) - drive_output(r.force, delay, lag, limit, dt))[
            UNSETTLED:
        ]
        for r in records
    ]


def _check_follows(records: list[Record], late: _Late, dt: float) -> None:
    """Refuse a measured force that is not that of the drive: any delay that lowers its misfit by chance would be named.

    Raises:
        BadInputError: see `drive`.
    """
    measured = np.concatenate([r.force_measured[UNSETTLED:] for r in records if r.force_measured is not None])
    left = late.left / max(float(np.sum((measured - measured.mean()) ** 2)), 1e-300)
    if left > FOREIGN_FORCE:
        share = 100.0 * min(left, 10.0)
        raise BadInputError(
            f"compare force_measured with force: with the best delay, lag and limit {share:.0f} % of its "
            "variance does not follow the commanded force; needs the drive's measured force of the same samples, or no "
            "such column, or, where the supply limits the drive, the measured force described as force"
        )
    if late.value > 0.98 * LATEST * dt and late.left < (1.0 - DRIVE_GAIN) * late.none:
        raise BadInputError(
            f"compare force_measured with force: it follows {LATEST:.0f} samples late or more, which is as far as is "
            "searched; needs columns of the same clock (or a longer sample_time_s), or no such column"
        )


@dataclass(frozen=True, slots=True)
class _Late:
    """How late a drive is: by delay or lag, by how much [s] with its standard error; squares left by it, by the other,
    by neither.
    """

    name: str
    value: float
    error: float
    left: float
    other: float
    none: float


def _latest(records: list[Record], limit: float, dt: float) -> _Late:
    """Fit a delay, and a lag, of a drive with a limit; return what leaves less."""

    def off(delay: float, lag: float) -> Array:
        return np.concatenate(_left(records, max(delay, 0.0), max(lag, 0.0), limit, dt))

    def misfit(delay: float, lag: float) -> float:
        e = off(delay, lag)
        return float(e @ e)

    delay = _delay(misfit, dt)
    lag = dt * float(
        minimize_scalar(
            lambda p: misfit(0.0, float(p) * dt),
            bounds=(0.0, LATEST),
            method="bounded",
            options={"maxiter": 25},
        ).x
    )
    left = {"delay": misfit(delay, 0.0), "lag": misfit(0.0, lag)}
    name, other = sorted(left, key=lambda s: left[s])
    value = delay if name == "delay" else lag
    step = STEP * dt
    ahead, behind = ((t, 0.0) if name == "delay" else (0.0, t) for t in (value + step, max(value - step, 0.0)))
    slope = (off(*ahead) - off(*behind)) / (step + min(step, value))
    size = max(float(slope @ slope), 1e-300)
    error = float(np.sqrt(left[name] / len(slope) / size))
    return _Late(name, value, error, left[name], left[other], misfit(0.0, 0.0))


def _delay(misfit: Callable[[float, float], float], dt: float) -> float:
    """Search half samples first, then between."""
    grid = np.arange(0.0, LATEST + 0.5, 0.5) * dt
    start = float(grid[int(np.argmin([misfit(float(d), 0.0) for d in grid]))] / dt)
    best = minimize_scalar(
        lambda p: misfit(float(p) * dt, 0.0),
        bounds=(max(start - 0.6, 0.0), start + 0.6),
        method="bounded",
        options={"xatol": 1e-4},
    )
    return float(best.x) * dt


def _white(records: list[Record]) -> float:
    """White noise of the measured force."""
    second = [
        1.4826 * np.median(np.abs(np.diff(r.force_measured, 2))) / np.sqrt(6.0)
        for r in records
        if r.force_measured is not None
    ]
    return float(max(np.median(second), 1e-12))


def _plateau(records: list[Record], noise: float) -> tuple[float, int]:
    """Find a level at which the measured force stays although the command passes it clearly.

    Returns:
        (level, number of samples there); (inf, 0) where there is none.
    """
    measured = np.concatenate([r.force_measured for r in records if r.force_measured is not None])
    commanded = np.concatenate([r.force for r in records])
    top = float(np.quantile(np.abs(measured), 0.9995))
    near = np.abs(np.abs(measured) - top) < 5.0 * noise + 0.004 * top
    beyond = near & (np.abs(commanded) > 1.03 * top + 6.0 * noise)
    if beyond.sum() < 8 or np.abs(commanded).max() < 1.05 * top:
        return np.inf, 0
    # a real plateau: hardly any measured sample above, and the command beyond it most of the time it is near
    level = float(np.median(np.abs(measured[beyond])))
    if np.mean(np.abs(measured) > level + 6.0 * noise) > 1e-3 or _late(records, level, noise):
        return np.inf, 0
    return level, int(beyond.sum())


def _late(records: list[Record], level: float, noise: float) -> bool:
    """Say whether large commands are reached later (a delay), not cut off."""
    reached = passed = 0
    for r in records:
        if r.force_measured is None:
            continue
        above = np.abs(r.force) > 1.05 * level + 6.0 * noise
        edges = np.flatnonzero(above[1:] & ~above[:-1]) + 1
        for e in edges:
            passed += 1
            stop = e + 30
            reached += bool(np.any(np.abs(r.force_measured[e:stop]) > 1.02 * level + 6.0 * noise))
    return passed > 0 and reached > 0.2 * passed
