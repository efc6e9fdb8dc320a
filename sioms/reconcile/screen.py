"""Screen the library: how much of the innovation each effect could explain, and where its fit should start.

Effects that are forces of the state are evaluated on the smoothed measured motion and passed through the same
linear filter that turns an unmodelled force into an innovation (so nothing is differentiated); the others are
tried in the tracking simulation on a small grid. The Jacobian of the effects already in the model takes part,
so that a gain is one beyond re-adjustment. Source of the filtered regression: M. Gautier, A. Janot,
P.-O. Vandanjon, "A new closed-loop output error method", IEEE T-CST 21 (2013) 428-444.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from sioms.reconcile.bounces import has_impacts
from sioms.reconcile.dry import dry_friction
from sioms.reconcile.effect import Array, Effect, Over, Parameter, Ref, Seen, Slot, Trials
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import SIDE
from sioms.reconcile.engine.search import Start
from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.locked import INTERPOLATION, waves
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import replay
from sioms.reconcile.variation import room_for

MANY = 3  # waves of a residual with each of which an error within a signal period is tried
FEW = 4  # trials that further values are tried with
#: First guesses of the level at speed and of the breakaway level, of a level that stood for both.
DROPS = ((1.0, 1.4), (0.85, 1.05))
SPEED_STEPS, PLACES = 7, 15
#: The last place of a law of speed or force is where all but so few samples are within.
SHOWN = 0.998
#: Below this the measured motion stands for one without noise; a command is followed up to COMMAND_HZ, if to this
#: share.
SLOW_HZ, COMMAND_HZ, FOLLOWED = 5.0, 30.0, 0.2
#: A regression on more rows than this leaves some out.
MOST_ROWS = 40_000


@dataclass(frozen=True, slots=True)
class Motion:
    """Smoothed motion of one record; arrays of shape (n,). ``u`` is the drive's force, ``outer`` a known one beside
    it.
    """

    x: Array
    v: Array
    a: Array
    u: Array
    temperature: Array
    outer: Array


def bandwidth(problem: Problem, model: AxisModel) -> float:
    """Frequency up to which the measured motion is used: three times the observer's bandwidth, within 10 and 150 Hz."""
    hz = 3.0 * np.sqrt(problem.noise.gain[1] / model.sample_time_s) / (2.0 * np.pi)
    return float(np.clip(hz, 10.0, 150.0))


def smoothed_motion(problem: Problem, model: AxisModel, cutoff_hz: float = 0.0) -> list[Motion]:
    """Return zero-phase filtered position, speed and acceleration of every record.

    Args:
        cutoff_hz: 0 takes ``bandwidth``.
    """
    dt, cutoff_hz = model.sample_time_s, cutoff_hz or bandwidth(problem, model)
    out = []
    for record, run in zip(problem.session.records, problem.runs(model), strict=True):
        x = low_passed(record.position, cutoff_hz, dt)
        v = np.gradient(x, dt)
        a = np.gradient(v, dt)
        force = run.applied if cutoff_hz > SLOW_HZ else low_passed(run.applied, cutoff_hz, dt)
        outer = np.zeros(len(record)) if record.external is None else record.external
        out.append(Motion(x, v, a, force, run.temperature, outer))
    return out


def direction(v: Array, dead: float) -> Array:
    """Sign of speed with a linear passage of half-width ``dead`` [{x}/s]."""
    s: Array = np.clip(v / max(dead, 1e-300), -1.0, 1.0)
    return s


def state_columns(effect: Effect, model: AxisModel, motion: Motion, shape: dict[str, float], dead: float) -> Array:
    """Forces per unit of each amplitude of a state effect (two columns where it has a phase), shape (n, k)."""
    columns = []
    m, way = motion, direction(motion.v, dead)
    own = effect.mechanism.column
    dry = dry_friction(model, m.x, m.v, m.u, m.temperature, way) if effect.mechanism.varies else way
    for amplitude, phase in amplitudes(effect):
        for turn in (0.0, np.pi / 2) if phase is not None else (0.0,):
            if own is not None:
                columns.append(own(m, shape["n"] * 2.0 * np.pi / model.pitch, turn, dry))
                continue
            values = {p.symbol: shape.get(p.symbol, 0.0) for p in effect.parameters}
            values[amplitude.symbol] = 1.0
            if phase is not None:
                values[phase.symbol] = turn
            row = effect.row(effect.values(values), model.pitch)
            columns.append(effect.force(m.x, m.v, m.u, m.temperature, way, row))
    return np.stack(columns, axis=1)


def amplitudes(effect: Effect) -> list[tuple[Parameter, Parameter | None]]:
    """Pair every parameter in which the effect is linear with the phase that follows it, if any."""
    out: list[tuple[Parameter, Parameter | None]] = []
    for i, p in enumerate(effect.parameters):
        linear = (
            ("{F}" in p.unit and not p.shape) or (effect.slot is Slot.GAIN and i == 0) or (i == 0 and p.unit == "1")
        )
        if linear:
            following = effect.parameters[i + 1] if i + 1 < len(effect.parameters) else None
            out.append((p, following if following is not None and following.phase else None))
    return out


def shapes(effect: Effect, model: AxisModel, travel: tuple[float, float]) -> Iterator[dict[str, float]]:
    """Yield trial values of the parameters in which a state effect is not linear.

    Args:
        travel: range of motion; of the orders those are tried of which it holds (nearly) one period, of places those
            within.
    """
    linear = {p.symbol for p, _ in amplitudes(effect)}
    order = next((p for p in effect.parameters if p.fixed), None)
    shape = next((p for p in effect.parameters if p.symbol not in linear and not p.fixed and not p.phase), None)
    if order is not None:
        # a wave of one period in a turn of the axis is gravity
        turn = model.pitch / (2.0 * np.pi) if model.rotary and effect.slot is Slot.FORCE else 0.0
        for n in range(max(1, int(model.pitch / (travel[1] - travel[0]))), int(order.upper) + 1):
            if abs(n - turn) > 1e-3:
                yield {order.symbol: float(n)}
    elif shape is not None:
        if shape.lower < 0.0:
            for s in np.linspace(*travel, PLACES + 2)[1:-1]:
                yield {shape.symbol: float(s)}
            return
        if shape.ref is not Ref.SPEED:
            for s in np.geomspace(shape.lower, shape.upper, 2 * SPEED_STEPS):
                yield {shape.symbol: float(s * model.scale(shape))}
            return
        for s in np.geomspace(max(shape.lower, 1e-3), min(shape.upper, 0.3), SPEED_STEPS):
            yield {shape.symbol: float(s * model.scale(shape))}
    else:
        yield {}


def laid(effect: Effect, motions: list[Motion], travel: tuple[float, float]) -> dict[str, float]:
    """Lay the places of a law over what the records show of its variable: about zero, or over the range of motion."""
    if effect.over is Over.PLACE:
        return {"middle": 0.5 * (travel[0] + travel[1]), "step": 0.5 * (travel[1] - travel[0]) / SIDE}
    size = np.abs(np.concatenate([m.v if effect.over is Over.SPEED else m.u for m in motions]))
    return {"middle": 0.0, "step": max(float(np.quantile(size, SHOWN)), 1e-300) / SIDE}


def screen(problem: Problem, fit: Fit, names: list[str], levels: Mapping[str, float] | None = None) -> list[Start]:
    """Rank effects by what they could explain beyond the fitted model.

    Args:
        names: effects to try; those that replace one in the model are tried without it being removed.
        levels: amplitudes already in the model, per symbol, to which what is found adds.

    Returns:
        The candidates, best first.
    """
    motions = smoothed_motion(problem, fit.model)
    lib = known()
    rows = thinned(len(fit.residual))
    q = orthonormal(fit.jacobian[rows])
    rest = fit.residual[rows] - q @ (q.T @ fit.residual[rows])
    dead = dead_band(problem, fit.model)
    travel, filtered = range_of(motions), _filter(problem, fit)
    out = []
    for name in names:
        effect = lib[name]
        if effect.trials is None:
            out.append(_screen_state(filtered, fit, effect, motions, q, rest, dead, travel, levels or {}))
        else:
            out.extend(_screen_trials(problem, fit, effect, q, rest, levels or {}))
    return sorted((s for s in out if s is not None), key=lambda s: -s.gain)


def range_of(motions: list[Motion]) -> tuple[float, float]:
    """Lowest and highest place of all records, [{x}]."""
    low, high = min(float(m.x.min()) for m in motions), max(float(m.x.max()) for m in motions)
    return low, max(high, low + 1e-300)


def instrument_motion(problem: Problem, model: AxisModel) -> list[Motion]:
    """Return a motion that carries (nearly) none of the noise of the measurement.

    That of the simulated closed loop; without a controller to simulate that of the command, where the axis follows it;
    without a command the measured one, below ``SLOW_HZ``: faster, force and acceleration hold the noise itself.
    """
    records = problem.session.records
    commands = [r.command for r in records if r.command is not None]
    if len(commands) < len(records):
        return smoothed_motion(problem, model, SLOW_HZ)
    if model.controller is None:
        error = np.concatenate([r.position - c for r, c in zip(records, commands, strict=True)])
        if np.std(error) > FOLLOWED * np.std(np.concatenate(commands)):
            return smoothed_motion(problem, model, SLOW_HZ)
        return [_moved_by(model, c) for c in commands]
    out, temperature = [], 0.0
    for r in records:
        run = replay(model, r, temperature)
        temperature = run.end_temperature if problem.session.continuous else 0.0
        out.append(
            Motion(
                run.x,
                run.v,
                np.gradient(run.v, model.sample_time_s),
                run.applied,
                run.temperature,
                np.zeros_like(run.x),
            )
        )
    return out


def _moved_by(model: AxisModel, command: Array) -> Motion:
    """Motion, and force of the rigid axis, of an axis that follows its command."""
    dt = model.sample_time_s
    x = low_passed(command, COMMAND_HZ, dt)
    v = np.gradient(x, dt)
    a = np.gradient(v, dt)
    nothing = np.zeros_like(x)
    return Motion(x, v, a, model.inertia * a + model.viscous * v, nothing, nothing)


def low_passed(x: Array, cutoff_hz: float, dt: float) -> Array:
    """Filter forth and back, shape (n,)."""
    sos = butter(3, min(2.0 * cutoff_hz * dt, 0.8), output="sos")
    out: Array = sosfiltfilt(sos, x, padtype="odd", padlen=min(int(max(300, 0.5 / (cutoff_hz * dt))), len(x) - 1))
    return out


def dead_band(problem: Problem, model: AxisModel) -> float:
    """Speed below which the sign of the smoothed speed is not known: three times its noise."""
    return float(3.0 * problem.noise.sensor * np.sqrt(problem.noise.gain[1] / model.sample_time_s))


def thinned(count: int) -> slice:
    """Choose the rows of a regression of ``count`` samples: in long or fast records neighbours say the same."""
    return slice(None, None, max(count // MOST_ROWS, 1))


def orthonormal(j: Array) -> Array:
    if j.shape[1] == 0:
        return j
    norms = np.linalg.norm(j, axis=0)
    kept = j[:, norms > 0] / norms[norms > 0]
    if kept.shape[1] == 0:
        return np.empty((j.shape[0], 0))
    u, s, _ = np.linalg.svd(kept, full_matrices=False)
    basis: Array = u[:, s > 1e-6 * s[0]]
    return basis


def _filter(problem: Problem, fit: Fit) -> Callable[[list[Array]], Array]:
    """Return what passes force columns of every record into the domain of the residual, shape (n, k), thinned."""
    rows, answer = thinned(len(fit.residual)), problem.answering(fit.model)
    slope = problem.slope(fit.residual)[rows, None]
    return lambda columns: problem.join([answer(c) for c in columns])[rows] / problem.noise.innovation * slope


def _screen_state(
    filtered: Callable[[list[Array]], Array],
    fit: Fit,
    effect: Effect,
    motions: list[Motion],
    q: Array,
    rest: Array,
    dead: float,
    travel: tuple[float, float],
    levels: Mapping[str, float],
) -> Start | None:
    best: Start | None = None
    for shape in [laid(effect, motions, travel)] if effect.over else shapes(effect, fit.model, travel):
        f = filtered([state_columns(effect, fit.model, m, shape, dead) for m in motions])
        f = f - q @ (q.T @ f)
        size = np.linalg.norm(f, axis=0)
        keep = size > 1e-9
        if not np.any(keep):
            continue
        coefficient = np.zeros(f.shape[1])
        unit = f[:, keep] / size[keep]
        coefficient[keep] = np.linalg.lstsq(unit.T @ unit, unit.T @ rest, rcond=1e-8)[0] / size[keep]
        gain = 1.0 - float(np.sum((rest - f @ coefficient) ** 2)) / float(rest @ rest)
        values = _values(effect, fit.model, shape, coefficient, levels)
        if (best is None or gain > best.gain) and not _overtone(effect, values):
            best = Start(effect.name, gain, values)
    return best


def _overtone(effect: Effect, values: Mapping[str, float]) -> bool:
    """Say whether the second harmonic is the larger: then the wave is one of twice the order, which is tried too."""
    order = next((p for p in effect.parameters if p.fixed), None)
    waves = [a.symbol for a, phase in amplitudes(effect) if phase is not None]
    return (
        order is not None
        and len(waves) == 2
        and values[waves[1]] > values[waves[0]]
        and 2 * values[order.symbol] <= order.upper
    )


def _values(
    effect: Effect, model: AxisModel, shape: dict[str, float], c: Array, levels: Mapping[str, float]
) -> dict[str, float]:
    """Turn regression coefficients into parameters within their bounds."""
    values, i = dict(shape), 0
    for amplitude, phase in amplitudes(effect):
        if phase is None:
            values[amplitude.symbol] = float(c[i]) + levels.get(amplitude.symbol, 0.0)
            i += 1
        else:
            values[amplitude.symbol] = float(np.hypot(c[i], c[i + 1]))
            values[phase.symbol] = float(np.arctan2(c[i + 1], c[i]))
            i += 2
    for p in effect.parameters:
        s = model.scale(p)
        if not p.phase:
            low = max(p.lower * s, 1e-3 * p.start * s) if p.lower >= 0.0 else p.lower * s
            values[p.symbol] = float(np.clip(values[p.symbol], low, p.upper * s))
    return values


def trial_values(
    effect: Effect, model: AxisModel, problem: Problem, waves: tuple[int, ...] = ()
) -> Iterator[dict[str, float]]:
    """Yield trial values of an effect that is no force of the state.

    Args:
        waves: how often in a pitch waves come that a residual has.
    """
    start = {p.symbol: p.start * model.scale(p) for p in effect.parameters}
    records = problem.session.records
    seen = Seen(
        {p.symbol: model.scale(p) for p in effect.parameters},
        model.pitch,
        model.max_speed,
        max(float(np.max(np.abs(r.force))) for r in records),
        max(float(np.ptp(r.position)) for r in records),
        has_impacts(model),
        waves,
    )
    for guess in effect.trials.guesses(seen) if effect.trials is not None else ():
        yield {**start, **guess}


def _screen_trials(
    problem: Problem, fit: Fit, effect: Effect, q: Array, rest: Array, levels: Mapping[str, float]
) -> list[Start]:
    """Try an effect on a grid in the simulation; the change it makes may be stretched, and turned round where its size
    has a sign.
    """
    model, way = room_for(fit.model, effect.name), effect.trials or Trials(lambda seen: ())
    at = tuple(w.order for w in waves(problem, fit, most=MANY)) if effect.name == INTERPOLATION else ()
    if effect.name == INTERPOLATION and not at:
        return []
    trials = [{**t, **levels} for t in trial_values(effect, model, problem, at)]
    if effect.joins:
        trials = _beside(trials, fit.model, effect)
    best = _scored(problem, fit, model, effect, trials, q, rest, stretched=not levels)
    if way.further:
        others = [{**s.values, **further} for s in best[:FEW] for further in way.further]
        best = sorted(best + _scored(problem, fit, model, effect, others, q, rest), key=lambda s: -s.gain)
    return best[: way.kept]


def _scored(
    problem: Problem,
    fit: Fit,
    model: AxisModel,
    effect: Effect,
    trials: list[dict[str, float]],
    q: Array,
    rest: Array,
    stretched: bool = True,
) -> list[Start]:
    """Simulate trials beside a model and say what each could explain, the best first.

    Args:
        stretched: their sizes are only typical, and are stretched to what is seen; else they are those of what they
            replace.
    """
    best: list[Start] = []
    least = -9.0 if effect.neutral or effect.primary.lower < 0.0 else 0.0
    for values, tried in zip(
        trials,
        problem.mapper(lambda v: problem.residual(model.with_effect(effect.name, v)), trials),
        strict=True,
    ):
        d = (tried - fit.residual)[thinned(len(fit.residual))]
        d = d - q @ (q.T @ d)
        size = float(d @ d)
        if size <= 0.0:
            continue
        stretch = float(np.clip(-(d @ rest) / size, least, 9.0))
        gain = 1.0 - float(np.sum((rest + stretch * d) ** 2)) / float(rest @ rest)
        best.append(Start(effect.name, gain, _stretched(effect, model, values, stretch) if stretched else values))
    return sorted(best, key=lambda s: -s.gain)


def _beside(trials: list[dict[str, float]], model: AxisModel, effect: Effect) -> list[dict[str, float]]:
    """Give trials of an effect that joins two the numbers of the one that is in the model, each once."""
    given = {k: v for n in effect.joins if n in model.effects for k, v in model.effects[n].items()}
    levels: list[dict[str, float]] = [{}]
    if "Fc" in given and "Fs" not in given:
        levels = [{"Fc": low * given["Fc"], "Fs": high * given["Fc"]} for low, high in DROPS]
    made = ({**trial, **given, **level} for trial in trials for level in levels)
    return list({tuple(t.items()): t for t in made}.values())


def _stretched(effect: Effect, model: AxisModel, values: dict[str, float], stretch: float) -> dict[str, float]:
    """Scale the amplitude where the effect is linear in it."""
    p = effect.parameters[0]
    if effect.joins or effect.trials is None or not effect.trials.stretched:
        return values
    s = model.scale(p)
    amplitude = effect.neutral + (values[p.symbol] - effect.neutral) * stretch
    low = max(p.lower * s, 1e-3 * p.start * s) if p.lower >= 0.0 else p.lower * s
    return {**values, p.symbol: float(np.clip(amplitude, low, p.upper * s))}
