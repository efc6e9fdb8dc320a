"""What the measured force of a drive says by itself, against the commanded one, before any mechanics is fitted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import lfilter

from sioms.reconcile.channels import SIGNIFICANT, Finding
from sioms.reconcile.effect import Array
from sioms.reconcile.engine.evidence import unseen
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.jit import kernel
from sioms.reconcile.kernel import ramped
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.records import Record, Session
from sioms.reconcile.stale import news
from sioms.reconcile.thresholds import (
    COLOURED,
    DOUBTED,
    GOES_WITH,
    LITTLE_DOUBTED,
    STEADY_ROWS,
    STRAYS,
    SURELY_LAW,
)

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
#: Samples back at which a command may still tell what a drive does, and those between; steps over so many samples, from
#: so many back on, of which a limited rate makes nothing else.
PAST, BETWEEN = (0, 1, 2, 4, 8, 16), (3, 5, 6, 7, 10, 12, 14)
STEPS, LONGEST_PAST = {1: (0, 1, 2, 3, 4, 6), 4: (0, 2, 4, 8)}, 17
#: Into how many parts the rows are parted, of which every tenth is foretold by the others.
PARTS, FOLDS = 40, 10
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
        old, new = held[: len(force)], held[1 : len(force) + 1]  # which takes its place within the sample
        u = (1.0 - part) * new + part * old
        if self.rate < np.inf:
            late, u = u, np.empty(len(u))
            _ramp(late, self.rate, dt, u)
            old, new = u, u
        if self.lag > 0.0:
            first, last = np.exp(-part * dt / self.lag), np.exp(-(1.0 - part) * dt / self.lag)
            within = new * (1.0 - last) + old * (1.0 - first) * last
            start: Array = np.asarray(lfilter([0.0, 1.0], [1.0, -first * last], within))  # at each sample's
            middle = old + (start - old) * first
            u = u + self.lag / dt * ((start - old) * (1.0 - first) + (middle - new) * (1.0 - last))
        if self.limit == np.inf:
            return u
        most, least = (self.limit * np.maximum(1.0 + way * speed / self.free, 0.0) for way in (-1.0, 1.0))
        limited: Array = np.clip(u, -least, most)
        return limited


#: What symbols of the effects are called in a law, and the laws of one number in time: effect and symbol.
PLACE = {"delay": "delay", "tau": "lag", "rate": "rate", "limit": "limit", "F0": "limit", "v0": "free"}
TIMED = {"delay": "delay", "lag": "tau", "slew_limit": "rate"}


@dataclass(frozen=True, slots=True)
class _Seen:
    """What is compared of a record: the rows at which the measured force is new, with what it was there; how many rows
    it is held, 0 where that varies, and of how many it is the mean.
    """

    record: Record
    rows: NDArray[np.int64]
    measured: Array
    held: int
    mean: int = 1

    @property
    def commanded(self) -> Array:
        """Return the command at those rows."""
        return self.record.force[self.rows]


def _seen(session: Session) -> list[_Seen]:
    out = []
    for r in session.records:
        if r.force_measured is not None:
            new = news(r.force_measured)
            rows = new.rows[new.rows >= UNSETTLED]
            out.append(_Seen(r, rows, r.force_measured[rows], new.every))
    return out


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
    records = _seen(session)
    if not records:
        return [], ""
    dt, unit = model.sample_time_s, model.force_unit
    noise = _white(records)
    found: list[Finding] = []
    read, late, unsteady = _read(records, Law(), dt)
    for limits in (_plateau(records, noise, unit), _supply(records, noise, model)):
        if limits is None:
            continue
        limited = _read(records, Law.of([limits]), dt)
        if limited[1].left < (1.0 - DRIVE_GAIN) * late.left:  # a drive that only is slow cuts peaks off, too
            (read, late, unsteady), found = limited, [limits]
    _check_follows(read, late, dt)
    if late.counts(dt):
        n = sum(len(r.rows) for r in read)
        misfits = ", ".join(f"with {name} {np.sqrt(left / n):.3g}" for name, left in late.others.items())
        for name, value in late.values.items():
            what = (
                f"changes by {value:.4g} {unit}/s at most"
                if name == "slew_limit"
                else f"is late by {1e3 * value:.3f} ms{_held(read)}"
            )
            text = (
                f"measured force {what}; misfit {np.sqrt(late.left / n):.3g}, {misfits}, with none of them "
                f"{np.sqrt(late.none / n):.3g} {unit}"
            )
            found.append(Finding(name, {TIMED[name]: value}, {TIMED[name]: late.errors[name]}, text))
    found, strays = _judged(read, found, _left(read, Law.of(found), dt), dt)
    return [replace(f, doubted=f.doubted or (unsteady and f.effect in TIMED)) for f in found], strays


def _held(records: list[_Seen]) -> str:
    """Say at which rows a measured force was compared, if not at all of them."""
    held = max(r.held for r in records)
    if min(r.held for r in records) == 0:
        return " at the rows where it is new, which come at no fixed rate"
    of = f", as the mean of {held} rows" if any(r.mean > 1 for r in records) else ""
    return f" at the rows where it is new, one of {held}{of}" if held > 1 else ""


def _read(records: list[_Seen], limits: Law, dt: float) -> tuple[list[_Seen], _Late, bool]:
    """Read a measured force that is held over rows as that of its row, or as the mean since it was new, whichever
    leaves less.

    Returns:
        Also how late it is, and whether that is doubtful: another law, or the other reading, does as well, or it is new
        at no fixed rate.
    """
    laws = [(records, _latest(records, limits, dt))]
    if any(r.held != 1 for r in records):
        means = [replace(r, mean=max(r.held, 1)) for r in records]
        laws.append((means, _latest(means, limits, dt)))
    laws.sort(key=lambda law: law[1].left)
    read, late = laws[0]
    instead = [*late.others.values(), *(other.left for _, other in laws[1:])]
    return read, late, not all(map(late.told_from, instead)) or any(r.held == 0 for r in records)


def _judged(records: list[_Seen], found: list[Finding], left: list[Array], dt: float) -> tuple[list[Finding], str]:
    """Doubt what was found where what it leaves goes with the command, as no noise does, of any colour; see ``drive``.

    Its zero is no law of the drive, and does not count. Its scale doubts a lag, which it looks like, and no more.
    """
    measured = np.concatenate([r.measured for r in records])
    ends = np.cumsum([len(e) for e in left])[:-1]
    whole = np.concatenate(left)
    whole -= np.mean(whole)
    scaled = whole - measured * (measured @ whole) / max(float(measured @ measured), 1e-300)
    share = np.sqrt(_steady(np.split(scaled, ends)) / max(float(measured @ measured), 1e-300))
    with_it = _of_command(records, whole)
    strays = ""
    if share > STRAYS and with_it > GOES_WITH:
        strays = (
            f"the drive does not follow its command by a delay, a lag and limits alone: {100 * share:.0f} % of the "
            "measured force is something else; describe force_measured as force to see the mechanics by what the drive "
            "did"
        )
    none = np.concatenate(_left(records, Law(), dt))
    least = LITTLE_DOUBTED if with_it > SURELY_LAW else DOUBTED
    doubted = with_it * float(whole @ whole) > least * len(none) * float(np.var(none))
    return [replace(f, doubted=doubted) for f in found], strays


def _of_command(records: list[_Seen], left: Array) -> float:
    """Return the share of what a drive leaves that its command, present and past, foretells on other parts of the
    records; none of noise, of any colour.
    """

    def seen(r: _Seen) -> Array:
        past = {k: np.concatenate([np.zeros(k), r.record.force])[r.rows] for k in range(LONGEST_PAST)}
        bent = [p for k in PAST for p in (np.abs(past[k]), past[k] * np.abs(past[k]))]
        steps = [past[k] - past[k + n] for n, first in STEPS.items() for k in first]
        steep = [p for s in steps for p in (s * np.abs(s), s**3)]
        return np.stack([*(past[k] for k in (*PAST, *BETWEEN)), *bent, *steep], axis=1)

    columns = np.concatenate([seen(r) for r in records])
    columns = (columns - columns.mean(axis=0)) / np.maximum(columns.std(axis=0), 1e-300)
    fold = np.arange(len(left)) * PARTS // len(left) % FOLDS
    unsaid = unseen(columns, left, fold, (1e-8, 1e-5, 1e-3))
    return max(1.0 - float(unsaid @ unsaid) / max(float(left @ left), 1e-300), 0.0)


def _steady(left: list[Array]) -> float:
    """Return the squares of what goes on from row to row; 0 of noise."""
    rows, squares = sum(map(len, left)), max(sum(float(e @ e) for e in left), 1e-300)
    steps = sum(float(np.sum(np.diff(e) ** 2)) for e in left) / squares  # 2 of white noise, by 2 over the root of rows
    return 0.0 if steps > 2.0 - max(STEADY_ROWS, COLOURED / np.sqrt(rows)) else squares * (1.0 - 0.5 * steps)


def _left(records: list[_Seen], law: Law, dt: float) -> list[Array]:
    """Return what a drive leaves of each measured force, at the rows where that is new."""

    def given(r: _Seen) -> Array:
        out = law.output(r.record.force, dt, speeds(r.record, dt) if law.free < np.inf else 0.0)
        return (lfilter(np.full(r.mean, 1.0 / r.mean), [1.0], out) if r.mean > 1 else out)[r.rows]

    return [r.measured - given(r) for r in records]


def _check_follows(records: list[_Seen], late: _Late, dt: float) -> None:
    """Refuse a measured force that is not that of the drive: any delay that lowers its misfit by chance would be named.

    Raises:
        BadInputError: see `drive`.
    """
    measured = np.concatenate([r.measured for r in records])
    left = late.left / max(float(np.sum((measured - measured.mean()) ** 2)), 1e-300)
    if left > FOREIGN_FORCE:
        share = 100.0 * min(left, 10.0)
        raise BadInputError(
            f"compare force_measured with force: with the best delay, lag and limits {share:.0f} % of its "
            "variance does not follow the commanded force; needs the drive's measured force of the same samples, or no "
            "such column, or, where the supply limits the drive, the measured force described as force"
        )
    longest = max(value for name, value in {"": 0.0, **late.values}.items() if name != "slew_limit")
    if longest > 0.98 * LATEST * dt and late.left < (1.0 - DRIVE_GAIN) * late.none:
        raise BadInputError(
            f"compare force_measured with force: it follows {LATEST:.0f} samples late or more, which is as far as is "
            "searched; needs columns of the same clock (or a longer sample_time_s), or no such column"
        )


@dataclass(frozen=True, slots=True)
class _Late:
    """How late a drive is: by which laws in time, with their standard errors; squares left by them, by others in their
    place, and by none; independent rows of what they leave.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    left: float
    others: Mapping[str, float]
    none: float
    rows: float

    def counts(self, dt: float) -> bool:
        """Say whether it is late at all."""
        told = all(v > max(SIGNIFICANT * self.errors[n], 1e-3 * dt) for n, v in self.values.items())
        return told and self.left < (1.0 - DRIVE_GAIN) * self.none

    def told_from(self, left: float) -> bool:
        """Say whether what another law leaves is more than chance makes of it."""
        return left - self.left > SIGNIFICANT**2 * self.left / self.rows


def _latest(records: list[_Seen], limits: Law, dt: float) -> _Late:
    """Fit a delay, a lag and a rate of change of a drive with given limits, and a delay and a lag at once; return both
    where each is told beside the other, else what leaves least.
    """

    def off(values: Mapping[str, float]) -> Array:
        law = replace(limits, **{PLACE[TIMED[name]]: max(value, 0.0) for name, value in values.items()})
        return np.concatenate(_left(records, law, dt))

    def misfit(values: Mapping[str, float]) -> float:
        e = off(values)
        return float(e @ e)

    def law(values: dict[str, float], others: dict[str, float]) -> _Late:
        e = off(values)
        rows, slopes = effective_samples(e), []
        for name, value in values.items():
            step = SMALL * value if name == "slew_limit" else STEP * dt
            below = min(step, value)
            slopes.append((off({**values, name: value + step}) - off({**values, name: value - below})) / (step + below))
        size = np.array([max(float(np.linalg.norm(s)), 1e-300) for s in slopes])
        unit = np.stack(slopes) / size[:, None]
        gram = unit @ unit.T
        errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(gram)), 0.0) * float(e @ e) / rows) / size
        named = dict(zip(values, map(float, errors), strict=True))
        return _Late(values, named, float(e @ e), others, none, rows)

    none = misfit({})
    top = max(float(np.max(np.abs(r.record.force))) for r in records)
    found = {
        "delay": _delay(lambda value: misfit({"delay": value}), dt),
        "lag": dt * _least(lambda p: misfit({"lag": p * dt}), (0.0, LATEST)),
        "slew_limit": top / (_rise(lambda rise: misfit({"slew_limit": top / (rise * dt)})) * dt),
    }
    left = {name: misfit({name: value}) for name, value in found.items()}
    name = min(left, key=lambda s: left[s])
    best = law({name: found[name]}, {n: v for n, v in left.items() if n != name})
    if not best.counts(dt):
        return best
    start = 0.5 * np.array([max(found[n], STEP * dt) for n in ("delay", "lag")]) / dt

    def at_once(p: Array) -> float:
        return misfit({"delay": float(p[0]) * dt, "lag": float(p[1]) * dt})

    at = dt * np.asarray(minimize(at_once, start, method="Nelder-Mead", options={"maxiter": 150}).x)
    if np.min(at) > 0.0:
        both = law({"delay": float(at[0]), "lag": float(at[1])}, {f"{n} alone": v for n, v in left.items()})
        if both.counts(dt) and both.told_from(best.left):
            return both
    return best


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


def _white(records: list[_Seen]) -> float:
    """White noise of the measured force."""
    second = [1.4826 * np.median(np.abs(np.diff(r.measured, 2))) / np.sqrt(6.0) for r in records]
    return float(max(np.median(second), 1e-12))


def _plateau(records: list[_Seen], noise: float, unit: str) -> Finding | None:
    """Find a level at which the measured force stays although the command passes it clearly."""
    measured, commanded = (np.concatenate(f) for f in zip(*((r.measured, r.commanded) for r in records), strict=True))
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


def _supply(records: list[_Seen], noise: float, model: AxisModel) -> Finding | None:
    """Find a largest force that falls with the speed in its direction, where the command passes it clearly."""
    measured, commanded = (np.concatenate(f) for f in zip(*((r.measured, r.commanded) for r in records), strict=True))
    along = np.sign(commanded) * np.concatenate([speeds(r.record, model.sample_time_s)[r.rows] for r in records])
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


def _late(records: list[_Seen], level: float, noise: float) -> bool:
    """Say whether large commands are reached later (a delay), not cut off."""
    reached = passed = 0
    for r in records:
        above = np.abs(r.commanded) > 1.05 * level + 6.0 * noise
        edges = np.flatnonzero(above[1:] & ~above[:-1]) + 1
        for e in edges:
            passed += 1
            stop = e + 30
            reached += bool(np.any(np.abs(r.measured[e:stop]) > 1.02 * level + 6.0 * noise))
    return passed > 0 and reached > 0.2 * passed
