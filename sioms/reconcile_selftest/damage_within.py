"""Ways in which a part of a record can be damaged, or every sample by a filter or a register.

As in ``damage``, none of them leaves anything that could be named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from sioms.reconcile_selftest.damage import KINDS, Damage, Public, Run, column, columns, rows

Array = NDArray[Any]
Change = Callable[[Array], Array]
FORCES = ("force", "force_measured")
HEADS = ("time", "counts", "command", *FORCES)


def _like(a: Array, values: Array) -> Array:
    """Return values of the kind of a column: counts are whole."""
    return np.asarray(np.rint(values) if a.dtype.kind == "i" else values, dtype=a.dtype)


def _scaled_later(factor: float) -> Change:
    """Go on in other units from half way, without a leap."""

    def change(a: Array) -> Array:
        steps = np.diff(a, prepend=a[:1]).astype(np.float64)
        steps[len(a) // 2 :] *= factor
        return _like(a, a[0] + np.cumsum(steps))

    return change


def _later(change: Change) -> Change:
    return lambda a: np.concatenate([a[: len(a) // 2], change(a[len(a) // 2 :])]).astype(a.dtype)


def _middle_backwards(a: Array) -> Array:
    third, half = len(a) // 3, len(a) // 2
    return np.concatenate([a[:third], a[third:half][::-1], a[half:]])


def _over_16_bits(a: Array) -> Array:
    """Count about the end of a register of 16 bits."""
    return _like(a, (a - int(np.median(a))) % 65536 - 32768.0)


def _over_the_end(a: Array) -> Array:
    top = 0.6 * np.abs(a).max()
    return _like(a, (a + top) % (2.0 * top) - top)


def _filtered(rows_: float, late: int = 0) -> Change:
    def change(a: Array) -> Array:
        y = lfilter([1.0 / rows_], [1.0, 1.0 / rows_ - 1.0], a - a[0]) + a[0]
        return _like(a, np.concatenate([np.full(late, a[0]), y])[: len(a)])

    return change


def _mean_of(n: int) -> Change:
    return lambda a: _like(a, np.convolve(np.concatenate([np.full(n - 1, a[0]), a]), np.full(n, 1.0 / n), "valid"))


def _held(n: int) -> Change:
    return lambda a: np.repeat(a[::n], n)[: len(a)]


def _as_large(a: Array, values: Array) -> Array:
    return _like(a, values * np.ptp(a) / max(float(np.ptp(values)), 1e-300))


def _every_second_interpolated(a: Array) -> Array:
    out = np.array(a)
    n = (len(a) - 1) // 2
    out[1 : 2 * n : 2] = _like(a, 0.5 * (a[0 : 2 * n : 2] + a[2 : 2 * n + 1 : 2]))
    return out


def _interpolated(p: Public, other: Public, rng: np.random.Generator) -> Public:
    def between(a: Array) -> Array:
        return _like(a, np.interp(np.arange(0.0, len(a) - 1.0, 0.5), np.arange(len(a)), a))

    return p.without_time().each(lambda r: {name: between(a) for name, a in r.items()})


def _dropped_out(name: str, share: float) -> Damage:
    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        return p.each(lambda r: {**r, name: np.where(rng.random(len(r[name])) < share, 0, r[name])})

    return damage


def _two(join: Callable[[Run, Run], Run]) -> Damage:
    """Make each record of one of each axis, cut to the same length."""

    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        size = min(len(r["counts"]) for r in (*p.runs, *other.runs))
        cut = [[{name: a[:size] for name, a in r.items()} for r in q.runs] for q in (p, other)]
        return replace(p, runs=tuple({**r, **join(r, o)} for r, o in zip(*cut, strict=True)))

    return damage


def _second_half(*names: str) -> Damage:
    def join(r: Run, o: Run) -> Run:
        half = len(r["counts"]) // 2
        out = {name: np.concatenate([r[name][:half], o[name][half:]]) for name in names}
        if "counts" in names:  # where one axis stands the other goes on
            out["counts"][half:] += r["counts"][half - 1] - o["counts"][half]
        return out

    return _two(join)


def _every_second(r: Run, o: Run) -> Run:
    even = np.arange(len(r["counts"])) % 2 == 0
    return {name: np.where(even, r[name], o[name]) for name in HEADS[1:]}


def _added(r: Run, o: Run) -> Run:
    return {name: r[name] + o[name] * np.std(r[name]) / max(float(np.std(o[name])), 1e-300) for name in FORCES}


def _one_after_another(leap: float) -> Damage:
    """Join two runs, and go on from where the first ended, or a part of its motion beside it."""

    def joined(a: Run, b: Run) -> Run:
        out = {name: np.concatenate([a[name], b[name]]) for name in a}
        off = a["counts"][-1] - b["counts"][0] + int(leap * np.ptp(a["counts"]))
        out["counts"][len(a["counts"]) :] += off
        out["time"] = np.arange(len(out["time"])) * (a["time"][1] - a["time"][0])
        return out

    return lambda p, other, rng: replace(
        p, runs=tuple(joined(a, b) for a, b in zip(p.runs[::2], p.runs[1::2], strict=True))
    )


def _one_record(change: Callable[[Run], Run]) -> Damage:
    return lambda p, other, rng: replace(p, runs=(*p.runs[:-1], change(dict(p.runs[-1]))))


def _every(step_s: float) -> Damage:
    """Log at a low rate, and say so."""

    def damage(p: Public, other: Public, rng: np.random.Generator) -> Public:
        dt = float(p.runs[0]["time"][1] - p.runs[0]["time"][0])
        n = max(round(step_s / dt), 2)
        return p.rows(lambda size: np.arange(0, size, n)).with_axis(sample_time_s=n * dt)

    return damage


def _control_error(p: Public, other: Public, rng: np.random.Generator) -> Public:
    unit = p.model["axis"]["resolution"]
    return p.each(lambda r: {**r, "counts": _like(r["counts"], 1000.0 * (r["command"] / unit - r["counts"]))})


def _of_the_acceleration(p: Public, other: Public, rng: np.random.Generator) -> Public:
    def force(r: Run) -> Array:
        a = np.convolve(np.diff(r["counts"].astype(np.float64), 2, prepend=0.0, append=0.0), np.ones(20), "same")
        return np.asarray(a * np.std(r["force"]) / max(float(np.std(a)), 1e-300))

    return p.each(lambda r: {**r, **dict.fromkeys(FORCES, force(r))})


def _decimal_commas(p: Public, other: Public, rng: np.random.Generator) -> Public:
    """Write decimal commas between commas."""

    def text(r: Run) -> bytes:
        table = np.stack([r[name].astype(np.float64) for name in HEADS], axis=1)[:500]
        lines = (",".join(f"{value:.6f}".replace(".", ",") for value in row) for row in table)
        return "\n".join([",".join(HEADS), *lines]).encode()

    return replace(p, raw={f"run{i}.csv": text(r) for i, r in enumerate(p.runs)})


WITHIN: Mapping[str, Damage] = {
    # from somewhere on
    "position in other units from half way": column("counts", _scaled_later(1.0 / 2.54)),
    "force in other units from half way": columns(FORCES, _later(lambda a: a / 4.448)),
    "force turned round from half way": columns(FORCES, _later(np.negative)),
    "time backwards in the middle": column("time", _middle_backwards),
    "rows backwards in the middle": rows(lambda n, rng: _middle_backwards(np.arange(n))),
    "two runs in one record": _one_after_another(0.0),
    "two runs in one record, and a leap between": _one_after_another(0.15),
    "another axis from half way": _second_half(*HEADS[1:]),
    "force of another axis from half way": _second_half(*FORCES),
    "position of another axis from half way": _second_half("counts"),
    # rows between rows
    "every second row of another axis": _two(_every_second),
    "rows interpolated between rows": _interpolated,
    "every second row interpolated": columns(HEADS[1:], _every_second_interpolated),
    "position held for ten rows": column("counts", _held(10)),
    "force held for fifty rows": columns(FORCES, _held(50)),
    "a log of ten rows a second": _every(0.1),
    "time in whole seconds": column("time", np.floor),
    "time in tenths of a second": column("time", lambda t: np.floor(10.0 * t) / 10.0),
    "decimal commas between commas": _decimal_commas,
    # registers
    "position beyond sixteen bits": column("counts", _over_16_bits),
    "force beyond its register": columns(FORCES, _over_the_end),
    "force cut off on one side": columns(FORCES, lambda a: np.minimum(a, 0.3 * a.max())),
    "measured force cut off": column("force_measured", lambda a: np.clip(a, -0.3 * a.max(), 0.3 * a.max())),
    "measured force constant": column("force_measured", np.ones_like),
    "force zero in a tenth of the rows": _dropped_out("force", 0.1),
    "position zero in some rows": _dropped_out("counts", 0.01),
    # other quantities
    "position filtered": column("counts", _filtered(15.0)),
    "position filtered and late": column("counts", _filtered(15.0, 20)),
    "position a mean of a hundred rows": column("counts", _mean_of(100)),
    "force a mean of two hundred rows": columns(FORCES, _mean_of(200)),
    "position its own speed": column("counts", lambda a: _as_large(a, np.diff(a, prepend=a[:1]).astype(np.float64))),
    "position its own integral": column("counts", lambda a: _as_large(a, np.cumsum(a - a.mean()))),
    "position the control error": _control_error,
    "force from the acceleration": _of_the_acceleration,
    "force squared": columns(FORCES, lambda a: a * np.abs(a) / np.abs(a).max()),
    "forces of two axes added": _two(_added),
    # one record of four
    "one record in other counts": _one_record(lambda r: {**r, "counts": 4 * r["counts"]}),
    "one record backwards": lambda p, other, rng: _one_record(lambda r: {n: a[::-1] for n, a in r.items()})(
        p.without_time(), other, rng
    ),
}
#: All kinds.
EVERY: Mapping[str, Damage] = {**KINDS, **WITHIN}
