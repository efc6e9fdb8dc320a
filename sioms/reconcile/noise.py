"""The noise floor from the data, and the observer that it makes best.

Sensor noise is read off the third difference of position (motion does not reach the highest frequencies),
drive noise off measured minus commanded force, and both give the steady Kalman gain of the rigid axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

from sioms.reconcile.effect import Array
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Session

#: Relative drive noise assumed where no force was measured; refined from the innovations afterwards.
DRIVE_NOISE_DEFAULT = 0.004


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of one axis.

    Attributes:
        sensor: standard deviation of the position reading, [{x}].
        drive: standard deviation of the force disturbance per sample, [{F}].
        gain: observer gain (position [1], speed [1/s]).
        innovation: standard deviation of the innovation that a right model leaves, [{x}].
    """

    sensor: float
    drive: float
    gain: tuple[float, float]
    innovation: float


def rigid(model: AxisModel) -> tuple[Array, Array]:
    """Return the exact sampled rigid axis: state matrix (2, 2) and force input (2,)."""
    t = model.sample_time_s
    a = model.viscous / model.inertia
    if a * t < 1e-9:
        return np.array([[1.0, t], [0.0, 1.0]]), np.array([0.5 * t * t, t]) / model.inertia
    decay = np.exp(-a * t)
    return (
        np.array([[1.0, (1.0 - decay) / a], [0.0, decay]]),
        np.array([(t - (1.0 - decay) / a) / model.viscous, (1.0 - decay) / model.viscous]),
    )


def observer(model: AxisModel, sensor: float, drive: float) -> Noise:
    """Design the steady Kalman gain of the rigid axis for given noises."""
    a, b = rigid(model)
    scale = sensor  # solve in units of the sensor noise, so that the Riccati equation is well scaled
    speed = sensor / model.sample_time_s
    d = np.array([scale, speed])
    an, bn = a * d[None, :] / d[:, None], b / d * drive
    p = solve_discrete_are(an.T, np.array([[1.0], [0.0]]), np.outer(bn, bn) + 1e-12 * np.eye(2), np.eye(1))
    s = p[0, 0] + 1.0
    return Noise(
        sensor, drive, (float(p[0, 0] / s), float(p[1, 0] / s * speed / scale)), float(np.sqrt(s)) * sensor
    )


def sensor_noise(session: Session, resolution: float) -> float:
    """Standard deviation of the position reading, never below that of the count lattice."""
    third = np.concatenate([np.diff(r.position, 3) for r in session.records])
    white = np.sqrt(np.mean(third**2) / 20.0)
    return float(max(white, resolution / np.sqrt(12.0)))


def drive_noise(
    session: Session, rated_force: float, delivered: Callable[[Array], Array] = lambda force: force
) -> float:
    """Standard deviation of measured minus delivered force above the control bandwidth.

    Args:
        delivered: what a drive without noise makes of a command: late, slow or limited.
    """
    found = []
    for r in session.records:
        if r.force_measured is not None:
            second = np.diff(r.force_measured - delivered(r.force), 2)
            found.append(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))
    floor = 1e-4 * rated_force
    return float(max(np.median(found), floor)) if found else DRIVE_NOISE_DEFAULT * rated_force


def response(model: AxisModel, noise: Noise, force: Array) -> Array:
    """Innovation that an unmodelled force leaves: the linear filter from force to innovation.

    Args:
        force: shape (n,) or (n, k), [{F}].

    Returns:
        Same shape, [{x}].
    """
    a, b = rigid(model)
    l1, l2 = noise.gain
    # error state after prediction: eps+ = A (I - L C) eps + B f, innovation = C eps
    m = a @ np.array([[1.0 - l1, 0.0], [-l2, 1.0]])
    den = np.array([1.0, -np.trace(m), np.linalg.det(m)])
    num = np.array([0.0, b[0], -m[1, 1] * b[0] + m[0, 1] * b[1]])
    out: Array = lfilter(num, den, force, axis=0)
    return out


def effective_samples(residual: Array, longest: int = 400) -> float:
    """Number of independent samples in a correlated residual (initial positive sequence)."""
    e = residual - residual.mean()
    n = len(e)
    if n < 8 or not np.any(e):
        return float(max(n, 1))
    size = 1 << int(np.ceil(np.log2(2 * n)))
    spectrum = np.abs(np.fft.rfft(e, size)) ** 2
    acf = np.fft.irfft(spectrum)[: min(longest, n // 2)]
    acf = acf / acf[0]
    negative = np.flatnonzero(acf < 0.02)
    stop = int(negative[0]) if len(negative) else len(acf)
    return float(n / (1.0 + 2.0 * np.sum(acf[1:stop])))
