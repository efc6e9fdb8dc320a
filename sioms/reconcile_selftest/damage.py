"""More than a hundred ways in which records, their description or their model can be damaged or of something else.

Each takes what the solver may see of one axis, and of another one, and returns what it is given instead. None of them
leaves anything that could be named: an answer is an error, or a refusal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Run = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Public:
    """What a solver may see: recordings by columns, the names of the columns that are described, the tables of the
    model, and files that are written as they are. It does not see what the axis hides.
    """

    runs: tuple[Run, ...]
    described: tuple[str, ...]
    model: dict[str, dict[str, Any]]
    raw: Mapping[str, bytes] | None = None
    hidden: tuple[str, ...] = ()

    def each(self, change: Callable[[Run], Run]) -> Public:
        """Change every recording."""
        return replace(self, runs=tuple(change(dict(r)) for r in self.runs))

    def without_time(self) -> Public:
        """Leave the time out: nothing then says when a row was."""
        kept = tuple(name for name in self.described if name != "time")
        return replace(self, described=kept)

    def rows(self, chosen: Callable[[int], NDArray[Any]]) -> Public:
        """Take other rows, by their numbers."""
        return self.each(lambda r: {name: a[chosen(len(a))] for name, a in r.items()})

    def with_axis(self, **numbers: Any) -> Public:
        """Change numbers of the axis in the model."""
        return replace(self, model={**self.model, "axis": {**self.model["axis"], **numbers}})


Damage = Callable[[Public, Public, np.random.Generator], Public]


def column(name: str, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Damage:
    return lambda p, other, rng: p.each(lambda r: {**r, name: change(r[name])})


def columns(names: tuple[str, ...], change: Callable[[NDArray[Any]], NDArray[Any]]) -> Damage:
    return lambda p, other, rng: p.each(lambda r: {**r, **{n: change(r[n]) for n in names}})


def _noise(names: tuple[str, ...]) -> Damage:
    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        return p.each(lambda r: {**r, **{n: _white(r[n], rng) for n in names}})

    return damage


def _white(a: NDArray[Any], rng: np.random.Generator) -> NDArray[Any]:
    drawn = np.std(a) * rng.standard_normal(len(a))
    return np.asarray(np.rint(drawn) if a.dtype.kind == "i" else drawn, dtype=a.dtype)


def _exchanged(one: str, two: str) -> Damage:
    return lambda p, other, rng: p.each(lambda r: {**r, one: r[two], two: r[one]})


def _from_next_run(name: str) -> Damage:
    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        turned = [p.runs[-1], *p.runs[:-1]]
        return replace(p, runs=tuple({**r, name: o[name]} for r, o in zip(p.runs, turned, strict=True)))

    return damage


def _from_other(*names: str) -> Damage:
    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        size = min(len(r["counts"]) for r in (*p.runs, *other.runs))
        runs = (
            {**{n: a[:size] for n, a in r.items()}, **{n: o[n][:size] for n in names}}
            for r, o in zip(p.runs, other.runs, strict=True)
        )
        return replace(p, runs=tuple(runs))

    return damage


def rows(chosen: Callable[[int, np.random.Generator], NDArray[Any]], timed: bool = False, one: bool = False) -> Damage:
    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        changed = (p if timed else p.without_time()).rows(lambda n: chosen(n, rng))
        return replace(changed, runs=(*p.runs[:-1], changed.runs[-1])) if one else changed

    return damage


def _axis(**factors: float) -> Damage:
    return lambda p, other, rng: p.with_axis(**{k: f * p.model["axis"][k] for k, f in factors.items()})


def _set(**numbers: Any) -> Damage:
    return lambda p, other, rng: p.with_axis(**numbers)


def _model_of_other(*tables: str) -> Damage:
    return lambda p, other, rng: replace(p, model={**p.model, **{t: other.model[t] for t in tables}})


def _file(name: str, content: Callable[[np.random.Generator], bytes]) -> Damage:
    return lambda p, other, rng: replace(p, raw={name: content(rng)})


def _leaping(a: NDArray[Any], size: float, rng: np.random.Generator, count: int) -> NDArray[Any]:
    out = np.array(a)
    at = rng.integers(len(a) // 10, len(a) - 2, count)
    out[at] += np.rint(size * np.ptp(a)).astype(a.dtype) if a.dtype.kind == "i" else size * np.ptp(a)
    return out


def _spikes(name: str, size: float, count: int) -> Damage:
    return lambda p, other, rng: p.each(lambda r: {**r, name: _leaping(r[name], size, rng, count)})


def _frozen(a: NDArray[Any]) -> NDArray[Any]:
    half = len(a) // 2
    return np.concatenate([a[:half], np.full(len(a) - half, a[half])])


def _clipped(share: float) -> Callable[[NDArray[Any]], NDArray[Any]]:
    return lambda a: np.clip(a, -share * np.abs(a).max(), share * np.abs(a).max()).astype(a.dtype)


def _wrapped(a: NDArray[Any]) -> NDArray[Any]:
    size = max(int(np.ptp(a) // 3), 2)
    return np.asarray(a % size, dtype=a.dtype)


def _walk(p: Public, other: Public, rng: np.random.Generator) -> Public:
    def walked(a: NDArray[Any]) -> NDArray[Any]:
        steps = np.cumsum(rng.standard_normal(len(a)))
        return np.asarray(np.rint(steps * np.ptp(a) / np.ptp(steps)), dtype=a.dtype)

    return p.each(lambda r: {**r, "counts": walked(r["counts"])})


def _mixed_records(p: Public, other: Public, rng: np.random.Generator) -> Public:
    return replace(p, runs=(*p.runs[:2], *other.runs[2:])).without_time()


def _swapped_blocks(n: int, rng: np.random.Generator) -> NDArray[Any]:
    a, b, c = n // 4, n // 2, 3 * n // 4
    at = np.arange(n)
    return np.concatenate([at[:a], at[b:c], at[a:b], at[c:]])


def _ordered(name: str) -> Damage:
    return lambda p, other, rng: p.without_time().each(lambda r: {n: a[np.argsort(r[name])] for n, a in r.items()})


def _turned_columns(p: Public, other: Public, rng: np.random.Generator) -> Public:
    names = ("counts", "command", "force", "force_measured")
    return p.each(lambda r: {**r, **{n: r[m] for n, m in zip(names, (*names[1:], names[0]), strict=True)}})


def _short(p: Public, other: Public, rng: np.random.Generator) -> Public:
    return p.rows(lambda n: np.arange(40))


def _resting(p: Public, other: Public, rng: np.random.Generator) -> Public:
    return p.each(lambda r: {**r, "counts": np.full_like(r["counts"], r["counts"][0])})


def _undescribed(p: Public, other: Public, rng: np.random.Generator) -> Public:
    return replace(p, described=("time", "position"))


CSV = b"time [s],position [rad],force [N m]\n"
MEASURED = ("counts", "command", "force", "force_measured")
LATER: Callable[[int], Callable[[NDArray[Any]], NDArray[Any]]] = lambda n: lambda a: np.roll(a, n)  # noqa: E731
KINDS: Mapping[str, Damage] = {
    # rows, where no time tells
    "every second row lost": rows(lambda n, rng: np.arange(0, n, 2)),
    "every second row lost in one record": rows(lambda n, rng: np.arange(0, n, 2), one=True),
    "two rows of three lost": rows(lambda n, rng: np.arange(0, n, 3)),
    "nine rows of ten lost": rows(lambda n, rng: np.arange(0, n, 10)),
    "rows doubled": rows(lambda n, rng: np.repeat(np.arange(n), 2)),
    "rows tripled": rows(lambda n, rng: np.repeat(np.arange(n), 3)),
    "a tenth of the rows lost": rows(lambda n, rng: np.flatnonzero(rng.random(n) > 0.1)),
    "half of the rows lost": rows(lambda n, rng: np.flatnonzero(rng.random(n) > 0.5)),
    "a tenth of the rows doubled": rows(lambda n, rng: np.repeat(np.arange(n), 1 + (rng.random(n) < 0.1))),
    "a part cut out": rows(lambda n, rng: np.r_[0 : n // 3, n // 2 : n]),
    "a part twice": rows(lambda n, rng: np.r_[0 : n // 2, n // 3 : n]),
    "two parts exchanged": rows(_swapped_blocks),
    "rows shuffled": rows(lambda n, rng: rng.permutation(n)),
    "rows backwards": rows(lambda n, rng: np.arange(n)[::-1]),
    "rows in order of position": _ordered("counts"),
    "rows in order of force": _ordered("force"),
    "neighbours exchanged": rows(lambda n, rng: np.arange(n - n % 2).reshape(-1, 2)[:, ::-1].ravel()),
    # time
    "rows shuffled with their time": rows(lambda n, rng: rng.permutation(n), timed=True),
    "every second row lost with its time": rows(lambda n, rng: np.arange(0, n, 2), timed=True),
    "time stands still": column("time", np.zeros_like),
    "time runs backwards": column("time", lambda t: t[::-1]),
    "time in milliseconds": column("time", lambda t: 1e3 * t),
    "time in minutes": column("time", lambda t: t / 60.0),
    "time half as fast": column("time", lambda t: 2.0 * t),
    "time a tenth too fast": column("time", lambda t: t / 1.1),
    "time without numbers": column("time", lambda t: np.full_like(t, np.nan)),
    "time with leaps": column("time", lambda t: t + np.floor(np.arange(len(t)) / 50)),
    "time at random": lambda p, other, rng: p.each(lambda r: {**r, "time": np.sort(rng.random(len(r["time"])))}),
    # columns
    "position and command exchanged": _exchanged("counts", "command"),
    "force and measured force exchanged": _exchanged("force", "force_measured"),
    "position and force exchanged": _exchanged("counts", "force"),
    "command and force exchanged": _exchanged("command", "force"),
    "position and measured force exchanged": _exchanged("counts", "force_measured"),
    "all columns turned on": _turned_columns,
    "force of the run before": _from_next_run("force"),
    "position of the run before": _from_next_run("counts"),
    "command of the run before": _from_next_run("command"),
    "measured force of the run before": _from_next_run("force_measured"),
    "force of another axis": _from_other("force", "force_measured"),
    "position of another axis": _from_other("counts"),
    "command of another axis": _from_other("command"),
    "all but the command of another axis": _from_other("counts", "force", "force_measured"),
    "two records of another axis": _mixed_records,
    "force five rows late": column("force", LATER(5)),
    "force fifty rows late": column("force", LATER(50)),
    "force five rows early": column("force", LATER(-5)),
    "position twenty rows late": column("counts", LATER(20)),
    "command thirty rows late": column("command", LATER(30)),
    "measured force sixty rows late": column("force_measured", LATER(60)),
    # signs and units
    "force turned round": columns(("force", "force_measured"), np.negative),
    "position turned round": column("counts", np.negative),
    "command turned round": column("command", np.negative),
    "measured force turned round": column("force_measured", np.negative),
    "force without its sign": columns(("force", "force_measured"), np.abs),
    "position without its sign": column("counts", np.abs),
    "force in thousandths": columns(("force", "force_measured"), lambda a: 1e3 * a),
    "force in thousands": columns(("force", "force_measured"), lambda a: 1e-3 * a),
    "force alone in thousandths": column("force", lambda a: 1e3 * a),
    "position in thousandths": columns(("counts", "command"), lambda a: 1000 * a),
    "command in thousandths": column("command", lambda a: 1e3 * a),
    "command in thousands": column("command", lambda a: 1e-3 * a),
    "command in inches": column("command", lambda a: a / 25.4),
    "measured force in thousandths": column("force_measured", lambda a: 1e3 * a),
    "measured force in amperes": column("force_measured", lambda a: 0.21 * a),
    "force in kilograms": columns(("force", "force_measured"), lambda a: a / 9.80665),
    "angle in degrees": columns(("counts", "command"), lambda a: 57.29578 * a),
    "resolution a thousand times": _axis(resolution=1e3),
    "resolution a thousandth": _axis(resolution=1e-3),
    # the model
    "inertia a thousand times": _axis(inertia=1e3),
    "inertia a thousandth": _axis(inertia=1e-3),
    "sample time ten times": _axis(sample_time_s=10.0),
    "sample time twice": _axis(sample_time_s=2.0),
    "model of another axis": _model_of_other("axis", "controller"),
    "numbers of another axis": _model_of_other("axis"),
    "controller of another axis": _model_of_other("controller"),
    "inertia below zero": _axis(inertia=-1.0),
    "rated force zero": _axis(rated_force=0.0),
    "pitch no number": _set(pitch=float("nan")),
    "kind unknown": _set(kind="round"),
    # noise, and channels that died
    "white noise in all columns": _noise(MEASURED),
    "white noise in position": _noise(("counts",)),
    "white noise in force": _noise(("force",)),
    "white noise in command": _noise(("command",)),
    "white noise in measured force": _noise(("force_measured",)),
    "position drifts at random": _walk,
    "position at rest": _resting,
    "force constant": column("force", np.ones_like),
    "force without numbers": column("force", lambda a: np.full_like(a, np.nan)),
    "spikes in position": _spikes("counts", 0.5, 30),
    "spikes in force": _spikes("force", 2.0, 200),
    "position stops half way": column("counts", _frozen),
    "force stops half way": columns(("force", "force_measured"), _frozen),
    "position cut off": column("counts", _clipped(0.5)),
    "force cut off in the record": columns(("force", "force_measured"), _clipped(0.3)),
    "position wrapped": column("counts", _wrapped),
    # files
    "NPZ of garbage": _file("run0.npz", lambda rng: rng.bytes(5000)),
    "MAT of garbage": _file("run0.mat", lambda rng: rng.bytes(5000)),
    "CSV of garbage": _file("run0.csv", lambda rng: rng.bytes(5000)),
    "MAT of version 7.3": _file(
        "run0.mat", lambda rng: b"MATLAB 7.3 MAT-file".ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n"
    ),
    "CSV with lines of other lengths": _file("run0.csv", lambda rng: CSV + b"1,2,3\n1,2,3\n1,2,3\n1,2\n"),
    "CSV of heads alone": _file("run0.csv", lambda rng: CSV),
    "an empty file": _file("run0.npz", lambda rng: b""),
    "description of garbage": _file("columns.toml", lambda rng: rng.bytes(300)),
    "model of garbage": _file("nominal.toml", lambda rng: rng.bytes(300)),
    "no force described": _undescribed,
    "records of a moment": _short,
}
