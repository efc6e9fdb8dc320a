"""The record that would decide: a small catalogue of commands, and the one on which two models differ most."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.model import AxisModel
from sioms.reconcile.simulate import simulate

DURATION_S = 5.0


@dataclass(frozen=True, slots=True)
class Experiment:
    """A proposed record.

    Attributes:
        command: position command at the axis's sample time, [{x}].
        separation: root mean square difference of the rival models' forces over the drive noise.
    """

    name: str
    text: str
    command: Array
    separation: float


def catalogue(model: AxisModel, travel: float, duration_s: float = DURATION_S) -> Iterator[tuple[str, str, Array]]:
    """Yield (name, description, command) of experiments within the speed and travel of the axis.

    Args:
        travel: largest displacement from the start to either side, [{x}].
    """
    t = np.arange(int(duration_s / model.sample_time_s), dtype=np.float64) * model.sample_time_s
    unit, fast = model.position_unit, 0.6 * model.max_speed
    yield ("slow_reversals", f"reversals at {0.02 * fast:.3g}, {0.05 * fast:.3g} and {0.1 * fast:.3g} {unit}/s",
           _legs(t, [s * fast for s in (0.02, -0.02, 0.05, -0.05, 0.1, -0.1)], travel, model))
    yield ("cruises", f"cruises at {0.15 * fast:.3g} to {fast:.3g} {unit}/s, both ways",
           _legs(t, [s * fast for s in (0.15, -0.15, 0.35, -0.35, 0.65, -0.65, 1.0, -1.0)], travel, model))
    reach = min(1.05 * model.pitch, travel) if model.rotary else travel
    yield ("full_turn", f"slowly out to {reach:.3g} {unit} and back" + (", one full turn" if model.rotary else ""),
           0.5 * reach * (1.0 - np.cos(2.0 * np.pi * t / duration_s)))
    f = np.array([0.7, 1.3, 2.1, 3.4, 5.5, 8.9])
    swing = np.sum(np.sin(2.0 * np.pi * f[:, None] * t[None, :]) / f[:, None], axis=0)
    swing *= min(fast / np.max(np.abs(np.gradient(swing, model.sample_time_s))), 0.5 * travel / np.max(np.abs(swing)))
    yield "multi_sine", "sum of sines from 0.7 to 9 Hz", swing * np.minimum(t / 0.2, 1.0)


def _legs(t: Array, speeds: list[float], travel: float, model: AxisModel) -> Array:
    """Constant speeds one after the other, with limited acceleration and travel."""
    leg = t[-1] / len(speeds)
    v = np.array(speeds)[np.minimum((t / max(leg, 1e-9)).astype(int), len(speeds) - 1)]
    step = 0.5 * model.rated_force / model.inertia * model.sample_time_s
    smooth = np.empty_like(v)
    now = 0.0
    for i, goal in enumerate(v):
        now += float(np.clip(goal - now, -step, step))
        smooth[i] = now
    x = np.cumsum(smooth) * model.sample_time_s
    reach = float(np.max(np.abs(x)))
    return x * min(1.0, travel / reach) if reach > 0 else x


def separate(rivals: list[AxisModel], travel: float, drive_noise: float) -> Experiment | None:
    """Choose the command on which the rival models differ most, each pair counted by its worst.

    Returns:
        The experiment, or None without a controller to simulate.
    """
    if len(rivals) < 2 or rivals[0].controller is None:
        return None
    best: Experiment | None = None
    for name, text, command in catalogue(rivals[0], travel):
        forces = [simulate(m, command + m.start_position).force for m in rivals]
        apart = min(float(np.sqrt(np.mean((a - b) ** 2))) for i, a in enumerate(forces) for b in forces[i + 1 :])
        apart = apart / drive_noise if np.isfinite(apart) else 0.0
        if best is None or apart > best.separation:
            best = Experiment(name, text, command, apart)
    return best
