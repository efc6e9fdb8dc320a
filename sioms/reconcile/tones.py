"""A force of one frequency in time: a machine beside the axis that vibrates, or a drive that hums.

Noise has no such line, and no state of the axis keeps time like this. Left in, it passes for noise, or whatever bends
itself to follow it gets a name. Found, it is taken for a known force beside the drive's, and the search begins anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import periodogram

from sioms.reconcile.effect import TERM_PREFIX, Array
from sioms.reconcile.fit import Fit, Problem
from sioms.reconcile.model import AxisModel
from sioms.reconcile.screen import instrument_motion
from sioms.reconcile.thresholds import OWN, PURE, TONE
from sioms.reconcile.timed import Timed, waves
from sioms.reconcile.verdict import Estimate, NamedEffect

OVERTONES = 3

ZOOMS = 6  # each halves the step of frequency


@dataclass(frozen=True, slots=True)
class Tone:
    """A force of one frequency, with an amplitude and a phase of its own in every record.

    Attributes:
        forces: in every record, from its first sample to its last, shape (n,) each, [{F}].
        share: of the residual's energy; trace: what it makes of the residual, shape (n,).
    """

    frequency_hz: float
    forces: tuple[Array, ...]
    share: float
    trace: Array

    @property
    def amplitude(self) -> float:
        """Amplitude over all records, [{F}]."""
        return float(np.sqrt(2.0 * np.mean(np.concatenate(self.forces) ** 2)))


def tone(problem: Problem, fit: Fit) -> Tone:
    """Fit the force of one frequency that explains most of a residual."""
    dt, n = fit.model.sample_time_s, max(len(r) for r in problem.session.records)
    parts = _per_record(problem, fit.residual)
    size = 1 << int(np.ceil(np.log2(2 * n)))
    lines = [periodogram(e, 1.0 / dt, "hann", size) for e in parts]
    power = np.sum([p * len(e) for (_, p), e in zip(lines, parts, strict=True)], axis=0)
    step = 0.5 / (size * dt)
    best = _line(problem, fit, max(float(lines[0][0][int(np.argmax(power))]), step))
    for _ in range(ZOOMS):
        around = [f for f in (best.frequency_hz - step, best.frequency_hz + step) if f > 0.0]
        best = max([best, *(_line(problem, fit, f) for f in around)], key=lambda t: t.share)
        step *= 0.5
    return best


def hum(problem: Problem, fit: Fit) -> Tone | None:
    """Return the tone that most of a residual is, if it is one; what the motion itself does at that frequency is
    none.
    """
    found = tone(problem, fit)
    return found if found.share > TONE and not _moved(problem, fit.model, found.frequency_hz) else None


def as_timed(found: Tone, fit: Fit) -> Timed:
    """Describe the tone, with the intervals of a sine in white noise (D. C. Rife, R. R. Boorstyn, 1974)."""
    lengths = np.array([len(f) for f in found.forces], dtype=np.float64)
    noise = (1.0 - found.share) / found.share
    wide = 1.96 * found.amplitude * float(np.sqrt(noise / lengths.sum()))
    off = 1.96 * float(np.sqrt(12.0 * noise / np.sum(lengths**3))) / (2.0 * np.pi * fit.model.sample_time_s)
    equation, size, hz = "F = amp sin(2 pi f t + phase)", found.amplitude, found.frequency_hz
    term = NamedEffect(
        TERM_PREFIX + "tone",
        equation,
        equation,
        "mechanics",
        (
            Estimate("amp", size, size - wide, size + wide, fit.model.force_unit, "amplitude"),
            Estimate("f", hz, hz - off, hz + off, "Hz", "frequency"),
        ),
        found.share,
        1.96 * size / wide,
        None,
        (f"it is {100.0 * found.share:.1f} % of the residual energy and keeps time, whatever the axis does",),
    )
    return Timed(found.forces, (1.0 - found.share) * fit.cost, term, f"a force of {hz:.3f} Hz keeps time")


def _per_record(problem: Problem, residual: Array) -> list[Array]:
    """Cut a residual, as ``Problem.residual`` lays it out, into its records."""
    lengths = [len(range(len(r))[problem.span(r)]) for r in problem.session.records]
    return np.split(residual, np.cumsum(lengths)[:-1])


def _line(problem: Problem, fit: Fit, frequency_hz: float) -> Tone:
    traces, forces = [], []
    for record, e in zip(problem.session.records, _per_record(problem, fit.residual), strict=True):
        wave = waves(len(record), frequency_hz, fit.model.sample_time_s)
        columns = problem.answer(fit.model, wave)[problem.span(record)] / problem.noise.innovation
        size = np.linalg.lstsq(columns, e, rcond=None)[0]
        traces.append(columns @ size)
        forces.append(wave @ size)
    trace = np.concatenate(traces)
    share = 1.0 - float(np.sum((fit.residual - trace) ** 2)) / max(fit.cost, 1e-300)
    return Tone(frequency_hz, tuple(forces), share, trace)


def _moved(problem: Problem, model: AxisModel, frequency_hz: float) -> bool:
    """Say whether the motion itself has a line at this frequency, or is mostly one of which this is a multiple."""
    speeds = [m.v for m in instrument_motion(problem, model)]
    energy = sum(float(v @ v) for v in speeds)
    for part in range(1, OVERTONES + 1):
        lines = 0.0
        for v in speeds:
            wave = waves(len(v), frequency_hz / part, model.sample_time_s)
            line = wave @ np.linalg.lstsq(wave, v, rcond=None)[0]
            lines += float(line @ line)
        if lines > (OWN if part == 1 else PURE) * energy:
            return True
    return False
