"""Where the disagreement lives: the force residual over bins of state, with permutation p-values, and spectra.

The force residual with measured motion is what the nominal plant lacks: J a + b v - u, low-passed. A
permutation shifts it in time against the state by a random amount, which keeps its own memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt, welch

from sioms.reconcile.dry import dry_friction
from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.engine.evidence import place
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.refuse import since_reversal
from sioms.reconcile.screen import Motion, dead_band, direction, smoothed_motion
from sioms.reconcile.verdict import Place

BINS = 16


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Amplitude density of the force residual over frequency [Hz] or spatial order [1/pitch]."""

    axis: Array
    density: Array
    peak: float


def force_residual(problem: Problem, model: AxisModel) -> tuple[list[Motion], list[Array]]:
    """Return smoothed motion and force residual of every record; positive where the model lacks driving force.

    The forces of state effects that the model already has are taken off.

    Returns:
        Motions, and J a + b v - u per record, zero-phase low-passed like the motion, [{F}].
    """
    motions, dead = smoothed_motion(problem, model), dead_band(problem, model)
    dt = model.sample_time_s
    cutoff = float(np.clip(3.0 * np.sqrt(problem.noise.gain[1] / dt) / (2.0 * np.pi), 10.0, 150.0))
    sos = butter(3, min(2.0 * cutoff * dt, 0.8), output="sos")
    out = []
    for m in motions:
        u = sosfiltfilt(sos, m.u + m.outer, padtype="odd", padlen=min(300, len(m.u) - 1))
        # the force of sample n acts from n to n + 1: half a sample late against the speed at n
        u = 0.5 * (u + np.concatenate([u[:1], u[:-1]]))
        lacking = model.inertia * m.a + model.viscous * m.v - u - _known_force(model, m, dead)
        out.append(sosfiltfilt(sos, lacking, padlen=min(300, len(u) - 1)))
    return motions, out


def _known_force(model: AxisModel, m: Motion, dead: float) -> Array:
    """Sum the forces of the model's state effects on a measured motion."""
    total = dry_friction(model, m.x, m.v, m.u, m.temperature, direction(m.v, dead))
    for name, given in model.effects.items():
        effect = known()[name]
        if effect.slot in (Slot.FORCE, Slot.GAIN):
            row = effect.row(effect.values(given), model.pitch)
            total += effect.force(m.x, m.v, m.u, m.temperature, m.v, row)
    return total


def variables(motions: list[Motion], model: AxisModel, dead: float) -> dict[str, tuple[str, list[Array]]]:
    """List the variables to bin over: name -> (unit, arrays per record)."""
    x, f = model.position_unit, model.force_unit
    sign = [direction(m.v, dead) for m in motions]
    time = np.cumsum([0] + [len(m.x) for m in motions])
    out = {
        "position": (x, [m.x for m in motions]),
        "position in the pitch": (x, [np.mod(m.x, model.pitch) for m in motions]),
        "speed": (f"{x}/s", [m.v for m in motions]),
        "direction": ("1", [np.round(s) for s in sign]),
        "acceleration": (f"{x}/s^2", [m.a for m in motions]),
        "motor force": (f, [m.u for m in motions]),
        "heat": ("1", [_heat(m.u, model) for m in motions]),
        "displacement since reversal": (
            x,
            [s * since_reversal(m.x, s) for m, s in zip(motions, sign, strict=True)],
        ),
        "time": (
            "s",
            [(np.arange(len(m.x)) + t) * model.sample_time_s for m, t in zip(motions, time, strict=False)],
        ),
    }
    if model.imposed:  # which has no motor, and no screw
        del out["motor force"], out["heat"]
        within = out.pop("position in the pitch")
        out |= {"angle in the turn": within} if model.rotary else {}
    return out


def _heat(u: Array, model: AxisModel) -> Array:
    out: Array = np.cumsum((u / model.rated_force) ** 2) * model.sample_time_s
    return out


def locate(problem: Problem, model: AxisModel, rng: np.random.Generator, shifts: int = 99) -> list[Place]:
    """Rank the variables by how far they order the force residual."""
    motions, residual = force_residual(problem, model)
    r = problem.join(residual)
    out = []
    for name, (unit, parts) in variables(motions, model, dead_band(problem, model)).items():
        v = problem.join(parts)
        least = len(r) // 20  # a turn by less, either way round, is hardly one
        turned = (np.roll(r, int(s)) for s in rng.integers(least, len(r) - least, shifts))
        out.append(place(name, unit, r, v, bins_of(v), turned))
    return sorted(out, key=lambda q: -q.explained)


def bins_of(v: Array) -> NDArray[np.int64]:
    """Bin numbers with about equal counts, without empty bins."""
    edges = np.unique(np.quantile(v, np.linspace(0.0, 1.0, BINS + 1)[1:-1]))
    number = np.searchsorted(edges, v, side="right")
    return np.asarray(np.unique(number, return_inverse=True)[1], dtype=np.int64)


def spectra(problem: Problem, model: AxisModel) -> tuple[Spectrum, Spectrum]:
    """Return temporal and spatial amplitude spectra of the force residual."""
    motions, residual = force_residual(problem, model)
    n = min(len(r) for r in residual)
    density = np.zeros(1)
    f = np.zeros(1)
    for r in residual:
        f, d = welch(r, 1.0 / model.sample_time_s, nperseg=min(n, 2048))
        density = density + d
    density = np.sqrt(density / len(residual))
    time = Spectrum(f, density, float(f[1 + int(np.argmax(density[1:]))]))
    orders = np.arange(1, 61, dtype=np.float64)
    x, r = problem.join([m.x for m in motions]), problem.join(residual)
    wave = np.exp(-2j * np.pi * orders[:, None] * x[None, :: max(len(x) // 8000, 1)] / model.pitch)
    amplitude = 2.0 * np.abs(wave @ r[:: max(len(x) // 8000, 1)]) / wave.shape[1]
    return time, Spectrum(orders, amplitude, float(orders[int(np.argmax(amplitude))]))
