"""A prepared finger as the workflow sees it: what is reported, features of the state, experiments, curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.finger.belief import Belief, outputs
from sioms.reconcile.finger.data import (
    COURSE,
    DRIFT,
    OWN_ERROR,
    STRENGTH,
    TOUCH,
    VIEWS,
    FingerData,
    only,
    warm_known,
)
from sioms.reconcile.finger.effects import library
from sioms.reconcile.finger.plan import Bench, indenter, propose
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.finger.terms import TERMS
from sioms.reconcile.refuse import hats, knots
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.subject import Variable, View, untouched
from sioms.reconcile.sensors.verdict import Curve, Proposal
from sioms.reconcile.thresholds import SHARPER
from sioms.reconcile.verdict import NamedEffect

TURNED = 0.3  # of the noise, from which on it counts what else a load does
NEAR_DEG, ACROSS = 24.0, 8  # from a touch: where an element answers, and bins across it


@dataclass(frozen=True, slots=True)
class FingerSubject:
    """A prepared finger; see ``sensors.analyse.Subject``."""

    whole: FingerData
    training: FingerData
    final: FingerData
    model: SensorModel
    settled: tuple[NamedEffect, ...]
    notes: tuple[str, ...]
    names: tuple[str, ...] = field(default_factory=lambda: tuple(n for n, e in library().items() if e.rankable))
    terms: tuple[str, ...] = tuple(t.name for t in TERMS)
    bench: Bench = field(default_factory=Bench)

    def views(self) -> Mapping[str, View]:
        """Outputs in per cent."""
        d = self.whole
        noise = float(np.sqrt(np.mean(d.touched.noise[d.alive] ** 2)))
        share = float(np.median(d.touched.share))
        drift = (
            float(np.median(d.untouched.noise[d.alive])) if d.untouched is not None else noise * np.sqrt(0.5 * share)
        )
        ramp = float(np.median([r.noise for r in d.ramps])) if d.ramps else noise
        return dict(
            zip(
                VIEWS,
                (
                    View("outputs under touch", "%", 100.0 * noise * np.sqrt(share)),
                    View("course under constant load", "%", 100.0 * float(np.median(d.course_sigma))),
                    View("untouched outputs", "%", 100.0 * drift),
                    View("load ramps", "%", 100.0 * ramp),
                    View("load cell", "N/m", float(np.median(d.cell_spread))),
                    View("strength of touches", "%", 100.0 * float(np.median(d.load_share))),
                ),
                strict=True,
            )
        )

    def features(self) -> Mapping[int, Floats]:
        """Columns of the state, in units of the floor like the rows."""
        d = self.training
        b: Belief = self.model.base
        place, ns = d.scene.place, len(d.alive)
        x = (b.angle[d.alive] - place[:, None]).ravel()
        out = d.touched.output[:, d.alive].ravel()
        load = np.log(d.scene.load / np.median(d.scene.load))
        near, level = hats(x, np.radians(np.linspace(-32.0, 32.0, 33))), hats(out, knots(out, 16))
        round_ = np.minimum(d.scene.radius, 1.0)
        kinds = np.stack([round_ == v for v in np.unique(round_)[:12]], axis=1).astype(np.float64)
        ways = [np.stack([load, load**2], axis=1), hats(place, knots(place, 30)), kinds]
        ways.append(hats(d.scene.time, knots(d.scene.time, 16)))
        if warm_known(d.touched):
            ways.append(d.scene.temperature[:, None])
        scaled = out[:, None] * np.repeat(np.concatenate(ways, axis=1), ns, axis=0)
        columns = [scaled, near, level, near * np.repeat(load, ns)[:, None]]
        columns += [near[:, 8:25] * np.repeat(k, ns)[:, None] for k in kinds.T]
        for e in range(ns):
            mine = np.zeros((len(place), ns))
            mine[:, e] = 1.0
            columns.append(mine.reshape(-1, 1) * np.stack([out, out**2, np.ones_like(out)], axis=1))
        sigma = np.sqrt(d.touched.share)[:, None] * d.touched.noise[d.alive]
        touch = np.zeros((len(d.view), sum(c.shape[1] for c in columns)))
        touch[d.view == TOUCH] = np.concatenate(columns, axis=1) / sigma.ravel()[:, None]
        seen = d.whiten(touch)
        found = {TOUCH: seen[d.view == TOUCH], STRENGTH: seen[d.view == STRENGTH][:, : scaled.shape[1]]}
        count = len(place)
        course = np.concatenate(
            [
                np.kron(hats(place, knots(place, 8)), np.eye(3)),
                np.kron(hats(d.scene.load, knots(d.scene.load, 4)), np.eye(3)),
            ],
            axis=1,
        )
        found[COURSE] = course / np.repeat(d.course_sigma, 3)[:, None]
        if np.any(d.view == DRIFT):
            found[DRIFT] = _drift_features(d, count)
        return found

    def sharpened(self, model: SensorModel, shares: Mapping[int, float]) -> FingerSubject | None:
        """Return the finger with loads as certain as touches beside a model show, and what they do as it says; None for
        nothing new.
        """
        d = self.training.loaded(model)
        seen = d.scatter(d.predict(model))
        if seen > SHARPER and d.turned(self.training) < TURNED:
            return None
        share = self.whole.load_share
        if seen < SHARPER:
            share = np.minimum(share, np.maximum(seen * share, OWN_ERROR))
        whole = replace(self.whole.loaded(model), load_share=share)
        mine, angle = untouched(len(whole.touched)), self.model.base.angle
        return replace(self, whole=whole, training=only(whole, ~mine, angle), final=only(whole, mine, angle))

    def groups(self) -> NDArray[np.int64]:
        """Touch of each row of the view of touches."""
        return np.repeat(np.arange(len(self.training.touched)), len(self.training.alive))

    def variables(self, d: FingerData) -> Sequence[Variable]:
        """What a disagreement may go with."""
        b: Belief = self.model.base
        ns, t = len(d.alive), d.touched
        per = {
            "place of touch": ("deg", np.degrees(t.place)),
            "load": ("N/m", t.load),
            "indenter radius": ("mm", 1e3 * np.minimum(t.radius, 0.1)),
            "time": ("s", t.time),
        }
        x = np.degrees(b.angle[d.alive] - t.place[:, None]).ravel()
        out: list[tuple[str, str, int, Floats]] = [
            ("angle from the touch", "deg", TOUCH, x),
            ("distance from the touch", "deg", TOUCH, np.abs(x)),
            ("output", "%", TOUCH, 100.0 * t.output[:, d.alive].ravel()),
        ]
        # bins across every element, as far as a profile reaches
        near = np.clip(np.floor((x + NEAR_DEG) / (2 * NEAR_DEG) * ACROSS), 0, ACROSS - 1).astype(np.int64)
        which = ACROSS * np.tile(np.arange(ns), len(t)) + near
        where = np.tile(d.alive.astype(np.float64), len(t)) + near / ACROSS
        across = Variable(
            "element, from one side to the other", "1", TOUCH, where, np.unique(which, return_inverse=True)[1]
        )
        out += [(name, unit, TOUCH, np.repeat(v, ns)) for name, (unit, v) in per.items()]
        out += [(name, unit, STRENGTH, v) for name, (unit, v) in per.items()]
        out.append(("time under load", "1", COURSE, np.tile(np.arange(3.0), len(t))))
        if warm_known(t):
            out.append(("temperature", "K", TOUCH, np.repeat(t.temperature, ns)))
            warm = [t.temperature]
            if d.untouched is not None:
                warm.append(np.repeat(d.untouched.temperature, ns))
            out.append(("temperature", "K", DRIFT, np.concatenate(warm)))
        return [across, *(Variable(*v) for v in out)]

    def propose(self, models: Sequence[SensorModel]) -> tuple[Proposal, ...]:
        """See ``finger.plan``."""
        noise = float(np.sqrt(np.mean(self.whole.touched.noise[self.whole.alive] ** 2)))
        return propose([m.belief() for m in models], noise, self.bench)

    def curves(self, before: SensorModel, after: SensorModel) -> tuple[Curve, ...]:
        """Outputs of the element that disagreed most, over the place of touch, one curve per indenter."""
        d = self.whole
        old, new = outputs(before.belief(), d.scene), outputs(after.belief(), d.scene)
        worst = d.alive[int(np.argmax(np.sum((old - d.touched.output)[:, d.alive] ** 2, axis=0)))]
        found = []
        kinds = sorted({(n, float(r)) for n, r in zip(d.touched.name, d.touched.radius, strict=True)})
        for name, radius in kinds:
            mine = np.array([n == name for n in d.touched.name]) & (d.touched.radius == radius)
            usual = np.median(d.touched.load[mine])
            mine &= np.abs(d.touched.load - usual) < 0.05 * usual
            if np.count_nonzero(mine) < 6:
                continue
            order = np.flatnonzero(mine)[np.argsort(d.touched.place[mine])]
            found.append(
                Curve(
                    f"element {worst}, {indenter(radius)} ({name})",
                    "place of touch, deg",
                    "output, %",
                    np.degrees(d.touched.place[order]),
                    100.0 * d.touched.output[order, worst],
                    100.0 * old[order, worst],
                    100.0 * new[order, worst],
                    untouched(len(d.touched))[order],
                )
            )
        return tuple(found[:1] + found[-2:]) if len(found) > 3 else tuple(found)

    def unit(self, effect: str, symbol: str) -> str:
        """Return the unit of a parameter."""
        return next(q.unit for q in self.model.library[effect].parameters if q.symbol == symbol)


def _drift_features(d: FingerData, count: int) -> Floats:
    rows = []
    if warm_known(d.touched):
        rows.append(
            np.concatenate(
                [
                    hats(d.touched.time, knots(d.touched.time, 8)),
                    hats(d.touched.temperature, knots(d.touched.temperature, 6)),
                    np.zeros((count, 6)),
                ],
                axis=1,
            )
        )
    if d.untouched is not None:
        t = d.untouched.temperature
        own = np.concatenate([np.zeros((len(t), rows[0].shape[1] - 6 if rows else 0)), hats(t, knots(t, 6))], axis=1)
        rows.append(np.repeat(own, len(d.alive), axis=0))
    widest = max(r.shape[1] for r in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, widest - r.shape[1]))) for r in rows])
