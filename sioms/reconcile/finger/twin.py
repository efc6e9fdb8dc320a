"""A finger as its model has it: what a simulated device answers in the place of the finger that the model was found
for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sioms.reconcile.finger.belief import Belief, outputs, scene_of
from sioms.reconcile.finger.model_file import from_table
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.sensors.effect import SensorModel


class FingerTwin:
    """Answers contacts by the same functions as the workflow, with every effect that is switched on.

    Drift with temperature and the load cell's scale have no part in it: it has neither. One caller at a time.

    Args:
        model: finger and effects.
        length_m: length of contact: N to N/m.
        noise: standard deviation of the outputs [%]; resolution: their step [%], 0 for none; seed: of the noise.
    """

    def __init__(
        self, model: SensorModel, length_m: float, noise: float = 0.0, resolution: float = 0.0, seed: int = 0
    ) -> None:
        self._belief: Belief = model.belief()
        self._length_m, self._noise, self._step = length_m, noise, resolution
        line = model.effects.get("mains_line")
        self._line = (float(line["a"][0]), float(line["f"][0])) if line else (0.0, 0.0)
        dead = model.effects.get("dead_element")
        self._dead = [int(dead["index"][0])] if dead else []
        self._random = np.random.default_rng(seed)
        self._late = np.zeros(len(self._belief.angle))
        self._time_s: float | None = None

    @property
    def count(self) -> int:
        """Number of elements."""
        return len(self._late)

    def mount(self, indenter_radius_m: float) -> None:
        """Tabulate an indenter, so that the first touch with it need not."""
        self._steady(1.0, float(self._belief.angle[0]), indenter_radius_m)

    def read(
        self, force: float, angle_rad: float, indenter_radius_m: float, out: Floats, time_s: float = 0.0
    ) -> Floats:
        """Fill out, shape of the elements, with the outputs [%] under a contact force [N] at a place [rad].

        Args:
            force: at most 0 is no contact.
            time_s: of this reading, for creep and the mains.
        """
        steady = self._steady(force, angle_rad, indenter_radius_m) if force > 0.0 else np.zeros(len(self._late))
        np.multiply(100.0, self._crept(steady, time_s), out=out)
        amplitude, frequency = self._line
        if amplitude:
            out += 100.0 * amplitude * math.sin(math.tau * frequency * time_s)
        if self._noise:
            out += self._noise * self._random.standard_normal(out.size)
        if self._step:
            np.multiply(np.round(out / self._step), self._step, out=out)
        out[self._dead] = 0.0
        return out

    def _steady(self, force: float, angle_rad: float, radius_m: float) -> Floats:
        touch = (np.array([v]) for v in (angle_rad, force / self._length_m, radius_m))
        found: Floats = outputs(self._belief, scene_of(*touch))[0]
        return found

    def _crept(self, steady: Floats, time_s: float) -> Floats:
        b = self._belief
        if not b.creep:
            return steady
        elapsed_s = 0.0 if self._time_s is None else max(time_s - self._time_s, 0.0)
        self._time_s = time_s
        self._late += -math.expm1(-elapsed_s / b.creep_time) * (steady - self._late)
        return steady + b.creep * (self._late - steady)


def twin(
    table: Mapping[str, Any], path: str, length_m: float, noise: float, resolution: float, seed: int
) -> FingerTwin:
    """Return the twin of the finger in a model file (the entry point ``finger`` of ``sioms.twins``); see
    ``FingerTwin``.

    Raises:
        ValueError: the file makes no sense.
    """
    return FingerTwin(from_table(table, path)[0], length_m, noise, resolution, seed)
