"""Commands that excite an axis, and the one on which two models differ most.

A small catalogue of laps, each within an envelope of travel, speed, acceleration and jerk, each beginning and
ending at rest in the middle. All are made of straight moves and a moving average, so that what they ask for is
known exactly: a move of speed s and acceleration a, averaged over a time w, keeps s and a and has the jerk 2 a / w.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import simulate

DURATION_S = 5.0
#: Shortest average over the acceleration.
SMOOTH_S = 0.02
#: A turn of a rotary axis, rad.
WHOLE = 2.0 * np.pi
#: Share of a lap at rest before it begins.
REST = 0.04


@dataclass(frozen=True, slots=True)
class Envelope:
    """What an experiment may ask of an axis.

    Attributes:
        centre: position where every lap begins and ends, [{x}].
        reach: largest distance from there to either side, [{x}].
        speed, acceleration, jerk: largest, [{x}/s ...].
    """

    centre: float
    reach: float
    speed: float
    acceleration: float
    jerk: float

    @classmethod
    def of(cls, model: AxisModel, centre: float, reach: float) -> Envelope:
        """Take what the natural sizes of the axis allow: half the rated force, six tenths of the largest speed."""
        a = 0.5 * model.rated_force / model.inertia
        return cls(centre, reach, 0.6 * model.max_speed, a, 2.0 * a / SMOOTH_S)


@dataclass(frozen=True, slots=True)
class Experiment:
    """A proposed record.

    Attributes:
        command: position command at the axis's sample time, [{x}].
        separation: root mean square difference of the rival models' forces over the drive noise; 0 without rivals.
    """

    name: str
    text: str
    command: Array
    separation: float = 0.0


def catalogue(model: AxisModel, envelope: Envelope, duration_s: float = DURATION_S) -> Iterator[Experiment]:
    """Yield the laps that fit into the envelope.

    Args:
        duration_s: of a lap; a lap that needs longer for its moves takes longer.
    """
    unit, e, dt = model.position_unit, envelope, model.sample_time_s
    slow, cruise = (0.02, 0.05, 0.1), (0.15, 0.35, 0.65, 1.0)
    yield Experiment(
        "slow_reversals",
        "reversals at " + _list(slow, e.speed) + f" {unit}/s",
        _shuttle(slow, e, dt, duration_s),
    )
    yield Experiment(
        "cruises",
        "cruises at " + _list(cruise, e.speed) + f" {unit}/s, both ways",
        _shuttle(cruise, e, dt, duration_s),
    )
    half = min(0.55 * WHOLE, e.reach) if model.rotary else e.reach
    turn = ", more than one full turn" if model.rotary and half >= 0.5 * WHOLE else ""
    speed = min(4.2 * half / duration_s, e.speed)
    path = np.concatenate([_move(half, speed, e, dt), _move(-2.0 * half, speed, e, dt), _move(half, speed, e, dt)])
    yield Experiment("full_turn", f"slowly over {2.0 * half:.3g} {unit} and back{turn}", _lap(path, e, dt, duration_s))
    yield Experiment(
        "multi_sine",
        "sum of sines from 0.7 to 9 Hz at two amplitudes",
        _lap(_waves(e, dt, duration_s * (1.0 - REST)), e, dt, duration_s),
    )


def one_speed(model: AxisModel, envelope: Envelope, duration_s: float = DURATION_S) -> Experiment:
    """Return the gentlest lap: one cruising speed, both ways."""
    text = f"cruise at {0.4 * envelope.speed:.3g} {model.position_unit}/s, both ways"
    return Experiment("one_speed", text, _shuttle((0.4,), envelope, model.sample_time_s, duration_s))


def repeated(experiment: Experiment, laps: int) -> Experiment:
    """Return the same lap several times on end: what differs between laps is noise."""
    return replace(experiment, command=np.tile(experiment.command, laps))


def demands(command: Array, dt: float) -> tuple[float, float, float]:
    """Return the largest speed, acceleration and jerk of a sampled command."""
    v = np.diff(command) / dt
    a = np.diff(v) / dt
    return tuple(float(np.max(np.abs(q), initial=0.0)) for q in (v, a, np.diff(a) / dt))  # type: ignore[return-value]


def separate(
    rivals: list[AxisModel], envelope: Envelope, drive_noise: float, duration_s: float = DURATION_S
) -> Experiment | None:
    """Choose the command on which the rival models differ most, each pair counted by its worst.

    Returns:
        The experiment, or None without a controller to simulate.
    """
    if len(rivals) < 2 or rivals[0].controller is None:
        return None
    best: Experiment | None = None
    for lap in catalogue(rivals[0], envelope, duration_s):
        forces = [simulate(replace(m, start_position=envelope.centre), lap.command).force for m in rivals]
        apart = min(float(np.sqrt(np.mean((a - b) ** 2))) for i, a in enumerate(forces) for b in forces[i + 1 :])
        apart = apart / drive_noise if np.isfinite(apart) else 0.0
        if best is None or apart > best.separation:
            best = replace(lap, separation=apart)
    return best


def _list(shares: tuple[float, ...], speed: float) -> str:
    return ", ".join(f"{s * speed:.3g}" for s in shares)


def _move(distance: float, speed: float, e: Envelope, dt: float) -> Array:
    """Speeds of a straight move from rest to rest, shape (n,); they sum to the distance over dt."""
    d = abs(distance)
    top = min(speed, np.sqrt(d * e.acceleration))
    rise, n = top / e.acceleration, int(np.ceil((d / top + top / e.acceleration) / dt)) + 1
    t = np.arange(n) * dt
    v: Array = np.clip(np.minimum(t, d / top + rise - t) / max(rise, dt), 0.0, 1.0) * top
    return v * (distance / (np.sum(v) * dt))


def _shuttle(shares: tuple[float, ...], e: Envelope, dt: float, duration_s: float) -> Array:
    """Go out and back at several speeds, to either side in turn, as far as time and reach allow."""
    time = duration_s * (1.0 - 2.0 * REST) / len(shares)
    parts, side = [], 1.0
    for share in shares:
        s = share * e.speed
        there_s = 0.5 * time - s / e.acceleration
        times = max(int(np.ceil(s * there_s / e.reach)), 1)
        d = min(max(0.5 * time / times - s / e.acceleration, 0.25 * time / times) * s, e.reach)
        for _ in range(times):
            parts += [_move(side * d, s, e, dt), _move(-side * d, s, e, dt)]
            side = -side
    return _lap(np.concatenate(parts), e, dt, duration_s)


def _waves(e: Envelope, dt: float, duration_s: float) -> Array:
    """Speeds of a sum of sines, its second half at four tenths of the amplitude, from rest to rest."""
    t = np.arange(int(duration_s / dt)) * dt
    f = np.array([0.7, 1.3, 2.1, 3.4, 5.5, 8.9])
    x = np.sum(np.sin(2.0 * np.pi * f[:, None] * t[None, :]) / f[:, None], axis=0)
    rise, change, fall = (np.clip((t - at) / 0.25, 0.0, 1.0) for at in (0.0, 0.5 * t[-1], t[-1] - 0.25))
    x *= _step(rise) * (1.0 - 0.6 * _step(change)) * (1.0 - _step(fall))
    v, a, _ = demands(x, dt)
    x *= min(e.speed / v, e.acceleration / a, e.reach / float(np.max(np.abs(x))))
    out: Array = np.diff(x, prepend=0.0) / dt
    return out


def _step(share: Array) -> Array:
    """Go from 0 to 1 with no speed and no acceleration at the ends."""
    out: Array = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return out


def _lap(speeds: Array, e: Envelope, dt: float, duration_s: float) -> Array:
    """Integrate speeds to positions, averaged so that the jerk stays in its limit, with rest before and after."""
    width = max(int(np.ceil(max(2.0 * e.acceleration / e.jerk, SMOOTH_S) / dt)), 1)
    rest = np.zeros(max(round(REST * duration_s / dt), 1))
    padded = np.concatenate([rest, speeds, np.zeros(width), rest])
    smooth = np.convolve(padded, np.ones(width) / width)[: len(padded)]
    x = np.cumsum(smooth) * dt
    out: Array = e.centre + np.concatenate([x, np.full(max(int(duration_s / dt) - len(x), 0), x[-1])])
    return out
