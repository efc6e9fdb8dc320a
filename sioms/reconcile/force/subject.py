"""Prepare a force/torque sensor for the workflow: noise floor, rows, and what the report wants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.effect import TERM_PREFIX
from sioms.reconcile.force.belief import Floats, Loads, readings
from sioms.reconcile.force.plan import Plan, catalogue, propose
from sioms.reconcile.force.records import ForceRecords, check, unit_of, whole_rows
from sioms.reconcile.refuse import hats, knots
from sioms.reconcile.sensors.analyse import Options, analyse
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.fit import ratios
from sioms.reconcile.sensors.subject import Variable, View, by_chance
from sioms.reconcile.sensors.verdict import Curve, Proposal, SensorVerdict
from sioms.reconcile.thresholds import SHARPER
from sioms.reconcile.verdict import NamedEffect

BLOCKS = 40


@dataclass(frozen=True, eq=False)
class ForceData:
    """Rows of one sensor, by component and time; see ``sensors.fit.Data``. A view for each component.

    Attributes:
        measured: readings as shares of full range, all rows of time; which: rows of time that count.
        sigma: noise of a reading, shape (components,).
    """

    loads: Loads
    measured: Floats
    sigma: Floats
    which: NDArray[np.bool_]
    views: tuple[str, ...]

    @cached_property
    def view(self) -> NDArray[np.int64]:
        """View of each row: its component."""
        return np.repeat(np.arange(len(self.views)), int(self.which.sum()))

    @property
    def element(self) -> NDArray[np.int64]:
        """Component of each row."""
        return self.view

    @property
    def footing(self) -> tuple[int, ...]:
        """Every component stands on its own."""
        return tuple(range(len(self.views)))

    @cached_property
    def block(self) -> NDArray[np.int64]:
        """Blocks of consecutive rows of each component."""
        own = np.unique(blocks_of(len(self.which))[self.which], return_inverse=True)[1]
        return np.concatenate([own + i * (int(own.max()) + 1) for i in range(len(self.views))])

    def predict(self, model: SensorModel) -> Floats:
        """Readings in units of their noise."""
        said = readings(model.belief(), self.loads)
        return np.asarray((said / self.sigma)[self.which].T.ravel())

    def doubts(self, model: SensorModel) -> Floats:
        """None: what a model reads is exact."""
        return np.zeros((len(self.view), 0))

    def miss(self, predicted: Floats) -> Floats:
        """Predicted less measured, the zero of every record projected out."""
        return self.whiten(predicted - (self.measured / self.sigma)[self.which].T.ravel())

    def independent(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the blocks, and no columns: what is projected out is told by many of them, or by one alone."""
        return self.block, np.zeros((len(self.block), 0))

    def whiten(self, change: Floats) -> Floats:
        """Take the mean of every record and component off, shape (n,) or (n, k)."""
        c = change.reshape(len(self.views), int(self.which.sum()), -1)
        out = np.empty_like(c)
        for record in self._records:
            out[:, record] = c[:, record] - c[:, record].mean(1, keepdims=True)
        return out.reshape(change.shape)

    @cached_property
    def _records(self) -> list[slice]:
        """Rows of each record among those that count."""
        ends = np.flatnonzero(np.diff(self.loads.record[self.which])) + 1
        count = int(self.which.sum())
        return [slice(a, b) for a, b in zip([0, *ends], [*ends, count], strict=True)]


def blocks_of(count: int) -> NDArray[np.int64]:
    """Number of the block of each row of time."""
    return np.arange(count) * min(BLOCKS, max(count // 8, 5)) // count


@dataclass(frozen=True, slots=True)
class ForceSubject:
    """A prepared sensor; see ``sensors.analyse.Subject``."""

    whole: ForceData
    training: ForceData
    final: ForceData
    model: SensorModel
    records: ForceRecords
    notes: tuple[str, ...]
    names: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()
    settled: tuple[NamedEffect, ...] = ()
    plans: tuple[Plan, ...] = ()

    def views(self) -> Mapping[str, View]:
        """Readings in their own units."""
        full = self.model.base.full
        return {
            n: View(f"reading {n}", unit_of(n), float(s * f))
            for n, s, f in zip(self.whole.views, self.whole.sigma, full, strict=True)
        }

    def features(self) -> Mapping[int, Floats]:
        """Columns of the state, the same for every component."""
        d = self.training
        mine, loads = d.which, d.loads
        columns = [hats(loads.time, knots(loads.time, 12))]
        for i in range(loads.load.shape[1]):
            own = loads.load[:, i]
            if np.ptp(own) == 0.0:
                continue
            way = np.sign(np.gradient(own))
            columns += [
                hats(own, knots(own, 10)),
                hats(own, knots(own, 6)) * way[:, None],
                own[:, None] * hats(loads.time, knots(loads.time, 6)),
                (own * loads.warmth)[:, None],
            ]
            columns += [(own * loads.load[:, j])[:, None] for j in range(i)]
        columns.append(hats(loads.warmth, knots(loads.warmth, 6)))
        full = np.concatenate(columns, axis=1)[mine]
        full = full - full.mean(0)
        return {i: full / s for i, s in enumerate(d.sigma)}

    def sharpened(self, model: SensorModel, shares: Mapping[int, float]) -> ForceSubject | None:
        """Return the sensor with the noise told beside a model; a loop of another form would then be no noise: the
        same.
        """
        d = self.whole
        seen = floor_of(d.measured, d.measured - readings(model.belief(), d.loads)) / d.sigma
        quiet = ratios(d, model) * np.sqrt([1.0 - shares.get(i, 0.0) for i in range(len(d.views))])
        lower = np.minimum(seen, quiet) * by_chance(len(d.measured))
        if "hysteresis" in model.effects or not (lower < SHARPER).any():
            return None
        sigma = d.sigma * np.where(lower < SHARPER, lower, 1.0)
        parts = [replace(p, sigma=sigma) for p in (d, self.training, self.final)]
        return replace(self, whole=parts[0], training=parts[1], final=parts[2])

    def groups(self) -> NDArray[np.int64]:
        """Row of time of each row of the first component."""
        return np.arange(int(self.training.which.sum()))

    def variables(self, d: ForceData) -> Sequence[Variable]:
        """What a disagreement may go with."""
        out: list[tuple[str, str, int, Floats]] = []
        r = self.records
        for i in range(len(r.names)):
            out += [(f"load {n}", unit_of(n), i, r.load[:, j]) for j, n in enumerate(r.names)]
            out.append(("size of its load", unit_of(r.names[i]), i, np.abs(r.load[:, i])))
            out.append(("direction of its load", "1", i, np.sign(np.gradient(r.load[:, i]))))
            out.append(("time", "s", i, r.time - r.time[0]))
            if np.isfinite(r.temperature).all():
                out.append(("temperature", "K", i, r.temperature))
        return [Variable(name, unit, view, values[d.which]) for name, unit, view, values in out]

    def propose(self, models: Sequence[SensorModel]) -> tuple[Proposal, ...]:
        """Rank the programmes of loads by how far the models differ on them; those of the stand where there is one."""
        return propose(models, self.plans or catalogue(len(self.records.names)), self.whole.sigma)

    def curves(self, before: SensorModel, after: SensorModel) -> tuple[Curve, ...]:
        """Reading less load of the components that disagreed most, over time."""
        r, full = self.records, before.base.full
        old, new = (readings(m.belief(), self.whole.loads) * full for m in (before, after))
        size = np.sum(((old - r.reading) / full / self.whole.sigma) ** 2, axis=0)
        out = []
        for i in np.argsort(-size)[:3]:
            shift = [np.mean(r.reading[:, i] - v[:, i]) for v in (old, new)]
            out.append(
                Curve(
                    f"{r.names[i]}: reading less load",
                    "time, s",
                    unit_of(r.names[i]),
                    r.time - r.time[0],
                    r.reading[:, i] - r.load[:, i],
                    old[:, i] + shift[0] - r.load[:, i],
                    new[:, i] + shift[1] - r.load[:, i],
                    self.final.which,
                )
            )
        return tuple(out)

    def unit(self, effect: str, symbol: str) -> str:
        """Return the unit of a parameter."""
        return next(q.unit for q in self.model.library[effect].parameters if q.symbol == symbol)


def prepare(records: ForceRecords, model: SensorModel, plans: Sequence[Plan] = ()) -> ForceSubject:
    """Check the recordings and lay them out.

    Args:
        plans: programmes of loads that can be applied to decide between confounders; none for those of the catalogue.

    Raises:
        BadInputError: they cannot be used; the message says why.
    """
    records, notes = whole_rows(records)
    notes += check(records, model)
    full = model.base.full
    t = records.temperature
    known = bool(np.isfinite(t).all() and np.ptp(t) > 0.0)
    if not known:
        notes.append("temperature was not recorded, or is constant: what follows the temperature is not judged")
    loads = Loads(
        records.load / full,
        records.time - records.time[0],
        t - t.mean() if known else np.zeros(len(t)),
        records.record,
    )
    measured = records.reading / full
    sigma = noise_of(loads, measured)
    block = blocks_of(len(measured))
    mine = block % 5 == 2
    everything = np.ones(len(measured), dtype=bool)
    data = [ForceData(loads, measured, sigma, w, records.names) for w in (everything, ~mine, mine)]
    names = tuple(n for n, e in model.library.items() if e.rankable and not n.startswith(TERM_PREFIX))
    terms = tuple(n for n in model.library if n.startswith(TERM_PREFIX))
    return ForceSubject(data[0], data[1], data[2], model, records, tuple(notes), names, terms, plans=tuple(plans))


def noise_of(loads: Loads, measured: Floats) -> Floats:
    """Return the noise of each component: what no smooth function of load, time and temperature
    explains, row to row.
    """
    n = len(measured)
    columns = [
        np.ones((n, 1)),
        loads.load,
        loads.load**2,
        loads.load**3,
        loads.time[:, None],
        loads.warmth[:, None],
    ]
    way = np.sign(np.gradient(loads.load, axis=0))
    a = np.concatenate([*columns, way], axis=1)
    size = np.linalg.norm(a, axis=0)
    a = a[:, size > 0.0] / size[size > 0.0]
    rest = measured - a @ np.linalg.lstsq(a, measured, rcond=1e-9)[0]
    return floor_of(measured, rest)


def floor_of(measured: Floats, rest: Floats) -> Floats:
    """Return how far each column scatters from row to row beside what is known of it; no less than its digits allow."""
    n = len(measured)
    noise = 1.4826 * np.median(np.abs(np.diff(rest, 2, axis=0)), axis=0) / np.sqrt(6.0)
    steps = [np.diff(np.unique(np.round(measured[:, i], 12))) for i in range(measured.shape[1])]
    floor = np.array([float(s.min()) / np.sqrt(12.0) if len(s) and len(s) < n // 2 else 0.0 for s in steps])
    out: Floats = np.maximum(np.maximum(noise, floor), 1e-9)
    return out


def reconcile(records: ForceRecords, model: SensorModel, options: Options | None = None) -> SensorVerdict:
    """Prepare and analyse one sensor.

    Raises:
        BadInputError: the recordings cannot be used.
    """
    return analyse(prepare(records, model), options)
