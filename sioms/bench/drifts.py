"""The watch of axes in production: drifts that are put into simulated axes, production without any, and what it costs.

The generator of the production (``sioms.reconcile_selftest.production``) has a plant of its own and is stepped
directly, so a day takes two or three minutes of a core; the watch gets the samples that a node would show. Axes are run
side by side, one process a core. ``--seed`` draws other axes, ``--trials`` so many drifts; hours of quiet production:
``--soak``.
"""

from __future__ import annotations

import copy
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sioms.reconcile.live.watch import Watched
from sioms.reconcile.report.watch import proposal_of
from sioms.reconcile.watch.axis import About, AxisWatch, Settings
from sioms.reconcile.watch.moves import Samples
from sioms.reconcile_selftest import production
from sioms.reconcile_selftest.production import Day, Machine

from .figures import Bar, Report
from .options import Options

AXES, TRIALS, HOURS, LEARN_H = 8, 20, 24, 4.0
#: What has to be named within this motion [s], and over which production following errors are compared [s].
WITHIN_S, COMPARED_S = 600.0, 240.0
NAMES = {
    "dry": "dry friction", "viscous": "viscous friction", "mass": "mass", "backlash": "backlash",
    "force": "lower force", "scale": "scale", "place": "place",
}  # fmt: skip


@dataclass(slots=True)
class Axis:
    """One axis of the cell, and its watch. ``spent_s``: processor time of the watch."""

    machine: Machine
    day: Day
    watch: AxisWatch
    spent_s: float = 0.0

    def produce(self, seconds: float) -> Iterator[bool]:
        """Produce; yield after each move whether there was a judgement."""
        for move in self.day.moves(seconds):
            n = len(move.position)
            samples = Samples(
                move.start_s + production.TICK_S * np.arange(n, dtype=np.float64), move.position, move.force,
                move.command, move.speed, move.moving, np.ones(n, dtype=np.bool_),
            )  # fmt: skip
            began = time.process_time()
            judged = self.watch.feed(samples, [move.start_s + at for at, _ in move.edges])
            self.spent_s += time.process_time() - began
            yield judged


def commissioned(seed: int, number: int, hours: float) -> Axis:
    """Return an axis that has been watched in its commissioning phase."""
    machine = production.draw_machine(seed, number)
    body = machine.body
    about = About(
        machine.name,
        machine.rotary,
        production.TICK_S,
        machine.servo.limit,
        2.0 * machine.travel,
        body.step,
        machine.speed,
    )
    axis = Axis(machine, Day(machine, 1000 * seed + number), AxisWatch(about, Settings(3600.0 * hours)))
    while axis.watch.normal is None:
        for _ in axis.produce(900.0):
            pass
    return axis


def bench_watch(options: Options, report: Report) -> None:
    """Drifts named, false alarms, following errors after correction, share of a core."""
    hours = options.soak if options.soak is not None else options.count(1, HOURS)
    learn_h = 1.0 if options.quick else LEARN_H
    with ProcessPoolExecutor() as cores:
        numbers = range(options.count(2, AXES))
        axes = list(cores.map(partial(commissioned, options.seed, hours=learn_h), numbers))
        days = cores.map(partial(quiet, hours=hours), axes)
        _drifts(options, report, axes)
        _quiet(report, list(days), hours)


def _drifts(options: Options, report: Report, axes: list[Axis]) -> None:
    rng = np.random.default_rng([options.seed, 5])
    counts, minutes, ratios, inside, wrong = Counter[str](), [], [], [], []
    trials = options.kills(4, TRIALS)
    for trial in range(trials):
        kind = production.DRIFTS[trial % len(production.DRIFTS)]
        able = [a for a in axes if a.machine.marks or kind not in ("scale", "place")]
        axis = copy.deepcopy(able[int(rng.integers(len(able)))])
        size = production.draw_drift(axis.machine, kind, rng)
        named, after_s = _injected(axis, kind, size)
        result = (
            "right" if named == NAMES[kind] else "open" if named == "" else "not told" if named is None else "wrong"
        )
        counts[result] += 1
        if result == "right":
            minutes.append(after_s / 60.0)
            ratios.append(_after_correction(axis, kind, size, options.seed))
            inside.append(_is_inside(axis, kind, size))
        else:
            wrong.append(f"{kind} {size:.3g} of {axis.machine.name}: {result}" + (f", {named}" if named else ""))
    rows = [f"{count} {result}" for result, count in counts.items()]
    report.note(f"drifts: {', '.join(rows)}" + "".join(f"; {text}" for text in wrong))
    report.value("drifts named rightly within 10 min of motion", 100.0 * counts["right"] / trials, "%",
                 bars=[Bar("value", 90.0, at_least=True, source="18 of 20")])  # fmt: skip
    report.value("drifts named wrongly", float(counts["wrong"]), "", bars=[Bar("value", 0.0, source="never")])
    if minutes:
        report.value("motion until the name, median", float(np.median(minutes)), "min")
        report.value("size within its interval", 100.0 * float(np.mean(inside)), "%")
        report.value("following error after correction to before the drift, largest", max(ratios), "",
                     bars=[Bar("value", 1.3)])  # fmt: skip


def _injected(axis: Axis, kind: str, size: float) -> tuple[str | None, float]:
    """Let an axis drift; return what was named in time ('' for an open cause), and after how much motion [s]."""
    axis.machine = axis.day.machine = axis.machine.drifted(kind, size)
    began, watch = axis.watch.motion_s, axis.watch
    for judged in axis.produce(1e6):
        so_far = watch.motion_s - began
        if judged and watch.drift is not None and watch.drift.name:
            return watch.drift.name, so_far
        if so_far > WITHIN_S:
            break
    return (None if watch.drift is None else ""), WITHIN_S


def _true_size(axis: Axis, kind: str, size: float, seed_machine: Machine) -> float:
    b = seed_machine.body
    return {"dry": b.dry * size, "viscous": b.viscous * size, "mass": b.mass * size, "force": 1.0 - size}.get(
        kind, size
    )


def _is_inside(axis: Axis, kind: str, size: float) -> bool:
    drift = axis.watch.drift
    normal = production.draw_machine(axis.day.seed // 1000, int(axis.machine.name.removeprefix("axis")))
    true = _true_size(axis, kind, size, normal)
    return drift is not None and drift.finding.low <= true <= drift.finding.high


def _after_correction(axis: Axis, kind: str, size: float, seed: int) -> float:
    """Return the following error with what is proposed, against that of the axis before it drifted."""
    worn = axis.machine
    before = production.draw_machine(axis.day.seed // 1000, int(worn.name.removeprefix("axis")))
    drift, s = axis.watch.drift, worn.servo
    by_place = kind in ("scale", "place")
    if drift is not None and kind == "place":
        worn = replace(worn, body=worn.body._replace(slip=worn.body.slip - drift.finding.size))
    if drift is not None and kind == "scale":
        worn = replace(worn, body=worn.body._replace(gain=worn.body.gain / (1.0 + drift.finding.size)))
    proposal = proposal_of(Watched(axis.watch, None, gains=(s.k, s.kz, s.kp, s.kb)))
    if proposal is not None and (g := proposal.gains) is not None:
        worn = replace(worn, servo=s._replace(k=g.k, kz=g.kz, kp=g.kp, kb=g.kb))
    return production.following(worn, seed, COMPARED_S, by_place) / production.following(
        before, seed, COMPARED_S, by_place
    )


@dataclass(frozen=True, slots=True)
class Quiet:
    """Production of one axis without a drift: whatever is ``told`` is false; of the watch: motion it looked at, and its
    processor time.
    """

    told: tuple[str, ...]
    motion_s: float
    spent_s: float


def quiet(axis: Axis, hours: float) -> Quiet:
    """Produce for so long without a drift."""
    told, was = [], False
    began_s, spent_s = axis.watch.motion_s, axis.spent_s
    for judged in axis.produce(3600.0 * hours):
        if judged:
            drift = axis.watch.drift
            if drift is not None and not was:
                told.append(f"{axis.machine.name}: {drift.text(axis.watch.about)}")
            was = drift is not None
    return Quiet(tuple(told), axis.watch.motion_s - began_s, axis.spent_s - spent_s)


def _quiet(report: Report, days: list[Quiet], hours: float) -> None:
    """Report what was told of production without a drift, and what the watch of it took."""
    told = [text for day in days for text in day.told]
    for text in told:
        report.note(f"false: {text}")
    report.value(
        f"false alarms in {hours:g} h of production of {len(days)} axes", float(len(told)), "", bars=[Bar("value", 0.0)]
    )
    motion_s, spent_s = sum(day.motion_s for day in days), sum(day.spent_s for day in days)
    share = 100.0 * AXES * spent_s / max(motion_s, 1e-9)
    report.value(
        f"processor time of the watch, {AXES} axes that always move", share, "% of a core", bars=[Bar("value", 5.0)]
    )
