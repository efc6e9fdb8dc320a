"""Run an axis model over records: closed loop or tracking.

The model's effects are packed into the rows that the kernel reads; nothing here depends on which effects exist.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from sioms.reconcile import kernel as k
from sioms.reconcile.effect import ROW, Array, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.jit import addresses
from sioms.reconcile.model import AxisModel, controller_row, plant_row
from sioms.reconcile.noise import Noise, Pair, corrections
from sioms.reconcile.records import Record

#: Corrections of an observer that follows nothing.
IDLE = (0.0,) * 8
#: A record begins in motion that at first makes more way than this share of the largest speed would. Its start is
#: fitted over so many periods of an elastic transmission, and samples.
MOVING, PERIODS, FEWEST = 0.01, 4.0, 40
#: Phase [rad] of the recorded motion that a step may take, and steps of a sample at most.
PHASE, MOST = 0.05, 32
#: Numbers of a start, and how many memories of an observer tell the speed in it.
START, MEMORIES = 7, 2.0


@dataclass(frozen=True, slots=True)
class Packed:
    """A model as the kernel reads it: its numbers, and per kind of state function the functions and their rows (n,
    ROW).
    """

    plant: Array
    functions: dict[Slot, Any]
    rows: dict[Slot, Array]
    substeps: int


@dataclass(frozen=True, slots=True)
class Run:
    """Result of one record; every array has shape (n,).

    Attributes:
        position: what the sensor would say (when closed, on the count lattice).
        force: command of the controller (when tracking, the recorded one).
        applied: mean force of the drive over each sample, at nominal force constant.
        innovation: measured - predicted position (tracking only).
        x, v: state; temperature: heat state; end_temperature: after the last sample.
    """

    position: Array
    force: Array
    applied: Array
    innovation: Array
    x: Array
    v: Array
    temperature: Array

    @property
    def end_temperature(self) -> float:
        """Heat state at the last sample."""
        return float(self.temperature[-1])


def pack(model: AxisModel, substeps: int = 0) -> Packed:
    """Pack a model for the kernel.

    Args:
        substeps: steps in a sample; 0 chooses by what the effects need.
    """
    plant = np.zeros(k.PLANT_SIZE)
    for place, value in vars(plant_row(model)).items():
        plant[getattr(k, place.upper())] = value
    effects = [(known()[name], given) for name, given in model.effects.items()]
    functions: dict[Slot, list[Any]] = {slot: [] for slot in Slot}
    rows: dict[Slot, list[Array]] = {slot: [] for slot in Slot}
    for effect, given in effects:
        if effect.slot is not None:
            rows[effect.slot].append(effect.row(effect.values(given), model.pitch))
            functions[effect.slot].append(effect.function)
    return Packed(
        plant,
        {s: addresses(f) for s, f in functions.items()},
        {s: np.array(r).reshape(-1, ROW) for s, r in rows.items()},
        substeps
        or max(
            _steps(max((e.mechanism.substeps for e, _ in effects), default=2), model.sample_time_s),
            _followed(model.swings_hz * model.sample_time_s),
        ),
    )


def inertia(packed: Packed) -> float:
    """Return the whole inertia, with what is added to that of the axis."""
    return float(packed.plant[k.INERTIA])


def linked(packed: Packed) -> Pair | None:
    """Return the two masses of a model in contact, if it has two."""
    row = packed.plant
    if row[k.LOAD] == 0.0:
        return None
    return Pair(*(float(row[i]) for i in (k.INERTIA, k.LOAD, k.STIFF, k.DAMP, k.VISCOUS)))


def _steps(most: int, sample_time_s: float) -> int:
    """Steps in a sample: as many as the fastest motion needs in a millisecond, at slow rates no more than at 1 kHz."""
    return min(most, math.ceil(most * sample_time_s / 1e-3 - 1e-9))


def _followed(periods: float) -> int:
    """Steps in a sample in which a motion makes so many periods: z of phase in a step make a spring z^2/12 stiffer."""
    return min(math.ceil(2.0 * math.pi * periods / PHASE), MOST)


def _march(
    p: Packed,
    closed: bool,
    command: Array,
    measured: Array,
    force: Array | None,
    external: Array,
    ctl: Array,
    gain: tuple[float, ...],
    start: Array,
    lost: float = np.inf,
) -> Run:
    nothing = np.zeros(len(command))
    out = np.zeros((len(command), k.OUT_SIZE))
    f, lv, g = Slot.FORCE, Slot.FRICTION, Slot.GAIN
    k.march(
        closed,
        command,
        measured,
        nothing if force is None else np.ascontiguousarray(force, dtype=np.float64),
        external,
        ctl,
        p.plant,
        p.functions[f],
        p.rows[f],
        p.functions[lv],
        p.rows[lv],
        p.functions[g],
        p.rows[g],
        np.array(gain),
        lost,
        start,
        p.substeps,
        out,
    )
    return Run(
        out[:, k.OUT_Y],
        out[:, k.OUT_FORCE],
        out[:, k.OUT_APPLIED],
        out[:, k.OUT_INNOVATION],
        out[:, k.OUT_X],
        out[:, k.OUT_V],
        out[:, k.OUT_T],
    )


def simulate(model: AxisModel, command: Array, temperature: float = 0.0, substeps: int = 0) -> Run:
    """Simulate the closed loop from rest at ``model.start_position``.

    Args:
        command: position command, shape (n,), [{x}].
        temperature: heat state at the start, dimensionless.

    Returns:
        The run; ``position`` lies on the count lattice.
    """
    command = np.ascontiguousarray(command, dtype=np.float64)
    start = np.array([model.start_position, 0.0, temperature, 0.0, 0.0, 0.0, 0.0])
    outer = _outer(len(command), None)
    return _march(pack(model, substeps), True, command, command, None, outer, controller_row(model), IDLE, start)


def _outer(count: int, external: Array | None, bends: Array | None = None) -> Array:
    """Lay a force beside the drive's out as the kernel reads it, shape (count, 3)."""
    out = np.zeros((count, 3))
    if external is not None:
        out[:, 0] = external
    if bends is not None:
        out[:, 1:] = bends
    return out


def replay(model: AxisModel, record: Record, temperature: float = 0.0) -> Run:
    """Simulate the closed loop over a record: its command, from where and as fast as it began, under the force of then.

    Raises:
        ValueError: the record has no command, or the model no controller.
    """
    if record.command is None:
        raise ValueError(f"simulate record {record.name}: it has no command; a closed loop needs one")
    command = np.ascontiguousarray(record.command, dtype=np.float64)
    p, y, added = pack(model), record.position, record.feedforward
    held = record.force[0] - (0.0 if added is None else added[0])
    start = np.array([_true_place(p.plant, y[0]), 0.0, temperature, command[0] - y[0], held, 0.0, 0.0])

    def run(at: Array, n: int) -> Run:
        force, outer = None if added is None else added[:n], _outer(len(command), record.external)[:n]
        return _march(p, True, command[:n], command[:n], force, outer, controller_row(model), IDLE, at)

    if _moves(y, model):
        n = _at_first(y, model.sample_time_s)
        moving = start.copy()
        moving[1] = _first_speed(y, model.sample_time_s) / p.plant[k.GAIN_Y]
        start = min((start, moving), key=lambda at: float(np.sum((run(at, n).position - y[:n]) ** 2)))
    return run(start, len(command))


def _true_place(plant: Array, y: float) -> float:
    """Where the axis is when its sensor reads ``y``."""
    turned = y / plant[k.GAIN_Y] * plant[k.TURN_X]
    error = plant[k.ECC_AMP] * np.sin(turned + plant[k.ECC_PHASE])
    error += plant[k.ERR_AMP] * np.sin(plant[k.ERR_N] * turned + plant[k.ERR_PHASE])
    return float((y - error) / plant[k.GAIN_Y])


def _first_speed(position: Array, dt: float) -> float:
    """Speed at the first sample of a record, which may begin in motion: of a parabola through the first 20 ms."""
    n = _at_first(position, dt)
    return float(_slope_weights(n) @ (position[:n] - position[0])) / dt if n > 2 else 0.0


def _moves(position: Array, model: AxisModel) -> bool:
    """Say whether a record begins in motion, or on its way into it."""
    n = _at_first(position, model.sample_time_s)
    return bool(np.ptp(position[:n]) > MOVING * model.max_speed * n * model.sample_time_s)


def _at_first(position: Array, dt: float) -> int:
    """Number of samples that the first 20 ms hold."""
    return min(max(8, round(0.02 / dt)), len(position))


@lru_cache(maxsize=16)
def _slope_weights(n: int) -> Array:
    """Weights of n samples in the slope at the first of them of the parabola that fits them best."""
    return np.asarray(np.linalg.pinv(np.vander(np.arange(n), 3))[1])


def _set_going(
    p: Packed,
    y: Array,
    force: Array,
    external: Array,
    gain: tuple[float, ...],
    start: Array,
    steps: Array,
    n: int,
) -> Array:
    """Start in motion with those numbers, of as many as there are small steps (k, len(start)), that leave least of the
    first n samples.
    """

    def innovation(at: Array) -> Array:
        return _march(p, False, y[:n], y[:n], force[:n], external[:n], np.zeros(k.CTL_SIZE), gain, at).innovation

    first = innovation(start)
    moved = np.stack([innovation(start + step) - first for step in steps], axis=1)
    if not np.all(np.isfinite(moved)):
        return start
    better: Array = start - steps.T @ np.linalg.lstsq(moved, first, rcond=1e-6)[0]
    after = innovation(better)
    return better if float(after @ after) < float(first @ first) else start


def _unknown_at_first(
    p: Packed, y: Array, noise: Noise, pair: Pair | None, model: AxisModel
) -> tuple[Array, int] | None:
    """Return small steps of what a record in motion does not tell of its start, and the samples that do; None where it
    tells all.

    Of two masses it is the speed, the wind-up and its rate, told by the first periods; of one the speed, where counts
    are too coarse to show it in 20 ms, told by as many samples as the observer remembers.
    """
    if not _moves(y, model):
        return None
    slow, dt = MOVING * model.max_speed, model.sample_time_s
    if pair is not None and p.plant[k.GAP] == 0.0:
        r, j = p.plant[k.LOAD], p.plant[k.INERTIA]
        turn = float(np.sqrt(p.plant[k.STIFF] / (j * r * (1.0 - r))))
        steps = np.zeros((3, START))
        steps[0, 1], steps[1, 5], steps[2, 6] = slow, slow / turn, slow
        return steps, min(len(y), max(FEWEST, int(PERIODS * 2.0 * np.pi / (turn * dt))))
    told = float(np.linalg.norm(_slope_weights(_at_first(y, dt)))) / dt * noise.sensor
    if pair is not None or told < slow:
        return None
    steps = np.zeros((1, START))
    steps[0, 1] = slow
    return steps, min(len(y), max(FEWEST, int(MEMORIES / noise.gain[0])))


def track(
    model: AxisModel,
    position: Array,
    force: Array,
    noise: Noise | None,
    temperature: float = 0.0,
    packed: Packed | None = None,
    lost: float = np.inf,
    external: Array | None = None,
    bends: Array | None = None,
) -> Run:
    """Drive the plant with a recorded force while an observer holds it on the recorded position.

    Args:
        position: measured, shape (n,), [{x}].
        force: command to the drive, shape (n,), held over each sample, [{F}].
        noise: for which the observer is made; None: nothing holds the plant.
        lost: innovation beyond which the model has lost the measurement and takes its speed from it, [{x}].
        external: force on the axis beside the drive's, shape (n,), [{F}]; None: none.
        bends: how the forces go within each sample, as of ``Record``.

    Returns:
        The run; ``innovation`` is what the model could not predict.
    """
    y, outer = np.ascontiguousarray(position, dtype=np.float64), _outer(len(position), external, bends)
    p = packed or pack(model)
    start = np.array(
        [
            _true_place(p.plant, y[0]),
            _first_speed(y, model.sample_time_s) / p.plant[k.GAIN_Y],
            temperature,
            *(0.0, force[0], 0.0, 0.0),  # a recorded force did not begin with its record
        ]
    )
    pair = linked(p)
    gain = IDLE if noise is None else corrections(noise, pair, model.sample_time_s)
    if noise is not None and (unknown := _unknown_at_first(p, y, noise, pair, model)) is not None:
        start = _set_going(p, y, force, outer, gain, start, *unknown)
    return _march(p, False, y, y, force, outer, np.zeros(k.CTL_SIZE), gain, start, lost)


def released(
    packed: Packed, force: Array, start: Array, external: Array | None = None, bends: Array | None = None
) -> Run:
    """Drive the plant with a recorded force while nothing holds it.

    Args:
        force: command to the drive, shape (n,), held over each sample, [{F}].
        start: as the time step reads it, shape (7,).
        external: force on the axis beside the drive's, shape (n,), [{F}]; None: none.
        bends: how the forces go within each sample, as of ``Record``.
    """
    still, outer = np.zeros(len(force)), _outer(len(force), external, bends)
    return _march(packed, False, still, still, force, outer, np.zeros(k.CTL_SIZE), IDLE, start)
