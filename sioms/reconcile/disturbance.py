"""What noise makes of a model that runs free: the floor under a simulation that nothing holds.

The disturbance is taken from what a model leaves in short windows: its spectrum, with the part that the sensor makes
taken out, is that of a force on the motor. Drawn anew from that spectrum and put on the same model, it says how far
the machine would have been from a simulation by noise alone, whatever the axis does with it: sticks, bounces, or
drifts away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from sioms.reconcile.effect import Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.fit import Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.noise import corrections, sampled_motion, sprung
from sioms.reconcile.simulate import inertia, linked, pack

#: Length of the windows of a spectrum.
WINDOW_S = 1.0
#: A stiffness matters from this share on of what one sample of motion would need; places at which it is looked at.
SPRUNG, PLACES = 1e-6, 41
#: Above the frequency where the sensor makes so large a share of the innovation, the force cannot be seen; it is
#: taken to be no larger there than below.
SEEN = 0.5


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A force on the motor, by its spectrum.

    Attributes:
        sample_time_s: of what is drawn.
        frequencies: rising from 0, shape (k,), [Hz].
        density: one-sided power density, shape (k,), [{F}^2/Hz].
    """

    sample_time_s: float
    frequencies: Array
    density: Array

    @property
    def size(self) -> float:
        """Root mean square, [{F}]."""
        return float(np.sqrt(np.trapezoid(self.density, self.frequencies)))

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Draw a force, shape (count,), [{F}]."""
        size = 1 << int(np.ceil(np.log2(max(2 * count, 16))))
        at = np.fft.rfftfreq(size, self.sample_time_s)
        density = np.interp(at, self.frequencies, self.density)
        white = np.fft.rfft(rng.standard_normal(size))
        out: Array = np.fft.irfft(white * np.sqrt(0.5 * density / self.sample_time_s), size)[:count]
        return out


def disturbance(problem: Problem, model: AxisModel, explained: float) -> Disturbance:
    """Read the force that a model leaves unexplained off its innovations on the samples of ``problem``.

    Args:
        explained: share of what is left that the state of the axis explains, and that is no noise.
    """
    dt, noise = model.sample_time_s, problem.noise
    parts = [r.innovation[problem.span(q)] for r, q in zip(problem.runs(model), problem.session.records, strict=True)]
    size = min(max(round(WINDOW_S / dt), 64), min(map(len, parts)))
    spectra = [welch(np.nan_to_num(p), 1.0 / dt, nperseg=size, detrend=False) for p in parts]
    at = spectra[0][0]
    seen = np.average([s[1] for s in spectra], axis=0, weights=[len(p) for p in parts])
    by_force, by_sensor = innovation_response(problem, model, at)
    sensor = by_sensor**2 * noise.sensor**2 * 2.0 * dt
    force = np.maximum(seen - sensor, 0.0) / np.maximum(by_force, 1e-300) ** 2
    hidden = np.flatnonzero(sensor > SEEN * seen)
    last = max(int(hidden[0]) if len(hidden) else len(at), 3)
    force[last:] = np.minimum(force[last:], np.median(force[max(last // 2, 1) : last]))
    return Disturbance(dt, at, force * min(max(1.0 - explained, 0.0), 1.0))


def innovation_response(problem: Problem, model: AxisModel, at: Array) -> tuple[Array, Array]:
    """Return how large an innovation a force on the motor [{x}/{F}], and noise of the sensor [1], makes at each
    frequency.
    """
    packed, dt = pack(model), model.sample_time_s
    pair, stiffness = linked(packed), _stiffness(problem, model)
    a, b = sampled_motion(inertia(packed), model.viscous, pair, dt)
    if pair is None and abs(stiffness) * dt**2 > SPRUNG * inertia(packed):
        a, b = sprung(inertia(packed), model.viscous, stiffness, dt)
    n = len(b)
    gain = np.array(corrections(problem.noise, linked(packed), dt))[:n]
    seen = np.eye(1, n)[0]
    closed = a @ (np.eye(n) - np.outer(gain, seen))
    inverse = np.linalg.inv(np.exp(2j * np.pi * at * dt)[:, None, None] * np.eye(n) - closed)
    return np.abs(inverse @ b @ seen), np.abs(1.0 - inverse @ (a @ gain) @ seen)


def _stiffness(problem: Problem, model: AxisModel) -> float:
    """Return the stiffness to ground that the forces of a model have over the places of the records, [{F}/{x}]."""
    x = np.concatenate([r.position[problem.span(r)] for r in problem.session.records])
    x = np.quantile(x, np.linspace(0.02, 0.98, PLACES))
    still, force = np.zeros_like(x), np.zeros_like(x)
    for name, given in model.effects.items():
        effect = known()[name]
        if effect.slot is Slot.FORCE:
            force += effect.evaluate(x, still, still, still, effect.row(effect.values(given), model.pitch))
    off = x - x.mean()
    return -float(off @ force) / max(float(off @ off), 1e-300)
