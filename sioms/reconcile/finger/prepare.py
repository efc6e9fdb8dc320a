"""Prepare a finger for the workflow: checks, channels (lines, dead elements, the load cell), and rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.finger.belief import Belief, outputs, scene_of
from sioms.reconcile.finger.checks import check_commands, check_match, check_raw
from sioms.reconcile.finger.data import FingerData, lay_out, only, warm_known
from sioms.reconcile.finger.effects import library
from sioms.reconcile.finger.plan import Bench
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
from sioms.reconcile.finger.subject import FingerSubject
from sioms.reconcile.finger.terms import TERMS
from sioms.reconcile.sensors.analyse import Options, analyse
from sioms.reconcile.sensors.effect import Quantity, SensorEffect, SensorModel
from sioms.reconcile.sensors.subject import untouched
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Estimate, NamedEffect
from sioms.tactile.touches import Recording

BLUR = Quantity("blur", "rad^2", 0.0, 0.0256, 1e-3, "square of the half angle that an element averages over")
START_EXTENT = 0.25  # of the elements' pitch: where the fit of an extent that is not stated begins
LOAD_MARGIN = 1.15  # the load cell's noise during a touch is a little more than its frames say
LOAD_SPREAD = 0.02  # of a touch's load where no load cell tells it
FOLLOWS = 0.3  # correlation of outputs and load cell from touch to touch above which the cell is believed


@dataclass(frozen=True, slots=True)
class Experiment:
    """One recording; touches come with place [rad], load [N/m] and indenter radius [m] per touch, else None."""

    name: str
    recording: Recording
    touches: tuple[Floats, Floats, Floats] | None = None


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
        bench: what touches can be made to decide between confounders.

    Raises:
        BadInputError: the recordings cannot be used; the message says why.
    """
    count = len(nominal.angle)
    touches = [e for e in experiments if e.touches is not None]
    if not touches:
        raise BadInputError("read recordings: none holds touches (cmd_theta, cmd_P, cmd_rc); record some first")
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
    still = reduce_untouched(by_name["thermal"], scale, lines, after_s=after) if "thermal" in by_name else None
    ramps = tuple(reduce_ramps(by_name["ramp"], scale, ~alive, lines)) if "ramp" in by_name else ()
    blur = nominal.blur or ((START_EXTENT * _pitch(nominal.angle)) ** 2 if refine_extent else 0.0)
    base = replace(
        nominal, angle=np.ascontiguousarray(nominal.angle), around=nominal.poisson, about=nominal.core, blur=blur
    )
    library_ = {**library(), **{t.name: t for t in TERMS}}
    model = SensorModel(base, count, library_, {}, (BLUR,) if refine_extent else (), name)
    model, settled = _settle(model, lines, alive)
    whole = _rows(touched, np.flatnonzero(alive), still, ramps, base, notes).loaded(model)
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
        model = model.with_effect("mains_line", {"a": np.array([line.amplitude]), "f": np.array([line.frequency])})
        e = float(student.ppf(0.975, np.count_nonzero(alive) - 1)) * line.deviation
        w = 1.96 * line.frequency_deviation
        told = [f"{100 * q.amplitude:.3g} % at {q.frequency:.3f} Hz" for q in lines]
        settled.append(
            _named(
                effect,
                (
                    Estimate("a", line.amplitude, line.amplitude - e, line.amplitude + e, "1", "amplitude"),
                    Estimate("f", line.frequency, line.frequency - w, line.frequency + w, "Hz", "frequency"),
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
        None,
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
    """Lay out the rows with the best guess of each touch's load: the load cell at the commanded level if outputs follow
    it.
    """
    count = len(t)
    told = bool(np.isfinite(t.cell).all() and np.ptp(t.cell) > 0.0 and np.all(t.cell > 0.0))
    load, share, spread = t.load.copy(), np.full(count, LOAD_SPREAD), np.full(count, np.nan)
    unsure = 0.0
    if told and np.allclose(t.cell, t.load, rtol=1e-6):
        share = LOAD_MARGIN * t.cell_noise / t.cell
        notes.append("the loads are what the load cell says: its scale is not judged")
    elif told:
        level, deviation, spread = cell_level(t)
        ratio = t.cell / t.load / level
        if _follows(t, ratio, base, alive):
            load, share, unsure = t.cell / level, LOAD_MARGIN * t.cell_noise / t.cell, deviation / level
        else:
            # no load was further from its command than the cell, with its noise, says; light ones are further, for
            # their size
            share = LOAD_MARGIN * spread / t.cell
            share *= min(1.0, LOAD_SPREAD / float(np.median(share)))
            notes.append("the outputs do not follow the load cell from touch to touch: the commanded load was used")
    else:
        notes.append(f"no load cell: the commanded load was used, {100 * LOAD_SPREAD:.0f} % of it taken as uncertain")
    return lay_out(t, alive, still, ramps, base.angle, share, load, spread, unsure)


def cell_level(t: Touched) -> tuple[float, float, Floats]:
    """Return what the load cell reads per commanded load, its standard deviation, and the cell's spread by touch [N/m].

    Weighed by the spread; touches far off count as far as three of its standard deviations (Huber 1964).
    """
    level = float(np.median(t.cell / t.load))
    spread = cell_spread(t, level)
    off = np.abs(t.cell - level * t.load) / spread
    weight = np.minimum(1.0, 3.0 / np.maximum(off, 1e-9)) / spread**2
    told = float(np.sum(weight * t.load**2))
    return float(np.sum(weight * t.load * t.cell)) / told, told**-0.5, spread


def cell_spread(t: Touched, level: float) -> Floats:
    """Return how far the load cell scatters about the commanded loads [N/m]: beyond its own noise alike, or in
    proportion to them.

    The likelier of the two; touches far off count no more than at three standard deviations.
    """
    off, least, best = t.cell - level * t.load, np.inf, t.cell_noise
    for size in (np.ones(len(t)), t.load):
        # 0.455 is the median of a normal deviate squared
        seen, own = (np.median((v / size) ** 2) for v in (off, t.cell_noise))
        spread = np.sqrt(t.cell_noise**2 + max(float(seen / 0.455 - own), 0.0) * size**2)
        unlikely = float(np.sum(np.log(spread) + 0.5 * np.minimum((off / spread) ** 2, 9.0)))
        if unlikely < least:
            least, best = unlikely, spread
    return best


def _follows(t: Touched, ratio: Floats, base: Belief, alive: NDArray[np.intp]) -> bool:
    """Say whether the strength of touches goes with the load cell beyond the commanded load.

    Every element gets its own gain first, and what repeats from element to element is taken off, or scatter and width
    of the elements hide the loads.
    """
    expected = outputs(base, scene_of(t.place, t.load, t.radius))[:, alive]
    own = t.output[:, alive]
    expected = expected * (np.sum(own * expected, axis=0) / (np.sum(expected**2, axis=0) + 1e-30))
    strength = np.sum(own * expected, axis=1) / (np.sum(expected**2, axis=1) + 1e-30)
    pitch = _pitch(base.angle)
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


def _pitch(angle: Floats) -> float:
    return float(np.median(np.abs(np.diff(np.sort(angle))))) if len(angle) > 1 else 1.0


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
