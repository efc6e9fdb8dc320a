"""Session parameters: what changes from one power-on to the next and is no property of the axis.

A model found in one session is judged in another twice: frozen, and with these few numbers re-estimated on the
first part of the new records. Both scores are of the same later samples and are never mixed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.effect import Array, Channel
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import effective_samples
from sioms.reconcile.records import Record
from sioms.reconcile.simulate import track

STEPS = 4
OFFSET = "offset"
VISCOUS = ("viscous", "viscous_direction")


@dataclass(frozen=True, slots=True)
class State:
    """The session parameters of one record, with what a frozen model assumes as defaults.

    Attributes:
        offset: constant force on the axis, beyond the model's, [{F}].
        dry, viscous: factors on the friction, which follows the temperature and the run-in of bearings and grease.
        zero: of the encoder, [{x}].
        heat: heat state at the first sample.
    """

    offset: float = 0.0
    dry: float = 1.0
    viscous: float = 1.0
    zero: float = 0.0
    heat: float = 0.0


@dataclass(frozen=True, slots=True)
class _Knob:
    """One session parameter: how it is varied and how far it may be expected to move."""

    name: str
    spread: float
    low: float = -np.inf


def knobs(model: AxisModel) -> tuple[str, ...]:
    """List the session parameters that can matter to a model."""
    return tuple(k.name for k in _knobs(model))


def _knobs(model: AxisModel) -> list[_Knob]:
    effects = [known()[n] for n in model.effects]
    out = [_Knob("offset", 0.03 * model.rated_force)]
    if any(e.is_friction for e in effects):
        out.append(_Knob("dry", 0.1, 0.0))
    if model.viscous > 0.0 or any(e.name in VISCOUS for e in effects):
        out.append(_Knob("viscous", 0.2, 0.0))
    if any(p.phase for e in effects for p in e.parameters if e.channel is not Channel.SENSOR):
        out.append(_Knob("zero", 0.1 * model.pitch))
    if any(e.mechanism.warms and e.channel is Channel.ACTUATOR for e in effects):
        out.append(_Knob("heat", 1.0, 0.0))
    return out


def applied(model: AxisModel, record: Record, state: State) -> tuple[AxisModel, Record]:
    """Return model and record as they are in a session; the heat state is handed over separately."""
    effects = {n: dict(v) for n, v in model.effects.items()}
    for name, values in effects.items():
        effect = known()[name]
        for p in effect.parameters:
            if effect.name in VISCOUS:
                values[p.symbol] *= state.viscous
            elif effect.is_friction and "{F}" in p.unit:
                values[p.symbol] *= state.dry
    if state.offset:
        held = effects.setdefault(OFFSET, {"off": 0.0})
        held["off"] += state.offset
    if state.zero:
        shifted = None if record.command is None else record.command - state.zero
        record = replace(record, position=record.position - state.zero, command=shifted)
    return replace(model, viscous=model.viscous * state.viscous, effects=effects), record


def estimate(problem: Problem, model: AxisModel, record: Record, stop: int, heat: float = 0.0) -> State:
    """Estimate the session parameters of a record on its samples up to ``stop``, by damped Gauss-Newton.

    What they gain must be worth their number (G. Schwarz, 1978); else they stay what the frozen model assumes.

    Args:
        problem: whose observer and start apply.
        heat: state at the first sample that the frozen model assumes.
    """
    moving, assumed = _knobs(model), State(heat=heat)
    state = assumed
    span = slice(problem.span(record).start, stop)

    def residual(s: State) -> Array:
        m, r = applied(model, record, s)
        e = track(m, r.position, r.force, problem.noise, s.heat, external=r.external, bends=r.bends).innovation[span]
        return np.clip(np.nan_to_num(e / problem.noise.innovation, nan=1e6), -1e6, 1e6)

    first = r = residual(state)
    for _ in range(STEPS):
        columns = [_slope(residual, state, k, r) for k in moving]
        j = np.stack(columns, axis=1)
        # As many independent samples, each as noisy as the residual is: against them the expected spread counts.
        off = np.array([(getattr(state, k.name) - getattr(assumed, k.name)) / k.spread for k in moving])
        weight = effective_samples(r) / float(r @ r)
        step = np.linalg.solve(weight * j.T @ j + np.eye(len(moving)), -(weight * j.T @ r + off))
        trial = _moved(state, moving, step)
        after = residual(trial)
        if not after @ after < r @ r * (1.0 - 1e-4):
            break
        state, r = trial, after
    count = effective_samples(first)
    worth = count * np.log(float(first @ first) / float(r @ r)) > len(moving) * np.log(max(count, 2.0))
    return state if worth else assumed


def _slope(residual: Callable[[State], Array], state: State, knob: _Knob, base: Array) -> Array:
    step = 1e-3
    return (residual(replace(state, **{knob.name: getattr(state, knob.name) + step * knob.spread})) - base) / step


def _moved(state: State, moving: list[_Knob], step: Array) -> State:
    return replace(state, **{
        k.name: max(getattr(state, k.name) + float(np.clip(s, -1.0, 1.0)) * k.spread, k.low)
        for k, s in zip(moving, step, strict=True)
    })  # fmt: skip


def half(problem: Problem, record: Record) -> int:
    """Return the sample that parts what session parameters are estimated on from what they are judged on."""
    span = problem.span(record)
    return int(span.start + span.stop) // 2


def heats(problem: Problem, model: AxisModel) -> list[float]:
    """Return the heat state that the frozen model has at the start of each record."""
    out, temperature = [], 0.0
    for run in problem.runs(model):
        out.append(temperature)
        temperature = run.end_temperature if problem.session.continuous else 0.0
    return out
