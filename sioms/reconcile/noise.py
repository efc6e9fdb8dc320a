"""The noise floor from the data, and the observer that it makes best.

Sensor noise is read off the third difference of position (motion does not reach the highest frequencies),
drive noise off measured minus commanded force, and both give the steady Kalman gain of the rigid axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import LinAlgError, expm, solve_discrete_are
from scipy.signal import lfilter, ss2tf, welch

from sioms.reconcile.effect import Array
from sioms.reconcile.model import AxisModel
from sioms.reconcile.records import Record, Session
from sioms.reconcile.thresholds import REACHED

#: Relative drive noise assumed where no force was measured; refined from the innovations afterwards.
DRIVE_NOISE_DEFAULT = 0.004
#: Samples of a spectrum of the position, frequencies judged together, and the lowest one, of the sampling rate.
SEGMENT, BAND, LOWEST = 128, 6, 0.06
#: Motion is what has so many times the density of white noise; counts of slow motion are not white.
ABOVE = 30.0


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
    return alone(model.inertia, model.viscous, model.sample_time_s)


def alone(inertia: float, viscous: float, t: float) -> tuple[Array, Array]:
    """Return one mass, sampled exactly: state matrix (2, 2) and force input (2,)."""
    a = viscous / inertia
    if a * t < 1e-9:
        return np.array([[1.0, t], [0.0, 1.0]]), np.array([0.5 * t * t, t]) / inertia
    decay = np.exp(-a * t)
    return (
        np.array([[1.0, (1.0 - decay) / a], [0.0, decay]]),
        np.array([(t - (1.0 - decay) / a) / viscous, (1.0 - decay) / viscous]),
    )


def sprung(inertia: float, viscous: float, stiffness: float, t: float) -> tuple[Array, Array]:
    """Return one mass on a spring to ground, sampled exactly: state matrix (2, 2) and force input (2,)."""
    rates = np.zeros((3, 3))
    rates[0, 1] = 1.0
    rates[1] = np.array([-stiffness, -viscous, 1.0]) / inertia
    step = expm(rates * t)
    return step[:2, :2], step[:2, 2]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two masses and what is between them: inertia of both, share of the load in it, stiffness, damping, and the
    motor's viscous friction.
    """

    inertia: float
    share: float
    stiffness: float
    damping: float
    viscous: float


@lru_cache(maxsize=16)
def coupled(pair: Pair, sample_time_s: float) -> tuple[Array, Array]:
    """Return the exact sampled pair: state matrix (4, 4) and force input (4,); motor place and speed, load place and
    speed.
    """
    motor, load = pair.inertia * (1.0 - pair.share), pair.inertia * pair.share
    k, d = pair.stiffness, pair.damping
    rates = np.zeros((5, 5))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1] = np.array([-k, -d - pair.viscous, k, d, 1.0]) / motor
    rates[3] = np.array([k, d, -k, -d, 0.0]) / load
    step = expm(rates * sample_time_s)
    return step[:4, :4], step[:4, 4]


def sampled_motion(inertia: float, viscous: float, pair: Pair | None, sample_time_s: float) -> tuple[Array, Array]:
    """Return what moves, one mass or a pair, sampled exactly: state matrix (n, n) and force input (n,)."""
    return alone(inertia, viscous, sample_time_s) if pair is None else coupled(pair, sample_time_s)


def observer(model: AxisModel, sensor: float, drive: float) -> Noise:
    """Design the steady Kalman gain of the rigid axis for given noises."""
    (place, speed), innovation = _kalman(*rigid(model), model.sample_time_s, sensor, drive)
    return Noise(sensor, drive, (place, speed), innovation)


@lru_cache(maxsize=64)
def corrections(noise: Noise, pair: Pair | None, sample_time_s: float) -> tuple[float, ...]:
    """Corrections of place [1] and speed [1/s] of motor and load by the innovation: in contact, and out of it.

    A transmission that rings is corrected as a Kalman filter of its own does it. Corrected alike, its masses would ring
    on from what
    noise did to them long ago: the innovation keeps their tone, damping comes out too large, and the cost has a minimum
    at every beat. Out of contact nothing tells of the load.
    """
    if pair is not None:
        try:
            gain, _ = _kalman(*coupled(pair, sample_time_s), sample_time_s, noise.sensor, noise.drive)
            motor = pair.inertia * (1.0 - pair.share)
            free, _ = _kalman(*alone(motor, pair.viscous, sample_time_s), sample_time_s, noise.sensor, noise.drive)
            return *gain, *free, 0.0, 0.0
        except (LinAlgError, ValueError):
            pass
    return *noise.gain, *noise.gain, *noise.gain, noise.gain[0], 0.0


def _kalman(a: Array, b: Array, dt: float, sensor: float, drive: float) -> tuple[tuple[float, ...], float]:
    """Solve the Riccati equation in units of the sensor noise, in which it is well scaled.

    Returns:
        Gain of every state, and standard deviation of the innovation, [{x}].
    """
    n = len(b)
    d = np.tile([sensor, sensor / dt], n // 2)
    an, bn = a * d[None, :] / d[:, None], b / d * drive
    seen = np.zeros((n, 1))
    seen[0] = 1.0
    p = solve_discrete_are(an.T, seen, np.outer(bn, bn) + 1e-12 * np.eye(n), np.eye(1))
    s = float(p[0, 0]) + 1.0
    return tuple(float(g) for g in p[:, 0] / s * d / sensor), float(np.sqrt(s)) * sensor


def sensor_noise(session: Session, resolution: float) -> float:
    """Standard deviation of the position reading, never below that of the count lattice.

    Motion that reaches the highest frequencies, or a wrong reading now and then, makes third differences many times as
    large as noise does: then it is what the quietest frequencies hold.
    """
    third = [np.diff(r.position, 3) for r in session.records]
    white = float(np.sqrt(np.mean(np.concatenate(third) ** 2) / 20.0))
    if (least := _quietest(third)) < REACHED * white:
        white = least
    return float(max(white, resolution / np.sqrt(12.0)))


def _quietest(third: list[Array]) -> float:
    """Return the standard deviation of white noise with the density of the quietest frequencies, by third differences.

    Infinite where no record is long enough to tell. Of white noise it is 0.95 times what it should be, the least of
    many.
    """
    long = [d for d in third if len(d) >= 4 * SEGMENT]
    if not long:
        return np.inf
    found = [welch(d, nperseg=SEGMENT, detrend=False, average="median") for d in long]
    f, density = found[0][0], np.average([p for _, p in found], axis=0, weights=[len(d) for d in long])
    level = density[f > LOWEST] / (2.0 * np.sin(np.pi * f[f > LOWEST])) ** 6
    bands = level[: len(level) // BAND * BAND].reshape(-1, BAND).mean(axis=1)
    return float(np.sqrt(0.5 * np.min(bands)))


def moves_at(session: Session, sensor: float, sample_time_s: float) -> float:
    """Frequency [Hz] above which half of the power of the speed lies, of what stands out of that noise of the position;
    0 where nothing does, or no record is long enough to tell.
    """
    long = [v for r in session.records if len(v := np.diff(r.position)) >= 4 * SEGMENT]
    if not long:
        return 0.0
    found = [welch(v, nperseg=SEGMENT) for v in long]
    f = found[0][0]
    density = np.average([p for _, p in found], axis=0, weights=[len(v) for v in long])
    noise = 2.0 * sensor**2 * (2.0 * np.sin(np.pi * f)) ** 2
    power = np.cumsum(np.where(density > ABOVE * noise, density, 0.0))
    return float(f[np.searchsorted(power, 0.5 * power[-1])] / sample_time_s)


def drive_noise(
    session: Session, rated_force: float, delivered: Callable[[Record], Array] = lambda record: record.force
) -> float:
    """Standard deviation of measured minus delivered force above the control bandwidth.

    Args:
        delivered: what a drive without noise makes of the command of a record: late, slow or limited.
    """
    found = []
    for r in session.records:
        if r.force_measured is not None:
            second = np.diff(r.force_measured - delivered(r), 2)
            found.append(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0))
    floor = 1e-4 * rated_force
    return float(max(np.median(found), floor)) if found else DRIVE_NOISE_DEFAULT * rated_force


def response(model: AxisModel, noise: Noise, force: Array, pair: Pair | None = None) -> Array:
    """Innovation that an unmodelled force on the motor leaves: the linear filter from force to innovation.

    Args:
        force: shape (n,) or (n, k), [{F}].
        pair: the transmission that rings, if there is one.

    Returns:
        Same shape, [{x}].
    """
    sampled = model.inertia, model.viscous, model.sample_time_s
    out: Array = lfilter(*_transfer(noise, pair, *sampled), force, axis=0)
    return out


@lru_cache(maxsize=16)
def _transfer(
    noise: Noise, pair: Pair | None, inertia: float, viscous: float, sample_time_s: float
) -> tuple[Array, Array]:
    """Return numerator and denominator of ``response``."""
    a, b = sampled_motion(inertia, viscous, pair, sample_time_s)
    n = len(b)
    gain = np.array(corrections(noise, pair, sample_time_s))[:n]
    seen = np.eye(1, n)
    # error state after prediction: eps+ = A (I - L C) eps + B f, innovation = C eps
    num, den = ss2tf(a @ (np.eye(n) - np.outer(gain, seen)), b[:, None], seen, np.zeros((1, 1)))
    return num[0], den


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
