"""Prepare a finger for the workflow: checks, channels (lines, dead elements, the load cell), rows, and what the report wants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.finger.belief import Belief, outputs, scene_of
from sioms.reconcile.finger.checks import check_commands, check_match, check_raw
from sioms.reconcile.finger.data import COURSE, DRIFT, TOUCH, VIEWS, FingerData, lay_out, only, warm_known
from sioms.reconcile.finger.effects import library
from sioms.reconcile.finger.plan import Bench, indenter, propose
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.finger.records import (
    Line,
    Ramped,
    Touched,
    Untouched,
    find_lines,
    reduce_ramps,
    reduce_touches,
    reduce_untouched,
)
from sioms.reconcile.finger.terms import TERMS
from sioms.reconcile.refuse import hats
from sioms.reconcile.sensors.analyse import Options, Variable, View, analyse, untouched
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, SensorModel
from sioms.reconcile.sensors.refuse import knots
from sioms.reconcile.sensors.verdict import Curve, Proposal, SensorVerdict
from sioms.reconcile.verdict import Estimate, NamedEffect
from sioms.tactile.touches import Recording

EXTENT = Quantity("extent", "rad", 0.0, 0.16, 0.01, "half angle that an element averages over")
LOAD_MARGIN = 1.15  # the load cell's noise during a touch is a little more than its frames say
LOAD_SPREAD = 0.02  # of a touch's load where no load cell tells it
NEAR_DEG, ACROSS = 24.0, 8  # from a touch: where an element answers, and bins across it
FOLLOWS = 0.3  # correlation of outputs and load cell from touch to touch above which the cell is believed


@dataclass(frozen=True, slots=True)
class Experiment:
    """One recording; touches come with place [rad], load [N/m] and indenter radius [m] per touch, else None."""

    name: str
    recording: Recording
    touches: tuple[Floats, Floats, Floats] | None = None


@dataclass(frozen=True, slots=True)
class FingerSubject:
    """A prepared finger; see ``sensors.analyse.Subject``."""

    whole: FingerData
    training: FingerData
    final: FingerData
    model: SensorModel
    settled: tuple[NamedEffect, ...]
    notes: tuple[str, ...]
    names: tuple[str, ...] = field(
        default_factory=lambda: tuple(n for n, e in library().items() if e.rankable)
    )
    terms: tuple[str, ...] = tuple(t.name for t in TERMS)
    bench: Bench = field(default_factory=Bench)

    def views(self) -> Mapping[str, View]:
        """Outputs in per cent."""
        d = self.whole
        noise = float(np.sqrt(np.mean(d.touched.noise[d.alive] ** 2)))
        share = float(np.median(d.touched.share))
        drift = (
            float(np.median(d.untouched.noise[d.alive]))
            if d.untouched is not None
            else noise * np.sqrt(0.5 * share)
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
                    View("load cell", "N/m", d.cell_spread),
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
        load = np.repeat(np.log(d.scene.load / np.median(d.scene.load)), ns)
        near, level = hats(x, np.radians(np.linspace(-32.0, 32.0, 33))), hats(out, knots(out, 16))
        per_touch = [hats(place, knots(place, 30)), hats(d.scene.time, knots(d.scene.time, 16))]
        round_ = np.minimum(d.scene.radius, 1.0)
        kinds = [np.asarray(round_ == v, dtype=np.float64) for v in np.unique(round_)][:12]
        columns = [near, level, near * load[:, None], out[:, None] * np.stack([load, load**2], axis=1)]
        columns += [out[:, None] * np.repeat(c, ns, axis=0) for c in per_touch]
        columns += [near[:, 8:25] * np.repeat(k, ns)[:, None] for k in kinds]
        if warm_known(d.touched):
            columns.append((out * np.repeat(d.scene.temperature, ns))[:, None])
        for e in range(ns):
            mine = np.zeros((len(place), ns))
            mine[:, e] = 1.0
            columns.append(mine.reshape(-1, 1) * np.stack([out, out**2, np.ones_like(out)], axis=1))
        sigma = np.sqrt(d.touched.share)[:, None] * d.touched.noise[d.alive]
        touch = np.zeros((len(d.view), sum(c.shape[1] for c in columns)))
        touch[d.view == TOUCH] = np.concatenate(columns, axis=1) / sigma.ravel()[:, None]
        found = {TOUCH: d.whiten(touch)[d.view == TOUCH]}
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

    def groups(self) -> NDArray[np.int64]:
        """Touch of each row of the view of touches."""
        return np.repeat(np.arange(len(self.training.touched)), len(self.training.alive))

    def variables(self) -> Sequence[Variable]:
        """What the disagreement is located by."""
        d = self.whole
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
        own = np.concatenate(
            [np.zeros((len(t), rows[0].shape[1] - 6 if rows else 0)), hats(t, knots(t, 6))], axis=1
        )
        rows.append(np.repeat(own, len(d.alive), axis=0))
    widest = max(r.shape[1] for r in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, widest - r.shape[1]))) for r in rows])


def prepare(
    experiments: Sequence[Experiment],
    nominal: Belief,
    name: str,
    scale: float = 0.01,
    refine_extent: bool = True,
    bench: Bench | None = None,
) -> FingerSubject:
    """Check the recordings and lay them out.

    Args:
        experiments: recordings; those with touches, and by their names ``noise``, ``thermal`` and ``ramp``.
        nominal: the finger as the simulation has it.
        scale: output per raw unit.
        refine_extent: the elements' width is not known and fitted along.
        bench: what touches can be made to decide between look-alikes.

    Raises:
        BadInputError: the recordings cannot be used; the message says why.
    """
    count = len(nominal.angle)
    touches = [e for e in experiments if e.touches is not None]
    if not touches:
        raise BadInputError(
            "read recordings: none holds touches (cmd_theta, cmd_P, cmd_rc); record some first"
        )
    for e in experiments:
        check_raw(e.recording.raw, count, e.name)
        if e.touches is not None:
            check_commands(*e.touches, e.name)
    dead = _stuck([e.recording for e in touches])
    if np.count_nonzero(~dead) < 2:
        raise BadInputError(
            f"read recordings: {int(dead.sum())} of {count} elements are stuck or hold no numbers; needs 2 living ones"
        )
    by_name = {e.name: e.recording for e in experiments}
    lines = find_lines(by_name["noise"], scale) if "noise" in by_name else []
    told = [(e.name, e.recording, *e.touches) for e in touches if e.touches is not None]
    touched, notes = reduce_touches(told, scale, dead, lines)
    alive = check_match(touched, nominal, ~dead)
    after = max(float(e.recording.time_s[-1]) for e in experiments if e.name not in ("thermal", "noise"))
    still = reduce_untouched(by_name["thermal"], scale, after_s=after) if "thermal" in by_name else None
    ramps = tuple(reduce_ramps(by_name["ramp"], scale, ~alive)) if "ramp" in by_name else ()
    base = replace(nominal, angle=np.ascontiguousarray(nominal.angle), around=nominal.poisson)
    library_ = {**library(), **{t.name: t for t in TERMS}}
    model = SensorModel(base, count, library_, {}, (EXTENT,) if refine_extent else (), name)
    model, settled = _settle(model, lines, alive)
    whole = _rows(touched, np.flatnonzero(alive), still, ramps, base, notes)
    notes += _missing(by_name, touched, refine_extent)
    mine = untouched(len(touched))
    parts = (whole, only(whole, ~mine, base.angle), only(whole, mine, base.angle))
    return FingerSubject(*parts, model, settled, tuple(notes), bench=bench or Bench())


def _stuck(recordings: Sequence[Recording]) -> NDArray[np.bool_]:
    """Elements whose readings never change, or are no numbers for the most part."""
    out = np.ones(recordings[0].raw.shape[1], dtype=bool)
    for r in recordings:
        finite = np.isfinite(r.raw)
        low = np.where(finite, r.raw, np.inf).min(0)
        high = np.where(finite, r.raw, -np.inf).max(0)
        out &= (finite.mean(0) < 0.5) | ~(high > low)
    return out


def _settle(
    model: SensorModel, lines: Sequence[Line], alive: NDArray[np.bool_]
) -> tuple[SensorModel, tuple[NamedEffect, ...]]:
    """Name what channels of their own have shown."""
    settled: list[NamedEffect] = []
    if lines:
        line = lines[0]
        effect = model.library["mains_line"]
        model = model.with_effect(
            "mains_line", {"a": np.array([line.amplitude]), "f": np.array([line.frequency])}
        )
        e = 1.96 * line.deviation
        told = [f"{100 * q.amplitude:.3g} % at {q.frequency:.3f} Hz" for q in lines]
        settled.append(
            _named(
                effect,
                (
                    Estimate("a", line.amplitude, line.amplitude - e, line.amplitude + e, "1", "amplitude"),
                    Estimate("f", line.frequency, line.frequency, line.frequency, "Hz", "frequency"),
                ),
                f"stands out of the spectrum of untouched frames: {', '.join(told)}; taken off every touch",
            )
        )
    lost = np.flatnonzero(~alive)
    if len(lost):
        effect = model.library["dead_element"]
        model = model.with_effect("dead_element", {"index": np.array([float(lost[0])])})
        settled.append(
            _named(
                effect,
                tuple(
                    Estimate(
                        f"index[{i}]" if len(lost) > 1 else "index",
                        float(n),
                        float(n),
                        float(n),
                        "1",
                        "its number, from 0",
                    )
                    for i, n in enumerate(lost)
                ),
                f"element {', '.join(map(str, lost))}: touches that should be felt there change nothing",
            )
        )
    return model, tuple(settled)


def _named(effect: SensorEffect, estimates: tuple[Estimate, ...], evidence: str) -> NamedEffect:
    return NamedEffect(
        effect.name,
        effect.title,
        effect.equation,
        effect.channel.value,
        estimates,
        1.0,
        np.inf,
        1.0,
        (evidence,),
    )


def _rows(
    t: Touched,
    alive: NDArray[np.intp],
    still: Untouched | None,
    ramps: tuple[Ramped, ...],
    base: Belief,
    notes: list[str],
) -> FingerData:
    """Lay out the rows with the best guess of each touch's load: the load cell at the commanded level if outputs follow it."""
    count = len(t)
    told = bool(np.isfinite(t.cell).all() and np.ptp(t.cell) > 0.0 and np.all(t.cell > 0.0))
    load, share, spread = t.load.copy(), np.full(count, LOAD_SPREAD), np.nan
    if told and np.allclose(t.cell, t.load, rtol=1e-6):
        share = LOAD_MARGIN * t.cell_noise / t.cell
        notes.append("the loads are what the load cell says: its scale is not judged")
    elif told:
        level = float(np.median(t.cell / t.load))
        ratio = t.cell / t.load / level
        spread = float(max(1.4826 * np.median(np.abs(t.cell - level * t.load)), np.median(t.cell_noise)))
        if _follows(t, ratio, base, alive):
            load, share = t.cell / level, LOAD_MARGIN * t.cell_noise / t.cell
        else:
            notes.append(
                "the outputs do not follow the load cell from touch to touch: the commanded load was used"
            )
    else:
        notes.append(
            f"no load cell: the commanded load was used, {100 * LOAD_SPREAD:.0f} % of it taken as uncertain"
        )
    return lay_out(t, alive, still, ramps, base.angle, share, load, spread)


def _follows(t: Touched, ratio: Floats, base: Belief, alive: NDArray[np.intp]) -> bool:
    """Say whether the strength of touches goes with the load cell beyond the commanded load.

    Every element gets its own gain first, and what repeats from element to element is taken off, or scatter and width of
    the elements hide the loads.
    """
    expected = outputs(base, scene_of(t.place, t.load, t.radius))[:, alive]
    own = t.output[:, alive]
    expected = expected * (np.sum(own * expected, axis=0) / (np.sum(expected**2, axis=0) + 1e-30))
    strength = np.sum(own * expected, axis=1) / (np.sum(expected**2, axis=1) + 1e-30)
    pitch = float(np.median(np.abs(np.diff(np.sort(base.angle))))) if len(base.angle) > 1 else 1.0
    turn = 2.0 * np.pi * (t.place - base.angle[alive[0]])[:, None] / pitch * np.arange(1.0, 4.0)
    waves = np.concatenate([np.ones((len(t), 1)), np.cos(turn), np.sin(turn)], axis=1)
    inside = (t.place > base.angle[alive].min()) & (t.place < base.angle[alive].max())
    told: list[Floats] = []
    heard: list[Floats] = []
    for kind in {(p, r) for p, r in zip(t.load[inside], t.radius[inside], strict=True)}:
        mine = np.flatnonzero(inside & (t.load == kind[0]) & (t.radius == kind[1]))
        if len(mine) < 16:
            continue
        for values, into in ((ratio[mine], told), (strength[mine], heard)):
            rest = values - waves[mine] @ np.linalg.lstsq(waves[mine], values, rcond=1e-8)[0]
            into.append(rest / max(float(np.mean(np.abs(values))), 1e-9))
    if not told:
        return True
    x, y = np.concatenate(told), np.concatenate(heard)
    return bool(x @ y > FOLLOWS * np.sqrt((x @ x) * (y @ y)))


def _missing(by_name: Mapping[str, Recording], t: Touched, refine: bool) -> list[str]:
    out = []
    if "noise" not in by_name:
        out.append("no recording 'noise' at full rate: lines of the mains are not looked for")
    if not warm_known(t) and "thermal" not in by_name:
        out.append("temperature was not recorded, or is constant: drift with temperature is not judged")
    if "ramp" not in by_name:
        out.append("no recording 'ramp': creep and quadratic response rest on the touches alone")
    if refine:
        out.append("the width of the elements is not stated and was fitted along")
    return out


def reconcile(
    experiments: Sequence[Experiment],
    nominal: Belief,
    name: str,
    options: Options | None = None,
    scale: float = 0.01,
    refine_extent: bool = True,
) -> SensorVerdict:
    """Prepare and analyse one finger.

    Raises:
        BadInputError: the recordings cannot be used.
    """
    return analyse(prepare(experiments, nominal, name, scale, refine_extent), options)
