"""The exponents of what is named: each must come out as that of its law, and no number may hang on it.

A law of the library has neighbours that differ from it by one number more: friction drops with exp(-(v/vs)^2) in one
text, with exp(-v/vs) in another; a drag goes with a power of the speed near one or two; friction builds up along
another curve; a wave has edges or points. A neighbour that is fitted by the named law and what stands beside it leaves
little, and no state orders that, for all numbers of the fit have had their share in hiding it. So each law is bent: its
exponent is let change, with all numbers of the fit free. Where it surely comes to another value, the law is another
one; where it is not told well, neither are the numbers that go with it, and their intervals have room for that.

Sources: B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994) 1083-1138, sec. 3, for exponents of
the drop from 1/2 to large ones; P. R. Dahl, "Solid friction damping of mechanical vibrations", AIAA J. 14 (1976)
1675-1682, for those of what builds up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.blocks import formal, intervals
from sioms.reconcile.dry import dry_friction
from sioms.reconcile.effect import Array, Effect
from sioms.reconcile.effects import known
from sioms.reconcile.effects.smooth import DRY, OF_FORCE, OF_PLACE, OF_SPEED
from sioms.reconcile.engine.fit import Free
from sioms.reconcile.fit import Fit, Problem, block_ids
from sioms.reconcile.jit import kernel
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.simulate import Run
from sioms.reconcile.thresholds import EXPONENT, EXPONENT_ERRORS, EXPONENT_PATH, HANGS, NEIGHBOUR

#: Laws with a power of a variable, by the name that it has in a run.
POWERS = {
    "coulomb": "v", "viscous": "v", "viscous_direction": "v", "quadratic_drag": "v", "quadratic_direction": "v",
    "load_friction": "applied", "load_square_friction": "applied", "gain_asymmetry": "applied",
    "spring": "x", "hardening_spring": "x", "asymmetric_spring": "x",
    "thermal_gain": "temperature", "warming_friction": "temperature",
}  # fmt: skip
#: Waves, with the symbols of their sizes.
RIPPLES = {"cogging": "amp", "torque_ripple": "depth", "coulomb_position": "Fm", "friction_variation": "depth"}
#: Laws of one variable.
TOGETHER = ((*OF_SPEED, *DRY), OF_PLACE, (*OF_FORCE, "load_friction", "load_square_friction"))
#: Words for what is bent.
POWER, DROP, BUILDING = "power", "exponent of the drop", "exponent of what builds up"
#: A wave has edges or points (its third harmonic is a quarter of the exponent), or flanks (its fifth is as much): a
#: triangle that is cut off at two thirds has no third.
WAVE, FLANKS = "shape of the wave", "flank of the wave"
#: A variable below this share of its usual size is taken for as large; a small change of an exponent.
LEAST, STEP = 1e-3, 0.05


@dataclass(frozen=True, slots=True)
class Bend:
    """A law that is bent.

    Attributes:
        effect: whose law it is; what: is bent.
        change: of the exponent that the records ask for, and half its 95 % interval.
        share: of what remains that is explained by it.
        hangs: other effects whose size is another one with it, or that share a force of its variable with it: the
            records tell that force, and not which law has how much of it.
    """

    effect: str
    what: str
    change: float = 0.0
    half: float = 0.0
    share: float = 0.0
    hangs: tuple[str, ...] = ()

    @property
    def errors(self) -> float:
        """How many standard errors the exponent is from that of the law."""
        return abs(self.change) / max(0.5 * self.half, 1e-300)


def bent(problem: Problem, fit: Fit, names: Sequence[str]) -> list[Bend]:
    """Return the laws of those effects whose exponents surely come to other values; of several the one that explains
    most first, and further ones only beside it.
    """
    ids, out = block_ids(problem, fit.model.sample_time_s), list[Bend]()
    paths = {n for n in fit.model.effects if known()[n].mechanism.builds_up}
    least = EXPONENT_PATH if paths else EXPONENT
    # what builds up is over within a few rows, and with it a drop of its own
    left = {b: c for b, c in _columns(problem, fit, names) if b.what != DROP or b.effect not in paths}
    while left:
        tried = [_bent(fit, ids, bend, column) for bend, column in left.items()]
        sure = [b for b in tried if abs(b.change) >= least and b.errors >= EXPONENT_ERRORS]
        if not sure:
            break
        most = max(sure, key=lambda b: b.share)
        out.append(most)
        key = next(b for b in left if (b.effect, b.what) == (most.effect, most.what))
        fit = _with(fit, key, left.pop(key))
    return out


def loosened(problem: Problem, fit: Fit, names: Sequence[str]) -> dict[tuple[str, str], float]:
    """Return what is added in quadrature to half the 95 % interval of each number, by effect and symbol and in its
    unit, because an exponent is that of the library to within ``NEIGHBOUR`` only where the records do not tell it.
    """
    columns = dict(_columns(problem, fit, names))
    if not columns or not fit.free:
        return {}
    j = np.column_stack([fit.jacobian, *(_beside_size(fit, b, c) for b, c in columns.items())])
    k = len(fit.free)
    each = float(fit.residual @ fit.residual) / effective_samples(fit.residual)
    h = j.T @ j / max(each, 1e-300)
    h[range(k, len(h)), range(k, len(h))] += 1.0 / NEIGHBOUR**2
    wider, tight = np.linalg.pinv(h)[:k, :k], np.linalg.pinv(h[:k, :k])
    half = 1.96 * np.sqrt(np.maximum(np.diag(wider) - np.diag(tight), 0.0))
    return {(f.effect, f.symbol): float(s * f.scale) for f, s in zip(fit.free, half, strict=True)}


def _beside_size(fit: Fit, bend: Bend, column: Array) -> Array:
    """Take off a bend what only changes the size of its effect, where its law has no scale of its own."""
    if bend.what not in (POWER, WAVE, FLANKS):
        return column
    size = RIPPLES.get(bend.effect, known()[bend.effect].primary.symbol)
    own = fit.jacobian[:, [(f.effect, f.symbol) == (bend.effect, size) for f in fit.free]]
    return column - own @ (own.T @ column) / max(float(np.sum(own**2)), 1e-300)


def _bent(fit: Fit, ids: NDArray[np.int64], bend: Bend, column: Array) -> Bend:
    other = _with(fit, bend, column)
    step = np.asarray(-np.linalg.lstsq(other.jacobian, fit.residual, rcond=1e-10)[0], dtype=np.float64)
    after, before = fit.residual + other.jacobian @ step, _left(fit)
    settled = replace(other, residual=after)
    half = np.maximum(intervals(settled, ids), formal(settled))
    share = 1.0 - float(after @ after) / max(float(before @ before), 1e-300)
    hangs = tuple(dict.fromkeys((*_hanging(fit, bend.effect, step), *_sharing(fit.model, bend))))
    return replace(bend, change=float(step[-1]), half=float(half[-1]), share=share, hangs=hangs)


def _with(fit: Fit, bend: Bend, column: Array) -> Fit:
    free = Free(bend.effect, bend.what, 1.0, -np.inf, np.inf)
    return replace(fit, free=(*fit.free, free), jacobian=np.column_stack([fit.jacobian, column]))


def _left(fit: Fit) -> Array:
    j, r = fit.jacobian, fit.residual
    return np.asarray(r - j @ np.linalg.lstsq(j, r, rcond=1e-10)[0]) if j.shape[1] else r


def _hanging(fit: Fit, name: str, step: Array) -> Iterator[str]:
    """Yield the other effects whose size a step of all numbers changes by a large share."""
    for f, s in zip(fit.free, step, strict=False):
        effect = known().get(f.effect)
        if effect is not None and f.effect != name and f.symbol == effect.primary.symbol:
            size = abs(fit.model.effects[f.effect][f.symbol] - effect.neutral)
            if abs(s) * f.scale > HANGS * size:
                yield f.effect


def _sharing(model: AxisModel, bend: Bend) -> Iterator[str]:
    """Yield the other effects of a model that are of the variable of a power, or of a drop with the speed."""
    if bend.what in (POWER, DROP):
        groups = [g for g in TOGETHER if bend.effect in g]
        yield from (n for n in model.effects if n != bend.effect and any(n in g for g in groups))


def _columns(problem: Problem, fit: Fit, names: Sequence[str]) -> Iterator[tuple[Bend, Array]]:
    """Yield each bend of the laws of effects, with how the residual goes with it."""
    model, runs = fit.model, problem.runs(fit.model)
    answer, slope = problem.answering(model), problem.slope(fit.residual) / problem.noise.innovation
    for name in names:
        for what, force in _forces(model, name, runs):
            column = -problem.join([answer(force(run)) for run in runs]) * slope
            if np.any(column):
                yield Bend(name, what), column


def _forces(model: AxisModel, name: str, runs: Sequence[Run]) -> Iterator[tuple[str, Callable[[Run], Array]]]:
    """Yield what can be bent in a law, with the force on the axis that a change of its exponent by 1 makes, to first
    order.
    """
    effect, given = known()[name], model.effects[name]
    if name in POWERS:
        over = [getattr(r, POWERS[name]) for r in runs]
        usual = max(float(np.sqrt(np.mean(np.concatenate(over) ** 2))), 1e-300)
        yield POWER, lambda run: _acting(model, effect, run) * _log(getattr(run, POWERS[name]) / usual)
    if name in RIPPLES:
        yield WAVE, lambda run: _rippling(model, name, run, lambda angle: np.sin(angle) * _log(np.sin(angle)))
        yield FLANKS, lambda run: _rippling(model, name, run, lambda angle: 0.25 * np.sin(5.0 * angle))
    if "vs" in given:
        yield DROP, lambda run: _dropping(given, run)
    if effect.mechanism.builds_up:
        yield BUILDING, lambda run: _building(given, run)


def _acting(model: AxisModel, effect: Effect, run: Run) -> Array:
    """Return the force on the axis of a law, shape (n,)."""
    given = model.effects[effect.name]
    if effect.function is None:
        return np.asarray(-given["loss"] * run.temperature * run.applied)
    row = effect.row(effect.values(given), model.pitch)
    return effect.force(run.x, run.v, run.applied, run.temperature, np.sign(run.v), row)


def _rippling(model: AxisModel, name: str, run: Run, shape: Callable[[Array], Array]) -> Array:
    """Return the force of a wave that has that shape of its angle, and the size of the named one."""
    given = model.effects[name]
    wave = given[RIPPLES[name]] * shape(given["n"] * 2.0 * np.pi / model.pitch * run.x + given["phase"])
    match name:
        case "torque_ripple":
            return wave * run.applied
        case "coulomb_position":
            return -wave * np.sign(run.v)
        case "friction_variation":
            even = model.without_effect(name)
            return wave * dry_friction(even, run.x, run.v, run.applied, run.temperature, np.sign(run.v))
        case _:
            return wave


def _dropping(given: Mapping[str, float], run: Run) -> Array:
    z = np.abs(run.v) / given["vs"]
    return np.asarray(np.sign(run.v) * (given["Fs"] - given["Fc"]) * z**2 * _log(z) * np.exp(-(z**2)))


def _building(given: Mapping[str, float], run: Run) -> Array:
    held = given.get("Fs", given.get("Fc", given.get("f", 0.0)))
    level = np.full(len(run.x), given.get("Fc", held))
    if "vs" in given:
        level += (held - level) * np.exp(-((run.v / given["vs"]) ** 2))
    more, less = (built_along(run.x, level, held / given["xs"], 1.0 + h) for h in (STEP, -STEP))
    return np.asarray((less - more) / (2.0 * STEP))


def _log(z: Array) -> Array:
    return np.log(np.maximum(np.abs(z), LEAST))


@kernel
def built_along(x: Array, level: Array, stiffness: float, exponent: float) -> Array:
    """Return friction that nears a level over displacement, dF/dx = stiffness (1 -+ F / level)^exponent, shape (n,);
    the exponent is not 1.
    """
    force, out, more = 0.0, np.zeros_like(x), exponent - 1.0
    for i in range(1, len(x)):
        moved = x[i] - x[i - 1]
        if level[i] > 0.0 and moved != 0.0:
            way = 1.0 if moved > 0.0 else -1.0
            short = max(1.0 - way * force / level[i], 1e-12)
            power = short**-more + more * stiffness / level[i] * np.abs(moved)
            short = power ** (-1.0 / more) if power > 0.0 else 0.0
            force = way * level[i] * (1.0 - min(short, 2.0))
        out[i] = force
    return out
