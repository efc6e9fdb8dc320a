"""A force/torque sensor as its model has it: what a simulated device reads in the place of the sensor the model was
found for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sioms.reconcile.force.belief import Floats, ForceBelief, Loads, Loops
from sioms.reconcile.force.effects import lagging
from sioms.reconcile.force.model_file import from_table
from sioms.reconcile.sensors.effect import SensorModel

_ONE = np.zeros(1, dtype=np.int64)


class ForceTwin:
    """Reads loads by the same functions as the workflow, with every effect that is switched on.

    What follows the temperature has no part in it: it has none. One caller at a time.

    Args:
        model: sensor and effects.
    """

    def __init__(self, model: SensorModel) -> None:
        self._belief: ForceBelief = model.belief()
        at_rest = np.zeros(model.count)
        self._loops = {
            i: Loops(p[model.count : -2], float(p[-2]), float(p[-1]), at_rest)
            for i, (response, p) in enumerate(self._belief.responses)
            if response is lagging
        }
        self._began_s: float | None = None

    def read(self, load: Floats, time_s: float) -> Floats:
        """Return the readings [N, N m] under a load [N, N m], shape (components,), at a time [s]; call it with rising
        times.
        """
        b = self._belief
        if self._began_s is None:
            self._began_s = time_s
        share = load / b.full
        row = Loads(share[None], np.array([time_s - self._began_s]), np.zeros(1), _ONE)
        out = row.load @ b.total.T
        for i, (response, p) in enumerate(b.responses):
            out = out + p[: len(share)] * self._loops[i].follow(row.load) if i in self._loops else response(out, row, p)
        return np.asarray(out[0] * b.full)


def twin(table: Mapping[str, Any], path: str, components: tuple[str, ...]) -> ForceTwin:
    """Return the twin of the sensor in a model file (the entry point ``force`` of ``sioms.twins``).

    Raises:
        ValueError: the file makes no sense, or is of a sensor with other components.
    """
    model, names = from_table(table, path)
    if names != components:
        raise ValueError(f"model_file {path}: of {', '.join(names)}; the sensor has {', '.join(components)}")
    return ForceTwin(model)
