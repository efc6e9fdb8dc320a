"""Lay touches, courses, untouched frames, ramps and the load cell out as rows for the fit.

Views: ``touch`` (what every element has of every touch, the profile), ``course`` (how the touch develops while the load
stays), ``drift`` (level of untouched outputs over temperature), ``ramp``, ``cell``, ``strength`` (how strong every
touch is in all, within
what is known of its load: a view of its own, or the many elements would hide it). Nuisances are projected out: zero and
scale of a ramp, the level at power-up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.finger.belief import Belief, Scene, late, outputs, scene_of
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.finger.records import PARTS, Ramped, Touched, Untouched
from sioms.reconcile.finger.terms import GROWING
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.subject import by_chance

VIEWS = ("touch", "course", "drift", "ramp", "cell", "strength")
TOUCH, COURSE, DRIFT, RAMP, CELL, STRENGTH = range(6)
GROUP = 6  # touches in a block
OWN_ERROR = 3e-3  # of a simulated touch
OWN_LEVEL = 1e-3  # of all simulated touches alike: finite elements of another's hand differ by half of it
LATEST = 0.95  # of the time without frames before the load: when the load came on at the latest
_LOAD_STEP = 0.01  # of a load, for a difference
LEAST_RUNS = 12  # of three like touches one after the other, of which the scatter of loads is told
_CONTRASTS = np.array([[-3, -1, 1, 3], [1, -1, -1, 1], [-1, 3, -3, 1]]) / np.array([[20**0.5], [2.0], [20**0.5]])


@dataclass(frozen=True, eq=False)
class FingerData:
    """Rows of one finger; immutable. Make it with ``lay_out``."""

    touched: Touched
    scene: Scene
    alive: NDArray[np.intp]
    untouched: Untouched | None
    ramps: tuple[Ramped, ...]
    ramp_scene: Scene | None
    load_share: Floats  # relative standard deviation of each touch's load
    cell_spread: Floats  # of the cell about the commanded load, by touch [N/m], nan without a cell
    view: NDArray[np.int64]
    block: NDArray[np.int64]
    element: NDArray[np.int64]
    unsure: float = 0.0  # relative standard deviation of the level of all loads
    beyond: Floats | float = (
        0.0  # what outputs change with the logarithm of the load, less themselves, shape (nt, alive)
    )
    views: tuple[str, ...] = VIEWS
    #: A touch's profile alone would be best without any output: its strength goes with it.
    footing: tuple[int, ...] = (0, 1, 2, 3, 4, 0)

    def predict(self, model: SensorModel) -> Floats:
        """See ``sensors.fit.Data``; outputs in units of their noise."""
        b: Belief = model.belief()
        t = self.touched
        out = outputs(b, self.scene)[:, self.alive]
        course = late(b, t.since)
        mean = course.mean(1)
        # the zero goes on drifting between baseline and touch; of the elements' own drifts that few K tell nothing
        warmed = b.common * t.warmed
        drift = warmed.mean(1)[:, None]
        rows = [((out * mean[:, None] + drift) / self._sigma).ravel()]
        following = course - mean[:, None] + self._weight.sum(1)[:, None] * (warmed - drift)
        rows.append(((following @ _CONTRASTS.T) / self.course_sigma[:, None]).ravel())
        rows.append(self._drift(b))
        rows.append(self._ramps(b))
        if np.isfinite(self.cell_spread).all():
            rows.append(t.load * (1.0 + b.cell) / self.cell_spread)
        rows.append(np.zeros(len(t)))  # strengths are taken of the touches' rows by ``whiten``
        return np.concatenate(rows)

    def miss(self, predicted: Floats) -> Floats:
        """See ``sensors.fit.Data``."""
        return self.whiten(predicted - self.measured())

    def doubts(self, model: SensorModel) -> Floats:
        """See ``sensors.fit.Data``: the level of all touches, when the load came on between two frames, when gains were
        stated.
        """
        said, t = self.predict(model), self.touched
        touch = np.where(self.view == TOUCH, said, 0.0)
        later = replace(t, since=t.since + LATEST * t.unseen[:, None])  # creep is less than it seems then
        columns = [
            np.hypot(OWN_LEVEL, self.unsure) * touch,
            (replace(self, touched=later).predict(model) - said) / 1.96,  # no standard deviation: an end
        ]
        columns += [self._growth(model, name) * touch for name in model.effects if name in GROWING]
        return np.stack(columns, axis=1)

    def _growth(self, model: SensorModel, name: str) -> float:
        """Return half the range over the touches of what a term multiplies by: gains may have been stated at its
        beginning.
        """
        grown = model.with_effect(name, {**model.effects[name], "c": np.zeros(1)})
        own, without = (outputs(m.belief(), self.scene) for m in (grown, model.without_effect(name)))
        return 0.5 * float(np.ptp(np.sum(own * without, axis=1) / np.sum(without**2, axis=1)))

    def measured(self) -> Floats:
        """Return the measured rows in the units of ``predict``."""
        t = self.touched
        rows = [(t.output[:, self.alive] / self._sigma).ravel()]
        weight = self._weight
        relative = np.einsum("ji,jpi->jp", weight, t.part[:, :, self.alive] - t.output[:, None, self.alive])
        rows.append(((relative @ _CONTRASTS.T) / self.course_sigma[:, None]).ravel())
        level = t.level[:, self.alive].mean(1) / self._level_sigma
        rows.append(level if self._has_temperature else np.empty(0))
        if self.untouched is not None:
            rows.append((self.untouched.output[:, self.alive] / self.untouched.noise[self.alive]).ravel())
        rows += [r.output / r.noise for r in self.ramps]
        if np.isfinite(self.cell_spread).all():
            rows.append(t.cell / self.cell_spread)
        rows.append(np.zeros(len(t)))
        return np.concatenate(rows)

    def independent(self) -> tuple[NDArray[np.int64], Floats]:
        """Return the blocks, and no columns: what is projected out is told by many of them, or by one alone."""
        return self.block, np.zeros((len(self.block), 0))

    def whiten(self, change: Floats) -> Floats:
        """Split touches into profile and strength, and project out the nuisances, shape (n,) or (n, k)."""
        flat = change.ndim == 1
        c = change[:, None].copy() if flat else change.copy()
        count, ns, k = len(self.touched), len(self.alive), c.shape[1]
        touch = c[: count * ns].reshape(count, ns, k)
        u, size = self._profile
        along = np.einsum("ji,jik->jk", u, touch)
        touch -= u[:, :, None] * along[:, None]
        c[-count:] = along / np.sqrt(1.0 + (size * self.load_share) ** 2)[:, None]
        for begin, stop, basis in self._projected:
            part = c[begin:stop]
            part -= basis @ (basis.T @ part)
        return c[:, 0] if flat else c

    @cached_property
    def _sigma(self) -> Floats:
        """Noise of a touch's output, shape (nt, alive)."""
        out: Floats = np.sqrt(self.touched.share)[:, None] * self.touched.noise[self.alive]
        return out

    def loaded(self, model: SensorModel) -> FingerData:
        """Return the rows with what the load does to outputs as a model has it: what a quadratic or proximity adds is
        not in proportion.
        """
        b: Belief = model.belief()
        more = replace(self.scene, load=(1.0 + _LOAD_STEP) * self.scene.load)
        now, then = (outputs(b, scene)[:, self.alive] for scene in (self.scene, more))
        grown = (then - now) / _LOAD_STEP - now
        return replace(self, beyond=late(b, self.touched.since).mean(1)[:, None] * grown)

    def turned(self, other: FingerData) -> float:
        """Return how far an uncertain load changes profiles less or more than in other rows, in units of their noise
        (rms of touches).
        """
        off = (np.asarray(self.beyond) - other.beyond) / self._sigma
        u, size = self._profile
        off = off - u * np.einsum("ji,ji->j", u, off)[:, None]
        return float(
            np.sqrt(np.mean(np.sum(off**2, axis=1) * self.load_share**2 / (1.0 + (size * self.load_share) ** 2)))
        )

    @cached_property
    def _profile(self) -> tuple[Floats, Floats]:
        """What the load changes in outputs in units of their noise, as a direction, shape (nt, alive), and its length,
        shape (nt,).
        """
        u = (self.touched.output[:, self.alive] + self.beyond) / self._sigma
        size = np.maximum(np.sqrt(np.einsum("ji,ji->j", u, u)), 1e-9)
        return u / size[:, None], size

    def scatter(self, predicted: Floats) -> float:
        """Return by how much loads scatter from touch to touch at most, in units of ``load_share``, as strengths
        beside a prediction tell; inf of few.
        """
        t = self.touched
        size = self._profile[1]
        unit = size * self.load_share
        beside = self.miss(predicted)[-len(t) :] * np.sqrt(1.0 + unit**2) / unit
        same = [n + str(r) for n, r in zip(t.name, t.radius, strict=True)]
        runs = np.array([a == b == c for a, b, c in zip(same, same[1:], same[2:], strict=False)])
        count = int(np.count_nonzero(runs))
        if count < LEAST_RUNS:
            return np.inf
        seen = 1.4826 * np.median(np.abs(np.diff(beside, 2)[runs])) / np.sqrt(6.0) * by_chance(count)
        return float(np.sqrt(max(seen**2 - float(np.median(unit**-2.0)), 0.0)))

    @cached_property
    def _weight(self) -> Floats:
        """Weights that turn a touch's outputs into one relative number, shape (nt, alive)."""
        loud = self.touched.output[:, self.alive]
        loud = np.where(np.abs(loud) > 0.25 * np.abs(loud).max(1, keepdims=True), loud, 0.0)
        w = loud / self.touched.noise[self.alive] ** 2
        out: Floats = w / np.maximum(np.einsum("ji,ji->j", w, loud), 1e-12)[:, None]
        return out

    @cached_property
    def course_sigma(self) -> Floats:
        """Noise of one contrast of a touch's course, shape (nt,)."""
        own = np.sqrt(np.einsum("ji,i->j", self._weight**2, self.touched.noise[self.alive] ** 2))
        frames = 2.0 / self.touched.share
        out: Floats = own * np.sqrt(PARTS / frames)
        return out

    @cached_property
    def _has_temperature(self) -> bool:
        return warm_known(self.touched)

    @cached_property
    def _level_sigma(self) -> float:
        """Noise of a baseline's level: of its frames and its temperature, or what it shows from touch to touch."""
        t = self.touched
        own = float(np.mean(t.noise[self.alive] ** 2) * np.median(t.share)) / 2.0 / len(self.alive)
        level, warm = t.level[:, self.alive].mean(1), t.temperature - t.temperature.mean()
        slope = float(warm @ level) / max(float(warm @ warm), 1e-12)
        jumps = np.diff(level[np.argsort(t.time)], 2)
        seen = float(1.4826 * np.median(np.abs(jumps)) / np.sqrt(6.0))
        told = float(np.sqrt(own + slope**2 * np.median(t.temperature_noise) ** 2))
        return max(told, seen)

    def _drift(self, b: Belief) -> Floats:
        rows = []
        if self._has_temperature:
            rows.append(self.touched.temperature * b.temperature[self.alive].mean() / self._level_sigma)
        if self.untouched is not None:
            u = self.untouched
            rows.append((u.temperature[:, None] * b.temperature[self.alive] / u.noise[self.alive]).ravel())
        return np.concatenate(rows) if rows else np.empty(0)

    def _ramps(self, b: Belief) -> Floats:
        if self.ramp_scene is None:
            return np.empty(0)
        told = b.cell if np.isfinite(self.cell_spread).all() else 0.0  # else nothing but the ramps would tell it
        full, at, out = outputs(b, _true_loads(self.ramp_scene, told)), 0, []
        for r in self.ramps:
            n = len(r.load)
            own = full[at : at + n, r.element]
            at += n
            out.append((own - b.creep * behind(own, r, b.creep_time)) / r.noise if b.creep else own / r.noise)
        return np.concatenate(out)

    @cached_property
    def _projected(self) -> list[tuple[int, int, Floats]]:
        """Spans of rows with the nuisance directions that are taken off them, orthonormal."""
        out: list[tuple[int, int, Floats]] = []
        at = len(self.touched) * (len(self.alive) + len(_CONTRASTS))
        if self._has_temperature:
            n = len(self.touched)
            out.append((at, at + n, np.full((n, 1), n**-0.5)))
            at += n
        if self.untouched is not None:
            n, ns = self.untouched.output[:, self.alive].shape
            basis = np.zeros((n, ns, ns))
            basis[:, np.arange(ns), np.arange(ns)] = n**-0.5
            out.append((at, at + n * ns, basis.reshape(n * ns, ns)))
            at += n * ns
        for r in self.ramps:
            n = len(r.load)
            out.append((at, at + n, np.linalg.qr(np.stack([np.ones(n), r.output], axis=1))[0]))
            at += n
        return out


@lru_cache(maxsize=4)
def _true_loads(scene: Scene, cell: float) -> Scene:
    """Return touches with the loads that a cell with this relative error has felt."""
    return replace(scene, load=scene.load / (1.0 + cell)) if cell else scene


def behind(own: Floats, r: Ramped, tau: float) -> Floats:
    """Return how far a ramp's output through a lag of first order is behind it; the ramp may begin with a step.

    Args:
        own: output without creep in the ramp's bins, straight between them; tau: time constant [s].
    """
    rate, first = np.polyfit(r.since, r.load, 1)
    begin = max(0.0, -first / rate)
    time = np.concatenate([[min(begin, r.since[0])], r.since])
    level = np.concatenate([[own[0] * max(first, 0.0) / r.load[0]], own])
    out, behind = np.empty(len(own)), level[0]
    for i, (step, rise) in enumerate(zip(np.diff(time), np.diff(level), strict=True)):
        ease = np.exp(-step / tau)
        behind = behind * ease + rise * tau / max(step, 1e-12) * (1.0 - ease)
        out[i] = behind
    return out


def lay_out(
    touched: Touched,
    alive: NDArray[np.intp],
    untouched: Untouched | None,
    ramps: tuple[Ramped, ...],
    elements: Floats,
    load_share: Floats,
    load: Floats,
    cell_spread: Floats,
    unsure: float = 0.0,
) -> FingerData:
    """Lay out the rows.

    Args:
        alive: elements that answer.
        elements: angles of the elements [rad]; ramps lie over them.
        load: best guess of each touch's load [N/m] and its relative standard deviation beside it.
        cell_spread: spread of the cell about the commanded load by touch [N/m], nan without a cell.
        unsure: relative standard deviation of the level of all loads.
    """
    warm = np.nan_to_num(touched.temperature - np.nanmean(touched.temperature)) if warm_known(touched) else 0.0 * load
    scene = Scene(touched.place, load, touched.radius, touched.since, touched.time - touched.time.mean(), warm)
    ramp_scene = None
    if ramps:
        place = np.concatenate([np.full(len(r.load), elements[r.element]) for r in ramps])
        loads = np.concatenate([r.load for r in ramps])
        ramp_scene = scene_of(place, loads, np.zeros(len(loads)))
    count, ns = len(touched), len(alive)
    group = np.arange(count) // GROUP
    group = np.minimum(group, max(count // GROUP - 1, 0))
    parts: list[tuple[int, NDArray[np.int64], NDArray[np.int64]]] = [
        (TOUCH, np.repeat(group, ns), np.tile(alive, count)),
        (COURSE, np.repeat(group, len(_CONTRASTS)), np.full(count * len(_CONTRASTS), -1)),
    ]
    if warm_known(touched):
        parts.append((DRIFT, group, np.full(count, -1)))
    if untouched is not None:
        n = len(untouched.temperature)
        parts.append((DRIFT, np.repeat(np.arange(n) * 12 // n, ns), np.tile(alive, n)))
    for r in ramps:
        parts.append((RAMP, np.zeros(len(r.load), dtype=np.int64), np.full(len(r.load), r.element)))
    if np.isfinite(cell_spread).all():
        parts.append((CELL, group, np.full(count, -1)))
    parts.append((STRENGTH, group, np.full(count, -1)))
    blocks, first = [], 0
    for _, own, _ in parts:
        blocks.append(own + first)
        first += int(own.max()) + 1
    return FingerData(
        touched,
        scene,
        alive,
        untouched,
        ramps,
        ramp_scene,
        load_share,
        cell_spread,
        np.concatenate([np.full(len(own), v) for v, own, _ in parts]),
        np.concatenate(blocks),
        np.concatenate([e for _, _, e in parts]).astype(np.int64),
        unsure,
    )


def warm_known(touched: Touched) -> bool:
    """Say whether the temperature was recorded, and not as a constant."""
    return bool(np.isfinite(touched.temperature).all() and np.ptp(touched.temperature) > 0.0)


def only(data: FingerData, which: NDArray[np.bool_], elements: Floats) -> FingerData:
    """Return the rows of some touches, and every fifth or the other untouched rows and ramps with them."""
    few = np.count_nonzero(which) < 0.5 * len(which)
    u = data.untouched
    if u is not None:
        mine = (np.arange(len(u.temperature)) % 5 == 2) == few
        u = replace(u, output=u.output[mine], temperature=u.temperature[mine])
    ramps = tuple(r for i, r in enumerate(data.ramps) if (i % 5 == 2) == few)
    rows = lay_out(
        data.touched.pick(which),
        data.alive,
        u,
        ramps,
        elements,
        data.load_share[which],
        data.scene.load[which],
        data.cell_spread[which],
        data.unsure,
    )
    return replace(rows, beyond=np.broadcast_to(data.beyond, (len(which), len(data.alive)))[which])
