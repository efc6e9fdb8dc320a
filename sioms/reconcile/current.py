"""What the measured force of a drive says by itself, against the commanded one, before any mechanics is fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from sioms.reconcile.channels import SIGNIFICANT, Finding
from sioms.reconcile.effect import Array
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.jit import kernel
from sioms.reconcile.kernel import ramped
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import COLOURED, DOUBTED, GOES_WITH, STEADY_ROWS, STRAYS

#: A law of the drive must explain at least this share of what is left without.
DRIVE_GAIN = 0.05
#: A measured force of which the best law leaves more than this share does not come from the command.
FOREIGN_FORCE = 0.5
#: Longest delay or lag of a drive that is searched for, in samples; one that is found there may be any longer one.
LATEST = 20.0
#: Rise from nothing to the largest command that is searched for [samples], and how many between.
RISES = np.geomspace(0.5, 400.0, 24)
#: First samples of a record, not compared: what was commanded before them is not known.
UNSETTLED = 20
#: Samples back at which a command may still tell what a drive does.
PAST = (0, 1, 2, 4, 8, 16)
#: Step of a slope over a time [samples], and over a rate, relative.
STEP, SMALL = 0.05, 0.01
#: Speed is measured over so long [s]; a supply is told by so many rows in which it limits, by so many fits.
OVER_S, FEWEST, FITS = 5e-3, 20, 4


@kernel
def _ramp(force: Array, rate: float, dt: float, out: Array) -> None:
    end = 0.0
    for i in range(len(force)):
        out[i], end = ramped(end, force[i], rate, dt)


@dataclass(frozen=True, slots=True)
class Law:
    """What a drive makes of its command: ``delay`` and ``lag`` [s], the largest ``rate`` of change and force
    (``limit``), and the speed ``free`` at which that has fallen to nothing.
    """

    delay: float = 0.0
    lag: float = 0.0
    rate: float = np.inf
    limit: float = np.inf
    free: float = np.inf

    @classmethod
    def of(cls, found: Sequence[Finding]) -> Law:
        """Return the law that findings are of."""
        values = {PLACE[symbol]: value for f in found for symbol, value in f.values.items()}
        return cls(**values)

    def output(self, force: Array, dt: float, speed: Array | float = 0.0) -> Array:
        """Return the mean force over each sample, at nominal constant, shape (n,).

        Args:
            force: commanded, held over each sample, [{F}]; dt: sample time [s]; speed: mean over each sample [{x}/s].
        """
        k = int(np.floor(self.delay / dt))
        part = self.delay / dt - k
        held = np.concatenate([np.zeros(k + 1), force])
        u = (1.0 - part) * held[1 : len(force) + 1] + part * held[: len(force)]
        if self.rate < np.inf:
            late, u = u, np.empty(len(u))
            _ramp(late, self.rate, dt, u)
        if self.lag > 0.0:
            decay = float(np.exp(-dt / self.lag))
            share = (1.0 - decay) * self.lag / dt
            state: Array = np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], u))  # at each sample's start
            u = u + (state - u) * share
        if self.limit == np.inf:
            return u
        most, least = (self.limit * np.maximum(1.0 + way * speed / self.free, 0.0) for way in (-1.0, 1.0))
        limited: Array = np.clip(u, -least, most)
        return limited


#: What symbols of the effects are called in a law, and the laws of one number in time: effect and symbol.
PLACE = {"delay": "delay", "tau": "lag", "rate": "rate", "limit": "limit", "F0": "limit", "v0": "free"}
TIMED = {"delay": "delay", "lag": "tau", "slew_limit": "rate"}


def speeds(record: Record, dt: float) -> Array:
    """Return the mean speed over each sample [{x}/s], by the positions ``OVER_S`` before and after it."""
    k = max(round(OVER_S / dt), 1)
    x = np.pad(record.position, (k, k + 1), mode="edge")
    out: Array = (x[2 * k + 1 :] - x[: -2 * k - 1]) / ((2 * k + 1) * dt)
    return out


def drive(session: Session, model: AxisModel) -> tuple[list[Finding], str]:
    """Compare measured with commanded force: how late, how fast and how large it gets, by the fewest laws that explain
    it.

    Returns:
        What was found, and why nothing can be told of an axis with this drive; empty where that is not so.

    Raises:
        BadInputError: the measured force does not follow the commanded one, or later than is searched for.
    """
    records = [r for r in session.records if r.force_measured is not None]
    if not records:
        return [], ""
    dt, unit = model.sample_time_s, model.force_unit
    n = sum(len(r) - UNSETTLED for r in records)
    noise = _white(records)
    found: list[Finding] = []
    late = _latest(records, Law(), dt)
    for limits in (_plateau(records, noise, unit), _supply(records, noise, model)):
        if limits is None:
            continue
        limited = _latest(records, Law.of([limits]), dt)
        if limited.left < (1.0 - DRIVE_GAIN) * late.left:  # a drive that only is slow cuts peaks off, too
            late, found = limited, [limits]
    _check_follows(records, late, dt)
    if late.told and late.left < (1.0 - DRIVE_GAIN) * late.none:
        misfits = ", ".join(f"with {name} {np.sqrt(left / n):.3g}" for name, left in late.others.items())
        what = (
            f"changes by {late.value:.4g} {unit}/s at most"
            if late.name == "slew_limit"
            else f"is late by {1e3 * late.value:.3f} ms"
        )
        symbol = TIMED[late.name]
        text = (
            f"measured force {what}; misfit {np.sqrt(late.left / n):.3g}, {misfits}, with none of them "
            f"{np.sqrt(late.none / n):.3g} {unit}"
        )
        found.append(Finding(late.name, {symbol: late.value}, {symbol: late.error}, text))
    return _judged(records, found, _left(records, Law.of(found), dt), dt)


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
            f"the drive does not follow its command by a delay, a lag and limits alone: {100 * share:.0f} % of the "
            "measured force is something else; describe force_measured as force to see the mechanics by what the drive "
            "did"
        )
    none = np.concatenate(_left(records, Law(), dt))
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


def _left(records: list[Record], law: Law, dt: float) -> list[Array]:
    """Return what a drive leaves of each measured force."""
    return [
        ((r.force if r.force_measured is None else r.force_measured) - _given(r, law, dt))[UNSETTLED:] for r in records
    ]


def _given(record: Record, law: Law, dt: float) -> Array:
    return law.output(record.force, dt, speeds(record, dt) if law.free < np.inf else 0.0)


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
            f"compare force_measured with force: with the best delay, lag and limits {share:.0f} % of its "
            "variance does not follow the commanded force; needs the drive's measured force of the same samples, or no "
            "such column, or, where the supply limits the drive, the measured force described as force"
        )
    if late.name != "slew_limit" and late.value > 0.98 * LATEST * dt and late.left < (1.0 - DRIVE_GAIN) * late.none:
        raise BadInputError(
            f"compare force_measured with force: it follows {LATEST:.0f} samples late or more, which is as far as is "
            "searched; needs columns of the same clock (or a longer sample_time_s), or no such column"
        )


@dataclass(frozen=True, slots=True)
class _Late:
    """How late a drive is: by which law of one number, with its standard error; squares left by it, by the others,
    by none.
    """

    name: str
    value: float
    error: float
    left: float
    others: dict[str, float]
    none: float
    told: bool


def _latest(records: list[Record], limits: Law, dt: float) -> _Late:
    """Fit a delay, a lag and a rate of change of a drive with given limits; return what leaves least."""

    def off(name: str, value: float) -> Array:
        law = replace(limits, **{PLACE[TIMED[name]]: max(value, 0.0)})
        return np.concatenate(_left(records, law, dt))

    def misfit(name: str, value: float) -> float:
        e = off(name, value)
        return float(e @ e)

    top = max(float(np.max(np.abs(r.force))) for r in records)
    found = {
        "delay": _delay(lambda value: misfit("delay", value), dt),
        "lag": dt * _least(lambda p: misfit("lag", p * dt), (0.0, LATEST)),
        "slew_limit": top / (_rise(lambda rise: misfit("slew_limit", top / (rise * dt))) * dt),
    }
    left = {name: misfit(name, value) for name, value in found.items()}
    name = min(left, key=lambda s: left[s])
    value, none = found[name], np.concatenate(_left(records, limits, dt))
    step = SMALL * value if name == "slew_limit" else STEP * dt
    below = min(step, value)
    slope = (off(name, value + step) - off(name, value - below)) / (step + below)
    error = float(np.sqrt(left[name] / len(slope) / max(float(slope @ slope), 1e-300)))
    told = value > max(SIGNIFICANT * error, 1e-3 * dt)
    others = {n: v for n, v in left.items() if n != name}
    return _Late(name, value, error, left[name], others, float(none @ none), told)


def _least(misfit: Callable[[float], float], bounds: tuple[float, float]) -> float:
    found = minimize_scalar(misfit, bounds=bounds, method="bounded", options={"maxiter": 25})
    return float(found.x)


def _rise(misfit: Callable[[float], float]) -> float:
    """Return the rise [samples] that leaves least, first of a few, then between."""
    best = int(np.argmin([misfit(rise) for rise in RISES]))
    low, high = (float(np.log(RISES[i])) for i in (max(best - 1, 0), min(best + 1, len(RISES) - 1)))
    return float(np.exp(_least(lambda p: misfit(float(np.exp(p))), (low, high))))


def _delay(misfit: Callable[[float], float], dt: float) -> float:
    """Search half samples first, then between."""
    grid = np.arange(0.0, LATEST + 0.5, 0.5) * dt
    start = float(grid[int(np.argmin([misfit(float(d)) for d in grid]))] / dt)
    best = minimize_scalar(
        lambda p: misfit(float(p) * dt),
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


def _plateau(records: list[Record], noise: float, unit: str) -> Finding | None:
    """Find a level at which the measured force stays although the command passes it clearly."""
    measured = np.concatenate([r.force_measured for r in records if r.force_measured is not None])
    commanded = np.concatenate([r.force for r in records])
    top = float(np.quantile(np.abs(measured), 0.9995))
    near = np.abs(np.abs(measured) - top) < 5.0 * noise + 0.004 * top
    beyond = near & (np.abs(commanded) > 1.03 * top + 6.0 * noise)
    if beyond.sum() < 8 or np.abs(commanded).max() < 1.05 * top:
        return None
    # a real plateau: hardly any measured sample above, and the command beyond it most of the time it is near
    level = float(np.median(np.abs(measured[beyond])))
    if np.mean(np.abs(measured) > level + 6.0 * noise) > 1e-3 or _late(records, level, noise):
        return None
    return Finding(
        "saturation",
        {"limit": level},
        {"limit": noise * np.sqrt(0.5 * np.pi / beyond.sum())},
        f"measured force stays at {level:.4g} {unit} in {beyond.sum()} samples while the command goes on",
    )


def _supply(records: list[Record], noise: float, model: AxisModel) -> Finding | None:
    """Find a largest force that falls with the speed in its direction, where the command passes it clearly."""
    measured, commanded = (
        np.concatenate([f[UNSETTLED:] for f in each])
        for each in zip(
            *((r.force if r.force_measured is None else r.force_measured, r.force) for r in records), strict=True
        )
    )
    along = np.sign(commanded) * np.concatenate([speeds(r, model.sample_time_s)[UNSETTLED:] for r in records])
    force, top = np.sign(commanded) * measured, float(np.max(np.abs(commanded)))
    rows = np.abs(commanded) - force > 6.0 * noise + 0.03 * top
    for _ in range(FITS):
        if np.count_nonzero(rows) < FEWEST or np.ptp(along[rows]) < 0.1 * model.max_speed:
            return None
        columns = np.stack([np.ones(np.count_nonzero(rows)), along[rows]], axis=1)
        (rest, slope), *_ = np.linalg.lstsq(columns, force[rows], rcond=None)
        if not (rest > 0.0 > slope):
            return None
        # within the law where the command passes it, whatever is measured there
        most = np.maximum(rest + slope * along, 0.0)
        rows = (np.abs(commanded) - most > 6.0 * noise + 0.03 * top) & (np.abs(force - most) < 0.1 * rest)
    off = force[rows] - (rest + slope * along[rows])
    spread = np.sqrt(np.mean(off**2) * np.diag(np.linalg.inv(columns.T @ columns)))
    if -slope < SIGNIFICANT * spread[1]:
        return None
    free = -rest / slope
    return Finding(
        "supply_limit",
        {"F0": float(rest), "v0": float(free)},
        {"F0": float(spread[0]), "v0": float(free * np.hypot(spread[0] / rest, spread[1] / slope))},
        f"measured force stays below {rest:.4g} {model.force_unit} less its share of {free:.4g} "
        f"{model.position_unit}/s in {np.count_nonzero(rows)} samples while the command goes on",
    )


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
