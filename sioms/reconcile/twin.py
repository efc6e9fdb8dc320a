"""The simulated twin of an axis: a model with its effects, as a plant that a simulated device steps.

The equations are those of the library, evaluated on arrays of axes; nothing is written twice. Effects with a state
function act as they stand, a user's own among them; those with a mechanism of their own (delay, two masses,
sensor errors) become the plant's effect of the same meaning. The plant has its own integration and its own servo,
so a twin that agrees with a recording says more than the simulation that was fitted to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sioms.plant.effects import Effect as PlantEffect
from sioms.plant.effects import build_effects
from sioms.plant.forces import Motion
from sioms.plant.foreign import Laws
from sioms.plant.parameters import Motor
from sioms.reconcile.effect import NONE, Array, Effect, Slot
from sioms.reconcile.effects import known
from sioms.reconcile.model import AxisModel, plant_row
from sioms.reconcile.model_file import parse_model

#: A hot drive keeps at least this share of its force constant, as in the time step of the workflow.
LEAST_GAIN = 0.05


class Heat:
    """Heat state of each axis and what it takes from the force: gain 1 - loss T, T' = ((u/rated)^2 - T)/tau.

    Axes without the effect stay cold. ``before`` is the force of the drive as commanded, which effects may depend on.
    """

    def __init__(self, loss: Array, tau_s: Array, rated_force: Array, tick_s: float) -> None:
        self._loss, self._rated = loss, rated_force
        self._keep = np.exp(-tick_s / tau_s)
        self.temperature, self.before = np.zeros((2, loss.size))

    def apply(self, force: Array) -> None:
        """Warm up by this tick's force, then weaken it."""
        np.copyto(self.before, force)
        heat = (force / self._rated) ** 2
        self.temperature = np.where(self._loss > 0.0, heat + (self.temperature - heat) * self._keep, 0.0)
        force *= np.maximum(1.0 - self._loss * self.temperature, LEAST_GAIN)


class Acting:
    """One effect of the library on those axes of a bank whose models have it.

    Args:
        axes: which, shape (k,).
        rows: their parameters as a state function reads them, shape (ROW, k).
    """

    def __init__(self, effect: Effect, axes: Sequence[int], rows: Sequence[Array], heat: Heat) -> None:
        self._effect, self._heat = effect, heat
        self._axes = np.array(axes)
        self._rows = np.stack(rows, axis=1)

    def add(self, motion: Motion, total: Array) -> None:
        """Add the force, or the level of friction, or what the gain adds to the force of the drive."""
        at, heat = self._axes, self._heat
        state = motion.position[at], motion.velocity[at], heat.before[at], heat.temperature[at]
        value = self._effect.evaluate(*state, self._rows)
        if self._effect.slot is Slot.GAIN:
            value = motion.drive[at] * (value - 1.0)
        elif self._effect.slot is Slot.FRICTION:
            value = np.maximum(value, 0.0)
        total[at] += value


def twins(
    models: Mapping[int, AxisModel], motors: Sequence[Motor], names: Sequence[str], tick_s: float
) -> tuple[list[Motor], tuple[PlantEffect, ...], Laws]:
    """Turn the models of some axes of a bank into what the plant is built of.

    Args:
        models: by the number of the motor in the bank.
        motors: as configured; stops, switches, wall, start and the limit of the drive stay theirs.
        names: of the axes, for messages.

    Returns:
        The motors, the plant's effects, and the laws from the library.

    Raises:
        ValueError: an effect that no plant can carry out, or a number out of the plant's range.
    """
    made = [_motor(models[i], m) if i in models else m for i, m in enumerate(motors)]
    table: dict[str, dict[str, object]] = {}
    acting: dict[str, list[tuple[int, Array]]] = {}
    for i, model in models.items():
        for name, values in model.effects.items():
            effect = known()[name]
            if effect.mechanism is not NONE:
                if effect.mechanism.twin is None:
                    raise ValueError(
                        f"simulate {name} of {model.name}: a plant cannot carry it out; "
                        "switch the effect off in the model file"
                    )
                table.setdefault(names[i], {}).update(effect.mechanism.twin(effect.values(values), model.pitch))
            if effect.slot is not None:
                acting.setdefault(name, []).append((i, effect.row(effect.values(values), model.pitch)))
    heat = _heat(models, len(motors), tick_s)
    forces = {n: Acting(known()[n], [i for i, _ in a], [r for _, r in a], heat) for n, a in acting.items()}
    levels = tuple(f for n, f in forces.items() if known()[n].slot is Slot.FRICTION)
    others = tuple(f for n, f in forces.items() if known()[n].slot is not Slot.FRICTION)
    return made, build_effects(table, names, "the model"), Laws((heat,), others, levels)


def _motor(model: AxisModel, motor: Motor) -> Motor:
    """Give a motor the body of the model; its friction is the model's effects and nothing else."""
    return replace(
        motor,
        mass=plant_row(model).inertia,
        viscous=model.viscous,
        coulomb=0.0,
        stiction=None,
        load_force=0.0,
        encoder_step=model.resolution,
        index_pitch=model.pitch,
    )


def _heat(models: Mapping[int, AxisModel], count: int, tick_s: float) -> Heat:
    loss, tau, rated = np.zeros(count), np.ones(count), np.ones(count)
    for i, model in models.items():
        row = plant_row(model)
        loss[i], tau[i], rated[i] = getattr(row, "loss", 0.0), row.tau_t, row.rated
    return Heat(loss, tau, rated, tick_s)


def from_files(
    files: Mapping[int, tuple[str, str]],
    motors: Sequence[Motor],
    axes: Sequence[tuple[str, str]],
    tick_s: float,
) -> tuple[list[Motor], tuple[PlantEffect, ...], Laws]:
    """Turn model files into what the plant is built of: see ``sioms.plant.foreign.TwinAxes``."""
    models = {i: parse_model(text, path) for i, (path, text) in files.items()}
    for i, model in models.items():
        name, unit = axes[i]
        if model.imposed:
            raise ValueError(f"model_file {files[i][0]}: imposed = true, of a rig; want the model of an axis")
        if model.rotary != (unit == "rad"):
            kind = "rotary" if model.rotary else "linear"
            raise ValueError(f"model_file {files[i][0]}: of a {kind} axis; {name} is in {unit}")
    return twins(models, motors, [name for name, _ in axes], tick_s)
